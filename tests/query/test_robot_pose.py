"""where_to_stand in rooms of boxes, whose free floor and lines of sight are known in closed form."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from perception.errors import InputError
from perception.query import Frame
from perception.query.floor_grid import HEIGHT
from perception.query.requests import UnknownInstance
from perception.query.robot_pose import CELL, RobotPose, where_to_stand
from support.box_rooms import FURNISHED, Boxes, cast, points
from support.box_rooms import map_of as room

RADIUS, SENSOR = 0.25, 1.2
ROOM: tuple[list[float], list[float]] = ([-2.0, -1.5, 0.0], [2.0, 1.5, 2.4])
CRATE: tuple[list[float], list[float]] = ([-0.6, -0.2, 0.0], [0.6, 0.2, 0.5])
FENCE: tuple[list[float], list[float]] = ([-0.9, -1.5, 0.0], [-0.8, 1.5, 0.8])  # the part at x < -0.9 is the smaller
SCREEN: tuple[list[float], list[float]] = ([-0.7, 0.3, 0.0], [0.7, 0.35, 2.0])


def gap(boxes: Boxes, place: np.ndarray) -> float:
    """Level distance of a place [2] from the boxes that reach below the robot's top, and from the walls."""
    (low, high), *rest = np.array(boxes)[:, :, :2]
    outside = [np.linalg.norm(np.maximum(np.maximum(lo - place, place - hi), 0)) for lo, hi in rest]
    outside = [g for g, (lo, _) in zip(outside, boxes[1:], strict=True) if lo[2] < HEIGHT]
    return float(min([*outside, *(place - low), *(high - place)]))


def open_share(boxes: Boxes, number: int, place: np.ndarray) -> float:
    """The share of rays from the sensor to points of a box that meet no other box."""
    own = points([boxes[0], boxes[number]], spacing=0.1)
    low, high = np.array(boxes[number])
    own = own[((own >= low) & (own <= high)).all(axis=1)]
    others = [box for n, box in enumerate(boxes) if n not in (0, number)]
    eye = np.array([*place, SENSOR])
    return float((cast([boxes[0], *others], eye, own - eye) > 1 - 1e-6).mean())


def in_room(stand: RobotPose, map_from_room: np.ndarray) -> np.ndarray:
    """room_from_robot [4, 4]."""
    return np.linalg.inv(map_from_room) @ stand.map_from_robot


def test_before_the_middle_of_a_long_side_at_the_wanted_distance() -> None:
    stand = where_to_stand(room([ROOM, CRATE]), 1, distance=0.7)
    x, y, z = stand.position
    assert abs(x) <= CELL and abs(abs(y) - 0.9) <= CELL and abs(z) < 1e-6  # the crate's side is at 0.2
    np.testing.assert_allclose(stand.yaw, -np.sign(y) * np.pi / 2, atol=0.05)
    np.testing.assert_allclose(stand.map_from_robot[:3, 0], [0, -np.sign(y), 0], atol=0.05)
    np.testing.assert_allclose(stand.map_from_robot[:3, 2], [0, 0, 1], atol=1e-9)
    assert (stand.frame, stand.seen) == ("home", 1.0) and abs(stand.distance - 0.7) <= CELL


@pytest.mark.parametrize("seed", range(3))
def test_every_box_of_a_furnished_room_in_any_pose(seed: int) -> None:
    """The disc is on the floor, clear of all boxes; the robot faces the box and sees it."""
    move = np.eye(4)
    if seed:
        move[:3, :3] = Rotation.random(random_state=seed).as_matrix()
        move[:3, 3] = [3.0, -2.0, 1.0]
    gmap = room(FURNISHED, move)
    for number in range(1, len(FURNISHED)):
        stand = where_to_stand(gmap, number, radius=RADIUS, sensor_height=SENSOR)
        pose = in_room(stand, move)
        np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-6)
        assert abs(pose[2, 3]) < 1e-3 and pose[2, 2] > 1 - 1e-6 and np.linalg.det(pose[:3, :3]) > 0
        assert gap(FURNISHED, pose[:2, 3]) >= RADIUS
        assert open_share(FURNISHED, number, pose[:2, 3]) >= 0.5
        low, high = np.array(FURNISHED[number])[:, :2]
        reach = np.linspace(0, 5, 500)[:, None] * pose[:2, 0] + pose[:2, 3]
        assert ((reach >= low) & (reach <= high)).all(axis=1).any()


def test_in_the_largest_part_of_the_floor_even_if_another_is_nearer() -> None:
    boxes = [ROOM, ([-1.3, -0.1, 0.0], [-1.1, 0.1, 1.6]), FENCE]
    x, _, _ = where_to_stand(room(boxes), 1).position
    assert x >= -0.8 + RADIUS
    x, _, _ = where_to_stand(room(boxes[:2]), 1).position  # without the fence, at the wanted distance
    assert x < -0.8 + RADIUS


