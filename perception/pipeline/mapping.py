"""Builds a map from an input in the stages of OpenSplat3D: poses, masks, optimise, group, describe.

Section (§) and equation numbers are the paper's (Piekenbrinck et al. 2025).
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from perception.config import MapConfig
from perception.errors import InputError
from perception.frame.recentre import recentred
from perception.frame.world_frame import in_world_frame, references
from perception.gaussians.photos import held_out_names, split_scene
from perception.inputs.load import load_scene
from perception.language.base import Encoder
from perception.language.encoders import make_encoder
from perception.language.ocr import TextReader, make_reader
from perception.machine import blas_on_one_thread, return_free_memory
from perception.map.write import Map, write_map
from perception.masks import MaskSource, make_source
from perception.masks.compute import load_segmentation
from perception.photos.scene_file import load_saved_scene, save_scene
from perception.photos.view_json import stored_view
from perception.pipeline.blocks import cut, optimise_blocks
from perception.pipeline.changes import finished, hold_inputs, refuse_unnamed
from perception.pipeline.checkpoint import check_name, fingerprint, frames_folder, poses_mark, working
from perception.pipeline.estimate import log_estimate
from perception.pipeline.instances import DescribedInstances, describe, group_gaussians
from perception.pipeline.optimise import Optimised, Run, label_by_tasks, optimise
from perception.pipeline.record import finite, run_record, scored
from perception.pipeline.splats import SplatInput, open_splat, unchanged
from perception.progress import QUIET, Progress
from perception.report.text import depth_text, frame_lines
from perception.sfm.options import ReadOptions
from perception.tasks.engine import LOCAL, Engine
from perception.types import Scene


def build_map(
    source: Path,
    output: Path,
    config: MapConfig,
    *,
    resume: bool = False,
    progress: Progress = QUIET,
    engine: Engine = LOCAL,
) -> Map:
    """Builds a map from photos, a video, a COLMAP workspace or a transforms.json, and writes it to `output`.

    Raises InputError for bad input. What a run has made is kept beside `output` until the map is written; `resume` goes
    on from there (see `pipeline.checkpoint`), or returns a finished map. engine: where tasks run.

    >>> config = MapConfig(masks="labels:table/labels", train={"iterations": 20}, language={"encoder": "none"})
    >>> gmap = build_map(Path("table"), Path("table.gsmap"), config)
    >>> len(gmap.views), gmap.means.shape == (len(gmap), 3)
    (12, True)
    """
    check_name(output)
    if resume and (made := finished(source, output, config, fingerprint(source, config), progress)) is not None:
        return made
    with blas_on_one_thread(), working(source, output, resume) as work:
        # Files, models and devices are opened first, so that errors appear before hours of work.
        refuse_unnamed(hold_inputs(work, source, config, output), config)
        run = Run.begun(source, config, work, progress, engine)
        masks, encoder, reader = _open_models(run)
        splat = open_splat(source, config)
        references(config.frame)
        if config.photos.held_out is not None:
            held_out_names(Path(config.photos.held_out))

        # Posed images I_v (§3.2) and a sparse cloud.
        scene = _posed_scene(output, run, splat)
        photos = config.photos if splat is None else config.photos.model_copy(update={"holdout": 0})
        scene, training, held_out = split_scene(scene, photos)
        _log_scene(scene, progress)

        # Masks M_v,i of every photo (§3.2), and Gaussians optimised on photos and masks (§3.1 to 3.2.3).
        label_by_tasks(run, training, masks)
        if splat is not None:  # Gaussians as they are, and features alone
            optimised = splat.optimise(run, training, held_out, masks)
        elif len(blocks := cut(scene, config.train.block_photos)) == 1:
            optimised = optimise(run, scene, training, held_out, masks)
        else:
            optimised = optimise_blocks(blocks, run, scene, training, held_out, masks)
        segments = load_segmentation(run.masks) if masks.needs_depth else None
        del masks  # with its images

        # Group the Gaussians by their features into instances (§3.2.1), describe these from their best views (§3.2.2).
        with run.stage("instances"):
            grouped = group_gaussians(optimised, run, segments)
            described = describe(optimised, grouped, run, encoder, reader)
        del encoder, reader  # with their networks
        return_free_memory()
        gmap = _assemble(run, scene, optimised, described, output, splat)
        write_map(output, gmap, fresh=True)
    _log_result(gmap, output, progress)
    return gmap


def _open_models(run: Run) -> tuple[MaskSource, Encoder | None, TextReader | None]:
    """The source of masks; the image-text encoder, None if disabled or if "auto" has none; the reader of texts."""
    config, encoder = run.config, None
    masks, spec = make_source(config.masks, config.sam), config.language.encoder
    try:
        encoder = make_encoder(spec, pictures=True)
    except InputError as error:
        if spec != "auto":
            raise
        run.progress.log(f"warning: no language: {error}")
    return masks, encoder, make_reader(config.language.texts)


def _posed_scene(output: Path, run: Run, splat: SplatInput | None) -> Scene:
    """The scene of the input in the map's frame: read from the work folder, or made and kept there."""
    source, config, work, progress = run.source, run.config, run.work, run.progress
    kept = work / f"poses-{poses_mark(source, config)}"
    with run.stage("poses"):
        scene = load_saved_scene(kept)
        if scene is None and splat is not None:
            save_scene(kept, scene := splat.scene(run, output))
        elif scene is None:
            log_estimate(source, config, progress.log)
            photos = config.photos
            files = (photos.ignore_masks, photos.camera, photos.init_points)
            masks, camera, cloud = (Path(file) if file else None for file in files)
            options = ReadOptions(work / "sfm", config.seed, progress, photos.strict, masks, camera)
            options = replace(options, frames=frames_folder(output), init_points=cloud, poses=photos.poses)
            scene = load_scene(source, replace(options, still=photos.ignore_still, engine=run.engine))
            save_scene(kept, scene := in_world_frame(recentred(scene), config.frame, config.seed))
        if config.losses.depth_weight == 0:
            scene = replace(scene, views=[replace(view, depth=None) for view in scene.views])
    run.inputs = hold_inputs(work, source, config, output)  # the frames of a video among them
    return scene


