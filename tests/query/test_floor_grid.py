"""The floor plan against a room whose floor, walls and furniture are known exactly."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from perception.errors import InputError
from perception.map.map import Map
from perception.query.floor_grid import FREE, OCCUPIED, UNKNOWN, floor_grid
from perception.types import View
from support.aimed import look_at

CELL, TABLE, LAMP = 0.1, ((1.0, 0.5), (2.0, 1.2)), ((2.5, 0.5), (2.8, 0.8))
WIDE, DEEP = 4.0, 3.0


def sheet(low: tuple[float, float], high: tuple[float, float], z: float) -> np.ndarray:
    """Points [P, 3] on a level rectangle, 2.5 cm apart, none on the border of a cell."""
    x, y = (np.arange(a + 0.0125, b, 0.025) for a, b in zip(low, high, strict=True))
    return np.stack([*np.meshgrid(x, y), np.full((len(y), len(x)), z)], axis=-1).reshape(-1, 3)


FLOOR = sheet((0, 0), (WIDE, DEEP), 0.0)
FURNITURE = np.concatenate(
    [sheet(*TABLE, 0.7), sheet((3.5, 2.0), (3.6, 2.1), 0.15), sheet((3.0, 0.0), (3.1, 3.0), 1.7)]
)
ABOVE = np.concatenate([sheet(*LAMP, 2.2), sheet((-1.0, 0.0), (0.0, 1.0), -0.6)])  # a lamp, and a stair down


def room(map_from_room: np.ndarray, **info: Any) -> Map:
    points = np.concatenate([FLOOR, FURNITURE, ABOVE]) @ map_from_room[:3, :3].T + map_from_room[:3, 3]
    up, count = map_from_room[:3, 2], len(points)
    eye = map_from_room[:3, :3] @ [2.0, 2.5, 1.4] + map_from_room[:3, 3]
    pose = look_at(eye, eye + map_from_room[:3, 0], up)
    return Map(
        means=points.astype(np.float32),
        quats=np.tile(np.array([1, 0, 0, 0], np.float32), (count, 1)),
        log_scales=np.full((count, 3), np.log(1e-4), np.float32),
        opacity_logits=np.full(count, 3, np.float32),
        sh=np.zeros((count, 1, 3), np.float32),
        features=np.zeros((count, 1), np.float32),
        instance_ids=np.full(count, -1, np.int32),
        membership=np.ones(count, np.float32),
        info={"metric": True, "gravity": {"direction": (-up).tolist()}, **info},
        views=[View("a.jpg", Path("a.jpg"), np.eye(3), 64, 48, pose)],
        path=Path("room.gsmap"),
    )


def cell_of(cells: np.ndarray, map_from_grid: np.ndarray, map_from_room: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Values of the cells that points [P, 3] of the room lie in; UNKNOWN outside the grid."""
    grid_from_room = np.linalg.inv(map_from_grid) @ map_from_room
    x, y = np.floor((points @ grid_from_room[:3, :3].T + grid_from_room[:3, 3])[:, :2] / CELL).astype(int).T
    inside = (x >= 0) & (y >= 0) & (x < cells.shape[1]) & (y < cells.shape[0])
    return np.where(inside, cells[np.where(inside, y, 0), np.where(inside, x, 0)], UNKNOWN)


def test_every_cell_of_a_room() -> None:
    cells, map_from_grid = floor_grid(room(np.eye(4)), CELL)
    truth = np.full((30, 40), FREE)
    truth[5:12, 10:20] = truth[20, 35] = truth[:, 30] = OCCUPIED
    np.testing.assert_array_equal(cells, truth)
    np.testing.assert_allclose(map_from_grid, np.eye(4), atol=1e-6)


@pytest.mark.parametrize("seed", range(4))
def test_a_room_in_any_pose(seed: int) -> None:
    """The grid finds gravity and floor: what stands is occupied, floor a cell away from it free, the rest unknown."""
    rng = np.random.default_rng(seed)
    map_from_room = np.eye(4)
    map_from_room[:3, :3] = Rotation.random(random_state=seed).as_matrix()
    map_from_room[:3, 3] = rng.normal(size=3) * 5
    cells, map_from_grid = floor_grid(room(map_from_room), CELL)
    axes = map_from_room[:3, :3].T @ map_from_grid[:3, :3]  # room_from_grid
    np.testing.assert_allclose(axes[:, 2], [0, 0, 1], atol=1e-6)
    assert abs((map_from_room[:3, :3].T @ (map_from_grid[:3, 3] - map_from_room[:3, 3]))[2]) < 1e-3
    assert (cell_of(cells, map_from_grid, map_from_room, FURNITURE) == OCCUPIED).all()
    gap = cKDTree(FURNITURE[:, :2]).query(FLOOR[:, :2])[0]
    assert (cell_of(cells, map_from_grid, map_from_room, FLOOR[gap > 1.5 * CELL]) == FREE).all()
    around = FLOOR * [2, 2, 0] - [2, 1.5, 0]
    away = np.maximum(np.maximum(-around, around - [WIDE, DEEP, 9]), 0)[:, :2].max(axis=1) > 1.5 * CELL
    assert (cell_of(cells, map_from_grid, map_from_room, around[away]) == UNKNOWN).all()


def test_a_wide_gaussian_covers_its_cells() -> None:
    """A disc of radius 0.14 m in the free row above the table, and the shelf at x = 3."""
    gmap = room(np.eye(4))
    lamp = len(FLOOR) + len(FURNITURE)
    gmap.log_scales[lamp] = np.log([0.14, 1e-4, 0.14])
    gmap.quats[lamp] = [np.cos(np.pi / 4), np.sin(np.pi / 4), 0, 0]  # about x: its plane is level
    gmap.means[lamp] = [2.55, 2.25, 0.7]
    cells = floor_grid(gmap, CELL)[0]
    assert np.flatnonzero(cells[22] == OCCUPIED).tolist() == [24, 25, 26, 30]
    assert np.flatnonzero(cells[:, 25] == OCCUPIED).tolist() == [21, 22, 23]


@pytest.mark.parametrize(
    ("info", "words"),
    [({"metric": False}, "no metric scale"), ({"gravity": None}, "no gravity")],
)
def test_maps_without_a_floor_plan_say_why(info: dict[str, Any], words: str) -> None:
    with pytest.raises(InputError, match=words):
        floor_grid(room(np.eye(4), **info), CELL)
    with pytest.raises(InputError, match="more than"):
        floor_grid(room(np.eye(4)), 1e-4)


@pytest.mark.parametrize("resolution", [0.0, -0.05, np.nan, np.inf])
def test_cells_have_a_size(resolution: float) -> None:
    with pytest.raises(InputError, match="expected a positive number of metres"):
        floor_grid(room(np.eye(4)), resolution)
