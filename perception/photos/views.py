"""Checked views of photos: a rigid pose, a lens that has the photo's size, and a place among the others."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np

from perception.errors import InputError
from perception.geometry import camera_centres, far_from_most, nearest_rotation, transform
from perception.photos.decode import orientation, photo_size
from perception.photos.lens import is_pinhole, lens_warnings, pinhole_from_lens, rescale_lens, resized
from perception.types import Lens, View

FARTHEST = 1e12
"""Maximum translation in scene units; float64 resolves about 1e-4 units there."""
_RESIZED = 0.1
"""Least relative difference between the areas of a photo and of its camera where one is taken for the other resized: a
difference of a pixel at about the same size is another camera."""


def make_view(name: str, photo: Path, lens: Lens, camera_from_world: np.ndarray, source: Path) -> View:
    """A view of `photo`, whose lens already has the photo's size; raises InputError on a NaN or non-rigid pose."""
    pose = rigid_pose(camera_from_world, f"{source}: the pose of {name}")
    (fx, fy, cx, cy), width, height = pinhole_from_lens(lens)
    K = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    return View(name, photo, K, width, height, pose, None if is_pinhole(lens) else lens)


def rigid_pose(matrix: np.ndarray, what: str) -> np.ndarray:
    """`matrix` [4, 4] with an exact rotation; small numerical errors are corrected, larger ones raise InputError."""
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        raise InputError(f"{what} is not a finite 4×4 matrix (NaN or missing values); repair or remove that frame")
    if np.abs(matrix[:3, 3]).max() > FARTHEST:
        raise InputError(f"{what} is more than {FARTHEST:g} from the origin; repair or remove that frame")
    rotation = nearest_rotation(matrix[:3, :3])
    if np.abs(matrix[:3, :3] - rotation).max() > 1e-2:
        raise InputError(f"{what} is not a rigid transform (scaled, sheared or mirrored); repair or remove that frame")
    if np.abs(matrix[3] - (0, 0, 0, 1)).max() > 1e-3:
        found = " ".join(f"{value:g}" for value in matrix[3])
        raise InputError(f"{what} has the last row {found}, expected 0 0 0 1; is it stored column by column?")
    return transform(rotation, matrix[:3, 3])


def posed_view(
    name: str, photo: Path, lens: Lens, pose: np.ndarray, source: Path, upright: bool = False
) -> tuple[View, list[str]]:
    """`make_view` of a photo with the lens that its camera says, scaled to the photo's size, and a line if it was, and
    on what is odd in the lens.

    Poses of other tools belong to the pixels as they are stored: EXIF rotation is not applied, unless the camera fits
    only the upright photo. upright: the poses are of the upright photo. InputError if sizes differ in their shape.
    """
    for as_stored in (False,) if upright else (True, False):
        if (fitted := fit_lens(lens, photo, as_stored)) is not None:
            turned = as_stored and orientation(photo) != 1
            view = replace(make_view(name, photo, fitted, pose, source), as_stored=turned)
            size, full = f"{fitted.width}×{fitted.height}", f"{lens.width}×{lens.height}"
            scaled = [] if size == full else [f"photos of {size}, camera {full}: intrinsics scaled"]
            return view, scaled + lens_warnings(fitted)
    found = f"{photo.name} is {'×'.join(map(str, photo_size(photo)))} but its camera says {lens.width}×{lens.height}"
    raise InputError(f"{source}: {found}; give the camera of these photos or the photos of this camera")


def fit_lens(lens: Lens, photo: Path, as_stored: bool) -> Lens | None:
    """The lens scaled to the size at which the photo is read; None for a camera of another shape."""
    size, full = photo_size(photo, as_stored), (lens.width, lens.height)
    if size == full:
        return lens
    if min(full) < 1:
        return None
    other = abs(size[0] * size[1] / (full[0] * full[1]) - 1) > _RESIZED
    fits = size[0] * full[1] == size[1] * full[0] or (other and resized(size, full))
    return rescale_lens(lens, *size) if fits else None


def view_lens(view: View) -> Lens:
    """The lens of the view's photo; a pinhole when the photo needs no undistortion."""
    if view.lens is not None:
        return view.lens
    K = view.K
    return Lens("PINHOLE", tuple(map(float, (K[0, 0], K[1, 1], K[0, 2], K[1, 2]))), view.width, view.height)


def without_far(
    views: list[View], points: np.ndarray, shared: set[str], strict: bool, source: Path
) -> tuple[list[View], list[dict[str, str]]]:
    """The views without those that lie far from the others and share nothing with them, and these as left out:
    structure from motion now and then registers a photo kilometres away.
    points [P, 3] of the scene, in its frame. shared: names of views that see points that others see as well.
    InputError for such a view if `strict`."""
    centres = camera_centres(np.stack([view.camera_from_world for view in views]))
    middle = np.median(centres, axis=0)
    depth = float(np.median(np.linalg.norm(points - middle, axis=1))) if len(points) else 0.0
    far = far_from_most(centres, depth) & [view.name not in shared for view in views]
    why = "lies {:.3g} units from the other cameras, far beyond the scene, and shares no points with them"
    distance = np.linalg.norm(centres - middle, axis=1)
    out = [{"name": views[i].name, "why": why.format(distance[i])} for i in np.flatnonzero(far)]
    if out and strict:
        raise InputError(f"{source}: the camera of {out[0]['name']} {out[0]['why']}; repair or remove it")
    return [view for view, is_far in zip(views, far, strict=True) if not is_far], out


@contextmanager
def leaving_out(left_out: list[dict[str, str]], name: str, strict: bool) -> Iterator[None]:
    """For one photo of many: adds it to those left out, and why, where the block raises InputError; strict: raised."""
    try:
        yield
    except InputError as error:
        if strict:
            raise
        left_out.append({"name": name, "why": str(error)})


def first_of(left_out: list[dict[str, str]]) -> str:
    """The first photo that was left out and why, for the message of an error; empty where none was."""
    return f" (first: {left_out[0]['name']}: {left_out[0]['why']})" if left_out else ""