def _assemble(
    run: Run, scene: Scene, optimised: Optimised, described: DescribedInstances, output: Path, splat: SplatInput | None
) -> Map:
    """The map to write, scored in its held-out views; in JSON values, None replaces NaN and infinity."""
    gaussians, quality = scored(run, optimised, scene.metric)
    held = {view.name: view for view in optimised.photos.held_out}
    arrays: dict[str, Any] = {name: tensor.detach().numpy() for name, tensor in gaussians.named().items()}
    return Map(
        **unchanged(splat, arrays),
        instance_ids=described.ids,
        membership=described.membership,
        instances=finite(described.instances),
        info=finite(run_record(run, scene, optimised, described.report, quality)),
        views=[stored_view(held.get(view.name, view), output, view.name in held) for view in scene.views],
        language=described.language,
        parts=described.parts,
        groups=described.groups,
    )


def _log_scene(scene: Scene, progress: Progress) -> None:
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


def _log_result(gmap: Map, output: Path, progress: Progress) -> None:
    info, quality = gmap.info, gmap.info["quality"]
    scored = f", held-out PSNR {quality['psnr']:.2f} dB, SSIM {quality['ssim']:.3f}" if quality.get("psnr") else ""
    scored += f", {depth_text(quality['depth'])}" if "depth" in quality else ""
    progress.log(
        f"{output}: {len(gmap)} Gaussians, {len(gmap.instances)} instances{scored}, "
        f"{info['seconds']['total']:.0f} s, peak {info['peak_memory_mib']:.0f} MiB"
    )
