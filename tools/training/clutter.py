"""Random things of random shapes and paints: what is learned from them holds beyond known objects."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from worlds import textures as tex
from worlds.cameras import orbit
from worlds.furniture import block
from worlds.light import Body, Lamp, Lighting, Part, Scene, bake_all
from worlds.shapes import Ellipsoid, Lathe, Sheet, Tube, rotation_from_axes, spin

VIEWS, FOCAL_35MM, POINTS = 24, 30, 40_000
REACH = 0.42  # metres from the centre within which things stand
Group = list[tuple[Body, float]]  # bodies about the origin, and the radius of them all


def build(seed: int, light_samples: int = 20) -> Scene:
    """The painted and lit scene. light_samples: rays per texel of the light maps."""
    return scene_of(np.random.default_rng((seed, 30)), light_samples, random_group, (16, 36), paint_of, 60)


def scene_of(
    rng: np.random.Generator,
    light_samples: int,
    draw: Callable[[np.random.Generator], Group],
    count: tuple[int, int],
    picture: Callable[[np.random.Generator], np.ndarray],
    texels: int,
) -> Scene:
    """Groups that `draw` makes on a ground between walls, under a lamp. count: of things, from and to; picture: paint
    of the pictures on the walls; texels: rows and columns of the ground's light map."""
    placed: Group = []
    wanted = rng.integers(*count)
    while len(placed) < wanted:
        group = draw(rng)
        for _ in range(60):  # a place that is free
            spot = rng.uniform(-REACH, REACH, 2)
            gaps = [np.hypot(*(spot - body.parts[0].shape.origin[:2])) - radius for body, radius in placed]
            if min(gaps, default=1) > group[0][1]:
                break
        turn = rng.uniform(0, 360)
        placed += [(body.placed(turn, np.array([*spot, 0.0])), radius) for body, radius in group]
    bodies = [body for body, _ in placed] + _ground(rng, picture, texels)
    lamp = Lamp(np.array([*rng.uniform(-1, 1, 2), 1.6]), rng.uniform(0.02, 0.4), rng.uniform(0.8, 1, 3) * 6)
    lighting = Lighting([lamp], np.full(3, rng.uniform(0.2, 0.5)))
    bake_all(bodies, lighting, rng, light_samples)
    return Scene(bodies, lighting, partial(orbit, focal_35mm=FOCAL_35MM), [])


def _ground(rng: np.random.Generator, picture: Callable[[np.random.Generator], np.ndarray], texels: int) -> list[Body]:
    """A floor, or a table over a floor, and three walls with pictures. They are often painted alike."""
    paints = [paint_of(rng) for _ in range(5)]
    for k in (2, 3, 4):
        paints[k] = paints[int(rng.integers(k + 1))]
    back, side, low = rng.uniform(0.5, 0.9), rng.uniform(0.9, 1.5), -0.7 if rng.random() < 0.5 else 0.0
    bodies = []
    for k, (normal, x, y) in enumerate([((0, 0, 1), 0, 0), ((0, -1, 0), 0, 2), ((1, 0, 0), -1, 0), ((-1, 0, 0), 1, 0)]):
        axes = rotation_from_axes([1, 0, 0] if x == 0 else [0, 1, 0], normal)
        center = np.array([x * side, back - 2 + y, low + (k > 0)])
        width, height = 4 if x else 2 * side, 2 if k else 4
        paint = tex.crop(rng, paints[k], 700, 700)
        parts = [Part(Sheet(width, height, axes, center), paint, 0.0, (60, 60) if k else (texels, texels), False)]
        bodies.append(Body("wall" if k else "ground", [], parts, is_stuff=True))
        if k and rng.random() < 0.6:
            at = center + axes @ [rng.uniform(-0.3, 0.3), rng.uniform(-0.4, 0), rng.uniform(0.002, 0.02)]
            sheet = Sheet(rng.uniform(0.3, 0.7), rng.uniform(0.3, 0.7), axes, np.minimum(at, [9, 0.4 if x else 9, 9]))
            bodies.append(Body("picture", [], [Part(sheet, picture(rng), 0.0, (24, 24), False)], is_stuff=True))
    if low < 0:
        plate = block(rng, (1.15, 1.0, 0.05), (0, 0, -0.025), paints[4])
        plate.light_texels = (6 * texels, texels)
        bodies.append(Body("table", [], [plate], is_stuff=True))
    return bodies


