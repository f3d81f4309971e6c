"""Optimises Gaussians against photos and masks (OpenSplat3D §3), with one rendered view per gradient step.

    L = L_RGB + λ_inst2d L_inst2d + λ_var L_var                                                                (eq. 14)

and λ_depth L_depth where a sensor measured depth. Depth by stereo only starts the Gaussians: held to it, they fit less.

All schedules are functions of progress in [0, 1], the larger of the shares of iterations done and of time spent. A time
limit thus shortens every phase instead of cutting off the end. Random numbers depend on (seed, iteration) only, so a
run resumed from a checkpoint takes the same steps as one without interruption.
"""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Protocol

import numpy as np
import torch

from perception.errors import InputError
from perception.gaussians import schedule
from perception.gaussians.losses import depth_loss, instance_loss, photometric, variance_loss
from perception.gaussians.model import STORED
from perception.gaussians.state import TrainingState, TrainRecord
from perception.gaussians.views import TrainingView, target_photo
from perception.interrupts import uninterrupted
from perception.machine import torch_on_one_thread
from perception.rasterizer.rasterize import rasterizer_for
from perception.rasterizer.types import Cotangents, Forward, Gradients, Settings

SSIM_WEIGHT = 0.2  # β of the photometric loss (eq. 4), as in Kerbl et al. 2023
_LEAST_RECORDS = 1 << 18  # gradient records that a GPU must have room for at once (see `Settings.max_records`)
INSTANCE_WEIGHT = 0.1  # λ_inst2d of eq. 14; w_p = w_n = 1 in eq. 9


class Observer(Protocol):
    """Interface for following a training run, for progress bars and checkpoints."""

    def after_step(self, trainer: Trainer, loss: float) -> None:
        """Called after every iteration, when the schedule has been applied."""

    def after_leg(self, trainer: Trainer) -> None:
        """Called when `Trainer.run` returns or is interrupted; not when a step failed."""


