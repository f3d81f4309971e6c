"""Floaters, up, and virtual cameras of a room whose surfaces, free space and gravity are known."""

from __future__ import annotations

import tracemalloc
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from perception.cli import build_parser
from perception.errors import InputError
from perception.geometry import camera_centres
from perception.splats import panoramas
from perception.splats.cameras import FIVE, Chosen, choose_views
from perception.splats.gravity import direction, planes
from perception.splats.panoramas import Survey, _grid, proxy_of, survey
from perception.splats.read import Splat, read_splat
from perception.splats.scene import drawn, rendered
from perception.splats.surface import floaters
from support.splat_rooms import SIDES, TABLE, room_columns, write_room

TURNS = {
    "z up": np.eye(3),
    "y down": np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]),
    "tilted": Rotation.from_rotvec([0.4, -0.9, 0.3]).as_matrix(),
}


def looked(splat: Splat, hidden: np.ndarray, up: np.ndarray | None = None) -> tuple[Survey, Chosen]:
    gaussians = drawn(splat, hidden, torch.zeros(len(splat), 1))
    proxy = proxy_of(gaussians, hidden)
    found = survey(proxy, splat.means[~hidden].astype(np.float64), up)
    return found, choose_views(found, proxy, 320, np.zeros((0, 4, 4)), 0.8)


def times_seen(splat: Splat, poses: np.ndarray) -> np.ndarray:
    """[N] by how many views each Gaussian is seen, by an oracle without voxels: nothing lies nearer on its ray."""
    K = np.array([[256.0, 0, 160], [0, 256.0, 120], [0, 0, 1]])
    gaussians = drawn(splat, splat.parked, torch.zeros(len(splat), 1))
    means, times = splat.means.astype(np.float64), np.zeros(len(splat))
    for pose in poses:
        depth = rendered(gaussians, pose, K, 320, 240).depth
        x, y, z = (means @ pose[:3, :3].T + pose[:3, 3]).T
        ahead = np.maximum(z, 1e-3)
        u, v = K[0, 0] * x / ahead + 160, K[1, 1] * y / ahead + 120
        inside = (z > 0.05) & (u >= 0) & (v >= 0) & (u < 320) & (v < 240)
        row, column = (np.where(inside, pixel, 0).astype(int) for pixel in (v, u))
        times += inside & (np.abs(depth[row, column] - z) < 0.06)
    return times


@pytest.mark.slow
@pytest.mark.parametrize("ceiling", [False, True])
@pytest.mark.parametrize("name", TURNS)
def test_cameras_stand_in_the_room_and_see_it_all(tmp_path: Path, name: str, ceiling: bool) -> None:
    turn = TURNS[name]
    columns, thing = room_columns(turn, ceiling=ceiling)
    splat = read_splat(write_room(tmp_path / "room.ply", columns))
    found, chosen = looked(splat, floaters(splat))
    angle = np.degrees(np.arccos(np.clip(-found.gravity.direction @ turn[:, 2], -1, 1)))
    assert angle < 4  # of a voxel over a wall
    centres = camera_centres(chosen.poses) @ turn
    assert np.all((centres[:, :2] > 0) & (centres[:, :2] < SIDES[:2]))  # between the walls
    assert np.all(centres[:, 2] > 0.9)
    on_table = np.all((centres > TABLE[0]) & (centres < TABLE[1]), axis=1)
    assert not on_table.any()
    level = chosen.poses[:, 0, :3] @ turn[:, 2]
    assert np.abs(level).max() < np.sin(np.radians(4))
    times = times_seen(splat, chosen.poses)
    assert np.mean(times >= FIVE) > 0.8
    assert np.mean(times[thing >= 2] >= 2) > 0.9


@pytest.mark.slow
def test_a_thing_in_empty_space_is_seen_from_all_sides(tmp_path: Path) -> None:
    """A table with two boxes and nothing around it, as a scan of one thing is."""
    columns, thing = room_columns()
    splat = read_splat(write_room(tmp_path / "thing.ply", {name: x[thing > 0] for name, x in columns.items()}))
    found, chosen = looked(splat, floaters(splat), np.array([0.0, 0, 1]))
    assert not found.inside and len(found.places) < 400
    away = camera_centres(chosen.poses) - TABLE[1]
    assert np.all(np.linalg.norm(away, axis=1) < 6)
    yaw = np.sort(np.arctan2(away[:, 1], away[:, 0]))
    assert np.diff(np.append(yaw, yaw[0] + 2 * np.pi)).max() < np.pi / 2


