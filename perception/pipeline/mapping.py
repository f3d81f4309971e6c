"""From an input to a map on disk: poses, masks, training, instances, language. Every stage skips what is done."""

from __future__ import annotations

import errno
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from perception.config import MapConfig
from perception.errors import InputError
from perception.gaussians.model import Gaussians, from_points
from perception.gaussians.train import Trainer, TrainingView, psnr, render_view
from perception.instances.label_transfer import transfer_labels, transfer_text
from perception.io.inputs import EXPECTED, load_scene
from perception.io.map_lock import writing
from perception.io.map_views import stored_view
from perception.io.photos import load_photo
from perception.io.recentre import recentred
from perception.io.scene_cache import load_saved_scene, save_scene
from perception.io.store import Map, read_info, read_map, write_map
from perception.masks import MaskSource, make_source
from perception.masks.source import GeometryMaskSource
from perception.masks.store import compute_masks
from perception.pipeline.checkpoint import fingerprint, load_checkpoint, save_checkpoint
from perception.pipeline.estimate import tell_estimate
from perception.pipeline.instances import find_instances
from perception.pipeline.photos import load_all, split_views, with_labels
from perception.pipeline.record import Stages, peak_memory_mib, versions
from perception.progress import Progress
from perception.types import Scene, View

WORK_SUFFIX = ".work"
CHECKPOINT = "checkpoint.pt"
GEOMETRY_START = 0.3
"""Progress at which masks that begin from the map's own depth (the built-in ones) are made."""
CHECKPOINT_SECONDS = 20.0
"""Between two checkpoints; so much work is lost at most."""
LEAST_DISK = 256 << 20
"""Bytes a small run writes to its work folder: features, masks, checkpoint, map."""


def work_folder(output: Path) -> Path:
    """Where an unfinished run keeps what it has done: a sibling of the map."""
    return output.with_name(output.name + WORK_SUFFIX)


def build_map(
    source: Path,
    output: Path,
    config: MapConfig,
    *,
    resume: bool = False,
    progress: Progress | None = None,
    labels_from: Path | None = None,
    on_note: Callable[[Trainer], None] | None = None,
) -> Map:
    """Builds a map from photos, a video, a COLMAP workspace or a transforms.json, and writes it to `output`.

    Raises InputError for bad input. What was done is kept in `work_folder(output)` until the map is written; with
    `resume` a run goes on from there. Names given to the instances of the map `labels_from` are carried over to those
    that fill the same place. A run refused before it trained leaves nothing behind. `on_note` sees the trainer each
    time a point of its curve is noted. To resume a run that is finished is to be given its map.
    """
    if config.device == "cuda":
        raise InputError("--device cuda: this build has no CUDA rasterizer; use --device cpu or auto")
    progress = progress or Progress(quiet=True)
    if resume and _finished(source, output, config):
        progress.log(f"{output}: this run is finished")
        with writing(output):  # one killed while it let go has left its lock and its work
            shutil.rmtree(work_folder(output), ignore_errors=True)
        return read_map(output)
    labelled = None if labels_from is None else read_map(labels_from)
    fresh = not work_folder(output).exists()
    work = _prepare(source, output, resume)
    with writing(output):
        try:
            return _build(source, output, work, config, progress, labelled, on_note)
        except OSError as error:
            if error.errno != errno.ENOSPC:
                raise
            raise InputError(f"{work}: the disk is full; free some space and go on with --resume") from error
        except InputError:
            if fresh and not (work / CHECKPOINT).exists():
                shutil.rmtree(work, ignore_errors=True)
            raise


def _build(
    source: Path,
    output: Path,
    work: Path,
    config: MapConfig,
    progress: Progress,
    labelled: Map | None,
    on_note: Callable[[Trainer], None] | None,
) -> Map:
    stages = Stages()
    started = time.monotonic()

    with stages("poses"):
        scene = _scene(source, output, work, config, progress)
    _tell_scene(scene, progress)
    training, held_out = split_views(scene.views, config.photos.holdout, config.photos.held_out)

    source_of_masks = make_source(config.masks)
    with stages("photos"):
        views = _photos(training, config, progress)
        held = _photos(held_out, config, progress)
    trainer = Trainer(initial_gaussians(scene, config), views, config, held)
    mark = fingerprint(source, config)
    session = _Session(trainer, work, mark, config, progress, on_note)
    depth = None
    if isinstance(source_of_masks, GeometryMaskSource):  # its masks wait for the map's own geometry
        with stages("train"):
            session.train(until=GEOMETRY_START)
        depth = trainer.depth
    with stages("masks"):
        mask_report = _masks(training, source_of_masks, work, config, depth, progress)
        views = [with_labels(view, of, work / "masks") for view, of in zip(views, training, strict=True)]
        trainer.show(views)
    with stages("train"):
        session.train()
    gaussians = trainer.gaussians
    with stages("instances"):
        found = find_instances(gaussians, views, scene, config, progress)
    with stages("score"):
        quality = score_views(gaussians, held)

    record = {
        "frame": scene.frame,
        "metric": scene.metric,
        "source": str(source),
        "seed": config.seed,
        "fingerprint": mark,
        "config": config.to_json(),
        "versions": versions(),
        "scene": scene.report,
        "masks": mask_report,
        "training": vars(trainer.record),
        "instances": found.report,
        "quality": quality,
        "seconds": {**stages.seconds, "total": round(time.monotonic() - started, 2)},
        "peak_memory_mib": peak_memory_mib(),
    }
    gmap = _assemble(gaussians, found, scene, held_out, record, output)
    if labelled is not None:
        _transfer_labels(labelled, gmap, progress)
    write_map(output, gmap)
    shutil.rmtree(work, ignore_errors=True)
    _tell_result(gmap, output, progress)
    return gmap


