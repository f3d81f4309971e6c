"""A table with small objects against a papered wall in the corner of a room, with posters on the walls."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from itertools import product

import numpy as np

from worlds import textures as tex
from worlds import things
from worlds.cameras import orbit
from worlds.light import Body, Lamp, Lighting, Part, Scene, bake_all
from worlds.shapes import Sheet, rotation_from_axes, spin

VIEWS = 40
FOCAL_35MM = 32  # 35 mm equivalent of a phone camera
POINTS = 60_000
TABLE = (1.10, 0.78)  # metres along x and y; its top is z = 0 and centred on the origin
FLOOR = -0.72
WALL = 0.58  # y of the wall behind the table
SIDE = 1.55  # |x| of the side walls
LIGHTING = Lighting(
    [Lamp(np.array([-1.0, -0.9, 1.75]), 0.34, np.array([1.0, 0.93, 0.82]) * 6.4)], np.array([0.36, 0.41, 0.48])
)


def build(seed: int, light_samples: int = 20) -> Scene:
    """The painted and lit scene. Seed 0 is the demo scene. Other seeds select, colour and place the objects randomly.

    light_samples: rays per texel of the light maps, for the lamp and for ambient light; fewer are faster and noisier.
    """
    rng = np.random.default_rng(seed)
    bodies = (_demo_things(rng) if seed == 0 else _chosen_things(rng)) + room_around(rng, seed != 0)
    bake_all(bodies, LIGHTING, rng, light_samples)
    asked = ["red mug", "basketball", "banana"] if seed == 0 else [body.name for body in bodies[:3]]
    return Scene(bodies, LIGHTING, partial(orbit, focal_35mm=FOCAL_35MM), [*asked, "laptop"])


def _demo_things(rng: np.random.Generator) -> list[Body]:
    red, blue = things.mug(rng, "red", True), things.mug(rng, "blue", False, "#f4efdc")
    balls = [things.ball(rng, "basketball", 0.088), things.ball(rng, "soccer ball", 0.066)]
    vase = replace(things.vase(rng, "blue"), name="vase", prompts=["blue and white vase", "ceramic vase"])
    banana, orange = things.banana(rng), things.fruit(rng, "orange")
    book = replace(things.book(rng, "green book"), name="book", prompts=["green book", "hardback book"])
    placed = [  # body, x, y, z, turn
        (red, -0.135, -0.155, 0, -35), (blue, 0.055, 0.085, 0, 20), (vase, -0.29, 0.155, 0, 0),
        (balls[0], 0.30, 0.13, 0, 0), (balls[1], -0.085, 0.20, 0, 0), (banana, -0.365, -0.195, 0, 0),
        (orange, 0.035, -0.185, 0, 0), (book, 0.25, -0.135, 0, -24), (things.cactus(rng), 0.44, -0.03, 0, 0),
        (things.clock(rng), 0.27, WALL, 0.46, 0),
    ]  # fmt: skip
    standing = [replace(body, on="table").placed(turn, np.array(spot)) for body, *spot, turn in placed]
    return [*standing[:-1], replace(standing[-1], on=None, hangs_on="wall")]


def _chosen_things(rng: np.random.Generator) -> list[Body]:
    """Objects with random size, colour and position: some stacked, some touching, the rest apart."""
    first, second, third = rng.permutation(list(things.COLORS))[:3]
    book, other = rng.permutation(list(things.BOOKS))[:2]
    fruits = rng.permutation(list(things.FRUITS))
    alone = [  # (radius of the footprint, body about the origin)
        (0.135, things.book(rng, book)),
        (0.090, things.bowl(rng, f"{third} bowl", things.COLORS[third])),
        (0.100, things.banana(rng).placed(0, np.array([-0.02, -0.08, 0]))),
        (0.088, things.ball(rng, "basketball", 0.088)),
        (0.080, things.vase(rng)),
        (0.080, things.carton(rng)),
        (0.070, things.ball(rng, "soccer ball", 0.066)),
        (0.070, things.teddy(rng)),
        (0.066, things.mug(rng, first)),
        (0.066, things.mug(rng, second)),
        (0.060, things.cactus(rng)),
        (0.040, things.bottle(rng, f"{third} bottle", things.COLORS[third])),
        (0.038, things.tin(rng, "tomato tin")),
        (0.042, things.fruit(rng, fruits[0])),
        (0.042, things.fruit(rng, fruits[1])),
    ]
    scales = rng.uniform(0.88, 1.12, len(alone))
    turns = rng.uniform(0, 360, len(alone))
    found = spots(rng, [radius * scale for (radius, _), scale in zip(alone, scales, strict=True)])
    placed = [
        replace(body, on="table").placed(turn, np.array([*spot, 0.0]), scale)
        for (_, body), turn, spot, scale in zip(alone, turns, found, scales, strict=True)
        if spot is not None
    ]
    stacked = things.book(rng, other)
    if found[0] is not None:  # the first disc always fits
        stacked = replace(stacked, on=alone[0][1].name)
        placed.append(stacked.placed(turns[0] + 25, np.array([*found[0], 0.036 * scales[0]]), 0.85))
    spot = np.array([rng.uniform(0.1, 0.4), WALL, 0.46])
    return [*placed, replace(things.clock(rng), hangs_on="wall").placed(0, spot)]


def spots(rng: np.random.Generator, radii: list[float]) -> list[tuple[float, float] | None]:
    """Non-overlapping positions on the table for discs; every third touches an earlier disc. None where none fits."""
    found: list[tuple[float, float] | None] = []
    taken: list[tuple[float, float, float]] = []
    for k, radius in enumerate(radii):
        spot = None
        for _ in range(3000):
            x, y = rng.uniform(-1, 1, 2) * (np.array(TABLE) / 2 - radius - 0.01)
            if k % 3 == 2:
                near = taken[int(rng.integers(len(taken)))]
                angle, reach = rng.uniform(0, 2 * np.pi), near[2] + radius
                x, y = near[0] + reach * np.cos(angle), near[1] + reach * np.sin(angle)
                if abs(x) > TABLE[0] / 2 - radius or abs(y) > TABLE[1] / 2 - radius:
                    continue
            if all(np.hypot(x - a, y - b) > 0.999 * (radius + r) for a, b, r in taken):
                spot = (float(x), float(y))
                taken.append((*spot, radius))
                break
        found.append(spot)
    return found


def room_around(rng: np.random.Generator, shuffled: bool) -> list[Body]:
    """Table, walls, floor and posters. shuffled: with random colours."""
    grounds = ["#b9cdc4", "#cfc3ae"]
    if shuffled:
        grounds = list(rng.permutation(["#b9cdc4", "#cfc3ae", "#c2c7d8", "#d8c3c0", "#c9d4b6", "#d9cfa8"])[:2])
    width, depth = TABLE
    top = tex.wood(rng, 900, 1270, 6, "#c9925a", "#7d4a24")
    edge = tex.wood(rng, 48, 1270, 1, "#b37d49", "#6f4120")
    plank = things.box_parts(np.array([0, 0, -0.02]), (width, depth, 0.04), [top, edge, edge], (6, 48))
    plank[0].light_texels = (120, 168)
    for part in plank[1:]:
        part.casts = False
    leg = tex.wood(rng, 80, 700, 1, "#a97443", "#66391a").transpose(1, 0, 2)
    for x, y in product((-1, 1), repeat=2):
        center = np.array([x * (width / 2 - 0.06), y * (depth / 2 - 0.06), (FLOOR - 0.04) / 2])
        plank += things.box_parts(center, (0.055, 0.055, -FLOOR - 0.04), [leg], (12, 4), casts=False)
    paper = tex.wallpaper(rng, 900, 1550, grounds[0], ["#9db8ac", "#86a699", "#d3dfd8", "#c7a86b", "#7b978f"])
    other = tex.wallpaper(rng, 900, 1100, grounds[1], ["#b7a88d", "#a3957a", "#e0d7c6", "#8a9a86", "#b98a5e"])
    tall, middle = 2.0, FLOOR + 1.0
    walls = [
        _wall([1, 0, 0], [0, -1, 0], [0, WALL, middle], 2 * SIDE, tall, paper, (48, 72)),
        _wall([0, 1, 0], [1, 0, 0], [-SIDE, WALL - 1.2, middle], 2.4, tall, other, (40, 48)),
        _wall([0, -1, 0], [-1, 0, 0], [SIDE, WALL - 1.2, middle], 2.4, tall, other[:, ::-1].copy(), (40, 48)),
    ]
    boards = tex.wood(rng, 1100, 1400, 11, "#9c7a56", "#5b4027")
    floor = Part(Sheet(2 * SIDE, 2.4, spin(0), np.array([0, WALL - 1.2, FLOOR])), boards, 0.0, (40, 48), casts=False)
    return [
        Body("table", ["wooden table"], plank, is_stuff=True, on="floor"),
        Body("wall", ["wallpaper"], walls, is_stuff=True),
        Body("floor", ["wooden floor"], [floor], is_stuff=True),
        *_posters(rng),
    ]


def _wall(along, normal, center, width, height, paint, texels) -> Part:  # type: ignore[no-untyped-def]
    return Part(Sheet(width, height, rotation_from_axes(along, normal), np.array(center)), paint, 0.0, texels, False)


def _posters(rng: np.random.Generator) -> list[Body]:
    """Framed prints on the walls: flat, 1 cm in front of the wallpaper."""
    alps = tex.landscape(rng, 640, 470, *tex.SKIES["mountain"], "MOUNTAINS")
    art = tex.mosaic(rng, 620, 620, ["#d1495b", "#edae49", "#00798c", "#30638e", "#003d5b", "#7fb069"])
    lake = tex.landscape(rng, 560, 760, *tex.SKIES["lake"], "NORTHERN LAKES")
    more = tex.mosaic(rng, 640, 760, tex.ABSTRACT)
    back = rotation_from_axes([1, 0, 0], [0, -1, 0])
    left, right = rotation_from_axes([0, 1, 0], [1, 0, 0]), rotation_from_axes([0, -1, 0], [-1, 0, 0])
    hung = [
        ("mountain poster", Sheet(0.42, 0.57, back, np.array([-0.62, WALL - 0.01, 0.36])), alps),
        ("abstract poster", Sheet(0.46, 0.46, back, np.array([-0.10, WALL - 0.01, 0.44])), art),
        ("lake poster", Sheet(0.80, 0.59, left, np.array([-SIDE + 0.01, -0.05, 0.1])), lake),
        ("colourful poster", Sheet(0.80, 0.67, right, np.array([SIDE - 0.01, -0.05, 0.1])), more),
    ]
    return [
        Body(name, ["poster", "picture"], [Part(sheet, paint, 0.0, (24, 24), False)], is_stuff=True, hangs_on="wall")
        for name, sheet, paint in hung
    ]
