"""Builds a map from an input in the stages of OpenSplat3D: poses, masks, optimise, group, describe.

Section (§) and equation numbers are the paper's (Piekenbrinck et al. 2025).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from perception.config import MapConfig
from perception.errors import InputError
from perception.frame.place import placed_scene
from perception.gaussians.depth_start import start_on_surface
from perception.gaussians.device import choose_device
from perception.gaussians.model import Gaussians, from_points
from perception.gaussians.train import Trainer, TrainingView, psnr, render_view
from perception.gaussians.transients import train_without_transients
from perception.io.inputs import load_saved_scene, load_scene, save_scene
from perception.io.map_files import read_info
from perception.io.map_views import stored_view
from perception.io.memory import DiskArrays, Keep
from perception.io.photos import load_photo
from perception.io.reading import Reading
from perception.io.recentre import recentred
from perception.io.store import Map, read_map, write_map
from perception.language.base import Encoder
from perception.language.ocr import make_reader
from perception.masks import MaskSource, compute_masks, make_source
from perception.masks.builtin import BuiltinSegmentation
from perception.masks.label_images import load_segmentation
from perception.pipeline.checkpoint import (
    TrainingObserver,
    clear_work,
    fingerprint,
    frames_folder,
    poses_mark,
    training_mark,
    working,
)
from perception.pipeline.estimate import image_memory, log_estimate, memory_limit
from perception.pipeline.instances import FoundInstances, describe, group_gaussians
from perception.pipeline.photos import exposed_as_neighbours, load_all, split_views, with_labels
from perception.pipeline.record import depth_errors, depth_used, finite, peak_memory_mib, versions
from perception.pipeline.summary import depth_text, frame_lines
from perception.progress import Progress, timed
from perception.types import Scene, View

GEOMETRY_START = 0.3
"""Training progress at which masks that use the depth of the map (the built-in ones) are made."""

FRAME_FACTS = ("map_from_input", "scale", "gravity")
"""Entries of a scene's report that map.json holds at its top level."""