@pytest.mark.slow
def test_a_building_is_seen_as_a_room_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(panoramas, "MOST_PLACES", 240)
    monkeypatch.setattr(panoramas, "PLACES", 60)  # as coarse for four rooms as the grid is for a large building
    columns, _ = room_columns()
    origins = [(SIDES[0] * i, SIDES[1] * j) for i in range(2) for j in range(2)]
    tiled = {name: np.tile(x, len(origins)) for name, x in columns.items()}
    for axis, name in enumerate("xy"):
        tiled[name] = np.concatenate([columns[name] + origin[axis] for origin in origins])
    splat = read_splat(write_room(tmp_path / "building.ply", tiled))
    found, chosen = looked(splat, splat.parked, np.array([0.0, 0, 1]))
    assert found.inside
    times = times_seen(splat, chosen.poses)
    assert np.mean(times >= 2) > 0.9
    assert np.mean(times >= FIVE) > 0.6


@pytest.mark.parametrize("side", [(1, 1, 1), (4, 3, 1e-3), (9, 0.1, 0.1), (2, 0, 0), (5, 3), (1, 0)])
@pytest.mark.parametrize("count", [64, 240])
def test_a_grid_has_about_as_many_places_as_asked_for(side: tuple[float, ...], count: int) -> None:
    low = np.arange(1.0, 1 + len(side))
    places = _grid(low, low + side, count)
    assert count / 4 <= len(places) <= 4 * count
    reach = np.maximum(side, 0.05 * max(side)) / 2 + 1e-9
    assert np.all(np.abs(places - low - np.array(side) / 2) <= reach)
    assert len(np.unique(places, axis=0)) == len(places)


@pytest.mark.slow
def test_the_choice_is_the_same_twice(tmp_path: Path) -> None:
    columns, _ = room_columns()
    splat = read_splat(write_room(tmp_path / "room.ply", columns))
    first, second = (looked(splat, floaters(splat), np.array([0.0, 0, 1]))[1] for _ in range(2))
    assert np.array_equal(first.poses, second.poses)
    assert first.facts == second.facts


def test_floaters_and_haze_are_told_and_nothing_else(tmp_path: Path) -> None:
    columns, thing = room_columns(floaters=12)
    splat = read_splat(write_room(tmp_path / "room.ply", columns))
    hidden = floaters(splat)
    assert hidden[thing == -1].mean() > 0.9  # of random places one may touch the table
    assert not hidden[thing >= 0].any()


def test_planes_are_found_in_little_memory() -> None:
    """Three planes of known sizes and directions, in a scene most of whose voxels no place sees."""
    axes, rng = TURNS["tilted"], np.random.default_rng(0)
    normals, areas = np.zeros((200_000, 3)), np.zeros(200_000)
    normals[:6000] = np.repeat(axes, [3000, 2000, 1000], axis=0) + rng.normal(0, 0.02, (6000, 3))
    normals[:6000] /= np.linalg.norm(normals[:6000], axis=1, keepdims=True)
    areas[:6000] = 1.0
    tracemalloc.start()
    found = planes(normals, areas)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert np.all(np.abs(np.diag(np.array(found) @ axes.T)) > np.cos(np.radians(1)))
    assert peak < 10 * normals.nbytes


def test_up_is_read(tmp_path: Path) -> None:
    assert np.array_equal(direction("-y"), [0, -1, 0])
    assert np.allclose(direction("0, -3,4"), [0, -0.6, 0.8])
    for text in ("w", "1,2", "0,0,0", "nan,0,1", ""):
        with pytest.raises(InputError, match=r"--up: found"):
            direction(text)


@pytest.mark.parametrize("text", ["z", "-y", "0,-0.9,0.1", "-0.1,-.9,0"])
def test_up_is_a_word_of_its_own_on_the_command_line(text: str) -> None:
    args = vars(build_parser().parse_args(["map", "scene.ply", "-o", "scene.gsmap", "--up", text, "--resume"]))
    assert args["splat.up"] == text and args["resume"]


@pytest.mark.slow
def test_one_blob_is_told(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    columns, _ = room_columns()
    count = len(columns["x"])
    fog = {name: rng.normal(size=count).astype(np.float32) for name in "xyz"} | {"opacity": np.full(count, -6.0, "f4")}
    splat = read_splat(write_room(tmp_path / "fog.ply", {**columns, **fog}))
    with pytest.raises(InputError, match="one blob"):
        looked(splat, splat.parked)
