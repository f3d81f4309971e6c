"""Scores `where_to_stand` for random objects of generated rooms.

python tools score.standing [ROOMS] [OBJECTS]

Each room is a map of true surface points, a Gaussian each, with true instances. The answers are checked against the
shapes that the points were drawn from, without the map: the distance of the robot's centre from the convex outline of
each body between 0.1 and 1.8 m above the floor, and rays from the sensor that the renderer follows to the first body.
Prints a line for each object that fails, then one JSON object.
"""

from __future__ import annotations

import json
import resource
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.spatial import cKDTree

from perception.boxes import oriented_box
from perception.errors import InputError
from perception.query.floor_grid import HEIGHT, STEP
from perception.query.query_map import QueryMap
from perception.query.robot_pose import where_to_stand
from perception.types import View
from worlds import room
from worlds.light import Body, casters, first_hits
from worlds.scene import _surface
from worlds.shapes import to_world

RADIUS, SENSOR, RAYS, MARGIN = 0.25, 1.2, 200, 0.02  # metres, metres, rays to an object, metres before its surface


def quats_along(normals: np.ndarray) -> np.ndarray:
    """Quaternions wxyz [N, 4] that turn z to unit normals [N, 3]."""
    q = np.c_[1 + normals[:, 2], -normals[:, 1], normals[:, 0], np.zeros(len(normals))]
    q[np.linalg.norm(q, axis=1) < 1e-6] = [0, 1, 0, 0]
    return (q / np.linalg.norm(q, axis=1, keepdims=True)).astype(np.float32)


def map_of(seed: int) -> tuple[QueryMap, list[Body], np.ndarray]:
    """The map of a room, its bodies (instance ids are positions + 1) and the room's half extents [2]."""
    room.bake_all = lambda *_: None  # type: ignore[assignment]  # light does not matter here
    made = room.build(seed)
    points, normals, _, ids = _surface(made, room.POINTS, np.random.default_rng((seed, 1)))
    spacing = cKDTree(points).query(points, k=4)[0][:, 1:].mean(axis=1)
    scales = np.c_[spacing, spacing, np.full(len(points), 1e-3)].astype(np.float32)
    instances = []
    for number in np.unique(ids).tolist():
        own = points[ids == number]
        box = oriented_box(own, trim=0.01).to_json()
        instances.append(
            {"id": number, "label": made.bodies[number - 1].name, "score": 1.0, "num_gaussians": len(own), "obb": box}
            | {"centroid": own.mean(axis=0).tolist()}
        )
    count = len(points)
    gmap = QueryMap(
        means=points,
        quats=quats_along(normals),
        log_scales=np.log(np.maximum(scales, 1e-4)),
        opacity_logits=np.full(count, 3, np.float32),
        sh=np.zeros((count, 1, 3), np.float32),
        features=np.zeros((count, 1), np.float32),
        instance_ids=ids,
        membership=np.ones(count, np.float32),
        instances=instances,
        info={"metric": True, "frame": "room", "gravity": {"direction": [0, 0, -1]}},
        views=[
            View(f"{n}.jpg", Path(f"{n}.jpg"), camera.K, camera.width, camera.height, camera.camera_from_world)
            for n, camera in enumerate(made.cameras(8, 64, 48))
        ],
        path=Path(f"room{seed}.gsmap"),
    )
    floor = next(body for body in made.bodies if body.name == "floor").parts[0].shape
    return gmap, made.bodies, np.array([floor.width, floor.height]) / 2


def sampled(body: Body, count: int, rng: np.random.Generator) -> np.ndarray:
    """Points [P, 3] on the surface of a body, `count` of each part."""
    return np.concatenate(
        [to_world(part.shape, part.shape.point_normal(*rng.random((2, count)))[0]) for part in body.parts]
    )


def outlines(bodies: list[Body], rng: np.random.Generator) -> dict[str, np.ndarray]:
    """The convex outline [P, 2] of each body that is in the way of a robot."""
    found = {}
    for body in bodies:
        points = sampled(body, 2000, rng)
        points = points[(points[:, 2] > STEP) & (points[:, 2] < HEIGHT)]
        if len(points) > 2 and not body.is_stuff:
            found[body.name] = cv2.convexHull(points[:, :2].astype(np.float32))
    return found


