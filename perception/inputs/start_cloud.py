"""The cloud to start training from: that of `--init-points` is read; any is checked against the views."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from perception.errors import InputError
from perception.io.cloud import read_cloud
from perception.sfm.options import Cloud
from perception.types import Scene, View

GREY = 128
FEW_SEEN = 0.01
"""Share of the points in some photo's view below which a warning is given."""
LOOKED_AT = 100_000
"""About as many points are looked for, of more."""


def start_points(path: Path) -> Cloud:
    """The finite points of a cloud or mesh file with their colours, grey without. InputError when there are none."""
    cloud = read_cloud(path)
    finite = np.isfinite(cloud.points).all(axis=1)
    if not finite.any():
        raise InputError(f"{path}: none of the {len(finite)} points has finite coordinates")
    colors = np.full((len(finite), 3), GREY, np.uint8) if cloud.colors is None else cloud.colors
    return np.asarray(cloud.points[finite], dtype=np.float64), colors[finite]


def seen_share(views: list[View], points: np.ndarray) -> float:
    """Share of points [P, 3], at least one, in the view of some photo; of many points every n-th is looked at."""
    points = points[:: len(points) // LOOKED_AT or 1]
    seen = np.zeros(len(points), bool)
    for view in views:
        x, y, z = view.K @ (view.camera_from_world[:3, :3] @ points.T + view.camera_from_world[:3, 3:])
        seen |= (z > 0) & (x >= 0) & (x < view.width * z) & (y >= 0) & (y < view.height * z)
    return float(seen.mean())


def check_seen(scene: Scene, path: Path) -> None:
    """InputError when no view sees a point of the scene; adds a warning when few are seen. path: of the cloud, or of
    the input that brought it."""
    share = seen_share(scene.views, scene.points)
    if share == 0:
        axes = "COLMAP's are camera_from_world, those of a transforms.json world_from_camera with y up and z back"
        found = f"{path}: no photo sees any of its {len(scene.points)} points"
        raise InputError(f"{found}; expected points and poses in one frame and unit ({axes})")
    if share < FEW_SEEN:
        scene.report["warnings"].append(f"{path}: only {share:.2%} of its points lie in the view of some photo")