def build_map(
    source: Path,
    output: Path,
    config: MapConfig,
    *,
    resume: bool = False,
    progress: Progress | None = None,
) -> Map:
    """Builds a map from photos, a video, a COLMAP workspace or a transforms.json, and writes it to `output`.

    Raises InputError for bad input. Intermediate results are kept beside `output` until the map is written; with
    `resume` a run continues from them and repeats only what has changed (see `pipeline.checkpoint`). A run that fails
    before training leaves no files. Resuming a finished run returns its map.
    """
    progress, started = progress or Progress(quiet=True), time.monotonic()
    seconds: dict[str, float] = {}
    stages = partial(timed, seconds)
    if resume and output.exists() and read_info(output).get("fingerprint") == fingerprint(source, config):
        progress.log(f"{output}: this run is finished")
        clear_work(output)
        return read_map(output)

    with working(source, output, resume) as work:
        # Files, models and devices are opened first, so that errors appear before hours of work.
        device, told = choose_device(config.device)
        if told is not None:
            progress.log(told)
        mask_source = make_source(config.masks, config.sam)
        encoder = _encoder(config.language.encoder, progress)
        reader = make_reader(config.language.texts)

        # Posed images I_v (§3.2) and a sparse cloud.
        with stages("poses"):
            scene = _scene(source, output, work, config, progress)
        _tell_scene(scene, progress)
        training, held_out = split_views(scene.views, config.photos.holdout, config.photos.held_out)
        held_out = exposed_as_neighbours(held_out, training)
        with stages("photos"):
            keep = DiskArrays(work, image_memory(config, memory_limit())).keep
            views = load_all(training, config.photos.max_side, progress, keep)
            held = load_all(held_out, config.photos.max_side, progress, keep)

        trainer = Trainer(initial_gaussians(scene, config, views), views, config, held, device)
        from_geometry = isinstance(mask_source, BuiltinSegmentation)
        masks_enter = GEOMETRY_START if from_geometry else config.losses.start
        mark = training_mark(source, config)
        observer = TrainingObserver(work, mark, mask_source.identity, masks_enter, progress)
        observer.take_up(trainer)
        if config.train.transients:
            with stages("train"):
                views = train_without_transients(trainer, views, observer, work / "transients.npz", progress)

        # Instance masks M_v,i of every photo (§3.2). Some need the depth of the map, which is then trained first.
        if from_geometry and trainer.progress < GEOMETRY_START:
            with stages("train"):
                trainer.run(observer, until=GEOMETRY_START)
        with stages("masks"):
            depth = trainer.depth if from_geometry else None
            mask_report = _masks(training, mask_source, work, config, depth, mark, progress, keep)
            del mask_source, depth  # with the views of stereo
            views = [with_labels(view, of, work / "masks") for view, of in zip(views, training, strict=True)]
            trainer.show(views)

        # Optimise colours and features together: L_RGB + λ_inst2d L_inst2d + λ_var L_var (§3.1 to 3.2.3, eq. 14).
        with stages("train"):
            trainer.run(observer)
        gaussians, trained = trainer.gaussians.to("cpu"), trainer.record
        del trainer, observer  # with the optimiser's moments

        # Group the Gaussians by their features into instances (§3.2.1), describe these from their best views (§3.2.2).
        with stages("instances"):
            cuts = load_segmentation(work / "masks") if from_geometry else None
            grouped = group_gaussians(gaussians, views, config, progress, cuts)
            found = describe(gaussians, grouped, views, config.language, encoder, progress, reader)

        with stages("score"):
            quality = score_views(gaussians, held, scene.metric)
        record = {
            "frame": scene.frame,
            "metric": scene.metric,
            **{key: scene.report[key] for key in FRAME_FACTS if key in scene.report},
            "source": str(source),
            "seed": config.seed,
            "fingerprint": fingerprint(source, config),
            "config": config.to_json(),
            "versions": versions(),
            "scene": {key: fact for key, fact in scene.report.items() if key not in FRAME_FACTS},
            "masks": mask_report,
            "depth": depth_used(views),
            "training": vars(trained),
            "instances": found.report,
            "quality": quality,
            "seconds": {name: round(s, 2) for name, s in (*seconds.items(), ("total", time.monotonic() - started))},
            "peak_memory_mib": peak_memory_mib(),
        }
        gmap = _assemble(gaussians, found, scene, held_out, record, output)
        write_map(output, gmap)
    _tell_result(gmap, output, progress)
    return gmap


# ----------------------------------------------------------------------- stages


def _encoder(spec: str, progress: Progress) -> Encoder | None:
    """The image-text encoder; None if disabled, or if "auto" finds none."""
    from perception.language.encoders import make_encoder

    try:
        return make_encoder("conse" if spec == "auto" else spec)
    except InputError as error:
        if spec != "auto":
            raise
        progress.log(f"warning: no language: {error}")
        return None


def _scene(source: Path, output: Path, work: Path, config: MapConfig, progress: Progress) -> Scene:
    kept = work / f"poses-{poses_mark(source, config)}"
    scene = load_saved_scene(kept)
    if scene is None:
        log_estimate(source, config, progress.log)
        photos = config.photos
        masks, camera, cloud = (
            Path(p) if p else None for p in (photos.ignore_masks, photos.camera, photos.init_points)
        )
        how = Reading(work / "sfm", config.seed, progress, photos.strict, masks, camera, poses=photos.poses)
        scene = load_scene(source, replace(how, frames=frames_folder(output), init_points=cloud))
        save_scene(kept, scene := placed_scene(recentred(scene), config.frame, config.seed))
    if config.losses.depth_weight == 0:
        return replace(scene, views=[replace(view, depth=None) for view in scene.views])
    return scene


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


