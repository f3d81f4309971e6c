"""Training runs that end in Ctrl-C at a given iteration."""

from __future__ import annotations

from collections.abc import Callable

from perception.gaussians.train import Trainer
from perception.pipeline import checkpoint


def interrupt_at(iteration: int) -> Callable[..., None]:
    """`TrainingObserver.after_step` that does its work, and at `iteration` is interrupted."""
    original = checkpoint.TrainingObserver.after_step

    def after_step(self: checkpoint.TrainingObserver, trainer: Trainer, loss: float) -> None:
        original(self, trainer, loss)
        if trainer.iteration == iteration:
            raise KeyboardInterrupt

    return after_step
