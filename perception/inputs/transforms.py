"""Reads JSON files of nerfstudio, instant-ngp and Blender: camera-to-world matrices with OpenGL camera axes."""

from __future__ import annotations

import contextlib
import math
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from perception.errors import InputError
from perception.geometry import OPENCV_FROM_OPENGL, inverse_se3
from perception.inputs.start_cloud import FEW_SEEN, seen_share, start_points
from perception.io.documents import brief, read_json, refusing, safe_name
from perception.photos.decode import SUFFIXES, photo_size, why_left_out
from perception.photos.ignore_masks import mask_of
from perception.photos.lens import FISHEYE, PERSPECTIVE, camera_from_lens, opencv_lens
from perception.photos.named_files import NamedFiles
from perception.photos.view_json import absolute, refuse_other_frame
from perception.photos.views import first_of, leaving_out, posed_view, rigid_pose, without_far
from perception.posed.triangulate import posed_scene
from perception.sfm.options import NO_CLOUD, ReadOptions
from perception.types import DepthImage, Lens, Scene, View

_FISHEYE = ("OPENCV_FISHEYE", "FISHEYE")
_RATIONAL = "FULL_OPENCV"
_PERSPECTIVE = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", _RATIONAL, "PERSPECTIVE")
_LISTED = ("k1", "k2", "k3", "k4", "p1", "p2")
"""The order of nerfstudio's `distortion_params`."""
MILLIMETRE = 1e-3
"""Unit of depth images without `depth_unit_scale_factor` or `integer_depth_scale`, in metres: nerfstudio's default."""
_TRAIN, _PART = "transforms_train.json", re.compile(r"transforms_(train|test|val\w*|eval)\.json$")
_FRAMES = re.compile(rb'"frames"\s*:\s*\[')
_NEEDED, _LACKS = {"file_path", "transform_matrix"}, "lacks file_path or transform_matrix"
GRAVITY_ERROR = 1.0
"""Standard error in degrees of a `gravity` without `gravity_std_deg`, as of a phone's motion sensors."""


def read_transforms(source: Path, options: ReadOptions) -> Scene:
    """The frames of the JSON files of `transforms_files` whose photos exist, as a Scene in the world of these files.

    Intrinsics of a frame override global ones. Without fl_x the focal length is computed from camera_angle_x; without w
    and h the size is that of the photo. Points are read from `ply_file_path`, else triangulated with the given poses.
    The unit is the metre if `metric` is true. View names are paths below the common folder of all photos. Photos that
    are missing or damaged, and frames that are wrong, are left out and reported. Views of frames of a "test" or "val"
    part are `held_out`.
    """
    files = transforms_files(source)
    file, listing = files[0], _Listing(files[0].parent)
    data, frames = _load(file), [frame for each in files for frame in _frames(each, each != file)]
    if not frames:
        raise InputError(f"{file}: 'frames' is empty; expected at least one posed photo")
    views, missing, notes = _views(file, frames, listing, options)
    if not views:
        raise InputError(f"{file}: none of the {len(frames)} photos it lists can be used{first_of(missing)}")
    listed = options.cloud
    if listed is None and data.get("ply_file_path"):
        listed = start_points(listing.needed(file, "ply_file_path", data["ply_file_path"]))
    views, far = without_far(views, (listed or NO_CLOUD)[0], set(), options.strict, file)
    if options.cloud is None and listed is not None and (share := seen_share(views, listed[0])) < FEW_SEEN:
        found = f"{share:.2%} of its points lie in the view of some photo, as if it had another frame or unit"
        notes, listed = [*notes, f"{data['ply_file_path']}: {found}; points are triangulated in its place"], None
    facts: dict[str, Any] = {
        "input": "transforms",
        "left_out": [*missing, *far],
        "warnings": notes,
        **_gravity(file, data),
    }
    facts["mean_reprojection_error_px"] = None
    if options.cloud is None and listed is not None:
        facts["points_from"] = str(data["ply_file_path"])
    if isinstance(data.get("frame_id"), str):  # of the map in which `perception localise` found the poses
        facts["frame_id"] = data["frame_id"]
    held = sum(view.held_out for view in views)
    split = f"; {held} of {len(views)} photos are of its test and val parts" if held else ""
    facts["notes"] = [f"poses of {file.parent}: {', '.join(each.name for each in files)}{split}"]
    scene = posed_scene(views, listed or NO_CLOUD, facts, options, least=1)
    return replace(scene, metric=data.get("metric") is True)


