"""How an input with poses is read, and the cloud that training starts from when one is given (`--init-points`)."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np

from perception.errors import InputError
from perception.io.cloud import read_cloud
from perception.progress import Progress
from perception.types import Scene

Cloud = tuple[np.ndarray, np.ndarray]
"""points [P, 3] float64 in the input's frame, colors [P, 3] uint8."""
NO_CLOUD: Cloud = (np.empty((0, 3)), np.empty((0, 3), np.uint8))
GREY = 128
FEW_SEEN = 0.01
"""Share of the points in some photo's view below which a warning is given."""


@dataclass(frozen=True)
class Reading:
    """workdir: caches features and models for later calls. strict: a damaged photo is an InputError, else left out.

    masks: folder of masks of pixels to ignore (see `ignore_masks`), which precede those that the input names. camera:
    ROS camera_info with the intrinsics of all photos, for photos, videos and recordings. frames: folder for the frames
    of a video (None: workdir/frames), which the map needs later. init_points: cloud in the frame of the input's poses,
    read as `cloud` and used instead of sparse points. poses: "keep", "refine", or "auto": checked where features are
    matched anyway or views have depth, and refined where they are wrong (see io.pose_refinement).
    """

    workdir: Path
    seed: int = 0
    progress: Progress = field(default_factory=lambda: Progress(quiet=True))
    strict: bool = False
    masks: Path | None = None
    camera: Path | None = None
    frames: Path | None = None
    init_points: Path | None = None
    cloud: Cloud | None = None
    poses: Literal["auto", "keep", "refine"] = "auto"


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
        raise InputError(
            f"{path}: no photo sees any of its {len(seen)} points; expected the frame and unit of the input's poses"
        )
    if seen.mean() < FEW_SEEN:
        scene.report["warnings"].append(f"{path}: only {seen.mean():.2%} of its points lie in the view of some photo")
