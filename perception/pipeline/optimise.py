"""Optimises the Gaussians of a scene, or of one block of a large scene, together with the masks of its photos."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from perception.config import MapConfig
from perception.gaussians.depth_start import start_on_surface
from perception.gaussians.device import choose_device
from perception.gaussians.model import Gaussians, Nearby, from_points
from perception.gaussians.photos import load_all, with_labels
from perception.gaussians.state import TrainRecord, sized
from perception.gaussians.stereo import with_stereo
from perception.gaussians.train import Trainer
from perception.gaussians.views import TrainingView, surface_depth
from perception.io.memory import DiskArrays, Keep
from perception.machine import blas_on_one_thread, memory_limit, return_free_memory
from perception.masks import MaskSource, compute_masks, make_source
from perception.photos.decode import load_photo
from perception.pipeline.checkpoint import TrainingObserver, digest, training_mark
from perception.pipeline.estimate import image_memory, largest_budget
from perception.progress import QUIET, Progress, timed
from perception.tasks.engine import LOCAL, Engine
from perception.tasks.folder import read_task, renew_task
from perception.types import Scene, View

GEOMETRY_START = 0.3  # training progress at which masks that use the depth of the map (the built-in ones) are made
PHOTOS_A_TASK = 8  # photos whose masks one task makes: minutes with SAM on a CPU, and reading the model takes seconds


@dataclass
class Run:
    """What every stage of a run needs. source: the input; work: its folder of intermediate results; masks: the folder
    of label images; engine: where tasks run; seconds: of each stage so far; inputs: the files that the map is made from
    (see `pipeline.changes`); started: monotonic time."""

    source: Path
    config: MapConfig
    work: Path
    masks: Path
    device: torch.device
    progress: Progress
    engine: Engine = field(default_factory=Engine)
    seconds: dict[str, float] = field(default_factory=dict)
    inputs: dict[str, dict[str, str]] = field(default_factory=dict)
    started: float = field(default_factory=time.monotonic)

    @classmethod
    def begun(cls, source: Path, config: MapConfig, work: Path, progress: Progress, engine: Engine = LOCAL) -> Run:
        """A run on the device of the settings, which is logged."""
        device, notice = choose_device(config.device)
        if notice is not None:
            progress.log(notice)
        return cls(source, config, work, work / "masks", device, progress, engine)

    def __post_init__(self) -> None:
        self._arrays = DiskArrays(self.work, image_memory(self.config, memory_limit()))
        self.keep: Keep = self._arrays.keep

    def new_keep(self) -> Keep:
        """Keeps arrays in what those of `keep` leave of `photos.memory`, until the last of them is freed."""
        return DiskArrays(self.work, 2 * self._arrays.most, self._arrays).keep

    def stage(self, name: str) -> AbstractContextManager[None]:
        """Adds the seconds of its block to the stage `name`."""
        return timed(self.seconds, name)

    @property
    def mark(self) -> str:
        """Hash of all that the optimisation depends on, apart from mask images."""
        return training_mark(self.source, self.config)


@dataclass(frozen=True)
class Photos:
    """The photos of a run: posed (training, held_out), and decoded at training size (views, held)."""

    training: list[View]
    held_out: list[View]
    views: list[TrainingView]
    held: list[TrainingView]

    @classmethod
    def load(cls, run: Run, training: list[View], held_out: list[View]) -> Photos:
        """Decodes all photos; the memory they fill is bounded by `photos.memory`."""
        side = run.config.photos.max_side
        with run.stage("photos"):
            views = load_all(training, side, run.progress, run.keep)
            return cls(training, held_out, views, load_all(held_out, side, run.progress, run.keep))


@dataclass(frozen=True)
class Optimised:
    """The Gaussians, the photos with their labels, the training's record, the report of the masks, and a report of
    each block of a large scene."""

    nearby: Nearby
    photos: Photos
    record: TrainRecord
    masks: dict[str, Any]
    blocks: list[dict[str, Any]] = field(default_factory=list)


def optimise(
    run: Run,
    scene: Scene,
    training: list[View],
    held_out: list[View],
    source: MaskSource,
    box: np.ndarray | None = None,
) -> Optimised:
    """Trains the Gaussians of a scene, or of the block of one that owns `box` (see `Trainer`), from the checkpoint in
    `run.work` on, if there is one."""
    photos = Photos.load(run, training, held_out)
    config = sized(run.config, len(photos.views), largest_budget(memory_limit()))
    start, stereo = _start(run, scene, config, photos)
    trainer = Trainer(start, photos.views, config, photos.held, run.device, box, by_stereo=bool(stereo))
    del start
    if config != run.config:
        size = f"{config.train.iterations} iterations, at most {config.train.budget} Gaussians"
        trainer.record.decisions.append(f"size: {size}, for {len(photos.views)} photos")
    if stereo:
        trainer.record.decisions.append(f"stereo: depth in {np.mean(stereo):.0%} of the pixels of {len(stereo)} photos")
    masks_enter = GEOMETRY_START if source.needs_depth else config.losses.start
    observer = TrainingObserver(run.work, run.mark, source.identity, masks_enter, run.progress)
    observer.take_up(trainer)

    # Instance masks M_v,i of every photo (§3.2). Some need the depth of the map, which is then trained first.
    if source.needs_depth and trainer.progress < GEOMETRY_START:
        with run.stage("train"):
            trainer.run(observer, until=GEOMETRY_START)
    photos, report = label_photos(run, photos, source, partial(surface_depth, trainer.gaussians))
    trainer.show(photos.views)

    # Optimise colours and features together: L_RGB + λ_inst2d L_inst2d + λ_var L_var (§3.1 to 3.2.3, eq. 14).
    with run.stage("train"):
        trainer.run(observer)
    optimised = Optimised(Nearby(trainer.gaussians), photos, trainer.record, report)
    del trainer, observer
    return_free_memory()
    return optimised


def _start(run: Run, scene: Scene, config: MapConfig, photos: Photos) -> tuple[Gaussians, list[float]]:
    """The first Gaussians, and the share of the pixels of each photo of which stereo found the depth. That depth is not
    kept: held to it, the Gaussians fit the photos less."""
    views = photos.views
    if config.losses.depth_weight > 0 and scene.report.get("points_from") != "random":
        with run.stage("stereo"):
            views = with_stereo(photos.training, views, scene.points, run.progress, run.new_keep())
    depths = [view.depth for view, photo in zip(views, photos.views, strict=True) if view is not photo]
    shares = [float((depth > 0).double().mean()) for depth in depths if depth is not None]
    return initial_gaussians(scene, config, views), shares


def initial_gaussians(scene: Scene, config: MapConfig, views: Sequence[TrainingView] = ()) -> Gaussians:
    """One Gaussian per voxel of the surface that depth sensors measured in `views`, and per point of the sparse cloud
    elsewhere; a random subset if there are more points than the budget."""
    points, colors = scene.points, scene.point_colors
    feature_dim, budget, seed = config.losses.feature_dim, config.train.budget, config.seed
    real = slice(0) if scene.report.get("points_from") == "random" else slice(None)
    surface = start_on_surface(views, points[real], colors[real], budget, feature_dim, seed)
    if surface is not None:
        return surface
    if len(points) > budget:
        keep = np.random.default_rng(seed).choice(len(points), budget, replace=False)
        points, colors = points[np.sort(keep)], colors[np.sort(keep)]
    return from_points(points, colors, feature_dim=feature_dim, seed=seed)


def label_by_tasks(run: Run, views: Sequence[View], source: MaskSource) -> None:
    """Has the label images of `views` made on other machines where that pays. `label_photos` then finds them."""
    if run.engine.kind == "local" or not source.remote:
        return
    folders = []
    for start in range(0, len(views), PHOTOS_A_TASK):
        scene = Scene(list(views[start : start + PHOTOS_A_TASK]), np.zeros((0, 3)), np.zeros((0, 3), np.uint8))
        folders.append(run.work / f"labels-{digest(run.mark, source.identity, [view.name for view in scene.views])}")
        renew_task(folders[-1], scene, config=run.config.to_json(), masks=str(run.masks.resolve()))
    with run.stage("masks"):
        run.engine.run(label_task, [str(folder.resolve()) for folder in folders], "photo set", run.progress)


@blas_on_one_thread()
def label_task(folder: str, progress: Progress = QUIET) -> None:
    """Makes the label images of the photos whose task lies in `folder`, where they are missing or out of date."""
    scene, facts = read_task(Path(folder))
    config = MapConfig.model_validate(facts["config"])
    side = config.photos.max_side
    source, masks = make_source(config.masks, config.sam), Path(facts["masks"])
    compute_masks(scene.views, source, lambda view: load_photo(view, side), masks, progress, depth_key=f"{side} px")


def label_photos(
    run: Run, photos: Photos, source: MaskSource, depth: Callable[[TrainingView], np.ndarray]
) -> tuple[Photos, dict[str, Any]]:
    """The photos with their label images, which are made where they are missing or out of date, and their report.

    depth: depth image of a view, for sources that need it.
    """
    side = run.config.photos.max_side
    by_name = {view.name: view for view in photos.views}
    with run.stage("masks"):
        report = compute_masks(
            photos.training,
            source,
            lambda view: by_name[view.name].photo.numpy(),
            run.masks,
            run.progress,
            load_depth=lambda view: depth(by_name[view.name]),
            depth_key=f"{run.mark} at progress {GEOMETRY_START}" if source.needs_depth else f"{side} px",
            keep=run.new_keep(),
        )
        for warning in report["warnings"]:
            run.progress.log(f"warning: {warning}")
        pairs = zip(photos.views, photos.training, strict=True)
        labelled = [with_labels(decoded, view, run.masks) for decoded, view in pairs]
        return replace(photos, views=labelled), report
