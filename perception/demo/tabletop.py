"""The demo's scene put together: a table against a papered wall in the corner of a room, ten things, two
posters."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from perception.demo import textures as tex
from perception.demo import things
from perception.demo.light import Body, Part, bake, casters
from perception.demo.shapes import Sheet, rotation_from_axes, spin

WORKERS = min(os.cpu_count() or 1, 8)  # a photo being cast holds about 150 MB
TABLE = (1.10, 0.78)  # metres along x and y; its top is z = 0 and centred on the origin
FLOOR = -0.72
WALL = 0.58  # y of the wall behind the table
SIDE = 1.55  # |x| of the side walls

# What is asked of the map, and the names of the bodies that answer. The last is not in the scene.
QUERIES = [
    ("red mug", ["red mug"]),
    ("basketball", ["basketball"]),
    ("banana", ["banana"]),
    ("laptop", []),
]


def build(seed: int, light_samples: int = 20) -> list[Body]:
    """All bodies, painted and lit. Ids count from 1 in the order of the list; the same seed gives the same
    scene.

    light_samples: rays per texel of the light maps, to the lamp and to the sky; fewer are faster and noisier.
    """
    rng = np.random.default_rng(seed)
    bodies = _objects(rng) + _room(rng)
    jobs = [(body, part) for body in bodies for part in body.parts]
    seeds = rng.integers(0, 2**31, len(jobs))
    around = casters(bodies)
    with ThreadPoolExecutor(WORKERS) as pool:  # numpy lets go of the interpreter lock in its loops
        list(
            pool.map(
                lambda k: bake(around, jobs[k][1], np.random.default_rng(seeds[k]), light_samples),
                range(len(jobs)),
            )
        )
    return bodies


def _objects(rng: np.random.Generator) -> list[Body]:
    red = things.mug_paint(rng, "#c3161c", "#f6efe0", hearts=True)
    blue = things.mug_paint(rng, "#1c4fb5", "#f4efdc", hearts=False)
    basket, soccer = tex.basketball(rng, 480, 960), tex.soccer_ball(rng, 440, 880)
    return [
        things.mug(rng, 1, "red mug", (-0.135, -0.155), -35, red),
        things.mug(rng, 2, "blue mug", (0.055, 0.085), 20, blue),
        things.vase(rng, 3, "vase", (-0.29, 0.155)),
        things.ball(4, "basketball", (0.30, 0.13), 0.088, basket, [0.5, -0.45, 0.75]),
        things.ball(5, "soccer ball", (-0.085, 0.20), 0.066, soccer, [0.2, -0.3, 1]),
        things.banana(rng, 6, "banana", (-0.365, -0.195), 0),
        things.orange(rng, 7, "orange", (0.035, -0.185)),
        things.book(rng, 8, "book", (0.25, -0.135), -24),
        things.cactus(rng, 9, "cactus", (0.44, -0.03)),
        things.clock(rng, 10, "wall clock", np.array([0.27, WALL, 0.46])),
    ]


def _room(rng: np.random.Generator) -> list[Body]:
    width, depth = TABLE
    top = tex.wood(rng, 900, 1270, 6, "#c9925a", "#7d4a24")
    edge = tex.wood(rng, 48, 1270, 1, "#b37d49", "#6f4120")
    plank = things.box_parts(np.array([0, 0, -0.02]), (width, depth, 0.04), np.eye(3), [top, edge, edge], (6, 48))
    plank[0].light_texels = (120, 168)
    for part in plank[1:]:
        part.casts = False
    leg = tex.wood(rng, 80, 700, 1, "#a97443", "#66391a").transpose(1, 0, 2)
    for x in (-1, 1):
        for y in (-1, 1):
            center = np.array([x * (width / 2 - 0.06), y * (depth / 2 - 0.06), (FLOOR - 0.04) / 2])
            plank += things.box_parts(center, (0.055, 0.055, -FLOOR - 0.04), np.eye(3), [leg], (12, 4), casts=False)
    paper = tex.wallpaper(rng, 900, 1550, "#b9cdc4", ["#9db8ac", "#86a699", "#d3dfd8", "#c7a86b", "#7b978f"])
    other = tex.wallpaper(rng, 900, 1100, "#cfc3ae", ["#b7a88d", "#a3957a", "#e0d7c6", "#8a9a86", "#b98a5e"])
    tall, middle = 2.0, FLOOR + 1.0
    walls = [
        _wall([1, 0, 0], [0, -1, 0], [0, WALL, middle], 2 * SIDE, tall, paper, (48, 72)),
        _wall([0, 1, 0], [1, 0, 0], [-SIDE, WALL - 1.2, middle], 2.4, tall, other, (40, 48)),
        _wall([0, -1, 0], [-1, 0, 0], [SIDE, WALL - 1.2, middle], 2.4, tall, other[:, ::-1].copy(), (40, 48)),
    ]
    boards = tex.wood(rng, 1100, 1400, 11, "#9c7a56", "#5b4027")
    floor = Part(Sheet(2 * SIDE, 2.4, spin(0), np.array([0, WALL - 1.2, FLOOR])), boards, 0.0, (40, 48), casts=False)
    return [
        Body(11, "table", ["table", "wooden table"], plank, is_stuff=True),
        Body(12, "wall", ["wall", "wallpaper"], walls, is_stuff=True),
        Body(13, "floor", ["floor", "wooden floor"], [floor], is_stuff=True),
        *_posters(rng),
    ]


def _wall(along, normal, center, width, height, paint, texels) -> Part:  # type: ignore[no-untyped-def]
    return Part(Sheet(width, height, rotation_from_axes(along, normal), np.array(center)), paint, 0.0, texels, False)


def _posters(rng: np.random.Generator) -> list[Body]:
    """Framed prints on the walls: flat, 1 cm in front of the paper."""
    alps = tex.landscape(
        rng, 640, 470, ["#f4b183", "#f7e1b5"], ["#8a5a83", "#5d3f72", "#3c2f5c", "#241f42"], "MOUNTAINS"
    )
    art = tex.mosaic(rng, 620, 620, ["#d1495b", "#edae49", "#00798c", "#30638e", "#003d5b", "#7fb069"])
    lake = tex.landscape(
        rng, 560, 760, ["#a9d6e5", "#eef4f7"], ["#61a5c2", "#2a6f97", "#014f86", "#013a63"], "NORTHERN LAKES"
    )
    more = tex.mosaic(rng, 640, 760, ["#264653", "#2a9d8f", "#e9c46a", "#f4a261", "#e76f51", "#6d597a"])
    back = rotation_from_axes([1, 0, 0], [0, -1, 0])
    left, right = rotation_from_axes([0, 1, 0], [1, 0, 0]), rotation_from_axes([0, -1, 0], [-1, 0, 0])
    hung = [
        ("mountain poster", Sheet(0.42, 0.57, back, np.array([-0.62, WALL - 0.01, 0.36])), alps),
        ("abstract poster", Sheet(0.46, 0.46, back, np.array([-0.10, WALL - 0.01, 0.44])), art),
        ("lake poster", Sheet(0.80, 0.59, left, np.array([-SIDE + 0.01, -0.05, 0.1])), lake),
        ("colourful poster", Sheet(0.80, 0.67, right, np.array([SIDE - 0.01, -0.05, 0.1])), more),
    ]
    return [
        Body(14 + i, name, [name, "poster"], [Part(sheet, paint, 0.0, (24, 24), False)], is_stuff=True)
        for i, (name, sheet, paint) in enumerate(hung)
    ]
