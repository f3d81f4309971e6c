"""Reads transforms.json of nerfstudio and instant-ngp: camera-to-world matrices with OpenGL camera axes."""

from __future__ import annotations

import contextlib
import math
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from perception.errors import InputError
from perception.geometry import OPENCV_FROM_OPENGL, inverse_se3
from perception.inputs.start_cloud import start_points
from perception.io.documents import brief, read_json, safe_name
from perception.photos.decode import SUFFIXES, photo_size, why_left_out
from perception.photos.ignore_masks import mask_of
from perception.photos.lens import FISHEYE, PERSPECTIVE, camera_from_lens, opencv_lens
from perception.photos.view_json import absolute
from perception.photos.views import fit_lens, make_view, rigid_pose
from perception.sfm.options import NO_CLOUD, ReadOptions
from perception.sfm.triangulate import posed_scene
from perception.types import DepthImage, Lens, Scene, View

_FISHEYE = ("OPENCV_FISHEYE", "FISHEYE")
_PERSPECTIVE = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "FULL_OPENCV", "PERSPECTIVE")
MILLIMETRE = 1e-3
"""Unit of depth images without `depth_unit_scale_factor` or `integer_depth_scale`, in metres: nerfstudio's default."""
GRAVITY_ERROR = 1.0
"""Standard error in degrees of a `gravity` without `gravity_std_deg`, as of a phone's motion sensors."""


def read_transforms(file: Path, options: ReadOptions) -> Scene:
    """The frames of a transforms.json whose photos exist, as a Scene in the file's own world.

    Intrinsics of a frame override global ones. Without fl_x the focal length is computed from camera_angle_x; without w
    and h the size is that of the photo. Points are read from `ply_file_path`, else triangulated with the given poses.
    The unit is the metre if `metric` is true. View names are paths below the common folder of all photos. Missing and
    damaged photos are left out and reported.
    """
    data = _load(file)
    frames = data["frames"]
    if not frames:
        raise InputError(f"{file}: 'frames' is empty; expected at least one posed photo")
    photos, missing = _photos(file, frames, options.strict)
    if not photos:
        first = f"{missing[0]['name']}: {missing[0]['why']}"
        raise InputError(f"{file}: none of the {len(frames)} photos it lists can be read (first: {first})")
    views, notes = _views(file, data, photos, options.masks)
    listed = options.cloud
    if listed is None and data.get("ply_file_path"):
        listed = start_points(_listed(file, "ply_file_path", data["ply_file_path"]))
    facts: dict[str, Any] = {"input": "transforms", "left_out": missing, "warnings": notes, **_gravity(file, data)}
    facts["mean_reprojection_error_px"] = None
    if options.cloud is None and listed is not None:
        facts["points_from"] = str(data["ply_file_path"])
    scene = posed_scene(views, listed or NO_CLOUD, facts, options, least=1)
    return replace(scene, metric=data.get("metric") is True)


def transforms_file(source: Path) -> Path:
    """The transforms.json in a folder, or `source` itself."""
    return source / "transforms.json" if source.is_dir() else source


def is_transforms(source: Path) -> bool:
    """Whether `source` is a JSON file, or a folder with a transforms.json."""
    return transforms_file(source).suffix.lower() == ".json" and transforms_file(source).is_file()


def read_frames(file: Path) -> list[tuple[str, np.ndarray, Lens]]:
    """(file_path, camera_from_world [4, 4], lens) of every frame, in file order; with w, h photos need not exist."""
    data = _load(file)
    return [(str(f["file_path"]), _pose(file, f), _lens(file, {**data, **f}, None)) for f in data["frames"]]


def in_map_frame(file: Path) -> bool:
    """Whether its poses are in the frame of a map, as `perception localise` writes them, not in that of an input."""
    data = read_json(file)
    return isinstance(data, dict) and "map_id" in data


