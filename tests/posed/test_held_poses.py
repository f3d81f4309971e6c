"""Bundle adjustment with some cameras held: they stay, the others get their exact poses and honest covariances."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from perception.posed.bundle_adjustment import LEAST_PIXELS, Poses, adjust, residuals
from perception.posed.pose_refinement import poses_of
from perception.sfm.tracks import Tracks
from support.aimed import look_at
from support.views_at import views_at

FOCAL, NOISE, VIEWS, POINTS = 500.0, 0.5, 5, 50
HELD = np.array([True, True, True, True, False])


def made() -> tuple[Poses, np.ndarray, Tracks]:
    """Five cameras before a cube of points, which all see, without noise."""
    rng = np.random.default_rng(3)
    eyes = [(np.sin(a) * 4, -np.cos(a) * 4, 0.5 * np.sin(3 * a)) for a in np.linspace(-0.6, 0.6, VIEWS)]
    poses = poses_of(views_at(look_at(np.array(e), np.zeros(3), np.array([0, 0, 1.0])) for e in eyes))
    points = rng.uniform(-1, 1, (POINTS, 3))
    view, point = np.tile(np.arange(VIEWS), POINTS), np.repeat(np.arange(POINTS), VIEWS)
    x = np.einsum("oij,oj->oi", poses.rotation[view], points[point] - poses.center[view])
    focal, none = np.full(len(view), FOCAL), np.zeros(len(view))
    return poses, points, Tracks(view, point, x[:, :2] / x[:, 2:], focal, none)


def start(poses: Poses) -> Poses:
    """The last camera off by 3 mm and a twentieth of a degree, a pixel or two: as a pose by RANSAC."""
    center, rotation = poses.center.copy(), poses.rotation.copy()
    center[-1] += (0.002, -0.002, 0.001)
    rotation[-1] = Rotation.from_rotvec([0.001, 0.001, -0.001]).as_matrix() @ rotation[-1]
    return Poses(rotation, center)


def test_held_cameras_stay_and_the_other_gets_its_exact_pose() -> None:
    poses, _, tracks = made()
    begun = start(poses)
    found = adjust(tracks, begun, begun, (0.1, 0.4), HELD).poses
    assert np.array_equal(found.center[:-1], begun.center[:-1])
    assert np.array_equal(found.rotation[:-1], begun.rotation[:-1])
    assert (
        np.abs(found.center[-1] - poses.center[-1]).max() < 1e-4
    )  # a thirtieth of the start's error: steps end when they gain little
    assert np.abs(found.rotation[-1] - poses.rotation[-1]).max() < 1e-4


@pytest.mark.parametrize("held", [(1, 1, 1, 1, 0), (1, 1, 1, 0, 0), (1, 0, 1, 0, 1)])
def test_held_cameras_stay_whatever_the_others_need(held: tuple[int, ...]) -> None:
    """With noise, from 3 cm and a degree: more than one step of the solver. 50 features of half a pixel at 4 units give
    a position to 1 mm; 1 cm is far above, and a third of what was off."""
    poses, _, tracks = made()
    mask, rng = np.array(held, bool), np.random.default_rng(0)
    noisy = replace(tracks, rays=tracks.rays + rng.normal(scale=NOISE / FOCAL, size=tracks.rays.shape))
    turn = Rotation.from_rotvec([0.01, 0.01, -0.01]).as_matrix()
    begun = Poses(
        np.where(mask[:, None, None], poses.rotation, turn @ poses.rotation),
        np.where(mask[:, None], poses.center, poses.center + np.array([0.02, -0.02, 0.01])),
    )
    found = adjust(noisy, begun, begun, (0.1, 0.4), mask).poses
    assert np.array_equal(found.center[mask], begun.center[mask])
    assert np.array_equal(found.rotation[mask], begun.rotation[mask])
    assert np.abs(found.center - poses.center).max() < 0.01


@pytest.mark.slow
def test_covariances_are_those_of_repeated_noise() -> None:
    poses, _, tracks = made()
    rng, changes, covariances = np.random.default_rng(0), [], []
    begun = start(poses)
    for _ in range(40):
        noisy = replace(tracks, rays=tracks.rays + rng.normal(scale=NOISE / FOCAL, size=tracks.rays.shape))
        found = adjust(noisy, begun, begun, (0.1, 0.4), HELD)
        changes.append(found.poses.since(poses)[-1])
        covariances.append(found.covariances(np.zeros((1, 2)))[0])
    seen, told = np.std(changes, axis=0), np.sqrt(np.mean([np.diag(c) for c in covariances], axis=0))
    # 40 draws give a standard deviation to 11 %, and the mean of six to 5 %. The weights of the robust loss take away a
    # fifth of the information; steps that gain little are not taken, so that poses stay a little nearer to the start.
    ratio = told / seen
    assert 0.85 < np.exp(np.log(ratio).mean()) < 1.45 and np.all((ratio > 0.7) & (ratio < 1.8)), ratio


@pytest.mark.parametrize("depth", [1.0, 0.01])  # of the box of points, to its width: flat things leave the lens open
def test_a_lens_that_is_not_known_adds_to_the_covariance(depth: float) -> None:
    """Oracle: the dense normal matrix of pose, lens and all points, by central differences of the residuals."""
    poses, points, tracks = made()
    points = points * (1, depth, 1)
    x = np.einsum("oij,oj->oi", poses.rotation[tracks.view], points[tracks.point] - poses.center[tracks.view])
    tracks = replace(tracks, rays=x[:, :2] / x[:, 2:])
    errors = np.array([0.3, 60.0])  # relative, pixels
    last = tracks.view == VIEWS - 1

    def residual(change: np.ndarray) -> np.ndarray:
        delta = np.zeros((VIEWS, 6))
        delta[-1] = change[:6]
        focal = np.where(last, FOCAL * np.exp(change[6]), FOCAL)
        # A pixel stays where it is: with another lens it is another ray.
        moved = last[:, None] * change[7:9]
        rays = (tracks.rays * FOCAL - moved) / focal[:, None]
        other = replace(tracks, focal=focal, rays=rays)
        pixels = residuals(other, poses.turned(delta), points + change[9:].reshape(-1, 3))[0] / LEAST_PIXELS
        return np.concatenate([pixels.ravel(), change[6:9] / errors[[0, 1, 1]]])

    steps = 1e-5 * np.eye(9 + points.size)
    J = np.stack([(residual(step) - residual(-step)) / 2e-5 for step in steps], axis=1)
    known = np.delete(np.arange(len(steps)), [6, 7, 8])
    expected = np.linalg.inv(J.T @ J)[:6, :6] - np.linalg.inv(J[:, known].T @ J[:, known])[:6, :6]
    found = adjust(tracks, poses, poses, (1e3, 1e3), HELD)
    added = found.covariances(errors[None])[0] - found.covariances(np.zeros((1, 2)))[0]
    scale = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(added / np.outer(scale, scale), expected / np.outer(scale, scale), atol=0.01)
    assert np.trace(added[3:, 3:]) > (100 if depth < 1 else 1) * np.trace(
        found.covariances(np.zeros((1, 2)))[0][3:, 3:]
    )


def test_steps_of_a_wrong_lens_find_the_true_one() -> None:
    poses, _, tracks = made()
    last, pixels = tracks.view == VIEWS - 1, tracks.rays * FOCAL
    focal, centre, begun = 1.1 * FOCAL, np.array([20.0, -15.0]), start(poses)
    changed = np.zeros(3)
    for _ in range(6):
        rays = np.where(last[:, None], (pixels - centre) / focal, tracks.rays)
        seen = replace(tracks, rays=rays, focal=np.where(last, focal, FOCAL))
        found = adjust(seen, begun, begun, (0.1, 0.4), HELD)
        (step,), (turn,) = found.lens_steps(np.array([[0.3, 60.0]]), changed[None])
        focal, centre, changed = focal * np.exp(step[0]), centre + step[1:], changed + step
        begun = found.poses.turned(np.outer(~HELD, turn))
    assert focal == pytest.approx(FOCAL, rel=1e-3) and np.abs(centre).max() < 0.2
    assert np.abs(found.poses.center[-1] - poses.center[-1]).max() < 1e-3
