"""Moves scenes to another frame. Georeferenced scenes are moved near the origin, as float32 resolves coordinates of
1e6 m to 1/16 m only."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from perception.geometry import camera_centres, check_similarity, far_from_most, move_points, scale_of, transform
from perception.types import Scene, View

FAR = 100.0
"""Distance from the origin, in extents of the camera path, beyond which a scene is moved. There the rounding
error of float32, 2⁻²⁴ of the distance, is 6e-6 of the extent: a hundredth of a pixel."""


def recentred(scene: Scene) -> Scene:
    """The scene, moved to its centre if it is far from the origin."""
    centres = camera_centres(np.stack([view.camera_from_world for view in scene.views]))
    middle = np.median(centres, axis=0)
    distances = np.linalg.norm(centres - middle, axis=1)
    extent = float(distances[~far_from_most(centres)].max())
    if extent == 0 or np.linalg.norm(middle) <= FAR * extent:
        return scene
    shift = -np.round(middle, -int(np.floor(np.log10(extent))))  # a round number, easy to remember
    return moved_scene(scene, transform(np.eye(3), shift))


def moved_scene(scene: Scene, b_from_a: np.ndarray) -> Scene:
    """The scene in frame b, by a similarity [4, 4]; report["map_from_input"] leads there from the input's frame.
    The down direction in report["gravity"] is rotated as well."""
    report = {**scene.report, "map_from_input": (b_from_a @ scene.report.get("map_from_input", np.eye(4))).tolist()}
    if "gravity" in report:
        down = b_from_a[:3, :3] @ report["gravity"]["direction"] / scale_of(b_from_a)
        report["gravity"] = {**report["gravity"], "direction": down.tolist()}
    views = [moved(view, b_from_a) for view in scene.views]
    return replace(scene, views=views, points=move_points(b_from_a, scene.points), report=report)


def moved(view: View, b_from_a: np.ndarray) -> View:
    """The view in frame b, its depth in units of b; b_from_a [4, 4]: a similarity."""
    pose, scale = moved_pose(view.camera_from_world, b_from_a), scale_of(b_from_a)
    depth = None if view.depth is None else replace(view.depth, scale=view.depth.scale * scale)
    return replace(view, camera_from_world=pose, depth=depth)


def moved_pose(camera_from_a: np.ndarray, b_from_a: np.ndarray) -> np.ndarray:
    """camera_from_b [4, 4], the camera's unit scaled with the world's; b_from_a: a similarity x_b = s R x_a + t.
    A camera x_c = R_c x_a + t_c becomes x_c = R_c Rᵀ x_b + s t_c − R_c Rᵀ t."""
    scale, pose = scale_of(b_from_a), np.array(camera_from_a, np.float64)
    pose[:3, :3] = pose[:3, :3] @ (b_from_a[:3, :3] / scale).T
    pose[:3, 3] = scale * pose[:3, 3] - pose[:3, :3] @ b_from_a[:3, 3]
    return pose


def map_from_input(path: Path, info: dict[str, Any]) -> np.ndarray:
    """The similarity [4, 4] from the coordinates of a map's input to those of the map; info: map.json.
    The identity for a map in its input's frame."""
    matrix = info.get("map_from_input")
    return np.eye(4) if matrix is None else check_similarity(matrix, f"{path / 'map.json'}: map_from_input")
