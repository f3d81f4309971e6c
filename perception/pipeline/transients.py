"""Leaves what moved between photos out of training; the masks are kept for a resumed run."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from perception.gaussians.train import Observer, Trainer
from perception.gaussians.transients import START, transient_masks, without_transients
from perception.gaussians.views import TrainingView
from perception.io.arrays import read_npz
from perception.io.atomic import atomic_file
from perception.progress import Progress


def train_without_transients(
    trainer: Trainer, views: list[TrainingView], observer: Observer, file: Path, progress: Progress
) -> list[TrainingView]:
    """Trains until START, and returns the views without what disagrees with the other photos then.

    file: holds the masks, and is read instead when it exists, so that a resumed run takes the same steps.
    """
    if trainer.progress < START:
        trainer.run(observer, until=START)
    if file.is_file():
        stored = read_npz(file, file, "it is damaged; delete the work folder to start over")
        masks = [stored[f"{index}"] for index in range(len(views))]
    else:
        masks = transient_masks(trainer.gaussians, views)
        with atomic_file(file) as aside, aside.open("wb") as stream:
            np.savez_compressed(stream, **{f"{index}": mask for index, mask in enumerate(masks)})  # type: ignore[arg-type]
    photos, share = sum(bool(mask.any()) for mask in masks), float(np.mean([mask.mean() for mask in masks]))
    progress.log(f"moved between photos: {share:.1%} of the pixels, in {photos} of {len(views)} photos, are left out")
    views = [without_transients(view, mask) for view, mask in zip(views, masks, strict=True)]
    trainer.show(views)
    return views