def test_on_the_side_that_is_not_hidden() -> None:
    """A screen above the sensor hides the crate from y > 0.35; one below it does not matter."""
    boxes = [ROOM, CRATE, SCREEN]
    assert where_to_stand(room(boxes), 1).position[1] < 0
    near = ([-2.0, -1.5, 0.0], [2.0, 1.5, 2.4]), CRATE, ([-2.0, -0.3, 0.0], [2.0, -0.25, 2.0])
    assert where_to_stand(room(list(near)), 1).position[1] > 0


def test_a_crate_behind_screens_on_all_sides_is_hidden() -> None:
    x, y = 0.75, 0.35
    sides = [([-x, s * y - 0.02, 0.0], [x, s * y + 0.02, 2.0]) for s in (-1, 1)]
    sides += [([s * x - 0.02, -y, 0.0], [s * x + 0.02, y, 2.0]) for s in (-1, 1)]
    boxes: Boxes = [ROOM, CRATE, *sides]
    with pytest.raises(InputError, match="instance 1: is hidden from every free place"):
        where_to_stand(room(boxes), 1)


def test_not_inside_the_box_of_another_instance_but_within_walls_that_are_one() -> None:
    """Two shelves with a niche of 0.8 m between them: a robot may stand in it, unless they are one instance."""
    shelves: Boxes = [([-1.4, 0.0, 0.0], [-0.4, 1.5, 1.5]), ([0.4, 0.0, 0.0], [1.4, 1.5, 1.5])]
    boxes: Boxes = [ROOM, *shelves, ([-0.1, 1.4, 0.9], [0.1, 1.5, 1.1])]  # a picture at the end of the niche
    apart = where_to_stand(room(boxes), 3, distance=0.5).position
    assert abs(apart[0]) < 0.4 and apart[1] > 0
    as_one = where_to_stand(room(boxes, merged={2: 1}), 3, distance=0.5).position
    assert as_one[1] <= -RADIUS
    shell = where_to_stand(room([ROOM, CRATE], merged={0: 9, 1: 1}), 1, distance=0.7).position
    assert gap([ROOM, CRATE], shell[:2]) >= RADIUS


def test_nothing_hides_an_instance_that_is_the_whole_map() -> None:
    assert where_to_stand(room([ROOM, CRATE], merged={0: 1, 1: 1}), 1).seen == 1.0


def test_what_hangs_above_the_robot_is_not_in_its_way() -> None:
    """A lamp over the wanted place at 1.9 m leaves it free, at 1.7 m it does not."""
    for height, free in ((1.9, True), (1.7, False)):
        lamps: Boxes = [([-1.0, s * 1.0 - 0.3, height], [1.0, s * 1.0 + 0.3, height + 0.05]) for s in (-1, 1)]
        boxes = [ROOM, CRATE, *lamps]
        place = where_to_stand(room(boxes), 1, distance=0.7).position[:2]
        assert (abs(abs(place[1]) - 0.9) <= CELL and abs(place[0]) <= CELL) == free
        assert gap(boxes, place) >= RADIUS


def test_in_another_frame() -> None:
    gmap = room([ROOM, CRATE])
    own, turn = where_to_stand(gmap, 1), np.eye(4)
    turn[:3, :3], turn[:3, 3] = 2 * Rotation.from_euler("z", 0.5).as_matrix(), [1, 2, 3]
    other = where_to_stand(gmap, 1, frame=Frame("base", turn))
    assert other.frame == "base" and (other.distance, other.seen) == (own.distance, own.seen)
    np.testing.assert_allclose(other.position, 2 * Rotation.from_euler("z", 0.5).apply(own.position) + [1, 2, 3])
    np.testing.assert_allclose((other.yaw - own.yaw) % (2 * np.pi), 0.5)
    np.testing.assert_allclose(np.linalg.det(other.map_from_robot[:3, :3]), 1)


def test_a_gaussian_far_away_changes_nothing() -> None:
    """Keys of voxels do not overflow."""
    near, far = room([ROOM, CRATE, SCREEN]), room([ROOM, CRATE, SCREEN])
    far.means[0] = [3e9, -4e9, 5e9]
    np.testing.assert_array_equal(where_to_stand(far, 1).map_from_robot, where_to_stand(near, 1).map_from_robot)


@pytest.mark.parametrize(
    ("info", "how", "words"),
    [
        ({"metric": False}, {}, "no metric scale"),
        ({"gravity": None}, {}, "no gravity"),
        ({}, {"radius": 0.0}, "radius is 0.0, expected a positive number"),
        ({}, {"sensor_height": float("nan")}, "sensor_height is nan"),
        ({}, {"radius": 1.6}, "no free floor within 2.0 m of it that a robot of radius 1.6 m reaches"),
    ],
)
def test_bad_input(info: dict[str, Any], how: dict[str, float], words: str) -> None:
    with pytest.raises(InputError, match=words):
        where_to_stand(room([ROOM, CRATE], **info), 1, **how)


def test_unknown_instances() -> None:
    with pytest.raises(UnknownInstance, match="instance 7"):
        where_to_stand(room([ROOM, CRATE]), 7)
