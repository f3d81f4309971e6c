"""COLMAP models and their photos, in any of the folders in which programs leave them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from perception.errors import InputError
from perception.inputs.colmap_files import Model, names_in, read_model
from perception.io.documents import safe_name
from perception.photos.folder import NO_PHOTOS, folders_below, list_photos
from perception.photos.lens import lens_from_camera
from perception.photos.named_files import NamedFiles, below, parts_of
from perception.photos.views import first_of, without_far
from perception.posed.triangulate import MIN_POINTS, posed_scene
from perception.sfm.model import cloud_of, views_of_model
from perception.sfm.options import ReadOptions
from perception.types import Lens, Scene

DEPTH = 3
"""Folders below the input in which models are looked for, and photos one less: "colmap/sparse/0" and "dslr/images"."""
LOOKED_AT = 200
SHARED = 15
"""Least number of points that a photo far from all others must share with them: half of the inliers that COLMAP asks of
a pose."""
APART = 0.01
"""Mean reprojection error as a share of the long side of the photos above which it is told; models have 1 pixel."""
_SPARSE, _DISTORTED, _PHOTOS = "sparse", "distorted", ("images", "input")


def models_below(folder: Path) -> list[Path]:
    """The folders with a sparse model, in order of preference: in `sparse`, then by depth and name. Models in one
    `sparse` are parts of one reconstruction, or its attempts. [] for a folder without one."""
    if not folder.is_dir():
        return []
    found = []
    for path in folders_below(folder, DEPTH):
        inside = path.relative_to(folder).parts
        if any((path / f"images.{kind}").is_file() for kind in ("bin", "txt")):
            in_sparse = _SPARSE in inside
            has_cameras = any((path / f"cameras.{kind}").is_file() for kind in ("bin", "txt"))
            if in_sparse or (has_cameras and len(inside) < DEPTH):
                found.append((inside[:1] != (_SPARSE,), len(inside), path))
    return [path for *_, path in sorted(found)]


def model_files(folder: Path) -> list[Path]:
    """The files of all sparse models of a workspace."""
    files = (file for model in models_below(folder) for file in model.iterdir())
    return [file for file in files if file.suffix in (".bin", ".txt") and file.is_file()]


def model_photos(folder: Path) -> list[Path]:
    """The photos of the preferred models of a workspace that exist; of a damaged model all those in `images`."""
    parts, images = _preferred(folder), folder / _PHOTOS[0]
    try:
        names = sorted({name for path in parts for name in names_in(path)})
    except InputError:
        return list_photos(images) if images.is_dir() else []
    files = NamedFiles(photo_folder(folder, parts[0], names), beyond=False)
    return [path for path in map(files.find, names) if path is not None]


def photo_folder(folder: Path, model: Path, names: Sequence[str]) -> Path:
    """The folder that holds most photos of a model: `images`, `input` (first for `distorted`), those nearest to the
    model first, or the input itself where one of them holds half, else any folder below, those of `NO_PHOTOS` last; if
    none is there and the input is a `sparse` or in one, those of the folder that holds it. Some of the names are tried,
    LOOKED_AT at most."""
    names = names[:: -(-len(names) // LOOKED_AT) or 1]
    inside = model.relative_to(folder).parts
    usual = _PHOTOS[::-1] if _DISTORTED in inside else _PHOTOS
    near = [folder.joinpath(*inside[:depth], name) for depth in range(len(inside), -1, -1) for name in usual]
    deeper = sorted(folders_below(folder, DEPTH - 1), key=lambda path: bool(NO_PHOTOS.search(path.name)))
    best, most = folder / usual[0], 0
    for path in [*near, folder, *deeper]:
        files = NamedFiles(path, beyond=False)
        held = sum(files.find(name) is not None for name in names) if path.is_dir() else 0
        if held > most:
            best, most = path, held
        if held == len(names) or (path == folder and 2 * most >= len(names)):
            break
    here = folder.absolute()
    above = next((path.parent for path in (here, here.parent) if path.name == _SPARSE), None)
    return best if most or above is None else photo_folder(above, model.absolute(), names)


def read_workspace(folder: Path, options: ReadOptions) -> Scene:
    """The preferred sparse model of a workspace as a Scene, in COLMAP's world.
    Photos that are missing or damaged, or whose pose or camera is not finite, are left out and reported. Of image names
    that point outside the photo folder the longest end that is a photo in it is taken."""
    paths, (models, model) = models_below(folder), _models(folder)
    path, reconstruction = model.path, model.reconstruction
    located, wrong = _located(folder, model)
    if wrong and (options.strict or not located):
        raise InputError(f"{path}: {len(wrong)} of {len(model.names)} photos cannot be used{first_of(wrong)}")
    views, facts = views_of_model(reconstruction, located, path, options, upright=False)
    facts["left_out"] = sorted([*facts["left_out"], *wrong], key=lambda entry: entry["name"])
    facts["warnings"] += model.warnings
    if len(paths) > 1:
        sizes = {model.path: f" ({_registered(model)} photos)" for model in models}
        others = ", ".join(f"{other.relative_to(folder)}{sizes.get(other, '')}" for other in paths if other != path)
        used = f"{path.relative_to(folder)}{sizes[path]}"
        facts["warnings"].append(f"{folder}: {len(paths)} sparse models; {used} is used, not {others}")
    observed = {name: reconstruction.images[image_id].num_points3D for image_id, (name, _) in located.items()}
    cloud = options.cloud or cloud_of(reconstruction)
    near = [view.name for view in views if observed[view.name] >= SHARED]
    views, far = without_far(views, cloud[0], set(near), options.strict, path)
    facts["left_out"] += far
    if len(cloud[0]) < MIN_POINTS:
        facts["warnings"].append(f"{path}: the sparse model holds {len(cloud[0])} points; new ones are triangulated")
    error = _reprojection_error(reconstruction)
    if error is not None and error > APART * max(max(c.width, c.height) for c in reconstruction.cameras.values()):
        apart = f"its photos see its points {error:.3g} pixels from where they are, in the mean"
        facts["warnings"].append(f"{path}: {apart}; its poses, cameras and points do not belong together")
    facts["notes"] = [f"poses of {folder}: COLMAP model {path.relative_to(folder)}"]
    facts |= {"model": path.relative_to(folder).as_posix(), "mean_reprojection_error_px": error}
    return posed_scene(views, cloud, {"input": "colmap", **facts}, options, MIN_POINTS)


def model_frames(folder: Path) -> list[tuple[str, np.ndarray, Lens]]:
    """(name, camera_from_world [4, 4], lens) of the images of the model that `read_workspace` reads, by name, but those
    that are wrong; photos need not exist."""
    _, model = _models(folder)
    lenses = {number: lens_from_camera(camera) for number, camera in model.reconstruction.cameras.items()}
    good = sorted((model.names[i], i) for i in model.reconstruction.reg_image_ids() if i not in model.wrong)
    images = [(name, model.reconstruction.images[i]) for name, i in good]
    return [
        (name, np.vstack([image.cam_from_world().matrix(), [0, 0, 0, 1]]), lenses[image.camera_id])
        for name, image in images
    ]


def _models(folder: Path) -> tuple[list[Model], Model]:
    """The models of `_preferred` without damaged ones after the first, and the largest, with a warning for each of
    these. InputError where that is empty, or the first is damaged."""
    first, *others = _preferred(folder)
    models, damaged = [read_model(first)], list[str]()
    for path in others:
        try:
            models.append(read_model(path))
        except InputError as error:
            damaged.append(f"{error}; this model is not used")
    model = max(models, key=_registered)
    model.warnings += damaged
    if _registered(model) == 0:
        found = "the sparse model is empty (no registered photo)"
        raise InputError(f"{model.path}: {found}; run structure from motion again")
    return models, model


def _registered(model: Model) -> int:
    return int(model.reconstruction.num_reg_images())


def _preferred(folder: Path) -> list[Path]:
    """The first model of a workspace, and the others in the same `sparse`."""
    paths = models_below(folder)
    bases = [path.parent if path.parent.name == _SPARSE else path for path in paths]
    return [path for path, base in zip(paths, bases, strict=True) if base == bases[0]]


def _located(folder: Path, model: Model) -> tuple[dict[int, tuple[str, Path]], list[dict[str, str]]]:
    """View name and photo by image id, and the images that are wrong."""
    written = {number: model.names[number] for number in model.reconstruction.reg_image_ids()}
    names = {number: safe_name(below(name), model.path) for number, name in written.items()}
    root = photo_folder(folder, model.path, list(written.values()))
    files, located, taken = NamedFiles(root, beyond=False), {}, set[Path]()
    for image_id, name in sorted(names.items(), key=lambda item: (not (root / item[1]).is_file(), item[0])):
        photo = files.find(written[image_id])
        if photo is None or photo in taken:  # another image has that very name
            photo = root / "/".join(parts_of(name))
        if photo in taken:
            model.wrong.setdefault(image_id, "the model holds it more than once; the first pose is used")
        taken.add(photo)
        located[image_id] = (safe_name(photo.relative_to(root).as_posix(), model.path), photo)
    wrong = [
        {"name": located.pop(number)[0], "why": why} for number, why in sorted(model.wrong.items()) if number in located
    ]
    return located, wrong


def _reprojection_error(model: Any) -> float | None:
    """Mean reprojection error in pixels, recomputed from the tracks as files may lack it; None without observations."""
    if not any(point.track.length() for point in model.points3D.values()):
        return None
    model.update_point_3d_errors()
    error = float(model.compute_mean_reprojection_error())
    return error if np.isfinite(error) else None
