"""Optimises Gaussians against photos and masks (OpenSplat3D §3), with one rendered view per gradient step.

    L = L_RGB + λ_inst2d L_inst2d + λ_var L_var                                                                (eq. 14)

and λ_depth L_depth where a sensor measured depth.

All schedules are functions of progress in [0, 1], the larger of the shares of iterations done and of time spent. A time
limit thus shortens every phase instead of cutting off the end. Random numbers depend on (seed, iteration) only, so a
run resumed from a checkpoint takes the same steps as one without interruption.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass, field
from typing import Any, Protocol

import numpy as np
import torch

from perception.config import MapConfig
from perception.errors import InputError
from perception.gaussians.densify import Statistics
from perception.gaussians.losses import (
    LabelAssignment,
    assign_labels,
    depth_loss,
    instance_loss,
    photometric,
    variance_loss,
)
from perception.gaussians.model import Gaussians
from perception.gaussians.optimiser import SparseAdam
from perception.gaussians.rasterize import Forward, Settings, passes
from perception.gaussians.rates import learning_rates
from perception.gaussians.schedule import Schedule
from perception.gaussians.size import sized
from perception.gaussians.views import TrainingView, scene_extent, target_photo
from perception.interrupts import uninterrupted
from perception.machine import torch_on_one_thread
from perception.progress import timed

__all__ = ["TrainRecord", "Trainer", "TrainingView", "scene_extent"]

SSIM_WEIGHT = 0.2
"""β of the photometric loss (eq. 4), as in Kerbl et al. 2023."""
_LEAST_RECORDS = 1 << 18
"""Gradient records that a GPU must have room for at once (see `Settings.max_records`)."""
INSTANCE_WEIGHT = 0.1
"""λ_inst2d of eq. 14; w_p = w_n = 1 in eq. 9."""


@dataclass
class TrainRecord:
    """JSON-able. profile: wall-clock seconds by part.

    pairs: (Gaussian, pixel) pairs of all training steps that contributed.
    """

    curve: list[dict[str, float]] = field(default_factory=list)
    decisions: list[str] = field(default_factory=list)
    profile: dict[str, float] = field(default_factory=dict)
    pairs: int = 0
    seconds: float = 0.0
    iterations: int = 0
    skipped_gradients: int = 0

    @staticmethod
    def joined(records: Sequence[TrainRecord]) -> TrainRecord:
        """The record of a model that was trained in blocks: sums, and the decisions of each; it has no curve."""
        whole = TrainRecord()
        for number, record in enumerate(records, start=1):
            whole.decisions += [f"block {number}: {told}" for told in record.decisions]
            whole.profile = {part: whole.profile.get(part, 0.0) + s for part, s in record.profile.items()}
            for name in ("pairs", "seconds", "iterations", "skipped_gradients"):
                setattr(whole, name, getattr(whole, name) + getattr(record, name))
        return whole

    def timed(self, part: str) -> AbstractContextManager[None]:
        """Adds the wall-clock seconds of its block to `part` of the profile. A nested block counts in both parts."""
        return timed(self.profile, part)


class Observer(Protocol):
    """Interface for following a training run, for progress bars and checkpoints."""

    def after_step(self, trainer: Trainer, loss: float) -> None:
        """Called after every iteration, when the schedule has been applied."""

    def after_leg(self, trainer: Trainer) -> None:
        """Called when `Trainer.run` returns or is interrupted; not when a step failed."""


class Trainer:
    """All state of one optimisation; `state` exports it for a checkpoint, and `load` restores it.

    gaussians, views, held_out: on the CPU. Gaussians, optimiser and training views are then kept on `device`. box:
    [2, 3] corners of the space that matters, in which most Gaussians are added; None: all.
    """

    def __init__(
        self,
        gaussians: Gaussians,
        views: list[TrainingView],
        config: MapConfig,
        held_out: list[TrainingView],
        device: torch.device | None = None,
        box: np.ndarray | None = None,
    ):
        self.config = sized(config, len(views))
        self.device = device or torch.device("cpu")
        self._forward, self._backward = passes(self.device)
        self._max_records = 0
        self.held_out = held_out
        self.box = None if box is None else torch.tensor(box, dtype=torch.float32, device=self.device)
        self.extent = scene_extent(views)
        self.record = TrainRecord()
        self.iteration = 0
        self.complete = False  # finished, unless a longer training is requested
        self.skipped = 0.0  # share of training progress skipped by early stopping
        self.initial_count = len(gaussians)
        self.gaussians = gaussians.to(self.device)
        self.statistics = Statistics.zeros(len(gaussians), self.device)
        self.optimiser = SparseAdam(vars(self.gaussians), self._rates(0.0))
        self._sync()
        self.schedule = Schedule(self)
        self.show(views)
        self._since: float | None = None  # time.monotonic() at the start of `run`, None outside

    def show(self, views: list[TrainingView]) -> None:
        """Sets the training views: the same photos as before, possibly with labels added."""
        self.views, self.coarse = views, [view.halved().stored() for view in views]
        self._placed: dict[tuple[str, int], TrainingView] = {}  # those seen so far, on the device
        self._assigned: dict[str, LabelAssignment] = {}  # of the views seen so far
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
                        try:
                            loss = self.step(progress)
                        except RuntimeError as error:
                            self._recover(error)
                            continue
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

    # -------------------------------------------------------------------- step

    def step(self, progress: float) -> float:
        """One iteration: renders a view, computes the loss and its gradient, takes an Adam step. Returns the loss."""
        chosen, with_features = self.schedule.next_view(progress)
        view = self._on_device(chosen)
        height, width = view.photo.shape[:2]
        g, measured = self.gaussians, view.depth is not None
        settings = Settings(
            width, height, g.sh_degree, eps2d=view.eps2d, variance=with_features, depth=measured,
            max_records=self._max_records,
        )  # fmt: skip
        # On a random background colour, so that an empty region cannot fit the photo.
        colors = np.random.default_rng([self.config.seed, self.iteration, 1]).random((1, 3), dtype=np.float32)
        background = torch.from_numpy(colors).to(self.device)
        with self.record.timed("rasterizer forward"):
            cameras = (view.camera_from_world[None], view.K[None])
            features = g.features if with_features else None
            inputs = (g.means, g.quats, g.scales, g.opacities, g.sh, features, *cameras)
            out = self._forward(inputs, background, settings)  # I (eq. 3), F (eq. 5) and Var F (eq. 12)
        with self.record.timed("losses"):
            loss, cotangents = self._losses(view, out)
        with self.record.timed("rasterizer backward"):
            gradients = {
                name: buffer for name, buffer in self._gradients.items() if with_features or name != "features"
            }
            stored = [gradients.get(name) for name in (*vars(g), "viewmats", "mean2d")]
            self._backward(inputs, background, settings, out, cotangents, (), stored)
        with self.record.timed("Adam"):
            self.optimiser.rates = self._rates(progress)
            self.record.skipped_gradients += int(sum(self.optimiser.step(out.visible[0], gradients).values()))
        if self.schedule.grows_at(progress):
            with self.record.timed("densification"):
                mean2d, long_side = self._gradients["mean2d"][0], max(height, width)
                self.statistics.add(mean2d, out.radii[0], out.visible[0], long_side)
        self.record.pairs += out.frames.contributing
        self.iteration += 1
        return float(loss)

    def _on_device(self, view: TrainingView) -> TrainingView:
        """The view on the device, where it stays."""
        if self.device.type == "cpu":
            return view
        key = view.name, len(view.photo)
        if key not in self._placed:
            self._placed[key] = view.to(self.device)
        return self._placed[key]

    def _losses(self, view: TrainingView, out: Forward) -> tuple[float, tuple[torch.Tensor | None, ...]]:
        """L (eq. 14) and its gradients with respect to colors, alphas, depths, features and their variance."""
        losses, image = self.config.losses, view.exposed(out.colors[0])
        rgb = photometric(image, target_photo(view, image), SSIM_WEIGHT, view.weight)  # L_RGB, eq. 4
        total, colors = rgb.value, view.exposed(rgb.gradient)[None]
        alphas = depths = features = variance = None
        if view.depth is not None and out.depths is not None:
            value, of_depths, of_alphas = depth_loss(out.depths[0], out.alphas[0], view.depth)
            total += losses.depth_weight * value
            depths, alphas = losses.depth_weight * of_depths[None], losses.depth_weight * of_alphas[None]
        if out.features is not None and out.feature_variance is not None:
            weight = 1.0 if view.weight is None else view.weight[..., None]
            spread = out.feature_variance[0] if view.weight is None else out.feature_variance[0] * weight
            value, variance = variance_loss(spread, losses.variance_weight)  # λ_var L_var, eq. 13
            total, variance = total + value, (variance if view.weight is None else variance * weight)[None]
            if view.labels is not None:
                labels = self._assigned.get(view.name) or assign_labels(view.labels, view.keep).to(self.device)
                self._assigned[view.name] = labels
                w = INSTANCE_WEIGHT
                found = instance_loss(out.features[0], labels, margin=losses.margin, w_pos=w, w_neg=w)  # eqs. 6 to 9
                total, features = total + found.value, found.gradient[None]
        return total, (colors, alphas, depths, features, variance)

    def _rates(self, progress: float) -> dict[str, float | torch.Tensor]:
        return learning_rates(progress, self.extent, self.gaussians.sh.shape[1], self.config.train.iterations)

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
        self.optimiser.resize("sh", (degree + 1) ** 2)
        self._sync()

    def _sync(self) -> None:
        """Makes `gaussians` share the optimiser's tensors, which are replaced when rows are added or removed.

        The gradients' memory is kept from step to step: rows that a step does not see hold old values, not read.
        """
        self.gaussians = Gaussians(**{name: tensor.detach() for name, tensor in self.optimiser.params.items()})
        self._gradients = {name: torch.zeros_like(tensor) for name, tensor in vars(self.gaussians).items()}
        self._gradients["mean2d"] = self.gaussians.means.new_zeros(1, len(self.gaussians), 2)

    # -------------------------------------------------------------- checkpoint

    def state(self, copy: bool = True) -> dict[str, Any]:
        """All values needed to resume, for a checkpoint; without `copy` they are those of now until the next step."""
        return {
            "iteration": self.iteration,
            "initial_count": self.initial_count,
            "optimiser": self.optimiser.state_dict(copy),
            "statistics": {name: tensor.cpu() for name, tensor in vars(self.statistics).items()},
            "record": dict(vars(self.record), seconds=self.elapsed, iterations=self.iteration),
            "stopping": asdict(self.schedule.stopping),
            "skipped": self.skipped,
            "complete": self.complete,
        }

    def load(self, state: dict[str, Any]) -> None:
        """Restores the result of `state`."""
        self.gaussians = Gaussians(**state["optimiser"]["params"]).to(self.device)
        self.optimiser = SparseAdam(vars(self.gaussians), self._rates(0.0))
        self.optimiser.load_state_dict(state["optimiser"])
        self._sync()
        sums = {name: tensor.to(self.device) for name, tensor in state["statistics"].items()}
        self.statistics = Statistics(**sums)
        self.record = TrainRecord(**state["record"])
        self.iteration, self.initial_count = state["iteration"], state["initial_count"]
        vars(self.schedule.stopping).update(state["stopping"])
        self.skipped, self.complete = state["skipped"], state["complete"]
