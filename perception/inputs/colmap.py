"""COLMAP workspaces: `images/` beside `sparse/0`, `sparse/*` or `sparse`, binary or text, any undistortable camera.

pycolmap does not check counts and string ends, so a damaged binary file can make it loop for ever or take all memory.
Here each file is read once before, and damage is reported by file and record. Layout: COLMAP's documentation, "Output
Format"; little endian. Rigs and frames came with COLMAP 3.12.
"""

from __future__ import annotations

import math
from pathlib import Path
from struct import Struct
from typing import Any

import numpy as np

from perception.errors import InputError
from perception.io.documents import brief, safe_name
from perception.photos.lens import load_pycolmap
from perception.sfm.model import cloud_of, views_of_model
from perception.sfm.options import ReadOptions
from perception.sfm.triangulate import MIN_POINTS, posed_scene
from perception.types import Scene

_PARAMS = (3, 4, 4, 5, 8, 8, 12, 5, 4, 5, 12, 16, 4, 5, 3, 4, 6, 2)
"""Number of parameters of a camera, by COLMAP's model id."""
_LONGEST_NAME = 4096
_HEADS = {  # of a record, up to its first name or list; where a list follows at once, the last number is its length
    "cameras": Struct("<IiQQ"),  # id, model, width, height
    "images": Struct("<I7dI"),  # id, pose, camera
    "points3D": Struct("<Q3d3BdQ"),
    "rigs": Struct("<II"),
    "frames": Struct("<II7dI"),  # id, rig, pose
}
_COUNT, _FLAG, _SENSOR, _POSE = Struct("<Q"), Struct("<B"), Struct("<iI"), Struct("<7d")


def is_workspace(folder: Path) -> bool:
    """True for a folder with photos in `images/` and a sparse model."""
    return (folder / "images").is_dir() and bool(_models(folder))


def read_workspace(folder: Path, options: ReadOptions) -> Scene:
    """The largest sparse model of a workspace as a Scene, in COLMAP's world.
    Photos that are missing or damaged are left out and reported. Image names that point outside the photo folder raise
    InputError."""
    found = {path: _read_model(path) for path in _models(folder)}
    path, model = max(found.items(), key=lambda item: item[1].num_reg_images())
    if model.num_reg_images() == 0:
        raise InputError(f"{path}: the sparse model is empty (no registered photo); run structure from motion again")
    names = {image_id: safe_name(model.images[image_id].name, path) for image_id in model.reg_image_ids()}
    located = {image_id: (name, folder / "images" / name) for image_id, name in names.items()}
    views, facts = views_of_model(model, located, path, options)
    if len(found) > 1:
        sizes = ", ".join(f"{p.name}: {m.num_reg_images()}" for p, m in found.items())
        facts["warnings"].append(f"{folder}: {len(found)} sparse models (photos in {sizes}); the largest is used")
    cloud = options.cloud or cloud_of(model)
    if len(cloud[0]) < MIN_POINTS:
        facts["warnings"].append(f"{path}: the sparse model holds {len(cloud[0])} points; new ones are triangulated")
    facts |= {"model": path.relative_to(folder).as_posix(), "mean_reprojection_error_px": _reprojection_error(model)}
    return posed_scene(views, cloud, {"input": "colmap", **facts}, options, MIN_POINTS)


def _reprojection_error(model: Any) -> float | None:
    """Mean reprojection error in pixels, recomputed from the tracks as files may lack it; None without observations."""
    if not any(point.track.length() for point in model.points3D.values()):
        return None
    model.update_point_3d_errors()
    error = float(model.compute_mean_reprojection_error())
    return error if np.isfinite(error) else None


def _models(folder: Path) -> list[Path]:
    sparse = folder / "sparse"
    if not sparse.is_dir():
        return []
    inside = sorted(path for path in sparse.iterdir() if path.is_dir())
    return [path for path in [sparse, *inside] if any((path / f"images.{kind}").is_file() for kind in ("bin", "txt"))]