def line_of_sight(bodies: list[Body], own: Body, eye: np.ndarray, rng: np.random.Generator) -> tuple[float, float]:
    """Shares of rays to points on `own` that no other body blocks, and that meet `own` before any other body."""
    points = sampled(own, RAYS, rng)
    points = points[rng.permutation(len(points))[:RAYS]]
    rays = points - eye
    lengths = np.linalg.norm(rays, axis=1)
    origins, rays = np.tile(eye, (len(points), 1)), rays / lengths[:, None]
    others = first_hits(casters([body for body in bodies if body is not own]), origins, rays)[0]
    itself = first_hits(casters([own]), origins, rays)[0]
    itself = np.where(np.isfinite(itself), itself, lengths)  # a body that casts no shadow: the point itself
    return float((others > lengths - MARGIN).mean()), float((others > itself - MARGIN).mean())


def main(rooms: int = 20, objects: int = 200) -> dict[str, Any]:
    rng = np.random.default_rng(25)
    rows, refused, failed, spent = [], [], 0, 0.0
    for seed in range(rooms):
        gmap, bodies, half = map_of(seed)
        blocked = outlines(bodies, rng)
        things = [n for n, body in enumerate(bodies) if not body.is_stuff]
        for n in rng.choice(things, -(-objects // rooms), replace=False).tolist():
            before = resource.getrusage(resource.RUSAGE_SELF).ru_utime
            try:
                stand = where_to_stand(gmap, n + 1, radius=RADIUS, sensor_height=SENSOR)
            except InputError as error:
                refused.append(f"room {seed}: {bodies[n].name}: {error}")
                print(refused[-1], flush=True)
                continue
            finally:
                spent += resource.getrusage(resource.RUSAGE_SELF).ru_utime - before
            at = stand.position
            spot = tuple(map(float, at[:2]))
            gaps = {name: -cv2.pointPolygonTest(hull, spot, True) for name, hull in blocked.items()}
            gap = min([*gaps.values(), *(half - np.abs(at[:2])).tolist()])
            open_, first = line_of_sight(bodies, bodies[n], at + np.array([0, 0, SENSOR]), rng)
            to = sampled(bodies[n], 500, rng).mean(axis=0)[:2] - at[:2]
            off = abs((np.degrees(np.arctan2(to[1], to[0]) - stand.yaw) + 180) % 360 - 180)
            row = {"gap": gap, "inside": gap < 0, "touches": gap < RADIUS, "open": open_, "first": first}
            rows.append(row | {"distance": stand.distance, "floor": abs(at[2]), "off": off})
            if gap < RADIUS or open_ < 0.5:
                failed += 1
                nearest = min(gaps, key=lambda name: gaps[name])
                print(f"room {seed}: {bodies[n].name}: {gap:.3f} m to {nearest}, open {open_:.2f}, first {first:.2f}, "
                      f"said {stand.seen:.2f}, distance {stand.distance:.2f}", flush=True)  # fmt: skip

    def column(name: str) -> np.ndarray:
        return np.array([row[name] for row in rows], float)

    told = {
        "objects": len(rows) + len(refused),
        "refused": len(refused),
        "centre inside something": int(column("inside").sum()),
        "disc touches something": int(column("touches").sum()),
        "least distance to anything [m]": round(float(column("gap").min()), 3),
        "line of sight, half of the rays": round(float((column("open") >= 0.5).mean()), 4),
        "line of sight, any ray meets it first": round(float((column("first") > 0).mean()), 4),
        "distance, median and largest [m]": [round(float(f(column("distance"))), 2) for f in (np.median, np.max)],
        "height off the floor, largest [m]": round(float(column("floor").max()), 4),
        "facing error, median and largest [degrees]": [round(float(f(column("off"))), 1) for f in (np.median, np.max)],
        "CPU seconds an answer": round(spent / max(len(rows), 1), 3),
    }
    print(json.dumps(told))
    return told


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
