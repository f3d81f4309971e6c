"""Writes a building: furnished rooms in a row, joined by openings in their walls, with exact truth.

python tools worlds.building FOLDER [--rooms 6] [--photos 1200] [--size 480x360] [--seed 0]
python tools worlds.building FOLDER --visit ROOM [--photos 60] [the same rooms, size, seed]

The walk goes round each room and on through the opening. FOLDER then holds what tools/worlds/make.py writes. --visit:
FOLDER-visit then holds photos of one room (from 0) at a later time, with things moved, removed and added in it as
`worlds.visits` does, and changes.json.
"""

from __future__ import annotations

import argparse
import itertools
import json
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from perception.io.cloud import read_cloud, write_cloud
from perception.types import PointCloud
from support.aimed import look_at
from worlds import room, scene, visits
from worlds.cameras import UP, Camera, intrinsics, walk
from worlds.light import Body, Part, Scene, corners
from worlds.shapes import Sheet, to_world
from worlds.truth import DemoTruth, Truth

VIEWS, FOCAL_35MM, POINTS = 1200, 26, 600_000
OPENING, HIGH, CORNER = 0.95, 2.1, 0.12
"""Width and height of an opening in metres, and its distance from the north wall."""
GAP = 0.002  # between the faces of two rooms' walls
PASSING = 0.12  # share of a room's photos that are taken on the way into the next one


def rooms(count: int, seed: int, light_samples: int) -> list[tuple[Scene, np.ndarray, float]]:
    """(scene, half extents [2], x of the centre) of each room, each as if it were alone."""
    made, edge = [], 0.0
    for number in range(count):
        alone = room.build(seed + number, light_samples)
        floor = next(body for body in alone.bodies if body.name == "floor").parts[0].shape
        half = np.array(floor.size()) / 2
        made.append((alone, half, edge + half[0]))
        edge += 2 * half[0] + GAP
    return made


def build(seed: int, light_samples: int = 20, count: int = 6) -> Scene:
    """The building: all rooms side by side along x, with openings in the walls between them."""
    return _joined(rooms(count, seed, light_samples))[0]


def _joined(
    made: list[tuple[Scene, np.ndarray, float]], later: dict[int, Scene] | None = None
) -> tuple[Scene, list[list[int]]]:
    """The building of `rooms`, and of each room the ids of its bodies, 0 = left out. later: rooms as they are at a
    later time, by number: what came is last of all, so that ids stay."""
    passages = []  # (x of the wall, y of the opening's middle)
    for (_, half, x), (_, beyond, _) in itertools.pairwise(made):
        passages.append((x + half[0], min(half[1], beyond[1]) - CORNER - OPENING / 2))
    bodies, came, ids = list[Body](), list[Body](), list[list[int]]()
    for number, (alone, _, x) in enumerate(made):
        doors, own = passages[max(number - 1, 0) : number + 1], list[int]()
        for before, body in itertools.zip_longest(alone.bodies, (later or {}).get(number, alone).bodies):
            there, moved = (
                each and replace(each.placed(0, np.array([x, 0, 0])), on=None, hangs_on=None) for each in (before, body)
            )
            if there is None:
                came.append(moved)
                continue
            if not there.is_stuff and any(_stands_in(there, *door) for door in doors):
                own.append(0)
                continue
            if moved.kind == "wall":
                moved = replace(moved, parts=[piece for part in moved.parts for piece in _opened(part, doors)])
            bodies.append(moved)
            own.append(len(bodies))
        ids.append(own)
    route = partial(_route, made=[(half, x) for _, half, x in made], passages=passages)
    return Scene([*bodies, *came], made[0][0].lighting, route, []), ids


def _opened(part: Part, doors: list[tuple[float, float]]) -> list[Part]:
    """A wall's part, or what is left of it on both sides of an opening and above it."""
    sheet = part.shape
    assert isinstance(sheet, Sheet)
    for x, y in doors:
        if abs(sheet.origin[0] - x) < 0.01 and abs(sheet.rotation[1, 0]) > 0.99:  # it runs along y
            along = np.sign(sheet.rotation[1, 0])
            u = sorted(0.5 + along * (y + side * OPENING / 2 - sheet.origin[1]) / sheet.width for side in (-1, 1))
            v = 1 - HIGH / sheet.height
            return [_piece(part, 0, u[0], 0, 1), _piece(part, u[1], 1, 0, 1), _piece(part, u[0], u[1], 0, v)]
    return [part]


def _piece(part: Part, u0: float, u1: float, v0: float, v1: float) -> Part:
    sheet = part.shape
    assert isinstance(sheet, Sheet)
    middle = np.array([((u0 + u1) / 2 - 0.5) * sheet.width, (0.5 - (v0 + v1) / 2) * sheet.height, 0])
    origin = sheet.origin + sheet.rotation @ middle
    shape = Sheet((u1 - u0) * sheet.width, (v1 - v0) * sheet.height, sheet.rotation, origin)
    rows, columns = part.lit.shape[:2]
    lit = part.lit[round(v0 * rows) : round(v1 * rows), round(u0 * columns) : round(u1 * columns)]
    return replace(part, shape=shape, lit=np.ascontiguousarray(lit))


def _stands_in(body: Body, x: float, y: float) -> bool:
    """Whether a body is in the way through an opening."""
    points = np.concatenate([to_world(part.shape, corners(part.shape)) for part in body.parts])
    low, high = points.min(axis=0), points.max(axis=0)
    reach = np.array([0.75, OPENING / 2 + 0.1])
    return bool((low[:2] < np.array([x, y]) + reach).all() and (high[:2] > np.array([x, y]) - reach).all())


