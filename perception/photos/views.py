"""Checked views of photos: a rigid pose, and a lens that has the photo's size."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from perception.errors import InputError
from perception.geometry import nearest_rotation
from perception.photos.decode import photo_size, reduced_size, stored_size
from perception.photos.lens import is_pinhole, pinhole_from_lens, rescale_lens
from perception.types import Lens, View

FARTHEST = 1e12
"""Maximum translation in scene units; float64 resolves about 1e-4 units there."""


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
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, matrix[:3, 3]
    return pose


def fit_lens(lens: Lens, photo: Path, source: Path) -> tuple[Lens, str | None]:
    """The lens scaled to the photo's size, and a note if it was scaled; InputError if the aspect ratio differs.
    For a large photo that is read at 1/2, 1/4 or 1/8, the lens of the full size is scaled in the same way."""
    size, full = photo_size(photo), (lens.width, lens.height)
    if full in (size, stored_size(photo)) and max(full) <= max(size):
        return lens, None
    if size[0] * lens.height == size[1] * lens.width or size in (reduced_size(*full, k) for k in (2, 4, 8)):
        note = f"{photo.name}: photo {size[0]}×{size[1]}, camera {lens.width}×{lens.height}: intrinsics scaled"
        return rescale_lens(lens, *size), note
    found = f"{photo.name} is {size[0]}×{size[1]} but its camera says {lens.width}×{lens.height}"
    raise InputError(f"{source}: {found}; give the camera of these photos or the photos of this camera")


def view_lens(view: View) -> Lens:
    """The lens of the view's photo; a pinhole when the photo needs no undistortion."""
    if view.lens is not None:
        return view.lens
    K = view.K
    return Lens("PINHOLE", tuple(map(float, (K[0, 0], K[1, 1], K[0, 2], K[1, 2]))), view.width, view.height)
