"""Reads any input as a Scene: a transforms.json, a COLMAP workspace, an RGB-D recording, photos or a video; and keeps
scenes, so that a resumed run starts from the same poses and points as the interrupted one."""

from __future__ import annotations

import json
import shutil
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from perception.errors import InputError
from perception.io.arrays import read_npz
from perception.io.atomic import atomic_directory
from perception.io.documents import DAMAGE
from perception.photos.camera_file import read_camera
from perception.photos.ignore_masks import with_checked_masks
from perception.photos.reading import Reading, check_seen, start_points
from perception.photos.view_json import view_from_json, view_json
from perception.types import Lens, Scene, View

EXPECTED = (
    "a folder of photos, a video, a COLMAP workspace, a transforms.json or an RGB-D recording (TUM, ScanNet, 7-Scenes, "
    "3DMatch, Redwood)"
)


def load_scene(source: Path, how: Reading) -> Scene:
    """Posed views of `source`, sorted by name, with a sparse cloud.

    A folder is read as a COLMAP workspace if it is one, else by its transforms.json if it has one, else as an RGB-D
    recording if it has the layout of one, else as photos, with poses from structure from motion.
    """
    from perception.inputs.colmap import read_workspace
    from perception.inputs.layouts import refuse_depth_without_poses
    from perception.inputs.recordings import Recording, recorded_scene
    from perception.inputs.transforms import read_transforms
    from perception.sfm.reconstruct import reconstruct

    started = time.perf_counter()
    kind = _kind(source)
    unposed = kind in ("photos", "video")
    if how.camera is not None and not unposed and not isinstance(kind, Recording):
        raise InputError(f"{how.camera}: a camera file goes with photos or a video; {source} brings its own cameras")
    if how.init_points is not None and unposed:
        what = "a cloud to start from goes with an input that has poses"
        raise InputError(f"{how.init_points}: {what}; {source} has none")
    if how.masks is not None and not how.masks.is_dir():
        raise InputError(f"{how.masks}: no such folder of masks")
    lens = None if how.camera is None else read_camera(how.camera)
    how = replace(how, cloud=None if how.init_points is None else start_points(how.init_points))
    how.workdir.mkdir(parents=True, exist_ok=True)
    if kind == "video":
        scene = _scene_of_video(source, lens, how)
    elif kind == "photos":
        refuse_depth_without_poses(source)
        scene = reconstruct(source, lens, how)
    elif kind == "workspace":
        scene = read_workspace(source, how)
    elif isinstance(kind, Path):
        scene = read_transforms(kind, how)
    else:
        scene = recorded_scene(replace(kind, lens=lens or kind.lens), how)
    if how.init_points is not None:
        scene.report["points_from"] = str(how.init_points)
        check_seen(scene, how.init_points)
    scene = with_checked_masks(scene, how.masks)
    scene.report["seconds"]["total"] = time.perf_counter() - started
    return scene


def _kind(source: Path) -> Any:
    """What an input is: "video", "workspace", "photos", its transforms.json, or the Recording in it."""
    from perception.inputs.colmap import is_workspace
    from perception.inputs.layouts import find_recording
    from perception.photos.folder import VIDEO_SUFFIXES

    if not source.exists():
        raise InputError(f"{source}: no such file or folder; expected {EXPECTED}")
    if source.is_dir():
        if is_workspace(source):
            return "workspace"
        file = source / "transforms.json"
        return file if file.is_file() else find_recording(source) or "photos"
    if source.suffix.lower() in VIDEO_SUFFIXES:
        return "video"
    if source.suffix.lower() != ".json":
        raise InputError(f"{source}: expected {EXPECTED}")
    return source


