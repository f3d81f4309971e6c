"""Poses from made matches with exact truth: right ones are found, doubtful ones refused with the reason."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from perception.localise.lenses import median
from perception.localise.pose import GUESSED, KNOWN, LIKELY, MIN_INLIERS, Matched, Pose, cropped, find_pose
from perception.types import Lens
from support.painted_room import difference, pose_at

LENS = Lens("PINHOLE", (500.0, 500.0, 320.0, 240.0), 640, 480)
POSE = pose_at((0.2, -4.0, 0.3), (0.0, 0.0, 0.0))
OTHER = pose_at((3.0, -3.0, 0.8), (0.2, 0.1, 0.0))


def seen(pose: np.ndarray, points: np.ndarray, lens: Lens = LENS) -> np.ndarray:
    x = points @ pose[:3, :3].T + pose[:3, 3]
    fx, fy, cx, cy = lens.params
    return np.asarray(x[:, :2] / x[:, 2:] * (fx, fy) + (cx, cy))


def matches(*parts: tuple[np.ndarray, int], noise: float = 0.3, lens: Lens = LENS, side: float = 1.0) -> Matched:
    """For each part (pose, count): other features at points of a cube of this side, and 100 wrong matches."""
    rng = np.random.default_rng(0)
    pixels, points = [], []
    for pose, count in parts:
        x = rng.uniform(-side, side, (count, 3))
        points.append(x)
        pixels.append(seen(pose, x, lens) + rng.normal(scale=noise, size=(count, 2)))
    points.append(rng.uniform(-1, 1, (100, 3)))
    pixels.append(rng.uniform((0, 0), (lens.width, lens.height), (100, 2)))
    pixel, point = np.concatenate(pixels), np.concatenate(points)
    return Matched(np.arange(len(pixel)), pixel, point)


def sure(_: Pose) -> None:
    """No further doubts."""


def test_the_pose_is_found_among_wrong_matches() -> None:
    found = find_pose(matches((POSE, 200)), LENS, KNOWN, sure)
    assert isinstance(found, Pose)
    length, degrees = difference(found.camera_from_map, POSE)
    assert length < 0.01 and degrees < 0.1
    assert found.count >= 195 and found.inliers[:200].sum() >= 195 and found.inliers[200:].sum() <= 2


def test_a_thing_that_was_moved_does_not_decide_but_an_equal_share_is_doubtful() -> None:
    found = find_pose(matches((POSE, 200), (OTHER, 90)), LENS, KNOWN, sure)
    assert isinstance(found, Pose) and difference(found.camera_from_map, POSE)[0] < 0.01
    refused = find_pose(matches((POSE, 200), (OTHER, 180)), LENS, KNOWN, sure)
    assert isinstance(refused, str) and "two poses fit" in refused


def test_the_same_features_at_two_spots_are_doubtful() -> None:
    """Each feature matches two points, which agree with two poses, and a few more features with the first only."""
    one, other = (matches((pose, 150)) for pose in (POSE, OTHER))
    both = Matched(
        np.concatenate([one.feature, np.arange(150)]),
        np.concatenate([one.pixel, one.pixel[:150]]),
        np.concatenate([one.point, _carried(one.pixel[:150], other.point[:150])]),
    )
    refused = find_pose(both, LENS, KNOWN, sure)
    assert isinstance(refused, str) and "two poses fit" in refused


def _carried(pixel: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Points that OTHER sees at `pixel`, as far away as `points` are."""
    depth = (points @ OTHER[:3, :3].T + OTHER[:3, 3])[:, 2:]
    rays = np.c_[(pixel - (320, 240)) / 500, np.ones(len(pixel))]
    return np.asarray((rays * depth - OTHER[:3, 3]) @ OTHER[:3, :3])


def test_few_or_crowded_features_give_no_pose() -> None:
    few = find_pose(matches((POSE, MIN_INLIERS - 5)), LENS, KNOWN, sure)
    assert isinstance(few, str) and f"{MIN_INLIERS} are needed" in few
    crowded = find_pose(matches((POSE, 150), side=0.05), LENS, KNOWN, sure)
    assert isinstance(crowded, str) and "of the picture" in crowded


def test_a_doubted_pose_leaves_room_for_the_next() -> None:
    found = find_pose(matches((POSE, 200), (OTHER, 90)), LENS, KNOWN, lambda pose: "no" if pose.count > 150 else None)
    assert isinstance(found, Pose) and difference(found.camera_from_map, OTHER)[0] < 0.03


@pytest.mark.parametrize("focal", [350.0, 700.0])
def test_a_guessed_lens_is_estimated(focal: float) -> None:
    true = Lens("PINHOLE", (focal, focal, 320.0, 240.0), 640, 480)
    guess = Lens("SIMPLE_RADIAL", (500.0, 320.0, 240.0, 0.0), 640, 480)
    found = find_pose(matches((POSE, 200), lens=true), guess, GUESSED, sure)
    assert isinstance(found, Pose)
    assert found.lens.params[0] == pytest.approx(focal, rel=0.02)
    assert difference(found.camera_from_map, POSE)[0] < 0.1


