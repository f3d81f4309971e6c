"""What reaches into the space around cameras, against distances in closed form; training with few photos drops it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from perception.config import load_config
from perception.gaussians.free_space import MEASURED, REACH, FreeSpace
from perception.gaussians.model import Gaussians, from_points
from perception.gaussians.train import Trainer
from perception.gaussians.views import TrainingView
from support.two_walls import sparse, taken

WALL = 4.0
FIRST, THIRD = REACH * WALL, REACH * (WALL - 2)
"""Radii around the cameras of the test."""
THIN = 1e-4


def camera(x: float, z: float) -> TrainingView:
    """At (x, 0, z), 100 pixels wide and high, of a right angle, looking along z."""
    K, pose = torch.tensor([[50.0, 0, 50], [0, 50, 50], [0, 0, 1]]), torch.eye(4)
    pose[0, 3], pose[2, 3] = -x, -z
    return TrainingView("photo", torch.zeros(100, 100, 3, dtype=torch.uint8), None, K, pose)


def gaussian(mean: tuple[float, float, float], scales: tuple[float, float, float], degrees: float) -> Gaussians:
    """One of `scales` along x, y and z, then turned about z."""
    one = from_points(np.array([mean]), np.zeros((1, 3), np.uint8), feature_dim=2, seed=0)
    half = np.radians(degrees) / 2
    quats = torch.tensor([[np.cos(half), 0, 0, np.sin(half)]], dtype=torch.float32)
    return replace(one, quats=3 * quats, log_scales=torch.tensor([scales]).log())


BALL = (THIN, THIN, THIN)
LONG = (1.0, THIN, THIN)
CASES = [
    ((0, 0.98 * FIRST, 0), BALL, 0, True),  # beside the first camera, out of its picture
    ((0, 1.02 * FIRST, 0), BALL, 0, False),
    ((8 - 0.98 * THIRD, 0, 2), BALL, 0, True),  # in the third's space, and out of the first's
    ((8 - 1.02 * THIRD, 0, 2), BALL, 0, False),
    ((30, 0, 1), BALL, 0, False),  # the second camera shows nothing
    ((0, 0, -1 - 0.98 * MEASURED * FIRST), BALL, 0, False),  # close to what is measured
    ((0, 0, -1 + 1.02 * MEASURED * FIRST), BALL, 0, True),
    ((0, 0, WALL), BALL, 0, False),
    ((-FIRST - 0.98, 0, 0), LONG, 0, True),  # from afar, towards the camera
    ((-FIRST - 1.02, 0, 0), LONG, 0, False),
    ((-FIRST - 0.98, 0, 0), LONG, 90, False),  # past it
    ((0, -FIRST - 0.98, 0), LONG, 90, True),
    ((0, 0, -1), (THIN, THIN, 1.02 * MEASURED * FIRST), 0, True),  # larger than what is measured
    ((0, 0, -1), (1.0, THIN, 0.98 * MEASURED * FIRST), 0, False),
    ((np.nan, 0, 0), BALL, 0, False),
]


def test_only_what_reaches_the_space_around_a_camera_is_found():
    column, row = np.mgrid[-2:12:71j, -2:2:21j].reshape(2, -1)
    wall = np.stack([column, row, np.full(len(row), WALL)], axis=1)
    behind = np.array([[0.0, 0, -1]])  # measured, though not in the pictures
    space = FreeSpace(np.concatenate([wall, behind]), [camera(0, 0), camera(30, 0), camera(8, 2)])
    found = space.reached_by(Gaussians.concatenate([gaussian(*case[:3]) for case in CASES]))
    np.testing.assert_array_equal(found, [case[3] for case in CASES])
    assert not FreeSpace(np.zeros((0, 3)), [camera(0, 0)]).reached_by(gaussian((0, 0, 0), BALL, 0)).any()


@pytest.mark.parametrize("by_stereo", [True, False])
def test_with_few_photos_a_veil_goes_in_training(by_stereo):
    _, view, _ = taken(0.0, 0.25)
    start = from_points(sparse(300), np.full((300, 3), 128, np.uint8), feature_dim=8, seed=0)
    pairs = ["train.iterations=20", "densify.every=10", "train.sh_degree=0"]
    trainer = Trainer(start, [view], load_config(pairs=pairs), [], by_stereo=by_stereo)
    veil = torch.tensor([[0.0, 1, 0.1]])
    one = start.rows(torch.tensor([0]))
    trainer.append(replace(one, means=veil, log_scales=torch.full((1, 3), -4.0), opacity_logits=torch.ones(1)))
    trainer.reset_statistics()
    trainer.run()
    near = (trainer.gaussians.means - veil).norm(dim=1) < 0.3
    assert near.any() == (not by_stereo)
