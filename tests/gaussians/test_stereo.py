"""Depth by stereo against exact depths of a slanted wall behind a smaller one, cast by rays; where it is not used."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.ndimage import map_coordinates

from perception.config import load_config
from perception.gaussians.depth_start import start_on_surface
from perception.gaussians.model import from_points
from perception.gaussians.stereo import FEW, LEAST_POINTS, with_stereo
from perception.gaussians.train import STEREO_WEIGHT, Trainer
from perception.gaussians.views import TrainingView, surface_depth
from perception.pipeline.record import depth_used
from perception.types import DepthImage, View
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


@pytest.fixture(scope="module")
def shots() -> list[tuple[View, TrainingView, np.ndarray]]:
    return [taken(x, z) for x in (-0.5, 0.0, 0.5) for z in (-0.25, 0.25)]


def test_depths_are_right_where_photos_agree(shots):
    views, decoded, depths = (list(part) for part in zip(*shots, strict=True))
    weight = torch.ones(HEIGHT, WIDTH)
    weight[:40] = 0
    decoded[0] = replace(decoded[0], weight=weight)
    found = with_stereo(views, decoded, sparse(300))
    assert not found[0].depth[:40].any()  # ignored pixels
    for view, depth in zip(found, depths, strict=True):
        known = view.depth.numpy() > 0
        error = np.abs(view.depth.numpy() / depth - 1)[known]
        assert not view.measured
        assert known.mean() > 0.4
        assert np.median(error) < 0.01
        assert (error < 0.05).mean() > 0.97  # the walls are 35 % apart
    start = start_on_surface(found, sparse(300), np.zeros((300, 3), np.uint8), 2000, 2, 0)
    x, y, z = start.means.double().numpy().T
    behind = np.abs(y - 4 - SLOPE * x) / 4
    before = np.where((np.abs(x) < 1.2 * HALF) & (np.abs(z) < 1.2 * HALF), np.abs(y - NEAR) / NEAR, 1)
    assert (np.minimum(behind, before) < 0.05).mean() > 0.95


def test_stereo_is_left_out_where_it_is_not_needed(shots):
    views, decoded, _ = (list(part) for part in zip(*shots, strict=True))
    assert with_stereo(views, decoded, sparse(LEAST_POINTS - 1)) is decoded
    measured = [replace(views[0], depth=DepthImage(Path("depth.png"), 0.001)), *views[1:]]
    assert with_stereo(measured, decoded, sparse(300)) is decoded
    halves = [view.halved() for view in decoded]  # too small to be matched
    assert with_stereo(views, halves, sparse(300)) is halves
    many = FEW // len(views) + 1  # so that each point is in more than FEW photos
    assert with_stereo(many * views, many * decoded, sparse(300)) == many * decoded


def test_stereo_counts_less_than_a_sensor_and_is_not_called_one(shots):
    _, view, depth = shots[0]
    depth = torch.from_numpy(depth.astype(np.float32))
    measured = replace(view, depth=depth)
    found = replace(measured, measured=False)
    points = sparse(300)
    losses = []
    for shown in (view, measured, found):
        gaussians = from_points(points, np.full((300, 3), 128, np.uint8), feature_dim=8, seed=0)
        pairs = ["train.iterations=10", "losses.half_resolution=false", "train.sh_degree=0"]
        losses.append(Trainer(gaussians, [shown], load_config(pairs=pairs), []).step(0.0))
    assert losses[2] - losses[0] == pytest.approx(STEREO_WEIGHT * (losses[1] - losses[0]), rel=1e-4)
    assert depth_used([found]) is None
    assert depth_used([found, measured]) == {"views": 1, "measured": 1.0}
    assert np.array_equal(surface_depth(gaussians, measured), depth.numpy())
    assert np.array_equal(surface_depth(gaussians, found), surface_depth(gaussians, view))
