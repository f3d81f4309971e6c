"""Moves georeferenced scenes near the origin, as float32 resolves coordinates of 1e6 m to 1/16 m only."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from perception.errors import InputError
from perception.geometry import camera_centres
from perception.types import Scene, View

FAR = 100.0
"""Distance from the origin, in extents of the camera path, beyond which a scene is moved. There the rounding
error of float32, 2⁻²⁴ of the distance, is 6e-6 of the extent: a hundredth of a pixel."""


def recentred(scene: Scene) -> Scene:
    """The scene, moved to its centre if it is far from the origin; report["origin"] [3] is the subtracted offset."""
    centres = camera_centres(np.stack([view.camera_from_world for view in scene.views]))
    middle = np.median(centres, axis=0)
    extent = float(np.linalg.norm(centres - middle, axis=1).max())
    if extent == 0 or np.linalg.norm(middle) <= FAR * extent:
        return scene
    origin = np.round(middle, -int(np.floor(np.log10(extent))))  # a round number, easy to remember
    return replace(
        scene,
        views=[moved(view, origin) for view in scene.views],
        points=scene.points - origin,
        report={**scene.report, "origin": origin.tolist()},
    )


def moved(view: View, origin: np.ndarray) -> View:
    """The view in coordinates with `origin` [3] subtracted."""
    pose = np.array(view.camera_from_world, np.float64)
    pose[:3, 3] += pose[:3, :3] @ origin
    return replace(view, camera_from_world=pose)


def map_origin(path: Path, info: dict[str, Any]) -> np.ndarray:
    """Offset [3] float64 from map coordinates to those of the input (input = map + offset); info: map.json."""
    try:
        origin = np.asarray(info.get("scene", {}).get("origin", (0, 0, 0)), np.float64)
        if origin.shape != (3,) or not np.isfinite(origin).all():
            raise ValueError(f"found {origin.tolist()}")
    except (AttributeError, TypeError, ValueError) as error:
        raise InputError(f"{path / 'map.json'}: scene.origin is no place ({error}); the map is damaged") from error
    return origin
