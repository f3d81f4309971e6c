"""A slanted wall behind a smaller one, painted with noise: photos and exact depths cast by rays."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from scipy.ndimage import map_coordinates

from perception.gaussians.views import TrainingView
from perception.geometry import inverse_se3
from perception.io.cloud import write_cloud
from perception.types import PointCloud, View
from support.aimed import look_at

WIDTH, HEIGHT, FOCAL = 320, 240, 300.0
K = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
SLOPE, NEAR, HALF = 0.2, 2.6, 0.5
"""The large wall is y = 4 + SLOPE x, the small one y = NEAR with |x|, |z| ≤ HALF."""


def walls(eye: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Multiples of rays [..., 3] from `eye` at which they hit a wall, and whether it is the small one."""
    far = (4 + SLOPE * eye[0] - eye[1]) / (rays[..., 1] - SLOPE * rays[..., 0])
    near = (NEAR - eye[1]) / rays[..., 1]
    at = eye + rays * near[..., None]
    small = (np.abs(at[..., [0, 2]]) <= HALF).all(axis=-1)
    return np.where(small, near, far), small


def taken(x: float, z: float) -> tuple[View, TrainingView, np.ndarray]:
    """A photo from (x, 0, z) of the walls, painted with noise, and its exact depth [HEIGHT, WIDTH]."""
    eye = np.array([x, 0.0, z])
    pose = look_at(eye, np.array([0, 3.0, 0]), np.array([0, 0, 1.0]))
    row, column = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    rays = np.stack([(column - WIDTH / 2) / FOCAL, (row - HEIGHT / 2) / FOCAL, np.ones_like(row)], axis=-1)
    depth, small = walls(eye, rays @ pose[:3, :3])
    at = eye + rays @ pose[:3, :3] * depth[..., None]
    paint = np.random.default_rng(1).uniform(0, 255, (2, 200, 200))
    place = [small.astype(float), 100 + 22 * at[..., 0], 100 + 22 * at[..., 2]]
    grey = map_coordinates(paint, place, order=1, mode="nearest").astype(np.uint8)
    name = f"{x:.2f} {z:.2f}"
    photo = torch.from_numpy(np.repeat(grey[..., None], 3, axis=2))
    tensors = (torch.from_numpy(matrix.astype(np.float32)) for matrix in (K, pose))
    return View(name, Path(name), K, WIDTH, HEIGHT, pose), TrainingView(name, photo, None, *tensors), depth


def sparse(count: int) -> np.ndarray:
    """[count, 3] random points on the walls, as seen from the origin."""
    rng = np.random.default_rng(0)
    rays = np.stack([rng.uniform(-0.4, 0.4, count), np.ones(count), rng.uniform(-0.3, 0.3, count)], axis=1)
    return rays * walls(np.zeros(3), rays)[0][:, None]


def write_scene(folder: Path, eyes: list[tuple[float, float]]) -> Path:
    """Writes photos from (x, 0, z) of `eyes`, labels 1 and 2 of the walls, a sparse cloud, and transforms.json, whose
    path it returns."""
    (folder / "images").mkdir(parents=True)
    (folder / "labels").mkdir()
    frames = []
    for number, (x, z) in enumerate(eyes):
        view, decoded, depth = taken(x, z)
        Image.fromarray(decoded.photo.numpy()).save(folder / "images" / f"{number}.png")
        Image.fromarray(np.where(depth < 3.2, 1, 2).astype(np.uint8)).save(folder / "labels" / f"{number}.png")
        pose = inverse_se3(view.camera_from_world) @ np.diag([1.0, -1, -1, 1])
        frames.append({"file_path": f"images/{number}.png", "transform_matrix": pose.tolist()})
    points = sparse(300)
    write_cloud(folder / "points.ply", PointCloud(points.astype(np.float32), np.full((300, 3), 128, np.uint8)))
    facts = {"fl_x": FOCAL, "fl_y": FOCAL, "cx": WIDTH / 2, "cy": HEIGHT / 2, "w": WIDTH, "h": HEIGHT}
    facts |= {"ply_file_path": "points.ply", "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(facts))
    return folder / "transforms.json"
