"""Optimises Gaussians against photos and masks (OpenSplat3D §3), with one rendered view per gradient step.

    L = L_RGB + λ_inst2d L_inst2d + λ_var L_var                                                                (eq. 14)

and λ_depth L_depth where a sensor measured depth.

All schedules are functions of progress in [0, 1], the larger of the shares of iterations done and of time spent. A time
limit thus shortens every phase instead of cutting off the end. Random numbers depend on (seed, iteration) only, so a
run resumed from a checkpoint takes the same steps as one without interruption.
"""

from __future__ import annotations

import time
from dataclasses import asdict
from typing import Any, Protocol

import numpy as np
import torch

from perception.config import MapConfig
from perception.gaussians.densify import Statistics
from perception.gaussians.losses import depth_loss, instance_loss, photometric, variance_loss
from perception.gaussians.model import Gaussians, sigmoid
from perception.gaussians.optimiser import SparseAdam
from perception.gaussians.rasterize import Rasterization, rasterize, torch_on_one_thread
from perception.gaussians.rates import learning_rates
from perception.gaussians.record import TrainRecord
from perception.gaussians.schedule import Schedule
from perception.gaussians.views import TrainingView, depth_image, psnr, render_view, scene_extent, target_photo
from perception.interrupts import uninterrupted

__all__ = ["TrainRecord", "Trainer", "TrainingView", "depth_image", "psnr", "render_view", "scene_extent"]

SSIM_WEIGHT = 0.2
"""β of the photometric loss (eq. 4), as in Kerbl et al. 2023."""
INSTANCE_WEIGHT = 0.1
"""λ_inst2d of eq. 14; w_p = w_n = 1 in eq. 9."""


class Observer(Protocol):
    """Interface for following a training run, for progress bars and checkpoints."""

    def after_step(self, trainer: Trainer, loss: float) -> None:
        """Called after every iteration, when the schedule has been applied."""

    def after_leg(self, trainer: Trainer) -> None:
        """Called when `Trainer.run` returns or is interrupted; not when a step failed."""


