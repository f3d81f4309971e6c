"""The map's own error, on cameras and points whose noise is known."""

from __future__ import annotations

import numpy as np

from perception.localise.keypoints import Described
from perception.localise.reference import Reference
from perception.sfm.bundle_adjustment import Poses
from perception.sfm.tracks import Features
from support.aimed import look_at

CAMERAS, POINTS, FOCAL = 14, 120, 500.0


def reference(shift: float) -> Reference:
    """Points seen by all cameras of a ring with errors of half a pixel; the map has each camera `shift` off."""
    rng = np.random.default_rng(0)
    points = rng.uniform(-0.5, 0.5, (POINTS, 3))
    angles = np.arange(CAMERAS) * 2 * np.pi / CAMERAS
    eyes = np.stack([2 * np.cos(angles), 2 * np.sin(angles), rng.uniform(0.3, 0.8, CAMERAS)], axis=1)
    cameras = np.stack([look_at(eye, np.zeros(3), np.array([0.0, 0, 1])) for eye in eyes])
    x = np.einsum("cij,pj->cpi", cameras[:, :3, :3], points) + cameras[:, None, :3, 3]
    rays = (x[..., :2] / x[..., 2:] + rng.normal(0, 0.5 / FOCAL, (CAMERAS, POINTS, 2))).reshape(-1, 2)
    size, view = CAMERAS * POINTS, np.repeat(np.arange(CAMERAS), POINTS)
    features = Features(view, rays, np.full(size, FOCAL), np.zeros(size), np.zeros((0, 2), np.int64))
    none = np.zeros((0, 2))
    poses = Poses(cameras[:, :3, :3], eyes + rng.normal(0, 1, eyes.shape) * shift)
    described = Described(features, np.arange(CAMERAS + 1) * POINTS, none, [], none, np.zeros(1, int))
    return Reference([None] * CAMERAS, [], described, poses, np.tile(np.arange(POINTS), CAMERAS), points)  # type: ignore[list-item]


def test_a_map_with_wrong_cameras_says_that_its_poses_err_more() -> None:
    """Of right cameras the errors are those that pixels explain; of cameras that are 1 cm off many times those."""
    assert reference(0.0).own_error < 1.5
    assert reference(0.01).own_error > 3
