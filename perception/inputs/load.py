"""Reads any input as a Scene: a transforms.json, a COLMAP workspace, an RGB-D recording, photos or a video."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

from perception.errors import InputError
from perception.inputs.readers import JSON, PhotoSizes, other_inputs, reader_of
from perception.inputs.start_cloud import check_seen, start_points
from perception.photos.camera_file import read_camera
from perception.photos.ignore_masks import with_checked_masks
from perception.photos.lens import lens_warnings, pinhole_from_lens
from perception.sfm.options import ReadOptions
from perception.types import Scene


def load_scene(source: Path, options: ReadOptions) -> Scene:
    """Posed views of `source`, sorted by name, with a sparse cloud.
    A folder is read by its COLMAP model if it has one, else by its transforms.json or another JSON with frames, else as
    an RGB-D recording if it has the layout of one, else as photos, with poses from structure from motion (see
    `readers`). What it holds besides is noted."""
    started = time.perf_counter()
    reader, camera, cloud, masks = reader_of(source), options.camera, options.init_points, options.masks
    if camera is not None and reader.cameras:
        raise InputError(f"{camera}: a camera file goes with photos or a video; {source} brings its own cameras")
    if cloud is not None and not reader.poses:
        raise InputError(f"{cloud}: a cloud to start from goes with an input that has poses; {source} has none")
    if masks is not None and not masks.is_dir():
        raise InputError(f"{masks}: no such folder of masks")
    lens, start = None if camera is None else read_camera(camera), None if cloud is None else start_points(cloud)
    if lens is not None:
        pinhole_from_lens(lens)  # refuses what describes no camera, before any work
    options = replace(options, lens=lens, cloud=start or options.cloud)
    options.workdir.mkdir(parents=True, exist_ok=True)
    scene = reader.read(source, options)
    notes = other_inputs(source, reader)
    if masks is None and reader.name != JSON and (source / "masks").is_dir():
        notes.append(f"{source / 'masks'} is not read; to ignore what is black there, give --ignore-masks")
    scene.report["notes"] = [*notes, *scene.report.get("notes", [])]
    scene.report["warnings"] += [f"{camera}: {line}" for line in (lens_warnings(lens) if lens else [])]
    if cloud is not None:
        scene.report["points_from"] = str(cloud)
    if reader.poses and len(scene.points) and (start or options.cloud is None):  # not the points of a map
        check_seen(scene, cloud or source)
    scene = with_checked_masks(scene, masks)
    scene.report["seconds"]["total"] = time.perf_counter() - started
    return scene


def photo_sizes(source: Path) -> PhotoSizes:
    """The sizes of the photos of `source` from their headers; photos that cannot be read are skipped.
    A video counts as the maximum number of frames. InputError where `source` cannot be read."""
    return reader_of(source).sizes(source)


def input_files(source: Path) -> list[Path]:
    """The files of `source` that a scene may come from: photos, depth images, masks, poses, cameras, models, clouds.
    InputError as `load_scene`."""
    return reader_of(source).files(source)
