"""The direction of gravity against truth that is known exactly, and how often two standard errors cover it."""

from __future__ import annotations

import numpy as np
import pytest

from perception.frame.gravity import floor_height, gravity_of_scene
from support.measured_scenes import cameras, estimated, random_similarity, rolled, room_points
from support.rotations import rotation_from_quaternion

DOWN = np.array([0.0, 0.0, -1.0])


def angle(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.degrees(np.arccos(np.clip(a @ b / np.linalg.norm(a) / np.linalg.norm(b), -1, 1))))


def draw(seed: int, points: bool, count: int = 40) -> tuple[float, float]:
    """(error, stated standard error) in degrees for a walk with hand-held rolls, in a random frame and unit."""
    rng = np.random.default_rng(seed)
    world, _ = random_similarity(rng)
    views = estimated(rolled(cameras("walk", count), rng), world, rng)
    cloud = room_points(rng) @ world[:3, :3].T + world[:3, 3] if points else np.empty((0, 3))
    found = gravity_of_scene(np.stack([view.camera_from_world for view in views]), cloud, seed)
    assert found is not None and found.confident and np.linalg.norm(found.direction) == pytest.approx(1)
    assert ("0 level planes, 0 walls" in found.source) != points
    return angle(found.direction, world[:3, :3] @ DOWN), found.standard_error


@pytest.mark.parametrize("points", [True, False])
def test_gravity_is_right_and_its_error_as_stated(points: bool) -> None:
    """Of a room with planes and of cameras alone: the goal is 1°; two standard errors cover 18 of 20 or more."""
    errors, stated = np.array([draw(seed, points) for seed in range(20)]).T
    print(
        f"planes {points}: median {np.median(errors):.2f}°, most {errors.max():.2f}°, stated {np.median(stated):.2f}°"
    )
    assert np.median(errors) < 0.5 and (errors < 1).mean() >= 0.9
    assert (errors <= 2 * stated).mean() >= 0.9 and np.median(stated) < 1


def test_a_slanted_plane_is_outvoted_and_doubt_is_stated() -> None:
    """One plane 8° off level, as of a desk: 60 level cameras are believed, or the stated error grows."""
    rng = np.random.default_rng(0)
    views = rolled(cameras("walk", 60), rng)
    desk = np.c_[rng.uniform(-1, 1, (3000, 2)), np.zeros(3000)] @ rotation_from_quaternion([1, 0.07, 0, 0]).T  # type: ignore[arg-type]
    found = gravity_of_scene(np.stack([view.camera_from_world for view in views]), desk)
    assert found is not None and angle(found.direction, DOWN) < 2 * found.standard_error


def test_a_path_without_turns_tells_less_and_wild_cameras_nothing() -> None:
    views = cameras("walk", 40)
    straight = np.stack([views[0].camera_from_world] * 10)
    found = gravity_of_scene(straight, np.empty((0, 3)))
    assert found is not None and not found.confident  # the pitch of the camera is unknown
    rng = np.random.default_rng(0)
    floor = np.c_[rng.uniform(-2, 2, (2000, 2)), 0.005 * rng.normal(size=2000)]
    better = gravity_of_scene(straight, np.concatenate([floor, floor[:, [2, 0, 1]] + [2, 0, 1.5]]))
    assert better is not None and (not better.confident or angle(better.direction, DOWN) < 2 * better.standard_error)
    wild = np.tile(np.eye(4), (30, 1, 1))
    wild[:, :3, :3] = [rotation_from_quaternion(q) for q in rng.normal(size=(30, 4))]
    assert gravity_of_scene(wild, floor) is None


def test_the_floor_is_the_lowest_slab_of_many_points() -> None:
    """A floor at 0.3 below a table at 1.0, a ceiling at 2.5, and stray points far below."""
    rng = np.random.default_rng(0)
    heights = np.r_[np.full(500, 0.3), np.full(900, 1.0), np.full(800, 2.5), rng.uniform(-5, 0, 20)]
    points = np.c_[rng.normal(size=(len(heights), 2)), heights + 0.004 * rng.normal(size=len(heights))]
    up, eye = np.array([0.0, 0, 1]), np.array([0, 0, 1.5])
    assert floor_height(up, points, eye) == pytest.approx(0.3, abs=0.01)
    assert floor_height(up, points[:0], eye) == 1.5
    assert floor_height(-up, -points, -eye) == pytest.approx(0.3, abs=0.01)  # the same scene, upside down


@pytest.mark.parametrize(("heights", "floor"), [((-1, 3), -0.96), ((1, 10), 0.0)])
def test_without_a_slab_the_floor_is_where_few_points_lie_below(heights: tuple[float, float], floor: float) -> None:
    """Evenly spread points, 1 % of which lie below the floor; and a camera below all but 40 strays of them."""
    z = np.r_[np.linspace(*heights, 8000), np.linspace(-3, -2, 40 if floor == 0 else 0)]
    points = np.c_[np.zeros((len(z), 2)), z]
    assert floor_height(np.array([0.0, 0, 1]), points, np.zeros(3)) == pytest.approx(floor, abs=1e-6)