def _route(
    views: int, width: int, height: int, made: list[tuple[np.ndarray, float]], passages: list[tuple[float, float]]
) -> list[Camera]:
    """Cameras round each room, then through the opening into the next, looking ahead."""
    cameras: list[Camera] = []
    K = intrinsics(width, height, FOCAL_35MM)
    for number, (half, x) in enumerate(made):
        total = views * (number + 1) // len(made) - views * number // len(made)
        through = round(PASSING * total) if number < len(passages) else 0
        shift = np.eye(4)
        shift[0, 3] = -x
        for camera in walk(total - through, width, height, FOCAL_35MM, half):
            cameras.append(replace(camera, camera_from_world=camera.camera_from_world @ shift))
        if not through:
            continue
        (wall, y), beyond = passages[number], made[number + 1][1]
        path = np.array([[x + 0.3 * half[0], 0.25 * y], [wall - 0.7, y], [wall + 0.7, y], [beyond - 0.5, 0.4 * y]])
        for share in (np.arange(through) + 0.5) / through:
            place, ahead = _along(path, share), _along(path, min(share + 0.25, 1.2))
            eye = np.array([*place, 1.45 + 0.05 * np.sin(40 * share)])
            cameras.append(Camera(K, look_at(eye, np.array([*ahead, 1.2]), UP), width, height))
    return cameras


def _along(path: np.ndarray, share: float) -> np.ndarray:
    """The point at a share of a polyline's length, beyond its end on the last segment."""
    steps = np.linalg.norm(np.diff(path, axis=0), axis=1)
    at = share * steps.sum()
    n = min(int(np.searchsorted(np.cumsum(steps), at)), len(steps) - 1)
    return np.asarray(path[n] + (path[n + 1] - path[n]) * (at - steps[:n].sum()) / steps[n])


class _Maker:
    """What `make_photos` asks of a scene."""

    VIEWS, FOCAL_35MM = VIEWS, FOCAL_35MM

    def __init__(self, count: int) -> None:
        self.count, self.POINTS = count, POINTS * count // 6

    def build(self, seed: int, light_samples: int) -> Scene:
        return build(seed, light_samples, self.count)


def make_building(
    folder: Path, count: int = 6, photos: int = VIEWS, size: tuple[int, int] = (480, 360), seed: int = 0, rays: int = 12
) -> None:
    """Writes photos and truth of a building of `count` rooms; transforms.json lists the depth images too."""
    scene.SCENES["building"] = _Maker(count)  # type: ignore[assignment]
    options = {"views": photos, "width": size[0], "height": size[1], "light_samples": rays}
    scene.make_photos(folder / "images", scene="building", seed=seed, truth_folder=folder, **options)
    path = folder / "transforms.json"
    facts = json.loads(path.read_text(encoding="utf-8"))
    path.write_text(json.dumps({**facts, "ply_file_path": "points.ply"}), encoding="utf-8")
    _sparse(folder)


def make_visit(
    folder: Path,
    room: int,
    count: int = 6,
    photos: int = 60,
    size: tuple[int, int] = (480, 360),
    seed: int = 0,
    rays: int = 12,
) -> None:
    """Writes a later visit of one room of a building beside it."""
    made, rng = rooms(count, seed, rays), np.random.default_rng((seed, room, 7))
    visit = visits.later(made[room][0], rng, visits.SHARE, rays)
    building, ids = _joined(made, {room: visit.scene})
    own, last = ids[room], max(map(max, ids))
    came = range(last + 1, last + 1 + len(visit.scene.bodies) - len(own))
    number = {of_room: i for of_room, i in enumerate([*own, *came], start=1) if i}
    shift = np.eye(4)
    shift[0, 3] = made[room][2]
    states = dict.fromkeys((i for each in ids for i in each if i), "unchanged")
    states |= {number[i]: state for i, state in visit.states.items() if i in number}
    motions = {number[i]: shift @ each @ np.linalg.inv(shift) for i, each in visit.motions.items() if i in number}
    cameras = visits.between(building.cameras(count * photos, *size)[room * photos : (room + 1) * photos], 1)
    home = folder.with_name(f"{folder.name}-visit")
    maker: Any = _Maker(count)
    after, pictures = scene.photograph(building, maker, cameras, home / "images", home, seed + 1000)
    facts = visits.changes(_truth(folder), after, visits.Visit(building, states, motions), pictures)
    (home / "changes.json").write_text(json.dumps(facts, indent=1), encoding="utf-8")


def _truth(folder: Path) -> DemoTruth:
    """The instances and surface points of a building that was written."""
    facts, cloud = json.loads((folder / "scene.json").read_text(encoding="utf-8")), read_cloud(folder / "gt_points.ply")
    assert cloud.colors is not None and cloud.normals is not None
    made = cloud.points, cloud.normals, cloud.colors, cloud.labels["instance_id"]
    return DemoTruth([Truth(**entry) for entry in facts["instances"]], [], [], [], *made, folder)


def _sparse(folder: Path) -> None:
    """points.ply: every 20th of the true surface points, as structure from motion would find them."""
    cloud = read_cloud(folder / "gt_points.ply")
    assert cloud.colors is not None
    write_cloud(folder / "points.ply", PointCloud(cloud.points[::20], cloud.colors[::20]))


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("folder", type=Path)
    parser.add_argument("--rooms", type=int, default=6)
    parser.add_argument("--photos", type=int)
    parser.add_argument("--visit", type=int, metavar="ROOM")
    parser.add_argument("--size", default="480x360")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    across, down = map(int, given.size.split("x"))
    if given.visit is None:
        make_building(given.folder, given.rooms, given.photos or VIEWS, (across, down), given.seed)
    else:
        make_visit(given.folder, given.visit, given.rooms, given.photos or 60, (across, down), given.seed)
