"""Writes visits of a made scene, one after the other, with exact truth of what changed.

python tools worlds.visits tabletop|room FOLDER [--seed N] [--visits N]

FOLDER/visit0 is the scene of `worlds.make`; FOLDER/visit1, … hold the same scene later: things moved, turned, taken
away, added and swapped, in other light, from other cameras. Ids agree between visits. changes.json in each has what
changed since the visit before, in the form of `tools score.changes`: per instance state, transform (new_from_old),
centroids, and which share of its surface, or of where it stood, the visit sees.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from worlds import things
from worlds.cameras import Camera
from worlds.light import Body, Lamp, Lighting, Scene, bake_all
from worlds.render import Picture
from worlds.scene import SCENES, photograph
from worlds.shapes import spin, to_world
from worlds.truth import DemoTruth

AWAY = np.array([0.0, 0.0, -500.0])
"""Where bodies lie that were taken away: no camera sees them, and ids stay those of the first visit."""
TRIES, GAP = 4000, 0.02
SHARE = {"moved": 0.2, "turned": 0.1, "removed": 0.12, "added": 0.12, "swapped": 0.0}
"""Of the things of a scene, in a visit."""
NEW = (
    lambda rng: things.mug(rng, "purple"), lambda rng: things.tin(rng, "soup tin"), lambda rng: things.teddy(rng),
    lambda rng: things.cactus(rng), lambda rng: things.carton(rng), lambda rng: things.ball(rng, "basketball", 0.08),
    lambda rng: things.fruit(rng, "orange"),
)  # fmt: skip
"""Things that visits bring."""
PATH = 0.35
"""Cameras of a visit stand between those of the first one, at this share of the way to the next."""


@dataclass
class Visit:
    """A scene at a visit: bodies (id = index + 1), and by id the state and the motion new_from_old [4, 4] since the
    visit before."""

    scene: Scene
    states: dict[int, str]
    motions: dict[int, np.ndarray]


def later(before: Scene, rng: np.random.Generator, share: dict[str, float], samples: int, dim: float = 1.0) -> Visit:
    """The scene at the next visit. share: of its things, by kind of change; dim: factor of the light, 1 = another."""
    bodies = list(before.bodies)
    movable = [n for n, body in enumerate(bodies) if _movable(body, bodies)]
    order = rng.permutation(movable).tolist()
    counts = {kind: round(part * len(movable)) for kind, part in share.items()}
    states = {n + 1: "unchanged" for n, body in enumerate(bodies) if _centre(body)[2] > AWAY[2] / 2}
    motions: dict[int, np.ndarray] = {}
    beside = {n: [_centre(bodies[m]) for m in movable if bodies[m].on == bodies[n].on] for n in movable}
    widest = max(movable, key=lambda n: len(beside[n]), default=None)
    floor = 0.0 if widest is None else _low(bodies[widest])

    def put(n: int, motion: np.ndarray, state: str) -> None:
        turn = float(np.degrees(np.arctan2(motion[1, 0], motion[0, 0])))
        bodies[n] = bodies[n].placed(turn, motion[:3, 3])
        states[n + 1], motions[n + 1] = state, motion

    for _ in range(counts.get("removed", 0)):
        if order:
            put(order.pop(), _shifted(AWAY), "removed")
    for _ in range(counts.get("turned", 0)):
        if order:
            n = order.pop()
            put(n, _about(_centre(bodies[n]), float(rng.uniform(40, 320)), np.zeros(3)), "moved")
    for _ in range(counts.get("swapped", 0)):
        if len(order) > 1:
            a, b = order.pop(), order.pop()
            step = np.append((_centre(bodies[b]) - _centre(bodies[a]))[:2], 0.0)
            put(a, _shifted(step), "moved")
            put(b, _shifted(-step), "moved")
    for _ in range(counts.get("moved", 0)):
        if order and (spot := _free(bodies, order[-1], beside[order[-1]], rng)) is not None:
            n = order.pop()
            put(n, _about(_centre(bodies[n]), float(rng.uniform(-180, 180)), spot - _centre(bodies[n])), "moved")
    for _ in range(counts.get("added", 0) if widest is not None else 0):
        body = NEW[int(rng.integers(len(NEW)))](rng)
        bodies.append(replace(body, name=f"{body.name} {len(bodies)}", kind=body.category))
        spot = _free(bodies, len(bodies) - 1, beside[widest], rng)
        if spot is None:
            bodies.pop()
        else:
            bodies[-1] = bodies[-1].placed(0, np.array([*(spot - _centre(bodies[-1]))[:2], floor - _low(bodies[-1])]))
            states[len(bodies)] = "added"
    lighting = _other_light(before.lighting, rng, dim)
    bodies = [replace(body, parts=[replace(part) for part in body.parts]) for body in bodies]
    bake_all(bodies, lighting, rng, samples)
    return Visit(replace(before, bodies=bodies, lighting=lighting), states, motions)


def _other_light(lighting: Lighting, rng: np.random.Generator, dim: float) -> Lighting:
    lamps = [Lamp(lamp.center, lamp.radius, lamp.color * dim * rng.uniform(0.8, 1.2, 3)) for lamp in lighting.lamps]
    return replace(lighting, lamps=lamps, ambient=lighting.ambient * dim * rng.uniform(0.9, 1.1, 3))


def _points(body: Body, count: int = 400) -> np.ndarray:
    u, v = np.random.default_rng(0).random((2, count))
    return np.concatenate([to_world(part.shape, part.shape.point_normal(u, v)[0]) for part in body.parts])


def _centre(body: Body) -> np.ndarray:
    points = _points(body)
    return np.asarray((points.min(axis=0) + points.max(axis=0)) / 2)


def _low(body: Body) -> float:
    return float(_points(body)[:, 2].min())


def _radius(body: Body) -> float:
    return float(np.linalg.norm((_points(body) - _centre(body))[:, :2], axis=1).max())


def _movable(body: Body, bodies: list[Body]) -> bool:
    """Whether a thing stands free, with nothing on it."""
    free = not body.is_stuff and body.hangs_on is None and _centre(body)[2] > AWAY[2] / 2
    support = next((other for other in bodies if other.name == body.on), None)
    return free and not any(other.on == body.name for other in bodies) and (support is None or support.is_stuff)


def _free(bodies: list[Body], n: int, beside: list[np.ndarray], rng: np.random.Generator) -> np.ndarray | None:
    """A centre [3] for body n among those `beside` it, where it touches no other thing; None where there is none."""
    low, high = np.min(beside, axis=0)[:2] - 0.05, np.max(beside, axis=0)[:2] + 0.05
    others = [(_centre(b)[:2], _radius(b)) for k, b in enumerate(bodies) if k != n and not b.is_stuff]
    centre, radius = _centre(bodies[n]), _radius(bodies[n])
    for spot in rng.uniform(low, high, (TRIES, 2)):
        if all(np.linalg.norm(spot - other) > radius + reach + GAP for other, reach in others):
            return np.array([*spot, centre[2]])
    return None


def _shifted(step: np.ndarray) -> np.ndarray:
    motion = np.eye(4)
    motion[:3, 3] = step
    return motion


def _about(centre: np.ndarray, degrees: float, step: np.ndarray) -> np.ndarray:
    """A turn about the vertical through `centre`, then a step."""
    motion = np.eye(4)
    motion[:3, :3] = spin(degrees)
    motion[:3, 3] = centre + step - motion[:3, :3] @ centre
    return motion


# ----------------------------------------------------------------------- truth


def changes(before: DemoTruth, after: DemoTruth, visit: Visit, pictures: list[Picture]) -> dict[str, Any]:
    """changes.json: what a visit changed, and what its cameras see."""
    names = {instance.id: instance for instance in (*before.instances, *after.instances)}
    listed = []
    for number, state in visit.states.items():
        old = before.points[before.instance_ids == number].astype(np.float64)
        new = after.points[after.instance_ids == number].astype(np.float64)
        motion = visit.motions.get(number) if state == "moved" else None
        there = new if state == "added" else old if motion is None else old @ motion[:3, :3].T + motion[:3, 3]
        entry = {
            "id": number, "name": names[number].name, "category": names[number].category,
            "is_stuff": names[number].is_stuff, "state": state,
            "transform": None if motion is None else motion.tolist(),
            "centroid_visit1": old.mean(axis=0).tolist() if len(old) and state != "added" else None,
            "seen_in_visit2": _seen(there, None if state == "removed" else number, after.cameras, pictures),
        }  # fmt: skip
        if motion is not None:
            entry["old_place_seen_in_visit2"] = _seen(old, None, after.cameras, pictures)
        listed.append(entry)
    return {"instances": listed}


def _seen(points: np.ndarray, number: int | None, cameras: list[Camera], pictures: list[Picture]) -> float:
    """Share of points [P, 3] that some photo sees: on the surface of thing `number`, or None: nothing in front."""
    seen = np.zeros(len(points), bool)
    for camera, picture in zip(cameras, pictures, strict=True):
        pixels, depth = camera.project(points)
        inside = (depth > 0) & (pixels >= 0).all(1) & (pixels < [camera.width, camera.height]).all(1)
        k = np.flatnonzero(inside)
        x, y = pixels[k].astype(int).T
        slack = 0.006 + 0.01 * depth[k]
        free = picture.depth[y, x] > depth[k] - slack
        seen[k] |= free & ((number is None) | (picture.ids[y, x] == (number or 0)))
    return float(seen.mean()) if len(points) else 0.0


def make_visits(
    folder: Path,
    scene: str = "tabletop",
    *,
    visits: int = 2,
    seed: int = 0,
    views: int | None = None,
    width: int = 640,
    height: int = 480,
    light_samples: int = 20,
    share: dict[str, float] | None = None,
    later_views: int | None = None,
) -> list[DemoTruth]:
    """Writes `visits` visits into folder/visit0, …; the truth of each. share: as SHARE. later_views: photos of all
    visits but the first."""
    maker, rng = SCENES[scene], np.random.default_rng((seed, 7))
    made: Scene = maker.build(seed, light_samples)
    count = views or maker.VIEWS
    cameras = made.cameras(count, width, height)
    home = folder / "visit0"
    truth, _ = photograph(made, maker, cameras, home / "images", home, seed)
    found = [truth]
    for number in range(1, visits):
        visit = later(made, rng, SHARE if share is None else share, light_samples)
        made, home = visit.scene, folder / f"visit{number}"
        path = between(made.cameras(later_views or max(3, count // 2), width, height), number)
        truth, pictures = photograph(made, maker, path, home / "images", home, seed + 1000 * number)
        facts = changes(found[-1], truth, visit, pictures)
        (home / "changes.json").write_text(json.dumps(facts, indent=1), encoding="utf-8")
        found.append(truth)
    return found


def between(cameras: list[Camera], number: int) -> list[Camera]:
    """Cameras on another path: each moved towards the next one."""
    moved = []
    for n, camera in enumerate(cameras):
        other = cameras[min(n + 1, len(cameras) - 1)].center if n + 1 < len(cameras) else cameras[n - 1].center
        share = PATH / number if n + 1 < len(cameras) else -PATH / number
        pose = camera.camera_from_world.copy()
        pose[:3, 3] = -pose[:3, :3] @ (camera.center + share * np.clip(other - camera.center, -0.3, 0.3))
        moved.append(replace(camera, camera_from_world=pose))
    return moved


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("scene", choices=("tabletop", "room"))
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seed", type=int, default=0, help="another N makes another scene")
    parser.add_argument("--visits", type=int, default=2)
    given = parser.parse_args()
    made = make_visits(given.folder, given.scene, visits=given.visits, seed=given.seed)
    print(f"{len(made)} visits, {', '.join(str(len(truth.names)) for truth in made)} photos, in {given.folder}")


if __name__ == "__main__":
    main()
