"""The state of a training: the Gaussians with their optimiser, the views, and all that a checkpoint holds."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
import torch

from perception.config import MapConfig
from perception.gaussians.densify import Statistics
from perception.gaussians.early_stopping import EarlyStopping
from perception.gaussians.free_space import FreeSpace
from perception.gaussians.losses import LabelAssignment, assign_labels
from perception.gaussians.model import STORED, Gaussians
from perception.gaussians.optimiser import SparseAdam
from perception.gaussians.views import TrainingView, scene_extent
from perception.geometry import along_curve
from perception.progress import timed
from perception.rasterizer.types import Gradients

USUAL_PHOTOS = 43  # of a table or a small room, for which ITERATIONS and BUDGET were chosen; fewer need as many
ITERATIONS, BUDGET = 2000, 100_000


def sized(config: MapConfig, photos: int, most: int | None = None) -> MapConfig:
    """`config` with iterations and budget of Gaussians for a number of training photos, where they are 0.

    Times `train.effort`, both are ITERATIONS and BUDGET for USUAL_PHOTOS or fewer, and proportional to the photos
    beyond. Growth ends before the budget, and training before its end, where more does not pay (`train.exchange_db`).
    most: largest budget that is chosen.
    """
    share = config.train.effort * max(1.0, photos / USUAL_PHOTOS)
    iterations = config.train.iterations or max(1, round(ITERATIONS * share))
    budget = config.train.budget or max(100, min(round(BUDGET * share), sys.maxsize if most is None else most))
    train = config.train.model_copy(update={"iterations": iterations, "budget": budget})
    return config.model_copy(update={"train": train})


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
    def joined(records: Sequence[TrainRecord], what: str = "block") -> TrainRecord:
        """The record of a model that was trained in blocks, or legs: sums, and the decisions of each; it has no curve.
        what: one of them."""
        total = TrainRecord()
        for number, record in enumerate(records, start=1):
            total.decisions += [f"{what} {number}: {decision}" for decision in record.decisions]
            total.profile = {part: total.profile.get(part, 0.0) + s for part, s in record.profile.items()}
            for name in ("pairs", "seconds", "iterations", "skipped_gradients"):
                setattr(total, name, getattr(total, name) + getattr(record, name))
        return total

    def timed(self, part: str) -> AbstractContextManager[None]:
        """Adds the wall-clock seconds of its block to `part` of the profile. A nested block counts in both parts."""
        return timed(self.profile, part)


class TrainingState:
    """What the steps of a training and its schedule change; `state` exports it for a checkpoint, `load` restores it.

    gaussians, views, held_out: on the CPU. Gaussians, optimiser and training views are then kept on `device`. box:
    [2, 3] corners of the space that matters, in which most Gaussians are added; None: all. held: the first rows, of
    which nothing but the colours is trained, and that are never dropped; fixed: [held] bool, of those the rows of which
    nothing is, None: none. by_stereo: the Gaussians lie on a surface that stereo found, so the space before the cameras
    is kept free (`free_space`).
    """

    def __init__(
        self,
        gaussians: Gaussians,
        views: list[TrainingView],
        config: MapConfig,
        held_out: list[TrainingView],
        device: torch.device | None = None,
        box: np.ndarray | None = None,
        held: int = 0,
        fixed: np.ndarray | None = None,
        by_stereo: bool = False,
    ):
        self.held = held
        self.config = sized(config, len(views))
        self.device = device or torch.device("cpu")
        fixed = np.zeros(held, bool) if fixed is None else fixed
        self.fixed = torch.from_numpy(np.flatnonzero(fixed)).to(self.device)
        self.held_out = held_out
        self.box = None if box is None else torch.tensor(box, dtype=torch.float32, device=self.device)
        self.extent = scene_extent(views)
        self.record = TrainRecord()
        train = self.config.train
        self.stopping = EarlyStopping(train.exchange_db, degree_decided=train.sh_degree == 0)
        self.iteration = 0
        self.complete = False  # finished, unless a longer training is requested
        self.skipped = 0.0  # share of training progress skipped by early stopping
        self.placed = False  # masks that had too few Gaussians were given some
        self.initial_count = len(gaussians)
        self.free_space = FreeSpace(gaussians.means.cpu().double().numpy(), views) if by_stereo else None
        self.gaussians = gaussians.to(self.device)
        self.reset_statistics()
        self.optimiser = SparseAdam(self.gaussians.named())
        self._sync()
        self.show(views)
        self._since: float | None = None  # time.monotonic() at the start of `running`, None outside

    @property
    def growing_by(self) -> str:
        """The gradient by which Gaussians are chosen for growth."""
        return "absgrad" if self.config.densify.absgrad else "mean2d"

    @property
    def elapsed(self) -> float:
        """Seconds of training, including those before a resume, without the time between two calls of `run`."""
        return self.record.seconds + (0.0 if self._since is None else time.monotonic() - self._since)

    @property
    def _share(self) -> float:
        """Share of the iterations done or skipped."""
        return self.iteration / self.config.train.iterations + self.skipped

    @property
    def progress(self) -> float:
        limit = self.config.train.time_limit
        return min(1.0, self._share if limit is None else max(self._share, self.elapsed / limit + self.skipped))

    @property
    def expected_iterations(self) -> int:
        """Estimate of the total number of iterations of the run."""
        progress = self.progress
        if progress > self._share:  # the time limit determines progress
            spent = max(progress - self.skipped, 1e-6)
            return max(self.iteration, round(self.iteration * (1 - self.skipped) / spent))
        return round(self.iteration + (1 - progress) * self.config.train.iterations)

    def show(self, views: list[TrainingView]) -> None:
        """Sets the training views: the same photos as before, possibly with labels added."""
        self.views, self.coarse = views, [view.halved().stored() for view in views]
        self.long_side = max(max(view.photo.shape[:2]) for view in views)
        self.has_labels = any(view.labelled for view in views)
        self._on_device: dict[tuple[str, int], TrainingView] = {}  # those seen so far
        self._assigned: dict[str, LabelAssignment] = {}  # of the views seen so far

    def on_device(self, view: TrainingView) -> TrainingView:
        """The view on the device, where it stays."""
        if self.device.type == "cpu":
            return view
        key = view.name, len(view.photo)
        if key not in self._on_device:
            self._on_device[key] = view.to(self.device)
        return self._on_device[key]

    def assigned(self, view: TrainingView) -> LabelAssignment | None:
        """The labels of the view on the device, where they stay; None if it has none."""
        if view.labels is not None and view.name not in self._assigned:
            self._assigned[view.name] = assign_labels(view.labels, view.keep).to(self.device)
        return self._assigned.get(view.name)

    def keep(self, rows: torch.Tensor) -> None:
        """Keeps the Gaussians that `rows` [M] int64 selects, with their Adam moments; statistics begin anew."""
        self.optimiser.keep(rows)
        self._sync()
        self.reset_statistics()

    def append(self, born: Gaussians) -> None:
        """Adds Gaussians with zero Adam moments; statistics begin anew."""
        self.optimiser.append(born.named())
        self._sync()
        self.reset_statistics()

    def arrange(self) -> None:
        """Orders the Gaussians behind the held ones along a curve through space: those of a photo then lie together in
        memory. A step of 171,000 Gaussians of a room takes 25 CPU ms instead of 35."""
        free = self.held + along_curve(self.gaussians.means[self.held :])
        self.keep(torch.cat([torch.arange(self.held, device=self.device), free]))

    def set_degree(self, degree: int) -> None:
        """Truncates the spherical harmonics to `degree`, or adds zero coefficients up to it."""
        self.optimiser.resize("sh", (degree + 1) ** 2)
        self._sync()

    def reset_statistics(self) -> None:
        """Begins the sums for the next densification."""
        self.statistics = Statistics.zeros(len(self.gaussians), self.device)

    def _sync(self) -> None:
        """Makes `gaussians` share the optimiser's tensors, which are replaced when rows are added or removed.

        The gradients' memory is kept from step to step: rows that a step does not see hold old values, not read.
        """
        self.gaussians = Gaussians(**self.optimiser.params)
        self.gradients = Gradients()  # frees the former before the next are allocated
        zeros = {name: torch.zeros_like(self.optimiser.params[stored]) for name, stored in STORED.items()}
        zeros[self.growing_by] = self.gaussians.means.new_zeros(1, len(self.gaussians), 2)
        self.gradients = Gradients(**zeros)

    def state(self, copy: bool = True) -> dict[str, Any]:
        """All values needed to resume, for a checkpoint; without `copy` they are those of now until the next step."""
        return {
            "iteration": self.iteration,
            "initial_count": self.initial_count,
            "optimiser": self.optimiser.state_dict(copy),
            "statistics": {"gradient": self.statistics.gradient.cpu(), "seen": self.statistics.seen.cpu()},
            "record": asdict(self.record) | {"seconds": self.elapsed, "iterations": self.iteration},
            "stopping": asdict(self.stopping),
            "skipped": self.skipped,
            "placed": self.placed,
            "complete": self.complete,
        }

    def load(self, state: dict[str, Any]) -> None:
        """Restores the result of `state`."""
        self.gaussians = Gaussians(**state["optimiser"]["params"]).to(self.device)
        self.optimiser = SparseAdam(self.gaussians.named())
        self.optimiser.load_state_dict(state["optimiser"])
        self._sync()
        gradient, seen = (state["statistics"][name].to(self.device) for name in ("gradient", "seen"))
        self.statistics = Statistics(gradient, seen)
        self.record = TrainRecord(**state["record"])
        self.iteration, self.initial_count = state["iteration"], state["initial_count"]
        self.stopping = EarlyStopping(**state["stopping"])
        self.skipped, self.placed, self.complete = (state[name] for name in ("skipped", "placed", "complete"))
