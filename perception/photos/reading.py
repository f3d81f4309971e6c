"""What all readers of inputs share: how to read, checked views, the cloud to start training from (`--init-points`)."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np

from perception.errors import InputError
from perception.geometry import nearest_rotation
from perception.io.cloud import read_cloud
from perception.photos.decode import photo_size, reduced_size, stored_size
from perception.photos.lens import is_pinhole, pinhole_from_lens, rescale_lens
from perception.progress import QUIET, Progress
from perception.tasks.engine import Engine
from perception.types import Lens, Scene, View

Cloud = tuple[np.ndarray, np.ndarray]
"""points [P, 3] float64 in the input's frame, colors [P, 3] uint8."""
NO_CLOUD: Cloud = (np.empty((0, 3)), np.empty((0, 3), np.uint8))
GREY = 128
FEW_SEEN = 0.01
"""Share of the points in some photo's view below which a warning is given."""
FARTHEST = 1e12
"""Maximum translation in scene units; float64 resolves about 1e-4 units there."""


@dataclass(frozen=True)
class Reading:
    """workdir: caches features and models for later calls. strict: a damaged photo is an InputError, else left out.

    masks: folder of masks of pixels to ignore (see `ignore_masks`), which precede those that the input names. camera:
    ROS camera_info with the intrinsics of all photos, for photos, videos and recordings. frames: folder for the frames
    of a video (None: workdir/frames), which the map needs later. init_points: cloud in the frame of the input's poses,
    read as `cloud` and used instead of sparse points. poses: "keep", "refine", or "auto": checked where features are
    matched anyway or views have depth, and refined where they are wrong (see io.pose_refinement). engine:
    where features are made.
    """

    workdir: Path
    seed: int = 0
    progress: Progress = QUIET
    strict: bool = False
    masks: Path | None = None
    camera: Path | None = None
    frames: Path | None = None
    init_points: Path | None = None
    cloud: Cloud | None = None
    poses: Literal["auto", "keep", "refine"] = "auto"
    engine: Engine = field(default_factory=Engine)


def start_points(path: Path) -> Cloud:
    """The finite points of a cloud or mesh file with their colours, grey without. InputError when there are none."""
    cloud = read_cloud(path)
    finite = np.isfinite(cloud.points).all(axis=1)
    if not finite.any():
        raise InputError(f"{path}: none of the {len(finite)} points has finite coordinates")
    colors = np.full((len(finite), 3), GREY, np.uint8) if cloud.colors is None else cloud.colors
    return np.asarray(cloud.points[finite], dtype=np.float64), colors[finite]


def check_seen(scene: Scene, path: Path) -> None:
    """InputError when no view sees a point of the scene; adds a warning when few are seen. path: of the cloud."""
    seen = np.zeros(len(scene.points), bool)
    for view in scene.views:
        x, y, z = view.K @ (view.camera_from_world[:3, :3] @ scene.points.T + view.camera_from_world[:3, 3:])
        seen |= (z > 0) & (x >= 0) & (x < view.width * z) & (y >= 0) & (y < view.height * z)
    if not seen.any():
        raise InputError(f"{path}: no photo sees any of its {len(seen)} points; expected frame and unit of the poses")
    if seen.mean() < FEW_SEEN:
        scene.report["warnings"].append(f"{path}: only {seen.mean():.2%} of its points lie in the view of some photo")


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
    size, whole = photo_size(photo), (lens.width, lens.height)
    if whole in (size, stored_size(photo)) and max(whole) <= max(size):
        return lens, None
    if size[0] * lens.height == size[1] * lens.width or size in (reduced_size(*whole, k) for k in (2, 4, 8)):
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
