"""Photos of a visit from one place: a ring of cameras around points, beside some that hardly moved."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from perception.visits.scene import SAME, without_doubles

DEPTH = 2.0
POINTS = np.random.default_rng(0).normal(0, 0.2, (500, 3))


def camera(angle: float, shift: float = 0.0, turn: float = 0.0) -> Any:
    """On the ring at `angle`, looking at its middle, then moved to its right and turned about its y axis."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec(np.array([0.0, angle, 0.0])).as_matrix()
    pose[2, 3] = DEPTH
    moved = np.eye(4)
    moved[:3, :3] = Rotation.from_rotvec(np.array([0.0, turn, 0.0])).as_matrix()
    moved[0, 3] = -shift
    return SimpleNamespace(camera_from_world=moved @ pose)


def test_cameras_that_stood_still_count_once() -> None:
    ring = [camera(angle) for angle in np.linspace(0, 2 * np.pi, 12, endpoint=False)]
    near, far = 0.45 * SAME, 1.1 * SAME
    still = [camera(0, near * DEPTH, near), camera(0, 0, -2 * near), ring[3]]
    others = [camera(0, far * DEPTH, 0), camera(0, 0, far)]
    assert without_doubles([*ring, *still, *others], POINTS) == [*ring, *others]
    assert without_doubles([ring[0]] * 5, POINTS) == [ring[0]]
    assert without_doubles([], POINTS) == []
    millimetres: list[Any] = [
        SimpleNamespace(camera_from_world=one.camera_from_world.copy()) for one in (*ring, *still, *others)
    ]
    for one in millimetres:
        one.camera_from_world[:3, 3] *= 1000
    assert len(without_doubles(millimetres, 1000 * POINTS)) == len(ring) + len(others)


def test_cameras_that_see_nothing_differ_by_their_turns() -> None:
    views = [camera(0), camera(0, 0, 1.0)]
    assert without_doubles(views, np.zeros((0, 3))) == views