# ----------------------------------------------------------------------- stages


def _prepare(source: Path, output: Path, resume: bool) -> Path:
    if not source.exists():
        raise InputError(f"{source}: does not exist; give {EXPECTED}")
    if output.exists():
        raise InputError(f"{output}: exists already; choose another -o or remove it first")
    work = work_folder(output)
    if work.exists() and not resume:
        raise InputError(f"{work}: an unfinished run lies there; go on with --resume or remove the folder")
    try:
        work.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{work}: cannot be made ({error.strerror}); choose a writable -o") from error
    # Libraries below abort the process when the disk fills up under them, so it is looked at first.
    free = shutil.disk_usage(work).free
    if free < LEAST_DISK:
        if not any(work.iterdir()):
            work.rmdir()
        raise InputError(
            f"{output}: the disk has {free >> 20} MiB free, at least {LEAST_DISK >> 20} are needed; free some"
        )
    return work


def _finished(source: Path, output: Path, config: MapConfig) -> bool:
    """Whether the map of this very run lies there: a kill after it took its place leaves only tidying to do."""
    return output.exists() and read_info(output).get("fingerprint") == fingerprint(source, config)


def _scene(source: Path, output: Path, work: Path, config: MapConfig, progress: Progress) -> Scene:
    scene = load_saved_scene(work / "scene")
    if scene is None:
        tell_estimate(source, config, progress.log)
        camera = Path(config.photos.camera) if config.photos.camera else None
        scene = load_scene(
            source, work / "sfm", camera_file=camera, progress=_stage(progress, "poses"), seed=config.seed,
            strict=config.photos.strict, frames=output.with_suffix(".frames"),
        )  # fmt: skip
        save_scene(work / "scene", scene := recentred(scene))
    return scene


def _masks(
    views: list[View],
    source: MaskSource,
    work: Path,
    config: MapConfig,
    depth: Callable[[str], np.ndarray] | None,
    progress: Progress,
) -> dict[str, Any]:
    report = compute_masks(
        views,
        source,
        lambda view: load_photo(view, config.photos.max_side),
        work / "masks",
        _stage(progress, f"masks ({source.name})"),
        load_depth=None if depth is None else lambda view: depth(view.name),
        depth_key="" if depth is None else f"progress {GEOMETRY_START}",
    )
    for warning in report["warnings"]:
        progress.log(f"warning: {warning}")
    return report


def _photos(views: list[View], config: MapConfig, progress: Progress) -> list[TrainingView]:
    return load_all(views, config.photos.max_side, _stage(progress, "photos"))


class _Session:
    """Training in legs, each ending in a checkpoint; takes up where an interrupted run left off."""

    def __init__(
        self,
        trainer: Trainer,
        work: Path,
        mark: str,
        config: MapConfig,
        progress: Progress,
        on_note: Callable[[Trainer], None] | None,
    ):
        self.trainer, self.mark, self.path = trainer, mark, work / CHECKPOINT
        self.watch = _Watch(self.path, mark, config, progress, on_note)
        state = load_checkpoint(self.path, mark)
        if state is not None:
            trainer.load(state)
            progress.log(f"resuming at iteration {trainer.iteration}")

    def train(self, until: float = 1.0) -> None:
        """Trains until `until`; a leg that is behind us already is skipped, and its checkpoint left as it is."""
        if self.trainer.progress >= until:
            return
        try:
            self.trainer.run(self.watch, until)
        finally:
            save_checkpoint(self.path, self.trainer.state(), self.mark)


def initial_gaussians(scene: Scene, config: MapConfig) -> Gaussians:
    """One Gaussian a point of the sparse cloud, a random part of them where there are more than the budget."""
    points, colors = scene.points, scene.point_colors
    if len(points) > config.train.budget:
        keep = np.random.default_rng(config.seed).choice(len(points), config.train.budget, replace=False)
        points, colors = points[np.sort(keep)], colors[np.sort(keep)]
    return from_points(points, colors, feature_dim=config.losses.feature_dim, seed=config.seed)