def input_files(source: Path) -> list[Path]:
    """The files of `source` that a scene may come from: photos, depth images, masks, poses, cameras, models, clouds.
    InputError as `load_scene`."""
    from perception.inputs.colmap import model_files
    from perception.inputs.layouts import text_files
    from perception.inputs.recordings import Recording
    from perception.inputs.transforms import listed_files
    from perception.photos.folder import list_photos

    kind = _kind(source)
    if kind == "photos":
        return list_photos(source)
    if kind == "workspace":
        return [*list_photos(source / "images"), *model_files(source)]
    if isinstance(kind, Recording):
        images = (image for frame in kind.frames for image in (frame.photo, frame.depth))
        return [*text_files(source), *(image for image in images if image is not None)]
    return listed_files(kind) if isinstance(kind, Path) else [source]


@dataclass(frozen=True)
class PhotoSizes:
    """(width, height) of every photo of an input; what: their number as text; depth: photos have depth images."""

    sizes: list[tuple[int, int]]
    what: str
    depth: bool = False


def photo_sizes(source: Path) -> PhotoSizes:
    """The sizes of the photos of `source` from their headers; photos that cannot be read are skipped.
    A video counts as the maximum number of frames. InputError where `source` cannot be read."""
    from perception.inputs.recordings import MOST_FRAMES as MOST_RECORDED
    from perception.inputs.recordings import Recording
    from perception.inputs.transforms import listed_photos
    from perception.photos.folder import list_photos
    from perception.photos.video import MOST_FRAMES, frame_size

    kind = _kind(source)
    if kind == "video":
        return PhotoSizes([frame_size(source)] * MOST_FRAMES, f"at most {MOST_FRAMES} frames")
    if isinstance(kind, Recording) and kind.frames:
        count = len(kind.frames)
        size = _size(kind.frames[0].photo) or (640, 480)
        taken = min(count, MOST_RECORDED)
        return PhotoSizes([size] * taken, f"at most {taken} of {count} frames", bool(kind.frames[0].depth))
    depth = False
    if isinstance(kind, Path):
        photos, depth = listed_photos(kind)
    else:
        photos = list_photos(source / "images" if kind == "workspace" else source)
    sizes = [size for size in map(_size, photos) if size is not None]
    return PhotoSizes(sizes, f"{len(sizes)} photos", depth)


def _size(photo: Path) -> tuple[int, int] | None:
    from perception.photos.decode import photo_size

    try:
        return photo_size(photo)
    except InputError:
        return None


def _scene_of_video(video: Path, lens: Lens | None, how: Reading) -> Scene:
    from perception.photos.video import video_frames
    from perception.sfm.reconstruct import reconstruct

    folder = how.frames or how.workdir / "frames"
    new = not folder.exists()
    record = video_frames(video, folder, how.progress)
    try:
        scene = reconstruct(folder, lens, how)
    except InputError:
        if new:
            shutil.rmtree(folder, ignore_errors=True)
        raise
    taken = f"{record['chosen']} of {record['frames']} frames of {video.name}"
    scene.report["notes"].insert(0, f"{folder}: {taken}; they are the map's photos, keep them")
    return scene


def save_scene(folder: Path, scene: Scene) -> None:
    """Writes `scene` to `folder` atomically; photos are not copied."""
    views = [view_json(view) for view in scene.views]
    facts = {"views": views, "metric": scene.metric, "frame": scene.frame, "report": scene.report}
    with atomic_directory(folder) as aside:
        (aside / "scene.json").write_text(json.dumps(facts, default=str), encoding="utf-8")
        np.savez(aside / "points.npz", points=scene.points, colors=scene.point_colors)


def load_saved_scene(folder: Path) -> Scene | None:
    """The scene saved in `folder`; None when there is none. InputError when it is damaged."""
    if not (folder / "scene.json").is_file():
        return None
    try:
        facts = json.loads((folder / "scene.json").read_text(encoding="utf-8"))
        arrays = read_npz(folder / "points.npz", folder / "points.npz", "")
        points, colors = arrays["points"], arrays["colors"]
        views: list[View] = [view_from_json(entry) for entry in facts["views"]]
        return Scene(views, points, colors, facts["metric"], facts["frame"], facts["report"])
    except DAMAGE as error:
        raise InputError(f"{folder}: the kept poses are damaged; delete {folder.parent} to start over") from error