def transforms_files(source: Path) -> list[Path]:
    """The JSON files that are read of a folder: the first in the order of `json_files`; of `transforms_train.json` also
    the other parts beside it, "test" and "val". `source` itself for a file; [] without any."""
    if not source.is_dir():
        return [source] if source.suffix.lower() == ".json" and source.is_file() else []
    found = json_files(source)
    if not found or found[0].name != _TRAIN:
        return found[:1]
    return [path for path in found if _PART.match(path.name) and path.parent == found[0].parent]


def json_files(folder: Path) -> list[Path]:
    """JSON files with frames in a folder or its `images`, in order of preference: `transforms.json`,
    `transforms_train.json`, its other parts, any other by name."""
    ranks = ("transforms.json", _TRAIN)
    found = [path for path in _listing_frames(folder) if path.name == ranks[0] or _fault(path) is None]
    return sorted(
        found, key=lambda path: (ranks.index(path.name) if path.name in ranks else 2, not _PART.match(path.name))
    )


def faults(folder: Path) -> list[str]:
    """Why JSON files that list frames are not among `json_files`, a line each."""
    return [fault for path in _listing_frames(folder) if (fault := _fault(path)) is not None]


def _listing_frames(folder: Path) -> list[Path]:
    found = (path for inside in (folder, folder / "images") for path in sorted(inside.glob("*.json")))
    readable = (path for path in found if os.access(path, os.R_OK))
    return [path for path in readable if path.name == "transforms.json" or _FRAMES.search(path.read_bytes())]


def _fault(file: Path) -> str | None:
    try:
        return None if _load(file)["frames"] else f"{file}: 'frames' is empty"
    except InputError as error:
        return str(error)


def read_frames(file: Path) -> list[tuple[str, np.ndarray, Lens]]:
    """(file_path, camera_from_world [4, 4], lens) of every frame, in file order; with w, h photos need not exist."""
    frames = [frame.values for frame in _frames(file)]
    for index, values in enumerate(frames):
        if not values.keys() >= _NEEDED:
            raise InputError(f"{file}: frame {index} {_LACKS}")
    return [(str(values["file_path"]), _pose(file, values), _lens(file, values, None)) for values in frames]


def in_map_frame(file: Path, info: dict[str, Any], views: Sequence[View]) -> bool:
    """Whether its poses are in the frame of a map, as `perception localise` writes them, not in that of its input.
    info: of map.json; views: of the map. InputError where they are in another map's frame, or the map has had another
    unit then."""
    data = read_json(file)
    if not isinstance(data, dict) or "map_id" not in data:
        return False
    if "frame_id" in data and data["frame_id"] == info.get("scene", {}).get("frame_id"):
        return False
    refuse_other_frame(file, data, info, views, "run perception localise again")
    return True


def lens_values(lens: Lens) -> dict[str, Any]:
    """The keys of a lens in transforms.json, as this file reads them. InputError for a model that has none there."""
    names = {"f": ("fl_x", "fl_y"), "fx": ("fl_x",), "fy": ("fl_y",), "k": ("k1",)}
    fisheye = "FISHEYE" in lens.model
    model = "OPENCV_FISHEYE" if fisheye else _RATIONAL if lens.model == _RATIONAL else "OPENCV"
    values: dict[str, Any] = {"camera_model": model}
    for name, value in zip(camera_from_lens(lens).params_info.split(", "), lens.params, strict=True):
        values.update(dict.fromkeys(names.get(name, (name,)), value))
    known = {"camera_model", "fl_x", "fl_y", "cx", "cy", *(FISHEYE if fisheye else PERSPECTIVE)}
    if "DIVISION" in lens.model or values.keys() - known:  # whose k is of another formula
        raise InputError(f"camera model {lens.model} cannot be written to a transforms.json; undistort the photos")
    return {**values, "w": lens.width, "h": lens.height}