@pytest.mark.parametrize("seed", range(4))
def test_pixels_are_square_so_that_a_slanted_wall_tells_the_focal_length(seed: int) -> None:
    """With two focal lengths the place was off by a tenth of the distance."""
    rng = np.random.default_rng(seed)
    wall = np.c_[rng.uniform(-1.2, 1.2, 300), rng.uniform(-0.9, 0.9, 300), np.zeros(300)]
    turn = Rotation.from_euler("yx", [35, 10], degrees=True).as_matrix()
    pose = np.block([[turn, np.array([[0.0], [0.0], [4.0]])], [np.zeros((1, 3)), np.ones((1, 1))]])
    pixel = seen(pose, wall) + rng.normal(scale=0.5, size=(300, 2))
    guess = Lens("PINHOLE", (768.0, 768.0, 320.0, 240.0), 640, 480)
    found = find_pose(Matched(np.arange(300), pixel, wall), guess, GUESSED, sure)
    assert isinstance(found, Pose)
    assert found.lens.params[0] == pytest.approx(500, rel=0.03)
    assert difference(found.camera_from_map, pose)[0] < 0.1


@pytest.mark.parametrize("guess", [LENS, Lens("SIMPLE_RADIAL", (768.0, 320.0, 240.0, 0.0), 640, 480)])
@pytest.mark.parametrize("corner", [(0.0, 0.0), (640.0, 480.0), (0.0, 240.0)])
def test_the_principal_point_of_a_cropped_photo_is_estimated(corner: tuple[float, float], guess: Lens) -> None:
    """A part of a photo of twice the size, whose middle is not the part's: the place was wrong by metres, with a
    standard error of millimetres."""
    true = Lens("PINHOLE", (1000.0, 1000.0, 640.0 - corner[0], 480.0 - corner[1]), 640, 480)
    whole = matches((POSE, 1500), lens=true)
    inside = ((whole.pixel >= 0) & (whole.pixel < (640, 480))).all(axis=1)
    part = Matched(*(array[inside] for array in (whole.feature, whole.pixel, whole.point)))
    found = find_pose(part, guess, LIKELY, sure)
    assert isinstance(found, Pose) and cropped(guess, found.lens)
    assert difference(found.camera_from_map, POSE)[0] < 0.05
    assert np.allclose(found.lens.params, true.params, atol=15)


@pytest.mark.parametrize("seed", [0, 1, 4])
def test_a_flat_thing_and_wrong_matches_give_no_lens_that_does_not_exist(seed: int) -> None:
    """Seen at a right angle, its distance is as open as the focal length: one wrong match that fits decides on both."""
    rng = np.random.default_rng(seed)
    flat = np.c_[rng.uniform(-0.7, 0.7, (30, 2)), np.full(30, 4.0)]
    pixel = flat[:, :2] / 4 * 1500 + (320, 240) + rng.normal(0, 1, (30, 2))
    points = np.concatenate([flat, rng.uniform((-1, -1, 3), (1, 1, 5), (60, 3))])
    pixel = np.concatenate([pixel, rng.uniform(0, 1, (60, 2)) * [640, 480]])
    guess = Lens("SIMPLE_RADIAL", (768.0, 320.0, 240.0, 0.0), 640, 480)
    found = find_pose(Matched(np.arange(90), pixel, points), guess, GUESSED, sure)
    assert isinstance(found, Pose) and 64 <= found.lens.params[0] <= 6400 and abs(found.lens.params[-1]) <= 1
    assert np.abs(found.camera_from_map[:3, 3]).max() < 20


@pytest.mark.parametrize("k", [-0.4, -0.25, 0.0])
def test_a_pinhole_is_replaced_where_the_photo_is_distorted(k: float) -> None:
    """As raw photos are of a camera whose undistorted ones the map was made from."""
    made = matches((POSE, 150), noise=0.5)
    middle = np.array(LENS.params[2:])
    normal = (made.pixel - middle) / LENS.params[0]
    bent = normal * (1 + k * (normal**2).sum(axis=1, keepdims=True))
    found = find_pose(replace(made, pixel=bent * LENS.params[0] + middle), LENS, LIKELY, sure)
    assert isinstance(found, Pose) and difference(found.camera_from_map, POSE)[0] < 0.02
    if k == 0:
        assert found.lens == LENS
    else:
        assert found.lens.model == "SIMPLE_RADIAL" and abs(found.lens.params[-1] - k) < 0.03


def test_photos_of_one_camera_get_the_median_of_their_lenses() -> None:
    bent = [Lens("SIMPLE_RADIAL", (500.0 + n, 320.0, 240.0, k), 640, 480) for n, k in enumerate((-0.2, 0.3, -0.1))]
    assert median([LENS, *bent]) == Lens("SIMPLE_RADIAL", (501.0, 320.0, 240.0, -0.1), 640, 480)
    assert median([LENS, *bent, LENS, LENS]) == LENS
