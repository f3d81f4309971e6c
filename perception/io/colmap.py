"""COLMAP workspaces: `images/` beside `sparse/0`, `sparse/*` or `sparse`, binary or text, any undistortable camera."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from perception.errors import InputError
from perception.io.colmap_check import check_binary_model
from perception.io.exposure import with_gains
from perception.io.ignore_masks import mask_of
from perception.io.lens import lens_from_camera, load_pycolmap
from perception.io.photos import why_left_out
from perception.io.reading import Reading
from perception.io.safe_names import safe_name
from perception.io.tracks import tracks_of_model
from perception.io.triangulate import MIN_POINTS, cloud_of, posed_scene
from perception.io.views import fit_lens, make_view
from perception.types import Scene, View


def is_workspace(folder: Path) -> bool:
    """True for a folder with photos in `images/` and a sparse model."""
    return (folder / "images").is_dir() and bool(_models(folder))


def read_workspace(folder: Path, how: Reading) -> Scene:
    """The largest sparse model of a workspace as a Scene, in COLMAP's world.

    Photos that are missing or damaged are left out and reported. Image names that point outside the photo folder raise
    InputError.
    """
    found = {path: _read_model(path) for path in _models(folder)}
    path, model = max(found.items(), key=lambda item: item[1].num_reg_images())
    if model.num_reg_images() == 0:
        raise InputError(f"{path}: the sparse model is empty (no registered photo); run structure from motion again")
    names = {image_id: safe_name(model.images[image_id].name, path) for image_id in model.reg_image_ids()}
    located = {image_id: (name, folder / "images" / name) for image_id, name in names.items()}
    views, missing, notes = views_of_model(model, located, path, how.strict)
    views = [replace(view, mask=mask_of(how.masks, view.name)) for view in views]
    if not views:
        raise InputError(f"{folder / 'images'}: none of the {model.num_reg_images()} photos of {path} is there")
    if len(found) > 1:
        sizes = ", ".join(f"{p.name}: {m.num_reg_images()}" for p, m in found.items())
        notes.append(f"{folder}: {len(found)} sparse models (photos in {sizes}); the largest is used")
    cloud = how.cloud or cloud_of(model)
    if len(cloud[0]) < MIN_POINTS:
        notes.append(f"{path}: the sparse model holds {len(cloud[0])} points; new ones are triangulated")
    facts: dict[str, Any] = {"input": "colmap", "left_out": missing, "warnings": notes}
    facts |= {"model": path.relative_to(folder).as_posix(), "mean_reprojection_error_px": _reprojection_error(model)}
    views, exposure = with_gains(views, tracks_of_model(model, views, names))
    return posed_scene(views, cloud, {**facts, **exposure}, how, MIN_POINTS)


def views_of_model(
    model: Any, located: dict[int, tuple[str, Path]], source: Path, strict: bool = False
) -> tuple[list[View], list[dict[str, str]], list[str]]:
    """Views sorted by name, photos left out with the reason, notes. located: image id to view name and photo.

    strict: a damaged photo is raised as InputError, not left out.
    """
    views, missing, notes = [], [], set()
    lenses = {camera_id: lens_from_camera(camera) for camera_id, camera in model.cameras.items()}
    for image_id, (name, photo) in located.items():
        image = model.images[image_id]
        why = "in the sparse model, but the photo is missing" if not photo.is_file() else why_left_out(photo, strict)
        if why is not None:
            missing.append({"name": name, "why": why})
            continue
        lens, note = fit_lens(lenses[image.camera_id], photo, source)
        pose = np.eye(4)
        pose[:3] = image.cam_from_world().matrix()
        views.append(make_view(name, photo, lens, pose, source))
        if note:
            notes.add(note)
    views.sort(key=lambda view: view.name)
    return views, sorted(missing, key=lambda item: item["name"]), sorted(notes)


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


def _read_model(path: Path) -> Any:
    pycolmap = load_pycolmap()
    for suffix in (".bin", ".txt"):
        if (path / f"images{suffix}").is_file():
            needed = [f"{stem}{suffix}" for stem in ("cameras", "images", "points3D")]
            absent = [name for name in needed if not (path / name).is_file()]
            if absent:
                raise InputError(f"{path}: the sparse model lacks {', '.join(absent)}")
            break
    if (path / "images.bin").is_file():
        check_binary_model(path)
    else:
        _refuse_nan_text(path)
    try:
        return pycolmap.Reconstruction(path)
    except (ValueError, RuntimeError, LookupError, TypeError) as error:
        reason = str(error).splitlines()[0][:120] if str(error) else "unknown reason"
        raise InputError(f"{path}: not a readable COLMAP model ({reason})") from error


def _refuse_nan_text(path: Path) -> None:
    """InputError naming the file for NaN poses in a text model, on which COLMAP may abort the process."""
    file = path / "images.txt"
    lines = [line for line in file.read_text(errors="replace").splitlines() if line and not line.startswith("#")]
    for line in lines:
        fields = line.split()
        if len(fields) == 10 and any(value.lower().lstrip("+-") in ("nan", "inf") for value in fields[1:8]):
            raise InputError(f"{file}: the pose of {fields[9]} is not finite (NaN); repair or remove that photo")