def listed_photos(source: Path) -> tuple[list[Path], bool]:
    """The photos that a transforms.json lists and that exist, in file order, and whether it lists depth images."""
    files = transforms_files(source)
    frames, listing = [frame.values for file in files for frame in _frames(file)], _Listing(files[0].parent)
    found = (listing.find(str(values.get("file_path"))) for values in frames)
    return [photo for photo in found if photo is not None], any("depth_file_path" in values for values in frames)


def listed_files(source: Path) -> list[Path]:
    """The files of `transforms_files`, and the photos, masks, depth images and cloud that they list and that exist."""
    files, keys = transforms_files(source), ("file_path", "mask_path", "depth_file_path", "depth_path")
    listing, clouds = _Listing(files[0].parent), [_load(file).get("ply_file_path") for file in files]
    listed = [*clouds, *(frame.values.get(key) for file in files for frame in _frames(file) for key in keys)]
    found = (listing.find(str(name)) for name in listed if name)
    return [*files, *(path for path in found if path is not None)]


@dataclass(frozen=True)
class _Frame:
    """A frame of a file. values: its keys, and the global ones that it does not override."""

    file: Path
    values: dict[str, Any]
    held_out: bool


class _Listing:
    """The files that a JSON file in `folder` lists: below the folder, or for one inside `images` beside that."""

    def __init__(self, folder: Path) -> None:
        self.folders = [NamedFiles(folder), *([NamedFiles(folder.parent)] if folder.name == "images" else [])]

    def find(self, listed: str) -> Path | None:
        """The file; a photo may be listed without its suffix."""
        found = (folder.find(listed, sorted(SUFFIXES)) for folder in self.folders)
        return next((path for path in found if path is not None), None)

    def needed(self, file: Path, what: str, listed: object) -> Path:
        """`find`, or an InputError that says what `file` lists."""
        path = self.find(str(listed))
        if path is None:
            raise InputError(f"{file}: {what} {brief(listed)} does not exist; remove the entry or add the file")
        return path


def _views(
    file: Path, frames: list[_Frame], listing: _Listing, options: ReadOptions
) -> tuple[list[View], list[dict[str, str]], list[str]]:
    """Views sorted by name, what is left out, and notes."""
    views, missing, notes, photos = dict[str, View](), list[dict[str, str]](), set[str](), dict[int, Path]()
    again = list[str]()
    for index, values in enumerate(frame.values for frame in frames):
        photo = listing.find(str(values.get("file_path")))
        why = "listed, but the photo is missing" if photo is None else why_left_out(photo, options.strict)
        if not values.keys() >= _NEEDED:
            why = f"{file}: frame {index} {_LACKS}"
            if options.strict:
                raise InputError(why)
        if photo is None or why is not None:
            missing.append({"name": str(values.get("file_path", f"frame {index}")), "why": str(why)})
        else:
            photos[index] = photo
    root = os.path.commonpath([absolute(photo).parent for photo in photos.values()]) if photos else ""
    for index, photo in photos.items():
        frame, name = frames[index], safe_name(absolute(photo).relative_to(root).as_posix(), file)
        values = frame.values
        if name in views:
            again.append(name)
            continue
        posed = None
        with leaving_out(missing, name, options.strict):
            lens, pose = _lens(frame.file, values, photo), _pose(frame.file, values)
            posed = posed_view(name, photo, lens, pose, frame.file)
        if posed is None:
            continue
        view, lines = posed
        mask = mask_of(options.masks, name)
        if mask is None and values.get("mask_path"):
            mask = listing.needed(frame.file, "mask", values["mask_path"])
        views[name] = replace(view, depth=_depth(frame.file, values, listing), mask=mask, held_out=frame.held_out)
        notes.update(lines)
    if again:
        what = f"{again[0]} is" if len(again) == 1 else f"{len(again)} photos, such as {again[0]}, are"
        notes.add(f"{what} listed more than once; the first pose is used")
    return [views[name] for name in sorted(views)], missing, sorted(notes)


def _load(file: Path) -> dict[str, Any]:
    data = read_json(file)
    frames = data.get("frames") if isinstance(data, dict) else None
    if not isinstance(frames, list):
        raise InputError(f"{file}: expected an object with a list 'frames' (nerfstudio / instant-ngp)")
    if frames and not any(isinstance(frame, dict) and frame.keys() >= _NEEDED for frame in frames):
        raise InputError(f"{file}: frame 0 {_LACKS}")
    return data


