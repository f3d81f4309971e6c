"""Many things close together: racks and trays full of them, rows of look-alikes that touch, small things in heaps; and
rooms from a robot's height, with such racks in them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from support.aimed import look_at
from training import clutter, patchwork
from training.clutter import FOCAL_35MM, POINTS, VIEWS, Group
from worlds import furniture as fur
from worlds import room, things, trifles
from worlds.cameras import UP, Camera
from worlds.light import Body, Scene, bake_all, corners
from worlds.shapes import to_world

__all__ = ["FOCAL_35MM", "POINTS", "VIEWS", "build"]

SMALL = (trifles.coin, trifles.die, trifles.ring, trifles.bead)
TRIFLES = (trifles.fork, trifles.key, trifles.battery, trifles.eraser)


def build(seed: int, light_samples: int = 20) -> Scene:
    """The painted and lit scene; of four seeds one is a room. light_samples: rays per texel of the light maps."""
    rng = np.random.default_rng((seed, 32))
    if seed % 4 < 3:
        return clutter.scene_of(rng, light_samples, _group, (14, 34), patchwork.cover, 100)
    made = room.build(seed, 2)
    groups = [_rack(rng)[0] for _ in range(4)]
    places = [(rng.uniform(0, 360), np.array([*rng.uniform(-1.7, 1.7, 2), 0.01]), rng.uniform(2, 4)) for _ in groups]
    bodies = [body.placed(*place) for group, place in zip(groups, places, strict=True) for body in group]
    bake_all(bodies, made.lighting, rng, max(2, light_samples // 2))

    def low(views: int, width: int, height: int) -> list[Camera]:
        """The walk through the room, at a height of 25 to 60 cm and about level."""
        cameras = []
        for camera in made.cameras(views, width, height):
            heading = camera.camera_from_world[2, :3] * [1, 1, 0]
            eye = np.array([*camera.center[:2], rng.uniform(0.25, 0.6)])
            target = eye + heading / np.linalg.norm(heading) + [0, 0, rng.uniform(-0.15, 0.25)]
            cameras.append(Camera(camera.K, look_at(eye, target, UP), width, height))
        return cameras

    return replace(made, bodies=made.bodies + bodies, cameras=low)


def _group(rng: np.random.Generator) -> Group:
    """A rack or a tray full of things, look-alikes that touch, small things near one another, or one thing."""
    kind = rng.integers(10)
    if kind < 2:
        bodies, radius = _rack(rng)
    elif kind < 4:
        bodies, radius = _tray(rng)
    elif kind < 7:
        bodies = _twins(rng)
        radius = float(np.abs(np.concatenate([_bounds(body)[:, :2] for body in bodies])).max())
    elif kind < 9:
        bodies, radius = _heap(rng, int(rng.integers(2, 4)), 0.0), 0.07
    else:
        return patchwork._group(rng)
    return [(body, radius) for body in bodies]


def _bounds(body: Body) -> np.ndarray:
    """[2, 3] lowest and highest coordinates."""
    points = np.concatenate([to_world(part.shape, corners(part.shape)) for part in body.parts])
    return np.stack([points.min(axis=0), points.max(axis=0)])


def _upright(rng: np.random.Generator) -> Body:
    """Something that stands on a shelf, about the origin: a tin, a carton, a bottle, a box, a vessel, a package."""
    kind, color = rng.integers(7), str(rng.choice(list(things.COLORS.values())))
    if kind == 0:
        made = things.tin(rng, "tin", str(rng.choice(patchwork.WORDS)))
    elif kind == 1:
        made = things.carton(rng)
    elif kind == 2:
        made = things.bottle(rng, "bottle", color)
    elif kind < 5:
        made = clutter._thing(rng, clutter.paint_of(rng), int(rng.choice([0, 3, 4])), upright=True)[0]
    else:
        size = rng.uniform([0.03, 0.02, 0.05], [0.1, 0.07, 0.16])
        faces = [patchwork.cover(rng) for _ in range(3)]
        made = Body("package", [], [fur.block(rng, size.tolist(), (0, 0, size[2] / 2), faces[0], 0.2, *faces[1:])])
    return replace(made, on=None).placed(0, np.zeros(3), rng.uniform(0.5, 1.0))


def _row(rng: np.random.Generator, length: float, depth: float, height: float) -> list[Body]:
    """Upright things side by side along x, some alike, some touching, at most so long, deep and high."""
    bodies, reach, made = [], 0.0, _upright(rng)
    loose = rng.choice([0.0, 0.003, 0.015])
    while True:
        made = made if rng.random() < 0.45 else _upright(rng)
        low, high = _bounds(made)
        size = min(1.0, 0.92 * depth / (high - low)[1], 0.92 * height / high[2])
        wide = size * (high - low)[0]
        if reach + wide > length:
            return [body.placed(0, np.array([-reach / 2, 0, 0])) for body in bodies]
        bodies.append(made.placed(0, np.array([reach - size * low[0], -size * (low + high)[1] / 2, 0]), size))
        reach += wide + rng.uniform(0, 1) * loose


def _rack(rng: np.random.Generator) -> tuple[list[Body], float]:
    """Shelves, or a cupboard with a back, and a row of things on each board."""
    width, depth = rng.uniform(0.2, 0.4), rng.uniform(0.06, 0.1)
    count, pitch, board = int(rng.integers(2, 4)), rng.uniform(0.06, 0.12), rng.uniform(0.003, 0.008)
    tile = fur.wood(rng, str(rng.choice(list(fur.WOODS)))) if rng.random() < 0.5 else clutter.paint_of(rng)
    tall = count * pitch
    rows = [(board, depth, tall, side * width / 2, 0, tall / 2) for side in (-1, 1)]
    rows += [(width, depth, board, 0, 0, board / 2 + k * pitch) for k in range(count + int(rng.integers(2)))]
    rows += [(width, 0.004, tall, 0, depth / 2, tall / 2)] if rng.random() < 0.3 else []
    bodies = [Body("shelf", [], fur.blocks(rng, tile, *rows))]
    for k in range(count):
        full = _row(rng, rng.uniform(0.3, 0.95) * (width - board), depth, pitch - board)
        bodies += [body.placed(0, np.array([0, 0, board + k * pitch])) for body in full]
    return bodies, float(np.hypot(width, depth) / 2)


def _twins(rng: np.random.Generator) -> list[Body]:
    """Look-alikes in rows, and boxes of one kind on one another."""
    made = _upright(rng)
    low, high = _bounds(made)
    flat = made.name in ("package", "box", "carton")
    counts = rng.integers([2, 1, 1], [5, 3, 3 if flat else 2])
    grid = np.stack(np.meshgrid(*map(np.arange, counts), indexing="ij"), axis=-1).reshape(-1, 3)
    places = (grid - (counts - 1) / 2 * [1, 1, 0]) * (high - low + [rng.choice([0.0, 0.002]), 0.001, 0])
    middle = (low + high) / 2 * [1, 1, 0]
    return [made.placed(0, place - middle + rng.normal(0, 0.001, 3) * [0, 1, 0]) for place in places]


def _heap(rng: np.random.Generator, side: int, up: float) -> list[Body]:
    """Small things on a jittered grid of side² places, `up` metres above the ground."""
    bodies = []
    for k in range(side * side):
        if rng.random() < 0.8:
            kind = rng.integers(4)
            small = SMALL[kind](rng, int(rng.integers(3))) if rng.random() < 0.6 else TRIFLES[kind](rng)
            spot = 0.045 * (np.array([k % side, k // side]) - (side - 1) / 2) + rng.uniform(-0.008, 0.008, 2)
            bodies.append(small.placed(rng.uniform(0, 360), np.array([*spot, up]), rng.uniform(0.8, 1.6)))
    return bodies


def _tray(rng: np.random.Generator) -> tuple[list[Body], float]:
    """A tray, or an open box, with small things or rows of others in it."""
    width, depth = rng.uniform([0.14, 0.1], [0.3, 0.2])
    rim, thick = rng.uniform(0.008, 0.06), rng.uniform(0.003, 0.006)
    rows = [(width, depth, thick, 0, 0, thick / 2)]
    rows += [(thick, depth, rim, side * width / 2, 0, rim / 2) for side in (-1, 1)]
    rows += [(width, thick, rim, 0, side * depth / 2, rim / 2) for side in (-1, 1)]
    held = _heap(rng, 3, thick) if rng.random() < 0.5 else []
    for y in (-0.25, 0.25) if not held else ():
        full = _row(rng, 0.9 * width, 0.45 * depth, rng.uniform(0.03, 0.1))
        held += [body.placed(0, np.array([0, y * depth, thick])) for body in full]
    return [Body("tray", [], fur.blocks(rng, clutter.paint_of(rng), *rows)), *held], float(np.hypot(width, depth) / 2)