def random_group(rng: np.random.Generator) -> Group:
    """One thing, some things that touch, a row of books, or a pile."""
    kind, count = rng.integers(8), int(rng.integers(3, 7))
    if kind < 3:
        return [_thing(rng, paint_of(rng), int(rng.integers(5)))]
    bodies, reach = [], 0.0
    if kind < 5:
        for _ in range(count):
            body, radius = _thing(rng, paint_of(rng), int(rng.choice([0, 0, 3, 4])), upright=True)
            bodies.append(body.placed(0, np.array([reach + radius, rng.uniform(-0.02, 0.02), 0])))
            reach += 2 * radius
        return [(body.placed(0, np.array([-reach / 2, 0, 0])), reach / 2) for body in bodies]
    x, y, z = rng.uniform([0.08, 0.012, 0.10], [0.2, 0.04, 0.22])
    paint, pile = paint_of(rng), kind == 7
    for _ in range(count):
        paint = paint if rng.random() < (0.5 if kind == 5 else 0.1) else paint_of(rng)
        thick = y * rng.uniform(0.6, 1.4) * (0.4 if pile else 1)
        long, wide = (x, z) * rng.uniform(0.7 if pile else 0.9, 1, 2)
        size = (long, wide, thick) if pile else (long, thick, wide)
        center = (0, 0, reach + thick / 2) if pile else (0, reach + thick / 2, wide / 2)
        turn = spin(rng.uniform(-25, 25)) if pile else np.eye(3)
        bodies.append(Body("book", [], [block(rng, size, center, paint, rng.uniform(0, 0.5), turn=turn)]))
        reach += thick + (0 if pile else rng.uniform(0, 0.004))
    return [(body, max(x, z if pile else reach) / 2) for body in bodies]


def _thing(rng: np.random.Generator, paint: np.ndarray, kind: int, upright: bool = False) -> tuple[Body, float]:
    """A box (0), some balls as one body (1), a rod (2), or a turned vessel (3), with a handle (4); with its radius."""
    gloss, size = rng.uniform(0, 0.8), rng.uniform(0.03, 0.08 if upright else 0.1)
    second = paint_of(rng) if rng.random() < 0.4 else paint
    if kind == 0:
        extent = (size * rng.uniform([0.6, 0.6, 0.8], [2, 2, 3])).tolist()
        part = block(rng, extent, (0, 0, extent[2] / 2), paint, gloss, top=second)
        return Body("box", [], [part]), (extent[0] if upright else np.hypot(*extent[:2])) / 2
    if kind == 1:
        balls, height = [], 0.0
        for k in range(rng.integers(1, 4)):
            radii = size * rng.uniform(0.5, 0.9, 3) * 0.85**k
            ball = Ellipsoid(radii, np.eye(3), np.array([0, 0, height + radii[2]]))
            balls.append(Part(ball, (paint, second)[k % 2], gloss, (24, 40)))
            height += 1.7 * radii[2]
        return Body("toy", [], balls), size
    if kind == 2:
        length, thick = rng.uniform(0.08, 0.2), rng.uniform(0.004, 0.012)
        rod = Tube(length, -0.7, 0.7, np.full(5, thick), spin(0), np.array([-length, 0, thick]))
        return Body("rod", [], [Part(rod, paint, gloss, (24, 12))]), length * 0.7
    height, knots = size * rng.uniform(0.8, 3), np.linspace(0, 1, 9)
    widths = rng.uniform(0.5, 1, 4) if rng.random() < 0.6 else np.ones(4)
    radius = size * 0.7 * np.interp(knots, np.linspace(0, 1, 4), widths)
    inside = [(radius[-1] * 0.9, height), (radius[-1] * 0.85, height * 0.7), (0.0, height * rng.uniform(0.2, 0.98))]
    cup = Lathe(np.concatenate([[(0.0, 0.0)], np.stack([radius, knots * height], axis=1), inside]))
    parts = [Part(cup, np.concatenate([paint, second[: len(second) // 2]]), gloss, (40, 40))]
    if kind == 4:
        axes, at = rotation_from_axes([1, 0, 0], [0, -1, 0]), np.array([radius[4], 0, height / 2])
        parts.append(Part(Tube(height / 4, -1.6, 1.6, np.full(5, height / 18), axes, at), second, gloss, (12, 24)))
    return Body("vessel", [], parts), float(radius.max())


def paint_of(rng: np.random.Generator) -> np.ndarray:
    """A texture of random colours: plain, mottled, dotted, striped, wooden, woven, printed, or a mosaic."""
    tint = rng.uniform(0.1, 1) * (1 - rng.uniform(0, 1) * rng.uniform(0, 1, 3))  # from grey to saturated
    one, two, three = (tex.rgb_code(c.clip(0.03, 0.95)) for c in (tint, tint + rng.normal(0, 0.15, 3), rng.random(3)))
    kind, side = rng.integers(8), (300, 400)
    if kind == 2:
        return tex.glaze(rng, *side, one, [two, three], int(rng.integers(5, 80)))
    if kind == 3:
        return tex.wood(rng, *side, int(rng.integers(1, 6)), one, two)
    if kind == 4:
        return tex.fabric(rng, *side, one, [two, three] if rng.random() < 0.5 else None)
    if kind == 5:
        place = np.indices(side)[1 - int(rng.integers(2))]
        stripes = place // int(rng.integers(15, 80)) % 2
        return tex.blend(stripes, tex.plaster(rng, *side, one), tex.plaster(rng, *side, three))
    if kind == 7:
        return tex.mosaic(rng, *side, [one, two, three])
    plain = tex.plaster(rng, *side, one)
    return plain if kind < 2 else tex.draw_text(plain, str(rng.choice(["OAT", "No 7", "SEA"])), (200, 150), 110, three)
