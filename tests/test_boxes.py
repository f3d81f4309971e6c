"""Oriented boxes of boxes."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from perception.boxes import oriented_box


def test_recovers_a_rotated_box() -> None:
    size = np.array([3.0, 2.0, 0.5])
    # A symmetric grid has its principal axes exactly along the box; a random sample would tilt them.
    local = np.array(np.meshgrid(*[np.linspace(-0.5, 0.5, 9)] * 3)).reshape(3, -1).T * size
    turn = Rotation.from_euler("xyz", [0.3, -0.8, 1.1]).as_matrix()
    box = oriented_box(local @ turn.T + [1, 2, 3])
    assert np.allclose(box.center, [1, 2, 3], atol=1e-9) and np.allclose(box.extent, size)
    assert np.allclose(np.abs(box.rotation @ turn), np.eye(3), atol=1e-9)
    assert np.isclose(np.linalg.det(box.rotation), 1)


def test_contains_every_point_and_ignores_order() -> None:
    points = np.random.default_rng(1).normal(size=(50, 3)) * [1, 2, 3]
    box, shuffled = oriented_box(points), oriented_box(points[::-1])
    local = (points - box.center) @ box.rotation.T
    assert (np.abs(local) <= box.extent / 2 + 1e-12).all()
    assert np.allclose(box.rotation, shuffled.rotation) and np.allclose(box.extent, shuffled.extent)


def test_degenerate_sets() -> None:
    assert np.allclose(oriented_box(np.ones((1, 3))).extent, 0)
    assert np.allclose(sorted(oriented_box(np.array([[0, 0, 0], [0, 2.0, 0]])).extent), [0, 0, 2])


def test_longest_side_first_and_strays_are_trimmed() -> None:
    rng = np.random.default_rng(4)
    points = rng.random((4000, 3)) * [1, 4, 2]
    assert np.allclose(np.argsort(-oriented_box(points).extent), [0, 1, 2])
    points[0] = [100, 100, 100]
    assert np.allclose(oriented_box(points, trim=0.001).extent, [4, 2, 1], rtol=0.02)
