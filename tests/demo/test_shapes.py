"""Ray crossings against closed forms and against a dense walk along the ray with the surface's implicit
equation."""

from __future__ import annotations

import numpy as np
import pytest

from worlds.shapes import (
    Box,
    Ellipsoid,
    Lathe,
    Shape,
    Sheet,
    Tube,
    placed,
    rotation_from_axes,
    to_local,
    to_world,
)

BULB = Lathe(np.array([(0, 0), (0.4, 0.1), (0.5, 0.6), (0.2, 0.9), (0.25, 1.0), (0.0, 1.0)]))
HOOK = Tube(0.6, -1.0, 1.4, np.array([0.08, 0.12, 0.15, 0.1]))
EGG = Ellipsoid(np.array([0.5, 0.3, 0.8]))
CRATE = Box(np.array([0.9, 0.5, 1.2]))


def _inside_bulb(p: np.ndarray) -> np.ndarray:
    radius = np.interp(p[..., 2], BULB.profile[:5, 1], BULB.profile[:5, 0], left=-1, right=-1)
    return np.hypot(p[..., 0], p[..., 1]) < radius


def _inside_hook(p: np.ndarray) -> np.ndarray:
    """Nearest of many balls strung along the arc: brute force, no chart."""
    share = np.linspace(0, 1, 60)
    angle = HOOK.start + share * (HOOK.stop - HOOK.start)
    centers = HOOK.bend * np.stack([np.cos(angle), np.sin(angle), 0 * angle], -1)
    radii = np.interp(share, np.linspace(0, 1, 4), HOOK.radii)
    return (np.linalg.norm(p[..., None, :] - centers, axis=-1) < radii).any(-1)


def _inside_egg(p: np.ndarray) -> np.ndarray:
    return ((p / EGG.radii) ** 2).sum(-1) < 1


def _inside_crate(p: np.ndarray) -> np.ndarray:
    return (np.abs(p) < CRATE.extent / 2).all(-1)


def _rays(count: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(5)
    start = rng.standard_normal((count, 3))
    start *= 2.5 / np.linalg.norm(start, axis=1, keepdims=True)
    toward = rng.uniform(-0.6, 0.8, (count, 3)) - start
    return start, toward / np.linalg.norm(toward, axis=1, keepdims=True)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("shape", "inside", "tolerance"),
    [(BULB, _inside_bulb, 0.005), (HOOK, _inside_hook, 0.01), (EGG, _inside_egg, 0.005), (CRATE, _inside_crate, 0.005)],
)
def test_first_crossing_is_where_a_dense_walk_enters(shape: Shape, inside, tolerance: float) -> None:
    origins, directions = _rays(150)
    t = shape.hit(origins, directions)[0]
    walk = np.arange(0.5, 4.5, 0.004)
    within = np.stack([inside(origins + s * directions) for s in walk], 1)
    entered = np.where(within.any(1), walk[within.argmax(1)], np.inf)
    # A ray that grazes for less than a few steps may be seen by one method only; deep crossings must agree.
    deep = (within.sum(1) > 19) | ~np.isfinite(t)
    assert deep.sum() > 100 and np.isfinite(t).sum() > 20
    steady = within.sum(1) > 19
    np.testing.assert_allclose(t[steady], entered[steady], atol=tolerance)
    assert (within[~np.isfinite(t)].sum(1) < 19).all()


def test_sphere_and_plane_have_their_closed_forms() -> None:
    ball = Ellipsoid(np.full(3, 0.5))
    t, _, v = ball.hit(np.array([[0, 0, 2.0]]), np.array([[0, 0, -1.0]]))
    assert t[0] == pytest.approx(1.5) and v[0] == pytest.approx(0)
    assert np.isinf(ball.hit(np.array([[0.51, 0, 2.0]]), np.array([[0, 0, -1.0]]))[0][0])
    sheet = Sheet(2.0, 1.0)
    t, u, v = sheet.hit(np.array([[0.5, 0.25, 3.0]]), np.array([[0, 0, -1.0]]))
    assert (t[0], u[0], v[0]) == pytest.approx((3.0, 0.75, 0.25))
    assert np.isinf(sheet.hit(np.array([[1.01, 0, 3.0]]), np.array([[0, 0, -1.0]]))[0][0])


@pytest.mark.parametrize("shape", [BULB, HOOK, EGG, CRATE, Sheet(0.8, 0.5)])
def test_a_hit_and_its_chart_agree(shape: Shape) -> None:
    origins, directions = _rays(400)
    t, u, v = shape.hit(origins, directions)
    # The round ends of a tube and the rim of its chart have no chart of their own.
    ok = np.isfinite(t) & (v > 0.02) & (v < 0.98)
    assert ok.sum() > 20
    points, normals = shape.point_normal(u[ok], v[ok])
    assert np.abs(points - (origins + t[:, None] * directions)[ok]).max() < 0.02
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-9)


def test_local_frames_are_rigid() -> None:
    rotation = rotation_from_axes([1, 2, 0.3], [0.2, -0.1, 0.7])
    np.testing.assert_allclose(rotation.T @ rotation, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1)
    shape = Sheet(1, 1, rotation, np.array([1.0, 2, 3]))
    points = np.random.default_rng(0).standard_normal((10, 3))
    np.testing.assert_allclose(to_world(shape, to_local(shape, points)), points, atol=1e-12)


@pytest.mark.parametrize("shape", [BULB, HOOK, EGG, CRATE, Sheet(0.8, 0.5)])
def test_a_placed_shape_is_the_shape_moved(shape: Shape) -> None:
    """Scaled, turned and moved points of the surface are the surface of the placed shape."""
    turn, shift = rotation_from_axes([1, 2, 0.3], [0.2, -0.1, 0.7]), np.array([3.0, -1, 0.5])
    moved = placed(shape, turn, shift, 1.7)
    u, v = np.random.default_rng(1).random((2, 50))
    points, normals = shape.point_normal(u, v)
    again, turned = moved.point_normal(u, v)
    np.testing.assert_allclose(to_world(moved, again), 1.7 * points @ turn.T + shift, atol=1e-9)
    np.testing.assert_allclose(turned @ moved.rotation.T, normals @ turn.T, atol=1e-9)


def test_the_faces_of_a_box_have_the_charts_they_say() -> None:
    sizes = CRATE.face_sizes()
    assert sizes.tolist() == [[0.9, 0.5], [0.9, 0.5], [0.9, 1.2], [0.5, 1.2], [0.9, 1.2], [0.5, 1.2]]
    _, normals = CRATE.point_normal(np.full(6, 0.5), (np.arange(6) + 0.5) / 6)
    assert normals.tolist() == [[0, 0, 1], [0, 0, -1], [0, -1, 0], [1, 0, 0], [0, 1, 0], [-1, 0, 0]]
    top, _ = CRATE.point_normal(np.array([0.5]), np.array([(2 + 0.011) / 6]))  # upper edge of the face to -y
    assert top[0, 2] == pytest.approx(0.6, abs=0.002)
