"""New photos beside each other and beside the map: made features with exact truth."""

from __future__ import annotations

import numpy as np
import pytest

from perception.localise.evidence import doubt
from perception.localise.joint import Adjustment, contradicted
from perception.localise.keypoints import Described
from perception.localise.pose import Matched, Pose
from perception.localise.reference import Reference
from perception.posed.bundle_adjustment import Poses
from perception.posed.pose_refinement import poses_of
from perception.sfm.tracks import Features
from perception.types import Lens
from support.aimed import look_at
from support.views_at import views_at

FOCAL = 50.0


def described(view: np.ndarray, rays: np.ndarray, pairs: np.ndarray) -> Described:
    none = np.zeros(0)
    features = Features(view, rays, np.full(len(view), FOCAL), np.zeros(len(view)), pairs)
    return Described(features, none, none, [], none, none)


def reference(poses: Poses, points: np.ndarray) -> Reference:
    """A map of one view that shows all points."""
    index = np.arange(len(points))
    known = described(0 * index, np.zeros((len(points), 2)), np.zeros((0, 2), int))
    return Reference(views_at([np.eye(4)]), [], known, poses, index, points)


@pytest.mark.parametrize(("wrong", "expected"), [(60, 2), (25, None)])
def test_of_two_photos_that_many_matches_contradict_the_weaker_is_named(wrong: int, expected: int | None) -> None:
    """Photos 0 and 1 have 50 matches that agree with their poses, 1 and 2 `wrong` ones that do not."""
    rng = np.random.default_rng(0)
    eyes = np.array([[-1.0, -4, 0], [0, -4, 0.5], [1, -4, 0]])
    up = np.array([0, 0, 1.0])
    poses = poses_of(views_at([np.eye(4), *(look_at(eye, np.zeros(3), up) for eye in eyes)]))
    view = np.repeat([0, 1, 1, 2], [50, 50, wrong, wrong])
    points = np.tile(rng.uniform(-1, 1, (50, 3)), (2, 1))
    points = np.concatenate([points, rng.uniform(-1, 1, (2 * wrong, 3))])
    x = np.einsum("oij,oj->oi", poses.rotation[view + 1], points - poses.center[view + 1])
    first = np.r_[np.arange(50), 100 + np.arange(wrong)]
    new = described(view, x[:, :2] / x[:, 2:], np.c_[first, first + np.repeat([50, wrong], [50, wrong])])
    found = Adjustment(poses, view, points, {0: 40, 1: 45, 2: 30}, {}, None)
    known = reference(poses, points[:0])
    assert contradicted(known, new, found, {0, 1, 2}, most=1.0) == expected
    assert contradicted(known, new, found, {0, 1}, most=1.0) is None


def test_points_far_outside_the_picture_are_not_expected_in_it() -> None:
    """The polynomial of this lens leads rays 65° from its axis into the middle of the picture; its corners are at 39°.
    The photo shows all points there are in it, at its left."""
    lens = Lens("SIMPLE_RADIAL", (500.0, 320.0, 240.0, -0.2), 640, 480)
    rng = np.random.default_rng(0)
    left = np.c_[rng.uniform(-0.6, -0.45, 200), rng.uniform(-0.4, 0.4, 200), np.ones(200)]
    turn, far = rng.uniform(0, 2 * np.pi, 2000), np.tan(np.radians(rng.uniform(61, 67, 2000)))
    outside = np.c_[far * np.cos(turn), far * np.sin(turn), np.ones(2000)]
    points = 4 * np.concatenate([left, outside])
    bent = left[:, :2] * (1 - 0.2 * (left[:, :2] ** 2).sum(axis=1, keepdims=True))
    matched = Matched(np.arange(200), bent * 500 + (320, 240), points[:200])
    pose = Pose(np.eye(4), np.ones(200, bool), 200, 200, lens)
    assert doubt(reference(poses_of(views_at([np.eye(4)])), points), matched, pose) is None