def model_files(folder: Path) -> list[Path]:
    """The files of all sparse models of a workspace."""
    files = (file for model in _models(folder) for file in model.iterdir())
    return [file for file in files if file.suffix in (".bin", ".txt") and file.is_file()]


def _read_model(path: Path) -> Any:
    suffix = ".bin" if (path / "images.bin").is_file() else ".txt"
    needed = [f"{stem}{suffix}" for stem in ("cameras", "images", "points3D")]
    absent = [name for name in needed if not (path / name).is_file()]
    if absent:
        raise InputError(f"{path}: the sparse model lacks {', '.join(absent)}")
    if suffix == ".bin":
        check_binary_model(path)
    else:
        _refuse_nan_text(path)
    try:
        return load_pycolmap().Reconstruction(path)
    except (ValueError, RuntimeError, LookupError, TypeError) as error:
        raise InputError(f"{path}: not a readable COLMAP model ({brief(error)})") from error


def _refuse_nan_text(path: Path) -> None:
    """InputError naming the file for NaN poses in a text model, on which COLMAP may abort the process."""
    file = path / "images.txt"
    for fields in map(str.split, file.read_text(errors="replace").splitlines()):
        if len(fields) == 10 and any(value.lower().lstrip("+-") in ("nan", "inf") for value in fields[1:8]):
            raise InputError(f"{file}: the pose of {fields[9]} is not finite (NaN); repair or remove that photo")


def check_binary_model(folder: Path) -> None:
    """InputError naming the first file and record that is not valid."""
    heads = {kind: _heads(folder / f"{kind}.bin", kind) for kind in _HEADS}
    known = {camera for camera, _ in heads["cameras"]}
    for image, camera in heads["images"]:
        if camera not in known:
            raise InputError(f"{folder / 'images.bin'}: image {image} has camera {camera}, which cameras.bin lacks")


def _heads(file: Path, kind: str) -> list[tuple[int, int]]:
    """First and last number of each record's head; [] if the file does not exist. InputError for an id that repeats."""
    if not file.is_file():
        return []
    data, at, found = file.read_bytes(), 0, list[tuple[int, int]]()

    def take(layout: Struct) -> tuple:
        skip(1, layout.size)
        return layout.unpack_from(data, at - layout.size)

    def skip(count: int, size: int) -> None:
        nonlocal at
        at += count * size
        if at > len(data):
            raise ValueError("the file is cut short")

    try:
        for _ in range(take(_COUNT)[0]):
            head = take(_HEADS[kind])
            pose = head[1:8] if kind == "images" else head[2:9] if kind == "frames" else (1.0,)
            if not all(map(math.isfinite, pose)) or not any(pose[:4]):
                raise ValueError(f"the pose of {kind[:-1]} {head[0]} is not finite, or no rotation")
            if kind == "cameras":
                if not 0 <= head[1] < len(_PARAMS) or max(head[2:]) > 1 << 30:
                    raise ValueError(f"camera {head[0]} of model {head[1]} and {head[2]}×{head[3]} pixels")
                if not all(map(math.isfinite, take(Struct(f"<{_PARAMS[head[1]]}d")))):
                    raise ValueError(f"camera {head[0]} has a parameter that is not finite")
            elif kind == "images":
                end = data.find(b"\0", at, at + _LONGEST_NAME)
                if end < 0:
                    raise ValueError("its name has no end")
                data[at:end].decode("utf-8")
                skip(end + 1 - at, 1)
                skip(take(_COUNT)[0], 24)
            elif kind == "rigs":
                for number in range(head[1]):
                    take(_SENSOR)
                    if number and take(_FLAG)[0]:
                        take(_POSE)
            else:
                skip(head[-1], 8 if kind == "points3D" else 16)
            found.append((head[0], head[-1]))
        if len({head[0] for head in found}) != len(found):
            raise ValueError("an id occurs twice")
    except ValueError as error:
        what = f"what follows {len(found)} good records cannot be right ({error})"
        raise InputError(f"{file}: {what}; the model is damaged") from error
    return found