class Trainer(TrainingState):
    """Takes the steps of a training on its own state, and between them those of the schedule."""

    _max_records = 0  # see `Settings`

    def run(self, observer: Observer | None = None, until: float = 1.0) -> TrainRecord:
        """Trains until progress `until`. Early stopping is allowed only with until = 1."""
        self._since = time.monotonic()
        intact = True  # what a failed step left is no state to resume from
        try:
            with torch_on_one_thread():
                while (progress := self.progress) < until:
                    with uninterrupted():
                        intact = self.complete = False
                        try:
                            loss = self.step(progress)
                        except RuntimeError as error:
                            self._recover(error)
                            continue
                        schedule.after_step(self, progress, may_stop=until >= 1.0)
                        intact = True
                    if observer is not None:
                        observer.after_step(self, loss)
                if until >= 1.0 and not self.complete:
                    with uninterrupted():
                        intact = False
                        schedule.finish(self)
                        self.complete = intact = True
        finally:
            self.record.seconds, self.record.iterations = self.elapsed, self.iteration
            self._since = None
            if observer is not None and intact:
                observer.after_leg(self)
        return self.record

    def _recover(self, error: RuntimeError) -> None:
        """After a step that failed, before Adam, so that nothing has changed: fewer gradient records at once where a
        GPU's memory was full. InputError when the fewest do not fit, or for another failure of a GPU."""
        if self.device.type == "cpu":
            raise error
        if not isinstance(error, torch.OutOfMemoryError):
            failed = f"{self.device}: failed at iteration {self.iteration} ({str(error).splitlines()[0]})"
            raise InputError(f"{failed}; continue from the checkpoint with --resume --device cpu") from error
        self._max_records = (self._max_records or 1 << 24) // 4
        if self._max_records < _LEAST_RECORDS:
            full = f"{self.device}: its memory is full with {len(self.gaussians)} Gaussians"
            raise InputError(f"{full}; use a smaller --budget or --max-side, or --device cpu") from error
        torch.cuda.empty_cache()
        self.record.decisions.append(f"memory: at most {self._max_records} gradient records at once")

    def step(self, progress: float) -> float:
        """One iteration: renders a view, computes the loss and its gradient, takes an Adam step. Returns the loss."""
        chosen, with_features = schedule.next_view(self, progress)
        view = self.on_device(chosen)
        height, width = view.photo.shape[:2]
        settings = Settings(
            width,
            height,
            sh_degree=self.gaussians.sh_degree,
            eps2d=view.eps2d,
            variance=with_features,
            depth=view.depth is not None,
            max_records=self._max_records,
        )
        rasterizer = rasterizer_for(self.device)
        with self.record.timed("rasterizer forward"):
            features = self.gaussians.features if with_features else None
            inputs = self.gaussians.inputs(
                view.camera_from_world, view.K, features, harmonics=True, background=self._background()
            )
            out = rasterizer.rasterize_forward(inputs, settings)  # I (eq. 3), F (eq. 5) and Var F (eq. 12)
        with self.record.timed("losses"):
            loss, cotangents = self._losses(view, out)
        with self.record.timed("rasterizer backward"):
            gradients = self.gradients if with_features else replace(self.gradients, features=None)
            rasterizer.rasterize_backward(inputs, settings, out, cotangents, gradients, stored=True)
        with self.record.timed("Adam"):
            self._update(progress, gradients, out.visible[0])
        if schedule.grows_at(self, progress):
            with self.record.timed("densification"):
                self.statistics.add(getattr(gradients, self.growing_by)[0], out.visible[0], max(height, width))
        self.record.pairs += out.frames.contributing
        self.iteration += 1
        return float(loss)

    def _background(self) -> torch.Tensor:
        """[1, 3], a random colour, so that an empty region cannot fit the photo."""
        rng = np.random.default_rng([self.config.seed, self.iteration, 1])
        return torch.from_numpy(rng.random((1, 3), dtype=np.float32))

    def _update(self, progress: float, gradients: Gradients, visible: torch.Tensor) -> None:
        """One step of Adam, for the visible Gaussians."""
        coefficients = self.gaussians.sh.shape[1]
        rates = schedule.learning_rates(progress, self.extent, coefficients, self.config.train.iterations)
        by_name = {stored: getattr(gradients, name) for name, stored in STORED.items()}
        if self.held:  # a row of zero gradients and moments stays as it is
            for name, gradient in by_name.items():
                if gradient is not None:
                    gradient[: self.held][self.fixed if name == "sh" else ...] = 0
        self.record.skipped_gradients += int(self.optimiser.step(rates, by_name, visible))

    def _losses(self, view: TrainingView, out: Forward) -> tuple[float, Cotangents]:
        """L (eq. 14) and its gradients with respect to the images."""
        losses, image = self.config.losses, view.exposed(out.colors[0])
        rgb = photometric(image, target_photo(view, image), SSIM_WEIGHT, view.weight)  # L_RGB, eq. 4
        total, colors = rgb.value, view.exposed(rgb.gradient)[None]
        alphas = depths = features = variance = None
        if view.depth is not None and out.depths is not None:
            value, depths, alphas = depth_loss(out.depths[0], out.alphas[0], view.depth)
            total += losses.depth_weight * value
            depths, alphas = losses.depth_weight * depths[None], losses.depth_weight * alphas[None]
        if out.features is not None and out.feature_variance is not None:
            weight = 1.0 if view.weight is None else view.weight[..., None]
            spread = out.feature_variance[0] if view.weight is None else out.feature_variance[0] * weight
            value, variance = variance_loss(spread, losses.variance_weight)  # λ_var L_var, eq. 13
            total, variance = total + value, (variance if view.weight is None else variance * weight)[None]
            if (labels := self.assigned(view)) is not None:
                w = INSTANCE_WEIGHT
                inst = instance_loss(out.features[0], labels, margin=losses.margin, w_pos=w, w_neg=w)  # eqs. 6 to 9
                total, features = total + inst.value, inst.gradient[None]
        return total, Cotangents(colors, alphas, depths, features, variance)