class _Watch:
    """Called after every step: draws progress now and then, keeps a checkpoint now and then."""

    def __init__(
        self,
        path: Path,
        mark: str,
        config: MapConfig,
        progress: Progress,
        on_note: Callable[[Trainer], None] | None,
    ):
        self.path, self.mark, self.config, self.progress, self.on_note = path, mark, config, progress, on_note
        self.noted = 0
        self.saved = self.drawn = time.monotonic()
        self.loss: float | None = None
        self.first: tuple[float, int] | None = None

    def __call__(self, trainer: Trainer, figures: dict[str, float]) -> None:
        now = time.monotonic()
        self.loss = figures["loss"] if self.loss is None else 0.95 * self.loss + 0.05 * figures["loss"]
        self.first = self.first or (now, trainer.iteration)
        if now - self.drawn > 0.5 or trainer.progress >= 1:
            self.drawn = now
            self._draw(trainer, now)
        if self.on_note is not None and len(trainer.record.curve) > self.noted:
            self.noted = len(trainer.record.curve)
            self.on_note(trainer)
        if now - self.saved > CHECKPOINT_SECONDS:
            save_checkpoint(self.path, trainer.state(), self.mark)
            self.saved = time.monotonic()

    def _draw(self, trainer: Trainer, now: float) -> None:
        assert self.first is not None
        speed = (trainer.iteration - self.first[1]) / max(now - self.first[0], 1e-6)
        total = trainer.expected_iterations
        curve = trainer.record.curve
        self.progress.update(
            "train",
            trainer.iteration,
            total,
            f"loss {self.loss:.3f}",
            f"{curve[-1]['psnr']:.1f} dB" if curve else "- dB",
            f"{len(trainer.gaussians) / 1000:.3g}k Gaussians",
            f"{speed:.1f} it/s",
            f"{round((total - trainer.iteration) / max(speed, 1e-6))} s left",
            f"{round(peak_memory_mib())} MiB",
        )


def score_views(gaussians: Gaussians, views: list[TrainingView]) -> dict[str, Any]:
    """PSNR and SSIM of each view (none: empty), and their means."""
    from perception.evaluate.images import ssim

    per_view = {}
    for view in views:
        image = render_view(gaussians, view)
        similarity = ssim(image.numpy().astype(np.float64), view.photo.numpy().astype(np.float64) / 255)
        per_view[view.name] = {"psnr": psnr(image, view.photo), "ssim": float(similarity)}
    if not per_view:
        return {"views": {}}
    means = {name: float(np.mean([entry[name] for entry in per_view.values()])) for name in ("psnr", "ssim")}
    return {**means, "views": per_view}


def _assemble(
    gaussians: Gaussians, found: Any, scene: Scene, held_out: list[View], record: dict[str, Any], output: Path
) -> Map:
    held = {view.name for view in held_out}
    arrays = {name: tensor.detach().numpy() for name, tensor in vars(gaussians).items()}
    arrays["quats"] = arrays["quats"] / np.maximum(np.linalg.norm(arrays["quats"], axis=1, keepdims=True), 1e-12)
    return Map(
        **arrays,
        instance_ids=found.ids,
        membership=found.membership,
        instances=found.instances,
        info=record,
        views=[stored_view(view, output, view.name in held) for view in scene.views],
        language=found.language,
        parts=found.parts,
    )


def _transfer_labels(old: Map, gmap: Map, progress: Progress) -> None:
    transfer = transfer_labels(old, gmap)
    for entry in gmap.instances:
        entry["label"] = transfer.labels.get(entry["id"], entry["label"])
    gmap.info["labels"] = {"carried": len(transfer.labels), "dropped": [name for _, name in transfer.dropped]}
    progress.log(transfer_text(transfer))


# ----------------------------------------------------------------------- words


def _stage(progress: Progress, name: str) -> Callable[..., None]:
    """An adapter for stages that report (done, total), or (what, share in [0, 1])."""

    def tell(first: Any, second: float) -> None:
        if isinstance(first, str):
            progress.update(f"{name}: {first}", round(100 * second), 100)
        else:
            progress.update(name, int(first), int(second))

    return tell


def _tell_scene(scene: Scene, progress: Progress) -> None:
    report = scene.report
    progress.log(f"{len(scene.views)} posed photos, {len(scene.points)} points")
    if "origin" in report:
        progress.log(f"far from the origin: the map's own lies at {report['origin']}; exports are in the input's frame")
    for note in report.get("notes", []):
        progress.log(note)
    for entry in report.get("left_out", []):
        progress.log(f"left out: {entry['name']} ({entry['why']})")
    for warning in report.get("warnings", []):
        progress.log(f"warning: {warning}")


def _tell_result(gmap: Map, output: Path, progress: Progress) -> None:
    info = gmap.info
    quality = info["quality"]
    scored = f", held-out PSNR {quality['psnr']:.2f} dB, SSIM {quality['ssim']:.3f}" if "psnr" in quality else ""
    progress.log(
        f"{output}: {len(gmap)} Gaussians, {len(gmap.instances)} instances{scored}, "
        f"{info['seconds']['total']:.0f} s, peak {info['peak_memory_mib']:.0f} MiB"
    )
