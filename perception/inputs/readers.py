"""The readers of inputs, in the order in which they are tried: a new kind of input is a new line of READERS."""

from __future__ import annotations

import contextlib
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from perception.errors import InputError
from perception.inputs import recordings
from perception.inputs.colmap import model_files, model_photos, models_below, read_workspace
from perception.inputs.layouts import layout_of, open_recording, refuse_depth_without_poses, text_files
from perception.inputs.transforms import (
    faults,
    json_files,
    listed_files,
    listed_photos,
    read_transforms,
    transforms_files,
)
from perception.photos import video
from perception.photos.decode import orientation, photo_size
from perception.photos.folder import VIDEO_SUFFIXES, folders_below, list_photos
from perception.photos.views import fit_lens
from perception.sfm.options import ReadOptions
from perception.sfm.reconstruct import reconstruct
from perception.types import Scene

COLMAP, JSON, RECORDING, PHOTOS = "COLMAP model", "JSON with frames", "RGB-D recording", "photos"
SENSOR_SIZE = (640, 480)
"""Width and height taken for the frames of a recording whose first cannot be read."""


@dataclass(frozen=True)
class PhotoSizes:
    """(width, height) of every photo of an input; what: their number as text; depth: photos have depth images."""

    sizes: list[tuple[int, int]]
    what: str
    depth: bool = False


@dataclass(frozen=True)
class Reader:
    """A kind of input. name: for messages. recognises: whether a path is one. sizes: of its photos, from their headers.
    files: all that the scene may come from. read: the Scene. poses, cameras: whether the input brings poses, and the
    intrinsics of its photos."""

    name: str
    recognises: Callable[[Path], bool]
    sizes: Callable[[Path], PhotoSizes]
    files: Callable[[Path], list[Path]]
    read: Callable[[Path, ReadOptions], Scene]
    poses: bool = False
    cameras: bool = False


def _sizes(photos: Sequence[Path], depth: bool = False) -> PhotoSizes:
    """Sizes of the photos that can be read."""
    sizes = []
    for photo in photos:
        with contextlib.suppress(InputError):
            sizes.append(photo_size(photo))
    return PhotoSizes(sizes, f"{len(sizes)} photos", depth)


def _is_video(source: Path) -> bool:
    return source.suffix.lower() in VIDEO_SUFFIXES and source.is_file()


def is_splat(source: Path) -> bool:
    """Whether a path is a file that may hold Gaussians, by its name."""
    return source.suffix.lower() in (".ply", ".spz") and source.is_file()


def _video_sizes(source: Path) -> PhotoSizes:
    return PhotoSizes([video.frame_size(source)] * video.MOST_FRAMES, f"at most {video.MOST_FRAMES} frames")


def _read_video(source: Path, options: ReadOptions) -> Scene:
    folder = options.frames or options.workdir / "frames"
    new = not folder.exists()
    record = video.video_frames(source, folder, options.progress)
    taken = f"{record['chosen']} of {record['frames']} frames of {source.name}"
    try:
        scene = _reconstructed(folder, options)
    except InputError as error:
        if new:
            shutil.rmtree(folder, ignore_errors=True)
        raise InputError(f"{source}: {taken} are sharp and of different views; {error}") from error
    scene.report["notes"].insert(0, f"{folder}: {taken}; they are the map's photos, keep them")
    return scene


def _recording_sizes(source: Path) -> PhotoSizes:
    frames = open_recording(source).frames
    taken = min(len(frames), recordings.MOST_FRAMES)
    size = (_sizes([frame.photo for frame in frames[:1]]).sizes or [SENSOR_SIZE])[0]
    return PhotoSizes([size] * taken, f"at most {taken} of {len(frames)} frames", bool(frames and frames[0].depth))


def _recording_files(source: Path) -> list[Path]:
    images = [image for frame in open_recording(source).frames for image in (frame.photo, frame.depth)]
    return [*text_files(source), *filter(None, images)]


def _read_photos(source: Path, options: ReadOptions) -> Scene:
    refuse_depth_without_poses(source)
    return _reconstructed(source, options)


def _reconstructed(folder: Path, options: ReadOptions) -> Scene:
    """`reconstruct`, with the lens of a camera file scaled to the largest photos that it fits: smaller copies are left
    out. A warning where the camera was turned by 180° between photos, which mirrors its principal point."""
    if options.lens is None:
        return reconstruct(folder, options)
    fitting = []
    for photo in list_photos(folder):
        with contextlib.suppress(InputError):
            fitting.append(fit_lens(options.lens, photo, as_stored=False))
    lens = max(filter(None, fitting), key=lambda lens: lens.width * lens.height, default=options.lens)
    scene = reconstruct(folder, replace(options, lens=lens))
    turns = [orientation(view.photo) for view in scene.views]
    other = [view.name for view, turn in zip(scene.views, turns, strict=True) if turn != max(turns, key=turns.count)]
    if other:
        turned = f"{len(other)} of {len(turns)} photos, such as {other[0]}, were taken with the camera turned by 180°"
        why = "which mirrors its principal point; map them without --camera"
        scene.report["warnings"].append(f"{options.camera}: {turned} (EXIF), {why}")
    return scene