def _masks(
    views: list[View],
    source: MaskSource,
    work: Path,
    config: MapConfig,
    depth: Callable[[str], np.ndarray] | None,
    mark: str,
    progress: Progress,
    keep: Keep,
) -> dict[str, Any]:
    report = compute_masks(
        views,
        source,
        lambda view: load_photo(view, config.photos.max_side),
        work / "masks",
        progress,
        load_depth=None if depth is None else lambda view: depth(view.name),
        depth_key=f"{config.photos.max_side} px" if depth is None else f"{mark} at progress {GEOMETRY_START}",
        keep=keep,
    )
    for warning in report["warnings"]:
        progress.log(f"warning: {warning}")
    return report


def score_views(gaussians: Gaussians, views: list[TrainingView], metric: bool = False) -> dict[str, Any]:
    """PSNR and SSIM of each view without ignored pixels, and their means; empty without views.

    Depth is compared where it was measured; metric: the unit is the metre.
    """
    from perception.evaluate.images import ssim

    per_view = {}
    for view in views:
        image = render_view(gaussians, view)
        weight = None if view.weight is None else view.weight.numpy()
        similarity = ssim(image.numpy().astype(np.float64), view.photo.numpy().astype(np.float64) / 255, weight)
        per_view[view.name] = {"psnr": psnr(image, view.photo, view.weight), "ssim": float(similarity)}
    if not per_view:
        return {"views": {}}
    means = {name: float(np.mean([entry[name] for entry in per_view.values()])) for name in ("psnr", "ssim")}
    depth = depth_errors(gaussians, views, metric)
    return {**means, **({"depth": depth} if depth else {}), "views": per_view}


def _assemble(
    gaussians: Gaussians,
    found: FoundInstances,
    scene: Scene,
    held_out: list[View],
    record: dict[str, Any],
    output: Path,
) -> Map:
    """The map to write; in JSON values, None replaces NaN and infinity."""
    held = {view.name: view for view in held_out}
    arrays = {name: tensor.detach().numpy() for name, tensor in vars(gaussians).items()}
    arrays["quats"] = arrays["quats"] / np.maximum(np.linalg.norm(arrays["quats"], axis=1, keepdims=True), 1e-12)
    return Map(
        **arrays,
        instance_ids=found.ids,
        membership=found.membership,
        instances=finite(found.instances),
        info=finite(record),
        views=[stored_view(held.get(view.name, view), output, view.name in held) for view in scene.views],
        language=found.language,
        parts=found.parts,
        groups=found.groups,
    )


# ----------------------------------------------------------------------- words


def _tell_scene(scene: Scene, progress: Progress) -> None:
    report = scene.report
    with_depth = sum(view.depth is not None for view in scene.views)
    depth = f", {with_depth} with depth" if with_depth else ""
    progress.log(f"{len(scene.views)} posed photos{depth}, {len(scene.points)} points")
    for line in frame_lines({"metric": scene.metric, **report}):
        progress.log(line)
    if report.get("exposure", {}).get("varies"):
        progress.log(f"exposure varies by {report['exposure']['spread']:.0%} between photos: each has its gains")
    for note in report.get("notes", []):
        progress.log(note)
    for entry in report.get("left_out", []):
        progress.log(f"left out: {entry['name']} ({entry['why']})")
    for warning in report.get("warnings", []):
        progress.log(f"warning: {warning}")


def _tell_result(gmap: Map, output: Path, progress: Progress) -> None:
    info, quality = gmap.info, gmap.info["quality"]
    scored = f", held-out PSNR {quality['psnr']:.2f} dB, SSIM {quality['ssim']:.3f}" if quality.get("psnr") else ""
    scored += f", {depth_text(quality['depth'])}" if "depth" in quality else ""
    progress.log(
        f"{output}: {len(gmap)} Gaussians, {len(gmap.instances)} instances{scored}, "
        f"{info['seconds']['total']:.0f} s, peak {info['peak_memory_mib']:.0f} MiB"
    )