class Trainer:
    """All state of one optimisation; `state` exports it for a checkpoint, and `load` restores it."""

    def __init__(
        self, gaussians: Gaussians, views: list[TrainingView], config: MapConfig, held_out: list[TrainingView]
    ):
        self.config = config
        self.held_out = held_out
        self.extent = scene_extent(views)
        self.record = TrainRecord()
        self.iteration = 0
        self.complete = False  # finished, unless a longer training is requested
        self.skipped = 0.0  # share of training progress skipped by early stopping
        self.initial_count = len(gaussians)
        self.gaussians = gaussians
        self.statistics = Statistics.zeros(len(gaussians))
        self.optimiser = SparseAdam(vars(gaussians), self._rates(0.0))
        self.schedule = Schedule(self)
        self.show(views)
        self._since: float | None = None  # time.monotonic() at the start of `run`, None outside

    def show(self, views: list[TrainingView]) -> None:
        """Sets the training views: the same photos as before, possibly with labels added."""
        self.views, self.coarse = views, [view.halved() for view in views]
        self.has_labels = any(view.labels is not None and bool((view.labels > 0).any()) for view in views)

    def run(self, observer: Observer | None = None, until: float = 1.0) -> TrainRecord:
        """Trains until progress `until`. Early stopping is allowed only with until = 1."""
        self._since = time.monotonic()
        whole = True  # what a failed step left is no state to resume from
        try:
            with torch_on_one_thread():
                while (progress := self.progress) < until:
                    with uninterrupted():
                        whole = False
                        self.complete = False
                        loss = self.step(progress)
                        self.schedule.after_step(progress, may_stop=until >= 1.0)
                        whole = True
                    if observer is not None:
                        observer.after_step(self, loss)
                if until >= 1.0 and not self.complete:
                    with uninterrupted():
                        whole = False
                        self.schedule.finish()
                        self.complete = whole = True
        finally:
            self.record.seconds, self.record.iterations = self.elapsed, self.iteration
            self._since = None
            if observer is not None and whole:
                observer.after_leg(self)
        return self.record

    # -------------------------------------------------------------------- step

    def step(self, progress: float) -> float:
        """One iteration: renders a view, computes the loss and its gradient, takes an Adam step. Returns the loss."""
        view, with_features = self.schedule.next_view(progress)
        params = {name: tensor.detach().requires_grad_() for name, tensor in vars(self.gaussians).items()}
        with self.record.timed("rasterizer forward"):
            out = self._render(params, view, with_features)  # I (eq. 3), F (eq. 5) and Var F (eq. 12)
        with self.record.timed("losses"):
            image = view.exposed(out.colors[0])
            photo = target_photo(view, image)
            loss = photometric(image, photo, SSIM_WEIGHT, view.weight).value  # L_RGB, eq. 4
            if with_features:
                loss = loss + self._feature_losses(view, out)
            images = [image for image in (out.colors, out.features, out.feature_variance) if image is not None]
            if view.depth is not None:
                loss = loss + self.config.losses.depth_weight * depth_loss(out.depths[0], out.alphas[0], view.depth)
                images += [out.depths, out.alphas]
            cotangents = torch.autograd.grad(loss, images, allow_unused=True)
        with self.record.timed("rasterizer backward"):
            used = [(image, grad) for image, grad in zip(images, cotangents, strict=True) if grad is not None]
            torch.autograd.backward([image for image, _ in used], [grad for _, grad in used])
        with self.record.timed("Adam"):
            gradients = {name: tensor.grad for name, tensor in params.items() if tensor.grad is not None}
            self.optimiser.rates = self._rates(progress)
            self.record.skipped_gradients += sum(self.optimiser.step(out.visible[0], gradients).skipped.values())
        if self.schedule.grows_at(progress) and out.stats.mean2d_grad is not None:
            with self.record.timed("densification"):
                long_side = max(view.photo.shape[:2])
                self.statistics.add(out.stats.mean2d_grad[0], out.stats.radii[0], out.visible[0], long_side)
        self.record.pairs += out.stats.contributing_pairs
        self.record.evaluated_pairs += out.stats.evaluated_pairs
        self.iteration += 1
        return float(loss.detach())

    def _render(self, params: dict[str, torch.Tensor], view: TrainingView, with_features: bool) -> Rasterization:
        """Renders the view on a random background colour, so that an empty region cannot fit the photo."""
        height, width = view.photo.shape[:2]
        colors = np.random.default_rng([self.config.seed, self.iteration, 1]).random(3, dtype=np.float32)
        return rasterize(
            params["means"],
            params["quats"],
            params["log_scales"].exp(),
            sigmoid(params["opacity_logits"]),
            params["sh"],
            view.camera_from_world[None],
            view.K[None],
            width,
            height,
            sh_degree=self.gaussians.sh_degree,
            features=params["features"] if with_features else None,
            background=torch.from_numpy(colors),
            depth=view.depth is not None,
            eps2d=view.eps2d,
        )

    def _feature_losses(self, view: TrainingView, out: Rasterization) -> torch.Tensor:
        """λ_var L_var (eq. 13) + λ_inst2d L_inst2d (eqs. 6 to 9)."""
        losses = self.config.losses
        assert out.features is not None and out.feature_variance is not None
        variance = out.feature_variance[0] if view.weight is None else out.feature_variance[0] * view.weight[..., None]
        total = losses.variance_weight * variance_loss(variance, losses.variance_form)
        if view.labels is None:
            return total
        return total + INSTANCE_WEIGHT * instance_loss(out.features[0], view.labels, margin=losses.margin).value

    def _rates(self, progress: float) -> dict[str, float | torch.Tensor]:
        return learning_rates(progress, self.extent, self.gaussians.sh.shape[1])

    # ---------------------------------------------------------------- progress

    @property
    def elapsed(self) -> float:
        """Seconds of training, including those before a resume, without the time between two calls of `run`."""
        return self.record.seconds + (0.0 if self._since is None else time.monotonic() - self._since)

    @property
    def progress(self) -> float:
        share = self.iteration / self.config.train.iterations + self.skipped
        limit = self.config.train.time_limit
        return min(1.0, share if limit is None else max(share, self.elapsed / limit))

    @property
    def expected_iterations(self) -> int:
        """Estimate of the total number of iterations of the run."""
        share = self.iteration / self.config.train.iterations + self.skipped
        if self.progress > share:  # the time limit determines progress
            return max(self.iteration, round(self.iteration / max(self.progress, 1e-6)))
        return round(self.iteration + (1 - self.progress) * self.config.train.iterations)

    def skip(self, share: float) -> None:
        """Skips `share` of training progress."""
        self.skipped += share

    # ------------------------------------------------------------------- model

    def keep(self, rows: torch.Tensor) -> None:
        """Keeps the Gaussians that `rows` [M] int64 selects, with their Adam moments."""
        self.optimiser.keep(rows)
        self._sync()

    def append(self, born: Gaussians) -> None:
        """Adds Gaussians with zero Adam moments."""
        self.optimiser.append(vars(born))
        self._sync()

    def set_degree(self, degree: int) -> None:
        """Truncates the spherical harmonics to `degree`, or adds zero coefficients up to it."""
        state, count = self.optimiser.state_dict(), (degree + 1) ** 2
        for table in ("params", "first", "second"):
            sh = state[table]["sh"]
            more = torch.zeros(len(sh), max(0, count - sh.shape[1]), 3)
            state[table]["sh"] = torch.cat([sh[:, :count], more], dim=1)
        self._restart_optimiser(state)

    @torch.no_grad()
    def depth(self, name: str) -> np.ndarray:
        """Depth [H, W] float32 along the optical axis of training view `name`, 0 = no surface.

        It is what a sensor measured, and rendered where nothing was.
        """
        view = next(view for view in self.views if view.name == name)
        rendered = depth_image(self.gaussians, view.camera_from_world, view.K, *view.photo.shape[1::-1])
        return (rendered if view.depth is None else torch.where(view.depth > 0, view.depth, rendered)).numpy()

    def _restart_optimiser(self, state: dict[str, Any]) -> None:
        self.gaussians = Gaussians(**state["params"])
        self.optimiser = SparseAdam(vars(self.gaussians), self._rates(0.0))
        self.optimiser.load_state_dict(state)
        self._sync()

    def _sync(self) -> None:
        """Makes `gaussians` share the optimiser's tensors, which are replaced when rows are added or removed."""
        self.gaussians = Gaussians(**{name: tensor.detach() for name, tensor in self.optimiser.params.items()})

    # -------------------------------------------------------------- checkpoint

    def state(self) -> dict[str, Any]:
        """All values needed to resume, for a checkpoint."""
        return {
            "iteration": self.iteration,
            "initial_count": self.initial_count,
            "optimiser": self.optimiser.state_dict(),
            "statistics": vars(self.statistics),
            "record": dict(vars(self.record), seconds=self.elapsed, iterations=self.iteration),
            "stopping": asdict(self.schedule.stopping),
            "skipped": self.skipped,
            "complete": self.complete,
        }

    def load(self, state: dict[str, Any]) -> None:
        """Restores the result of `state`."""
        self._restart_optimiser(state["optimiser"])
        self.statistics = Statistics(**state["statistics"])
        self.record = TrainRecord(**state["record"])
        self.iteration, self.initial_count = state["iteration"], state["initial_count"]
        vars(self.schedule.stopping).update(state["stopping"])
        self.skipped, self.complete = state["skipped"], state["complete"]
