"""Georeferenced scenes: maps are kept near their own origin, for float32 knows a place 1e6 m away to 1/16 m only."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from perception.errors import InputError
from perception.geometry import camera_centres
from perception.types import Scene, View

FAR = 100.0
"""Distance from the origin, in extents of the camera path, beyond which a scene is moved. There float32's rounding,
2⁻²⁴ of the distance, reaches 6e-6 of the extent: a hundredth of a pixel."""


def recentred(scene: Scene) -> Scene:
    """The scene about its own middle when it lies far from the origin; report["origin"] [3] is what was taken off."""
    centres = camera_centres(np.stack([view.camera_from_world for view in scene.views]))
    middle = np.median(centres, axis=0)
    extent = float(np.linalg.norm(centres - middle, axis=1).max())
    if extent == 0 or np.linalg.norm(middle) <= FAR * extent:
        return scene
    origin = np.round(middle, -int(np.floor(np.log10(extent))))  # a place a person can remember
    return replace(
        scene,
        views=[moved(view, origin) for view in scene.views],
        points=scene.points - origin,
        report={**scene.report, "origin": origin.tolist()},
    )


def moved(view: View, origin: np.ndarray) -> View:
    """The view in coordinates from which `origin` [3] was taken."""
    pose = np.array(view.camera_from_world, np.float64)
    pose[:3, 3] += pose[:3, :3] @ origin
    return replace(view, camera_from_world=pose)


def map_origin(path: Path, info: dict[str, Any]) -> np.ndarray:
    """[3] float64: add it to a place in the map to get the place in the input's coordinates; `info` is map.json."""
    try:
        origin = np.asarray(info.get("scene", {}).get("origin", (0, 0, 0)), np.float64)
        if origin.shape != (3,) or not np.isfinite(origin).all():
            raise ValueError(f"found {origin.tolist()}")
    except (AttributeError, TypeError, ValueError) as error:
        raise InputError(f"{path / 'map.json'}: scene.origin is no place ({error}); the map is damaged") from error
    return origin