def lens_values(lens: Lens) -> dict[str, Any]:
    """The keys of a lens in transforms.json, as this file reads them. InputError for a model that has none there."""
    names = {"f": ("fl_x", "fl_y"), "fx": ("fl_x",), "fy": ("fl_y",), "k": ("k1",)}
    fisheye = "FISHEYE" in lens.model
    values: dict[str, Any] = {"camera_model": "OPENCV_FISHEYE" if fisheye else "OPENCV"}
    for name, value in zip(camera_from_lens(lens).params_info.split(", "), lens.params, strict=True):
        values.update(dict.fromkeys(names.get(name, (name,)), value))
    if values.keys() - {"camera_model", "fl_x", "fl_y", "cx", "cy", *(FISHEYE if fisheye else PERSPECTIVE)}:
        raise InputError(f"camera model {lens.model} cannot be written to a transforms.json; undistort the photos")
    return {**values, "w": lens.width, "h": lens.height}


def listed_photos(file: Path) -> tuple[list[Path], bool]:
    """The photos that a transforms.json lists and that exist, in file order, and whether it lists depth images."""
    frames = _load(file)["frames"]
    found = (_find(file.parent, str(frame["file_path"])) for frame in frames)
    return [photo for photo in found if photo is not None], any("depth_file_path" in frame for frame in frames)


def listed_files(file: Path) -> list[Path]:
    """A transforms.json, and the photos, masks, depth images and cloud that it lists and that exist."""
    data, keys = _load(file), ("file_path", "mask_path", "depth_file_path", "depth_path")
    listed = [data.get("ply_file_path"), *(frame.get(key) for frame in data["frames"] for key in keys)]
    found = (_find(file.parent, str(name)) for name in listed if name)
    return [file, *(path for path in found if path is not None)]


def _views(
    file: Path, data: dict[str, Any], photos: dict[int, Path], masks: Path | None
) -> tuple[list[View], list[str]]:
    """Views sorted by name, and notes. photos: by number of the frame."""
    views, notes = dict[str, View](), set[str]()
    root = os.path.commonpath([absolute(photo).parent for photo in photos.values()])
    for index, photo in photos.items():
        frame = data["frames"][index]
        lens, note = fit_lens(_lens(file, {**data, **frame}, photo), photo, file)
        name = safe_name(absolute(photo).relative_to(root).as_posix(), file)
        if name in views:
            notes.add(f"{name} is listed more than once; the first pose is used")
            continue
        view = make_view(name, photo, lens, _pose(file, frame), file)
        mask = mask_of(masks, name)
        if mask is None and frame.get("mask_path"):
            mask = _listed(file, "mask", frame["mask_path"])
        views[name] = replace(view, depth=_depth(file, data, frame), mask=mask)
        if note:
            notes.add(note)
    return [views[name] for name in sorted(views)], sorted(notes)


def _load(file: Path) -> dict[str, Any]:
    data = read_json(file)
    frames = data.get("frames") if isinstance(data, dict) else None
    if not isinstance(frames, list):
        raise InputError(f"{file}: expected an object with a list 'frames' (nerfstudio / instant-ngp)")
    for index, frame in enumerate(frames):
        if not isinstance(frame, dict) or not {"file_path", "transform_matrix"} <= frame.keys():
            raise InputError(f"{file}: frame {index} lacks file_path or transform_matrix")
    return data


def _photos(file: Path, frames: list[dict[str, Any]], strict: bool) -> tuple[dict[int, Path], list[dict[str, str]]]:
    photos, missing = {}, []
    for index, frame in enumerate(frames):
        photo = _find(file.parent, str(frame["file_path"]))
        why = "listed, but the photo is missing" if photo is None else why_left_out(photo, strict)
        if photo is not None and why is None:
            photos[index] = photo
        else:
            missing.append({"name": str(frame["file_path"]), "why": str(why)})
    return photos, missing


def _find(folder: Path, listed: str) -> Path | None:
    plain = folder / listed
    others = (plain.with_name(plain.name + suffix) for suffix in sorted(SUFFIXES) if plain.name)
    # Path.is_file raises for a name that is too long for the file system.
    return next((path for path in (plain, *others) if os.path.isfile(path)), None)  # noqa: PTH113