def _refuse_splat(source: Path, options: ReadOptions) -> Scene:
    """A splat has no photos to read: `pipeline.splats` renders some."""
    raise InputError(f"{source}: is a finished splat, which `perception map` reads; photos are needed here")


READERS = (
    Reader("video", _is_video, _video_sizes, lambda source: [source], _read_video),
    Reader(
        COLMAP,
        lambda source: bool(models_below(source)),
        lambda source: _sizes(model_photos(source)),
        lambda source: [*model_photos(source), *model_files(source)],
        read_workspace,
        poses=True,
        cameras=True,
    ),
    Reader(
        JSON,
        lambda source: bool(transforms_files(source)),
        lambda source: _sizes(*listed_photos(source)),
        listed_files,
        read_transforms,
        poses=True,
        cameras=True,
    ),
    Reader(
        RECORDING,
        lambda source: layout_of(source) is not None,
        _recording_sizes,
        _recording_files,
        lambda source, options: recordings.recorded_scene(open_recording(source), options),
        poses=True,
    ),
    Reader(PHOTOS, Path.is_dir, lambda source: _sizes(list_photos(source)), list_photos, _read_photos),
    Reader("splat", is_splat, lambda source: PhotoSizes([], "no photos"), lambda source: [source], _refuse_splat),
)
EXPECTED = (
    "a folder of photos, a video, a COLMAP workspace, a transforms.json, an RGB-D recording (TUM, ScanNet, 7-Scenes, "
    "3DMatch, Redwood) or a finished splat (.ply, .spz)"
)
_BAGS = (".bag", ".mcap", ".db3")
UNREAD = (
    *("*.nvm", "bundle*.out", "camera*.xml", "cameras.sfm", "sfm_data.json", "poses_bounds.npy", "reconstruction.json"),
    *("cameras.json", "model.tsv", "*.rsproj", "*.psx", "*.xmp", "cameras/*.json", "metadata.json", "odometry.csv"),
    *("frame_*.json", "traj*.txt", "*.traj"),
)
"""Files of other programs that hold poses of photos and are not read: Bundler, Metashape, Meshroom, OpenMVG, LLFF,
OpenSfM, Gaussian splatting, RealityScan, Polycam, Record3D, Stray Scanner, 3D Scanner App, Replica, kapture, ARKit."""
UNREAD_DEPTH = 2
"""Folders below the input in which they are looked for."""


def reader_of(source: Path) -> Reader:
    """The first reader that recognises `source`. InputError where none does, and for a ROS bag."""
    if not source.exists():
        raise InputError(f"{source}: no such file or folder; expected {EXPECTED}")
    found = next((reader for reader in READERS if reader.recognises(source)), None)
    inside = source.glob("*") if source.is_dir() else [source]
    if any(path.suffix in _BAGS for path in inside) and (found is None or not found.files(source)):
        raise InputError(f"{source}: is a ROS bag; take photos and poses out of it first: perception frames")
    if found is None:
        raise InputError(f"{source}: expected {EXPECTED}")
    return found


def other_inputs(source: Path, reader: Reader) -> list[str]:
    """A line on what folder `source`, read by `reader`, holds besides, and one on poses that lie beside it."""
    if not source.is_dir():
        return []
    lines = [f"its poses are not read: {fault}" for fault in faults(source)]
    used = transforms_files(source) if reader.name == JSON else []
    others = [path.relative_to(source).as_posix() for path in json_files(source) if path not in used]
    if reader.name in (COLMAP, JSON) and layout_of(source) is not None:
        others.append(f"an {RECORDING}")
    below = folders_below(source, UNREAD_DEPTH)
    for found in ([path for folder in below for path in sorted(folder.glob(pattern))] for pattern in UNREAD):
        more = f" and {len(found) - 1} more" if found[1:] else ""
        others += [f"{path.relative_to(source).as_posix()}{more}" for path in found[:1]]
    if others:
        order = ", ".join(kind.name for kind in READERS[1:])
        lines.append(f"{source}: read as {reader.name}; not read: {', '.join(others)} (order of preference: {order})")
    if reader.name == PHOTOS:
        above = source.absolute().parent
        beside = [above / "sparse"] if models_below(above / "sparse") else []
        beside += [path for path in json_files(above) if path.name.startswith("transforms")]
        beside += [path for folder in below[1:] for path in sorted(folder.glob("transforms*.json"))]
        lines += [f"{path} holds poses that are not read; give {path.parent} to use them" for path in beside]
    return lines
