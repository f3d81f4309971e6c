"""A row of coloured balls of Gaussians, and photos taken while walking past it: a place that no photo shows whole."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from perception.gaussians.model import Gaussians, from_points
from perception.gaussians.views import render
from perception.instances.silhouettes import render_silhouettes
from perception.io.cloud import write_cloud
from perception.types import PointCloud
from support.aimed import look_at

SPACING, DISTANCE, FOCAL, SIZE = 1.0, 2.4, 60.0, (64, 48)


def centres(balls: int) -> np.ndarray:
    """[balls, 3]: along x."""
    return np.arange(balls)[:, None] * [SPACING, 0.0, 0.0]


def write_row(folder: Path, balls: int = 8, photos: int = 24) -> Path:
    """Writes photos, label images with other ids in every photo, points, and transforms.json, whose path it returns."""
    rng = np.random.default_rng(0)
    places = centres(balls)
    directions = rng.normal(size=(balls, 150, 3))
    points = places[:, None] + 0.3 * directions / np.linalg.norm(directions, axis=2, keepdims=True)
    colors = rng.integers(40, 255, (balls, 1, 3)) - rng.integers(0, 40, (balls, 150, 3))
    paint = colors.reshape(-1, 3).astype(np.uint8)
    made = from_points(points.reshape(-1, 3), paint, feature_dim=1, seed=0, opacity=0.95)
    owner = np.repeat(np.arange(balls, dtype=np.int32), 150)
    for name in ("images", "labels"):
        (folder / name).mkdir(parents=True)
    frames = []
    for number, x in enumerate(np.linspace(0, places[-1, 0], photos)):
        name = f"{number:03d}"
        eye = np.array([x, -DISTANCE, 0.4 * (-1) ** number])
        pose = look_at(eye, np.array([x, 0, 0.0]), np.array([0, 0, 1.0]))
        photo, labels = _photo(made, owner, pose, rng.permutation(balls) + 1)
        Image.fromarray(photo).save(folder / "images" / f"{name}.png")
        Image.fromarray(labels).save(folder / "labels" / f"{name}.png")
        world = np.linalg.inv(pose) @ np.diag([1.0, -1.0, -1.0, 1.0])
        frames.append({"file_path": f"images/{name}.png", "transform_matrix": world.tolist()})
    cloud = PointCloud(points.reshape(-1, 3).astype(np.float32), paint)
    write_cloud(folder / "points.ply", cloud)
    lens = {"fl_x": FOCAL, "fl_y": FOCAL, "cx": SIZE[0] / 2, "cy": SIZE[1] / 2, "w": SIZE[0], "h": SIZE[1]}
    facts = {"camera_model": "PINHOLE", **lens, "ply_file_path": "points.ply", "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(facts))
    return folder / "transforms.json"


def _photo(made: Gaussians, owner: np.ndarray, pose: np.ndarray, names: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The photo [H, W, 3] uint8 and its labels [H, W] uint8, in which ball i is called names[i]."""
    K = torch.tensor([[FOCAL, 0, SIZE[0] / 2], [0, FOCAL, SIZE[1] / 2], [0, 0, 1]])
    camera = torch.from_numpy(pose).float()
    out = render(made, camera, K, *SIZE)
    seen = render_silhouettes(made, [owner], camera, K, *SIZE)[0].ids
    labels = np.where(seen >= 0, names[seen], 0).astype(np.uint8)
    return (out.colors[0].clamp(0, 1) * 255).byte().numpy(), labels