def _pose(file: Path, frame: dict[str, Any]) -> np.ndarray:
    what = f"{file}: the pose of {frame['file_path']}"
    try:
        matrix = np.asarray(frame["transform_matrix"], dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{what} is not a 4×4 matrix of numbers") from error
    if matrix.shape == (3, 4):
        matrix = np.vstack([matrix, [0.0, 0.0, 0.0, 1.0]])
    return OPENCV_FROM_OPENGL @ inverse_se3(rigid_pose(matrix, what))


def _depth(file: Path, data: dict[str, Any], frame: dict[str, Any]) -> DepthImage | None:
    """The depth image that a frame names; the unit is a millimetre unless a scale is given, as in nerfstudio."""
    listed = frame.get("depth_file_path", frame.get("depth_path"))
    if not listed:
        return None
    what, keys = f"{file}: {frame['file_path']}", ("depth_unit_scale_factor", "integer_depth_scale")
    scales = (_number({**data, **frame}, key, what) for key in keys)
    scale = next((scale for scale in scales if scale is not None), MILLIMETRE)
    if scale <= 0:
        raise InputError(f"{what}: the scale of its depth must be above 0, found {scale:g}")
    return DepthImage(_listed(file, "depth image", listed), scale)


def _listed(file: Path, what: str, listed: object) -> Path:
    path = _find(file.parent, str(listed))
    if path is None:
        raise InputError(f"{file}: {what} {brief(listed)} does not exist; remove the entry or add the file")
    return path


def _gravity(file: Path, data: dict[str, Any]) -> dict[str, Any]:
    """The report's entry of `gravity` [3], down in the file's world, whose error in degrees is `gravity_std_deg`."""
    if data.get("gravity") is None:
        return {}
    try:
        down = np.array(data["gravity"], np.float64)
    except (TypeError, ValueError, OverflowError):
        down = np.zeros(3)
    length = float(np.linalg.norm(down)) if down.shape == (3,) else 0.0
    error = _number(data, "gravity_std_deg", str(file))
    if not 0 < length < np.inf or (error is not None and error <= 0):
        raise InputError(f"{file}: gravity must be three numbers, not all 0, and gravity_std_deg above 0")
    error = GRAVITY_ERROR if error is None else error
    return {"gravity": {"direction": (down / length).tolist(), "source": file.name, "standard_error_deg": error}}


def _lens(file: Path, values: dict[str, Any], photo: Path | None) -> Lens:
    """Lens of one frame; values: the global keys of the file, overridden by those of the frame."""
    what = f"{file}: {values['file_path']}"
    width, height = (_number(values, key, what) for key in ("w", "h"))
    if width is None or height is None:
        if photo is None:
            raise InputError(f"{what} has no w and h")
        width, height = photo_size(photo)
    fx, fy = _focals(values, what, width, height)
    cx, cy = _number(values, "cx", what), _number(values, "cy", what)
    center = (width / 2 if cx is None else cx, height / 2 if cy is None else cy)
    model = str(values.get("camera_model") or "OPENCV").upper()
    fisheye = bool(values.get("is_fisheye")) or model in _FISHEYE
    if not fisheye and model not in _PERSPECTIVE:
        raise InputError(f"{what}: camera_model '{model}' is not supported; expected one of {_PERSPECTIVE + _FISHEYE}")
    k = [_number(values, key, what) or 0.0 for key in (FISHEYE if fisheye else PERSPECTIVE)]
    k = [] if "PINHOLE" in model and not fisheye else k
    return opencv_lens((fx, fy, *center), k, int(width), int(height), fisheye)


def _focals(values: dict[str, Any], what: str, width: float, height: float) -> tuple[float, float]:
    keys = ("fl_x", "fl_y", "camera_angle_x", "camera_angle_y")
    fx, fy, angle_x, angle_y = (_number(values, key, what) for key in keys)
    if fx is None and fy is None and angle_y:
        fy = 0.5 * height / math.tan(0.5 * angle_y)
    if fx is None and angle_x:
        fx = 0.5 * width / math.tan(0.5 * angle_x)
    fx = fy if fx is None else fx
    fy = fx if fy is None else fy
    if fx is None or fy is None or min(fx, fy) <= 0:
        raise InputError(f"{what} has no focal length; expected fl_x (pixels) or camera_angle_x (radians), above 0")
    return fx, fy


def _number(values: dict[str, Any], key: str, what: str) -> float | None:
    value = values.get(key)
    if value is None:
        return None
    if not isinstance(value, bool) and isinstance(value, (int, float)):
        with contextlib.suppress(OverflowError):  # an integer out of range of float64
            if math.isfinite(number := float(value)):
                return number
    raise InputError(f"{what}: {key} must be a finite number, found {brief(value)}")
