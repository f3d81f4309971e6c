"""Builds a map from an input in the stages of OpenSplat3D: poses, masks, optimise, group, describe.

Section (§) and equation numbers are the paper's (Piekenbrinck et al. 2025).
"""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from perception.config import MapConfig
from perception.errors import InputError
from perception.frame.recentre import recentred
from perception.frame.world_frame import in_world_frame
from perception.gaussians.device import choose_device
from perception.gaussians.model import Gaussians
from perception.gaussians.photos import exposed_as_neighbours, split_views
from perception.gaussians.views import TrainingView, psnr, render_view, surface_depth
from perception.inputs.load import load_scene
from perception.language.base import Encoder
from perception.language.ocr import make_reader
from perception.map.files import read_info
from perception.map.write import Map, read_map, write_map
from perception.masks import make_source
from perception.masks.builtin import BuiltinSegmentation
from perception.masks.label_images import load_segmentation
from perception.photos.scene_file import load_saved_scene, save_scene
from perception.photos.view_json import stored_view
from perception.pipeline.blocks import cut, optimise_blocks
from perception.pipeline.checkpoint import clear_work, fingerprint, frames_folder, poses_mark, working
from perception.pipeline.estimate import log_estimate
from perception.pipeline.instances import FoundInstances, describe, group_gaussians
from perception.pipeline.optimise import Photos, Run, label_by_tasks, label_photos, optimise
from perception.pipeline.record import depth_errors, depth_used, finite, peak_memory_mib
from perception.progress import QUIET, Progress
from perception.report.text import depth_text, frame_lines
from perception.sfm.options import ReadOptions
from perception.tasks.engine import Engine
from perception.tasks.folder import versions
from perception.types import Scene, View

FRAME_FACTS = ("map_from_input", "scale", "gravity")
"""Entries of a scene's report that map.json holds at its top level."""


def build_map(
    source: Path,
    output: Path,
    config: MapConfig,
    *,
    resume: bool = False,
    progress: Progress = QUIET,
    engine: Engine | None = None,
    origin: str | None = None,
) -> Map:
    """Builds a map from photos, a video, a COLMAP workspace or a transforms.json, and writes it to `output`.

    Raises InputError for bad input. Intermediate results are kept beside `output` until the map is written; with
    `resume` a run continues from them and repeats only what has changed (see `pipeline.checkpoint`). A run that fails
    before training leaves no files. Resuming a finished run returns its map. engine: where features, masks and the
    blocks of a large place are made; None: here. origin: the input's name in map.json, where `source` is a copy of it.
    """
    started = time.monotonic()
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
        run = Run(source, config, work, work / "masks", device, progress)
        where = engine or Engine()

        # Posed images I_v (§3.2) and a sparse cloud.
        with run.stage("poses"):
            scene = _scene(source, output, run, where)
        _tell_scene(scene, progress)
        training, held_out = split_views(scene.views, config.photos.holdout, config.photos.held_out)
        held_out = exposed_as_neighbours(held_out, training)
        scene = replace(scene, views=sorted([*training, *held_out], key=lambda view: view.name))
        blocks, from_geometry = cut(scene, config.train.block_photos), isinstance(mask_source, BuiltinSegmentation)

        label_by_tasks(run, training, mask_source, where)

        # Optimise Gaussians on the photos and their masks (§3.1 to 3.2.3), block by block in a large place.
        if len(blocks) == 1:
            photos = Photos.load(run, training, held_out)
            nearby, trained, mask_report = optimise(run, scene, photos, mask_source)
            of_blocks: list[dict[str, Any]] = []
        else:
            nearby, trained, of_blocks = optimise_blocks(run, scene, blocks, held_out, from_geometry, where)
            photos = Photos.load(run, training, held_out)
            mask_report = label_photos(
                run, photos, mask_source, lambda view: surface_depth(nearby.of(view.name)[0], view)
            )
        del mask_source  # with the views of stereo

        # Group the Gaussians by their features into instances (§3.2.1), describe these from their best views (§3.2.2).
        with run.stage("instances"):
            cuts = load_segmentation(run.masks) if from_geometry else None
            grouped = group_gaussians(nearby, photos.views, run, cuts)
            found = describe(nearby, grouped, photos.views, run, encoder, reader)
        gaussians = nearby.gaussians.to("cpu")

        with run.stage("score"):
            quality = score_views(gaussians, photos.held, scene.metric)
        record = {
            "frame": scene.frame,
            "metric": scene.metric,
            **{key: scene.report[key] for key in FRAME_FACTS if key in scene.report},
            "source": origin or str(source),
            "seed": config.seed,
            "fingerprint": fingerprint(source, config),
            "config": config.to_json(),
            "versions": versions(),
            "scene": {key: fact for key, fact in scene.report.items() if key not in FRAME_FACTS},
            "masks": mask_report,
            "depth": depth_used(photos.views),
            "training": vars(trained),
            **({"blocks": of_blocks} if of_blocks else {}),
            "instances": found.report,
            "quality": quality,
            "seconds": {name: round(s, 2) for name, s in (*run.seconds.items(), ("total", time.monotonic() - started))},
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


def _scene(source: Path, output: Path, run: Run, engine: Engine) -> Scene:
    config, work, progress = run.config, run.work, run.progress
    kept = work / f"poses-{poses_mark(source, config)}"
    scene = load_saved_scene(kept)
    if scene is None:
        log_estimate(source, config, progress.log)
        photos = config.photos
        masks, camera, cloud = (
            Path(p) if p else None for p in (photos.ignore_masks, photos.camera, photos.init_points)
        )
        frames = frames_folder(output)
        options = ReadOptions(
            work / "sfm", config.seed, progress, photos.strict, masks, camera, frames, cloud, photos.poses, engine
        )
        scene = load_scene(source, options)
        save_scene(kept, scene := in_world_frame(recentred(scene), config.frame, config.seed))
    if config.losses.depth_weight == 0:
        return replace(scene, views=[replace(view, depth=None) for view in scene.views])
    return scene


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
    lines = [f"{len(scene.views)} posed photos{depth}, {len(scene.points)} points"]
    lines += frame_lines({"metric": scene.metric, **report})
    if report.get("exposure", {}).get("varies"):
        lines.append(f"exposure varies by {report['exposure']['spread']:.0%} between photos: each has its gains")
    lines += report.get("notes", [])
    lines += [f"left out: {entry['name']} ({entry['why']})" for entry in report.get("left_out", [])]
    lines += [f"warning: {warning}" for warning in report.get("warnings", [])]
    progress.log("\n".join(lines))


def _tell_result(gmap: Map, output: Path, progress: Progress) -> None:
    info, quality = gmap.info, gmap.info["quality"]
    scored = f", held-out PSNR {quality['psnr']:.2f} dB, SSIM {quality['ssim']:.3f}" if quality.get("psnr") else ""
    scored += f", {depth_text(quality['depth'])}" if "depth" in quality else ""
    progress.log(
        f"{output}: {len(gmap)} Gaussians, {len(gmap.instances)} instances{scored}, "
        f"{info['seconds']['total']:.0f} s, peak {info['peak_memory_mib']:.0f} MiB"
    )
