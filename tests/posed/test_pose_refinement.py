"""Refinement of given poses: made points seen from known true poses, with painted drift and wrong matches."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from perception.errors import InputError
from perception.geometry import align_similarity
from perception.posed.bundle_adjustment import Poses, _linearised, _Problem, starting_points
from perception.posed.pose_refinement import checked_poses, match_errors, moved_back, poses_of, refine
from perception.sfm.tracks import Features, Tracks, tracks_of
from perception.types import View
from support.aimed import look_at

FOCAL, NOISE, VIEWS, POINTS = 500.0, 0.3, 12, 240


def views_at(matrices):
    K = np.array([[FOCAL, 0, 320], [0, FOCAL, 240], [0, 0, 1.0]])
    return [View(f"{i:02d}.jpg", None, K, 640, 480, matrix) for i, matrix in enumerate(matrices)]


def truth(rng):
    """Cameras on an arc around a cloud of points of 2 units, 3 units away."""
    angles = np.linspace(0, 1.5, VIEWS)
    eyes = np.stack([3 * np.cos(angles), 3 * np.sin(angles), 0.3 * np.sin(5 * angles)], axis=1)
    return np.stack([look_at(eye, rng.uniform(-0.2, 0.2, 3), np.array([0, 0, 1.0])) for eye in eyes])


def seen(rng, matrices, wrong=0.1, blind=(), depth_noise=0.01):
    """Features of points in a cube, matched between views up to five apart; a share of the matches is wrong."""
    points = rng.uniform(-1, 1, (POINTS, 3))
    x = np.einsum("nij,pj->npi", matrices[:, :3, :3], points) + matrices[:, None, :3, 3]
    rays = x[..., :2] / x[..., 2:] + rng.normal(0, NOISE / FOCAL, (*x.shape[:2], 2))
    depth = x[..., 2] * (1 + rng.normal(0, depth_noise, x.shape[:2]))
    pairs = []
    for a in range(VIEWS):
        for b in range(a + 1, min(a + 6, VIEWS)):
            if not {a, b} & set(blind):
                of = rng.choice(POINTS, 100, replace=False)
                to = np.where(rng.random(100) < wrong, rng.integers(POINTS, size=100), of)
                pairs.append(np.stack([a * POINTS + of, b * POINTS + to], axis=1))
    view = np.repeat(np.arange(VIEWS), POINTS)
    return Features(view, rays.reshape(-1, 2), np.full(len(view), FOCAL), depth.ravel(), np.concatenate(pairs))


def drifted(rng, poses, degrees=0.3, units=0.01):
    """A random walk of so much per view and axis, as odometry drifts."""
    steps = np.concatenate([rng.normal(0, np.radians(degrees), (VIEWS, 3)), rng.normal(0, units, (VIEWS, 3))], axis=1)
    return poses.turned(np.cumsum(steps, axis=0))


def errors(found, right):
    """Largest centre error and angle in degrees, after the similarity that aligns the centres."""
    scale, rotation, shift = align_similarity(right.center, found.center)
    turned = right.rotation @ rotation @ found.rotation.transpose(0, 2, 1)
    return np.linalg.norm(scale * found.center @ rotation.T + shift - right.center, axis=1).max(), np.degrees(
        Rotation.from_matrix(turned).magnitude()
    ).max()


@pytest.fixture
def made():
    rng = np.random.default_rng(3)
    matrices = truth(rng)
    return rng, poses_of(views_at(matrices)), seen(rng, matrices)


@pytest.mark.parametrize("with_depth", [True, False])
def test_painted_drift_is_removed_to_the_noise_of_features(made, with_depth):
    rng, right, features = made
    if not with_depth:
        features = replace(features, depth=0 * features.depth)
    given = drifted(rng, right)
    before, after = errors(given, right), errors(refine(features, given), right)
    # A feature is right to 0.3 / 500 · 3 = 0.002 units and 0.03°; hundreds hold a camera, chains of views add up.
    assert before[0] > 0.015 and before[1] > 1
    assert after[0] < 0.003 and after[1] < 0.1


def test_the_world_frame_is_kept(made):
    rng, right, features = made
    given = drifted(rng, right)
    found = refine(features, given)
    offset = (found.center + 3 * found.rotation[:, 2]) - (given.center + 3 * given.rotation[:, 2])  # of what is seen
    assert np.linalg.norm(offset.mean(0)) < 0.3 * np.linalg.norm(offset, axis=1).mean()
    assert align_similarity(found.center, given.center)[0] == pytest.approx(1, abs=0.02)
    turn, shift = Rotation.from_euler("xyz", [3, -2, 5], degrees=True).as_matrix(), np.array([0.3, -0.1, 0.2])
    jumped = replace(given, center=given.center + 9 * (np.arange(VIEWS) == 3)[:, None])  # one view is far off
    back = moved_back(Poses(given.rotation @ turn.T, given.center @ turn.T + shift), jumped, 3.0)
    np.testing.assert_allclose(back.rotation, given.rotation, atol=0.01)
    np.testing.assert_allclose(back.center, given.center, atol=0.01)


def test_a_world_far_from_its_origin_makes_no_difference(made):
    rng, right, features = made
    given, far = drifted(rng, right), np.array([5e5, -4e6, 100.0])  # as in UTM coordinates
    tracks = tracks_of(replace(features, depth=0 * features.depth), features.pairs[:300])
    near, moved = (starting_points(tracks, Poses(given.rotation, given.center + shift)) for shift in (0 * far, far))
    np.testing.assert_allclose(moved - far, near, atol=1e-5)


def test_depth_gives_the_scale(made):
    _, right, features = made
    wide = Poses(right.rotation, 1.04 * right.center)  # odometry that counts its wheels 4 % too large
    scale = align_similarity(right.center, refine(features, wide).center)[0]
    assert scale == pytest.approx(1, abs=0.005)
    assert align_similarity(right.center, wide.center)[0] == pytest.approx(1 / 1.04)


def test_a_view_without_features_moves_with_its_neighbours(made):
    rng, right, _ = made
    features = seen(rng, right.matrices(), blind=[6])
    rest = np.delete(np.arange(VIEWS), 6)
    shift = np.zeros((VIEWS, 6))
    shift[:, 5] = 0.05 * np.linspace(-1, 1, VIEWS) ** 3
    shift[4:9, 5] += 0.03
    found = refine(features, right.turned(shift))
    moved = found.since(right)[:, 3:]
    assert np.linalg.norm(moved[6] - moved[[5, 7]].mean(0)) < 0.01
    assert (
        errors(Poses(found.rotation[rest], found.center[rest]), Poses(right.rotation[rest], right.center[rest]))[0]
        < 0.004
    )


def test_one_view_of_mostly_wrong_matches_stays_near(made):
    rng, right, features = made
    bad = (features.view[features.pairs] == 5).any(1) & (rng.random(len(features.pairs)) < 0.7)
    pairs = features.pairs.copy()
    pairs[bad, 1] = pairs[bad, 1] // POINTS * POINTS + rng.integers(POINTS, size=bad.sum())
    found = refine(replace(features, pairs=pairs), drifted(rng, right))
    assert errors(found, right)[0] < 0.02


def test_jacobians_are_finite_differences():
    rng = np.random.default_rng(0)
    matrices = truth(rng)
    features = seen(rng, matrices, wrong=0)
    tracks, poses = tracks_of(features, features.pairs[:50]), poses_of(views_at(matrices))
    points = starting_points(tracks, poses)
    problem = _Problem(
        tracks, poses, None, np.empty(0), 1e6, 1e6, np.zeros(len(poses.center), bool)
    )  # noise so large that the robust weights are 1

    def residual(delta, shift):
        moved = _linearised(problem, poses.turned(delta), points + shift)[0]
        return 1e6 * moved

    _, J_pose, J_point = (1e6 * part for part in _linearised(problem, poses, points))
    still, step = (np.zeros((VIEWS, 6)), np.zeros((tracks.size, 3))), 1e-6
    for axis in range(6):
        delta = np.zeros((VIEWS, 6))
        delta[:, axis] = step
        numeric = (residual(delta, still[1]) - residual(-delta, still[1])) / (2 * step)
        np.testing.assert_allclose(J_pose[:, :, axis], numeric, rtol=1e-5, atol=1e-4)
    for axis in range(3):
        shift = np.zeros((tracks.size, 3))
        shift[:, axis] = step
        numeric = (residual(still[0], shift) - residual(still[0], -shift)) / (2 * step)
        np.testing.assert_allclose(J_point[:, :, axis], numeric, rtol=1e-5, atol=1e-4)


def test_errors_of_matches_by_hand():
    """Two cameras a unit apart along x, a point 5 units ahead: its second feature is 10 px too low."""
    poses = Poses(np.tile(np.eye(3), (2, 1, 1)), np.array([[0, 0, 0], [1.0, 0, 0]]))
    rays = np.array([[0.1, 0.2], [0.1 - 1 / 5, 0.2 + 10 / FOCAL]])
    features = Features(np.array([0, 1]), rays, np.full(2, FOCAL), np.array([5.0, 0]), np.array([[0, 1]]))
    lines, carried = match_errors(features, poses)
    np.testing.assert_allclose(lines, [10, 10])
    np.testing.assert_allclose(carried, [10, np.nan])


def test_a_view_with_two_features_of_a_track_is_left_out_of_it():
    features = Features(np.array([0, 0, 1, 2]), np.zeros((4, 2)), np.ones(4), np.zeros(4), np.empty((0, 2)))
    tracks = tracks_of(features, np.array([[0, 2], [1, 2], [2, 3]]))
    assert isinstance(tracks, Tracks) and tracks.view.tolist() == [1, 2] and tracks.size == 1


# ------------------------------------------------------------------ what is done with them


def check(features, poses, how="auto"):
    views = views_at(poses.matrices())
    return views, *checked_poses(views, features, how)


def test_exact_poses_are_used_as_they_are(made):
    _, right, features = made
    given, views, report = check(features, right)
    assert views is given and not report["poses"]["refined"] and not report["warnings"]
    assert report["poses"]["given_error_px"]["epipolar"] < 2 * NOISE


def test_drifting_poses_are_refined_and_told(made):
    rng, right, features = made
    given, views, report = check(features, drifted(rng, right, 0.5, 0.02))
    facts = report["poses"]
    assert facts["refined"] and facts["error_px"]["epipolar"] < 2 * NOISE < 1 < facts["given_error_px"]["epipolar"]
    moved = np.linalg.norm(poses_of(views).center - poses_of(given).center, axis=1)
    assert facts["moved"]["max"] == pytest.approx(moved.max()) and facts["moved"]["median"] == pytest.approx(
        np.median(moved)
    )
    assert any("refined poses" in note for note in report["notes"])
    assert all(view.name == old.name and view.K is old.K for view, old in zip(views, given, strict=True))


def test_depth_in_another_unit_is_left_out_with_a_warning(made):
    rng, right, features = made
    millimetres = replace(features, depth=1000 * features.depth)
    _, views, report = check(millimetres, drifted(rng, right, 0.5, 0.02))
    assert report["poses"]["refined"] and "another unit" in report["warnings"][0]
    assert errors(poses_of(views), right)[0] < 0.004
    given, views, report = check(millimetres, right)
    assert "another unit" in report["warnings"][0]
    assert all(view.camera_from_world is old.camera_from_world for view, old in zip(views, given, strict=True))


@pytest.mark.parametrize("noise", [0.01, 0.0])
def test_distances_along_the_rays_are_no_depth(made, noise):
    """A renderer's distance to the camera's centre is √(1 + x² + y²) times the depth at the ray (x, y, 1)."""
    rng, right, _ = made
    features = seen(rng, truth(np.random.default_rng(3)), depth_noise=noise)
    lengths = np.sqrt(1 + (features.rays**2).sum(axis=1))
    given, views, report = check(replace(features, depth=features.depth * lengths), right)
    assert "distance along each pixel's ray" in report["warnings"][0]
    assert all(view.camera_from_world is old.camera_from_world for view, old in zip(views, given, strict=True))
    assert not check(features, right)[2]["warnings"]


BODY = np.array([[0, 0, 1.0, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])  # body_from_camera


@pytest.mark.parametrize(
    ("told", "written"),
    [
        ("y and z axes point the other way", lambda pose: pose @ np.diag([1.0, -1, -1, 1])),
        ("of bodies with x forward", lambda pose: pose @ np.linalg.inv(BODY)),
        ("of bodies with x forward", lambda pose: pose @ np.linalg.inv(BODY) @ np.diag([1.0, -1, -1, 1])),
        ("camera_from_world in place of", np.linalg.inv),
        ("camera_from_world in place of", lambda pose: np.linalg.inv(pose) @ np.diag([1.0, -1, -1, 1])),
    ],
)
def test_poses_in_another_convention_are_refused_by_its_name(told, written):
    rng = np.random.default_rng(3)
    matrices = truth(rng)
    read = np.stack([np.linalg.inv(written(np.linalg.inv(matrix))) for matrix in matrices])
    with pytest.raises(InputError, match=f"do not fit the photos: .* if they are .*{told}.*photos.poses=keep"):
        check(seen(rng, matrices), poses_of(views_at(read)))


def test_poses_that_no_match_agrees_with_are_kept_with_a_warning():
    rng = np.random.default_rng(0)
    matrices = truth(rng)
    given, views, report = check(seen(rng, matrices, wrong=1), poses_of(views_at(matrices)))
    assert views is given and "do not fit the photos" in report["warnings"][0]


def test_few_matches_are_no_check(made):
    _, right, features = made
    given, views, report = check(replace(features, pairs=features.pairs[:20]), right)
    assert views is given and "not checked: 20" in report["notes"][0]


def test_things_that_move_with_the_camera_do_not_drag_good_poses(made):
    """In two corners of every photo stand the same features, and outnumber those of the scene."""
    rng, right, features = made
    count = 200
    corners = rng.uniform((0.30, -0.35), (0.42, -0.20), (count, 2)) * np.where(rng.random((count, 1)) < 0.5, (1, 1), -1)
    pairs = []
    for a in range(VIEWS):
        for b in range(a + 1, min(a + 6, VIEWS)):
            of = rng.choice(count, 150, replace=False)
            pairs.append(len(features.view) + np.stack([a * count + of, b * count + of], axis=1))
    noisy = np.tile(corners, (VIEWS, 1)) + rng.normal(0, NOISE / FOCAL, (VIEWS * count, 2))
    held = Features(
        np.concatenate([features.view, np.repeat(np.arange(VIEWS), count)]),
        np.concatenate([features.rays, noisy]),
        np.full(len(features.view) + len(noisy), FOCAL),
        np.concatenate([features.depth, np.full(len(noisy), 0.3)]),
        np.concatenate([features.pairs, *pairs]),
    )
    given, views, report = check(held, right)
    np.testing.assert_array_equal(poses_of(views).center, poses_of(given).center)
    assert not report["poses"]["refined"] and report["warnings"]