def _frames(file: Path, held_out: bool = False) -> list[_Frame]:
    """The frames of a file. held_out: the file is another part than "train"; else the lists of nerfstudio say."""
    data = _load(file)
    shared = {key: value for key, value in data.items() if key != "frames"}
    listed = (data.get(f"{key}_filenames") for key in ("train", "val", "test"))
    train, val, test = ({str(name) for name in names} if isinstance(names, list) else set() for names in listed)
    own = [frame if isinstance(frame, dict) else {} for frame in data["frames"]]
    return [
        _Frame(file, {**shared, **values}, held_out or str(values.get("file_path")) in (val | test) - train)
        for values in own
    ]


def _pose(file: Path, frame: dict[str, Any]) -> np.ndarray:
    what = f"{file}: the pose of {frame['file_path']}"
    with refusing(f"{what} is not a 4×4 matrix of numbers"):
        matrix = np.asarray(frame["transform_matrix"], dtype=np.float64)
    if matrix.shape == (3, 4):
        matrix = np.vstack([matrix, [0.0, 0.0, 0.0, 1.0]])
    return OPENCV_FROM_OPENGL @ inverse_se3(rigid_pose(matrix, what))


def _depth(file: Path, frame: dict[str, Any], listing: _Listing) -> DepthImage | None:
    """The depth image that a frame names; the unit is a millimetre unless a scale is given, as in nerfstudio."""
    listed = frame.get("depth_file_path", frame.get("depth_path"))
    if not listed:
        return None
    what, keys = f"{file}: {frame['file_path']}", ("depth_unit_scale_factor", "integer_depth_scale")
    scales = (_number(frame, key, what) for key in keys)
    scale = next((scale for scale in scales if scale is not None), MILLIMETRE)
    if scale <= 0:
        raise InputError(f"{what}: the scale of its depth must be above 0, found {scale:g}")
    return DepthImage(listing.find(str(listed)) or file.parent / str(listed), scale)


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
        width, height = photo_size(photo, as_stored=True)
    fx, fy = _focals(values, what, width, height)
    cx, cy = _number(values, "cx", what), _number(values, "cy", what)
    center = (width / 2 if cx is None else cx, height / 2 if cy is None else cy)
    model = str(values.get("camera_model") or "OPENCV").upper()
    fisheye = bool(values.get("is_fisheye")) or model in _FISHEYE
    if not fisheye and model not in _PERSPECTIVE:
        raise InputError(f"{what}: camera_model '{model}' is not supported; expected one of {_PERSPECTIVE + _FISHEYE}")
    k = _distortion(values, what, model, FISHEYE if fisheye else () if "PINHOLE" in model else PERSPECTIVE)
    return opencv_lens((fx, fy, *center), k, int(width), int(height), fisheye)


def _distortion(values: dict[str, Any], what: str, model: str, names: Sequence[str]) -> list[float]:
    """The coefficients of such names, those of PERSPECTIVE, FISHEYE or none. InputError for others that are not 0, and
    for k4 of a perspective camera without k5 and k6: to nerfstudio that is the factor of r⁸, which OpenCV has not."""
    if (listed := values.get("distortion_params")) is not None:
        if not isinstance(listed, list) or len(listed) != len(_LISTED):
            raise InputError(f"{what}: distortion_params must be {' '.join(_LISTED)}, found {brief(listed)}")
        values = {**values, **dict(zip(_LISTED, listed, strict=True))}
    k = {name: _number(values, name, what) or 0.0 for name in PERSPECTIVE}
    if other := [f"{name} = {value:g}" for name, value in k.items() if value and name not in names]:
        expected = f"its camera_model has {', '.join(names) or 'no distortion'}"
        raise InputError(f"{what}: {expected}, found {', '.join(other)}; correct camera_model, or undistort the photos")
    if k["k4"] and names == PERSPECTIVE and model != _RATIONAL and not values.keys() & {"k5", "k6"}:
        found = f"k4 = {k['k4']:g} is nerfstudio's factor of r⁸, which is not supported"
        raise InputError(f"{what}: {found}; undistort the photos, or write camera_model {_RATIONAL} if it is OpenCV's")
    return [k[name] for name in names]


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
