"""Things of several colours that are one, and things that look alike or touch and are several.

Animals with a coat in patches, vessels with pictures, magazines that overlap or lie edge to edge, rows of books of one
series. The last have the opposite answer to the first, for the same evidence of colour: shape and borders must decide.
"""

from __future__ import annotations

import numpy as np

from training import clutter
from training.clutter import FOCAL_35MM, POINTS, VIEWS, Group
from worlds import textures as tex
from worlds.furniture import block
from worlds.light import Body, Part, Scene
from worlds.shapes import Ellipsoid, Lathe, Tube, rotation_from_axes, spin

__all__ = ["FOCAL_35MM", "POINTS", "VIEWS", "build"]

WORDS = ["VOGUE", "ATLAS 2", "SEA", "home", "No 7", "KITCHEN", "Art & Life", "TRAINS"]


def build(seed: int, light_samples: int = 20) -> Scene:
    """The painted and lit scene. light_samples: rays per texel of the light maps, which are finer than of clutter, so
    that shadows have borders."""
    return clutter.scene_of(np.random.default_rng((seed, 31)), light_samples, _group, (10, 28), cover, 150)


def _group(rng: np.random.Generator) -> Group:
    """An animal, a vessel with a picture, a package, magazines, a row of books, or things of `clutter`."""
    kind = rng.integers(10)
    if kind < 3:
        return [animal(rng)]
    if kind < 5:
        return [_vessel(rng)]
    if kind < 6:
        extent = rng.uniform([0.05, 0.03, 0.06], [0.16, 0.1, 0.22])
        part = block(
            rng, extent.tolist(), (0, 0, extent[2] / 2), cover(rng), rng.uniform(0, 0.5), cover(rng), cover(rng)
        )
        return [(Body("package", [], [part]), float(np.hypot(*extent[:2]) / 2))]
    if kind < 7:
        return _magazines(rng)
    return books(rng) if kind < 9 else clutter.random_group(rng)


def color(rng: np.random.Generator) -> np.ndarray:
    """[3] sRGB, from grey to saturated."""
    return (rng.uniform(0.05, 1) * (1 - rng.uniform(0, 1) * rng.uniform(0, 1, 3))).clip(0.03, 0.97)


def cover(rng: np.random.Generator, height: int = 400, width: int = 300) -> np.ndarray:
    """Large areas of different colours, some with pictures, and a title."""
    page = tex.paper(tex.rgb_code(color(rng)), height, width)
    for _ in range(rng.integers(1, 5)):
        top, left = (rng.uniform(-0.2, 0.7, 2) * (height, width)).astype(int).clip(0)
        down, right = np.add((top, left), (rng.uniform(0.2, 0.9, 2) * (height, width)).astype(int))
        area, tones = page[top:down, left:right], [tex.rgb_code(color(rng)) for _ in range(3)]
        kind = rng.integers(5)
        if kind == 0:
            area[:] = tex.landscape(rng, height, width, tones[:2], tones[1:], "")[top:down, left:right]
        elif kind == 1:
            area[:] = tex.mosaic(rng, height, width, tones)[top:down, left:right]
        elif kind == 2:
            tex.disc(
                page, (int(left + right) // 2, int(top + down) // 2), int(rng.uniform(0.15, 0.5) * width), tones[0]
            )
        else:
            area[:] = tex.rgb(tones[0])
    for _ in range(rng.integers(4)):
        place = rng.uniform(0.2, 0.8) * width, rng.uniform(0.08, 0.92) * height
        page = tex.draw_text(page, str(rng.choice(WORDS)), place, int(rng.uniform(14, 90)), tex.rgb_code(color(rng)))
    return page


def _coat(rng: np.random.Generator, tones: list[np.ndarray]) -> np.ndarray:
    """Hair of one colour, with another one below and a third in patches; borders between them are soft or sharp."""
    size, sharp = (160, 240), rng.uniform(2, 14)
    furs = [tex.fur(rng, *size, tex.rgb_code(tone), tex.rgb_code(tone * rng.uniform(0.5, 0.9))) for tone in tones]
    down = np.linspace(0, 1, size[0])[:, None] + 0.08 * tex.noise(rng, *size, (3, 4))
    coat = tex.blend(sharp * (down - rng.uniform(0.35, 0.9)), furs[0], furs[1])
    return tex.blend(sharp * (tex.noise(rng, *size, (2, 3)) - rng.uniform(0.6, 2.5)) / 2, coat, furs[2]).astype(
        np.float32
    )


def animal(rng: np.random.Generator) -> tuple[Body, float]:
    """Torso, neck, head, muzzle, nose, ears, legs and a tail of ellipsoids; a bust has no legs."""
    size, bust, gloss = rng.uniform(0.03, 0.09), rng.random() < 0.4, rng.uniform(0, 0.4)
    tones, dark = [color(rng) for _ in range(3)], color(rng) * 0.3
    height = 0.0 if bust else rng.uniform(0.3, 1.0)
    wide, long, tall = rng.uniform([0.6, 0.7, 0.6], [1.0, 1.7, 1.3])
    neck = np.array([0, -long * rng.uniform(0.2, 0.8), height + tall * rng.uniform(1.2, 2.2)])
    head, snout = rng.uniform(0.45, 0.8), rng.uniform(0.2, 0.7)
    tip = neck + np.array([0, -head - 0.6 * snout, -rng.uniform(0, 0.3) * head])
    rows = [((wide, long, tall), (0, 0, height + 0.95 * tall), 0)]
    rows += [((0.6 * head, 0.7 * head, 0.8 * head), neck / 2 + [0, 0, (height + tall) / 2], 0)]
    rows += [((head, head * rng.uniform(0.8, 1.2), head * rng.uniform(0.7, 1.0)), neck, 0)]
    rows += [((0.45 * head, snout, 0.4 * head), tip, int(rng.integers(1, 3)))]
    rows += [((0.15 * head,) * 3, tip + np.array([0, -snout, 0.1 * head]), 3)]
    ear, lean = rng.uniform(0.15, 0.6), rng.uniform(0.3, 0.8)
    for side in (-1, 1):
        root = neck + np.array([side * lean * head, 0, 0.8 * head + ear / 2])
        rows.append(((0.3 * head, 0.12, ear), root, int(rng.choice([0, 3]))))
    rows += [((0.12 * head,) * 3, neck + head * np.array([s * 0.4, -0.88, 0.25]), 3) for s in (-1, 1)]
    if not bust:
        leg = int(rng.choice([0, 1, 3]))
        rows += [((0.25, 0.28, height / 2 + 0.3), (s * 0.6 * wide, t * 0.6 * long, height / 2 + 0.3), leg)
                 for s in (-1, 1) for t in (-1, 1)]  # fmt: skip
    if rng.random() < 0.5:
        rows += [((0.2, rng.uniform(0.3, 0.9), 0.2), (0, long + 0.3, height + tall), int(rng.integers(3)))]
    orders = tones, [tones[1], tones[0], tones[2]], [tones[2], tones[1], tones[0]]
    paints = [_coat(rng, order) for order in orders] + [tex.plaster(rng, 40, 60, tex.rgb_code(dark))]
    parts = [
        Part(Ellipsoid(size * np.array(radii), spin(0), size * np.array(at)), paints[k], gloss, (24, 36))
        for radii, at, k in rows
    ]
    return Body("animal", [], parts), float(size * (long + 0.4))


def _vessel(rng: np.random.Generator) -> tuple[Body, float]:
    """A mug with a picture or bands around it, another colour inside, and often a handle."""
    radius, height, gloss = rng.uniform(0.03, 0.06), rng.uniform(0.06, 0.16), rng.uniform(0, 0.8)
    wide = radius * rng.uniform(0.7, 1.0, 2)
    profile = [(0, 0), (wide[0], 0), (radius, height / 2), (wide[1], height), (0.9 * wide[1], height)]
    profile += [(0.85 * wide[0], 0.15 * height), (0, rng.uniform(0.1, 0.9) * height)]
    lengths = np.linalg.norm(np.diff(profile, axis=0), axis=1)
    low, high = lengths[0] / lengths.sum(), lengths[:3].sum() / lengths.sum()
    glaze, inside = color(rng), color(rng)
    paint = tex.plaster(rng, 400, 600, tex.rgb_code(glaze))
    top, bottom = int(400 * low), int(400 * high)
    if rng.random() < 0.7:
        left, right = int(rng.uniform(0, 200)), int(rng.uniform(330, 600))
        paint[top:bottom, left:right] = cover(rng, bottom - top, right - left)[::-1]
    else:
        for _ in range(rng.integers(1, 4)):
            start = int(rng.uniform(top, bottom))
            paint[start : start + int(rng.uniform(20, 120))] = color(rng)
    paint[bottom:] = inside if rng.random() < 0.7 else glaze
    parts = [Part(Lathe(np.array(profile)), paint, gloss, (40, 40))]
    if rng.random() < 0.7:
        axes = rotation_from_axes([1, 0, 0], [0, -1, 0])
        ring = Tube(height / 3.5, -1.6, 1.6, np.full(5, height / 16), axes, np.array([0.95 * radius, 0, height / 2]))
        tone = tex.plaster(rng, 40, 60, tex.rgb_code(inside if rng.random() < 0.3 else glaze))
        parts.append(Part(ring, tone, gloss, (12, 24)))
    return Body("mug", [], parts), float(radius)


def _magazines(rng: np.random.Generator) -> Group:
    """Thin sheets of paper or books: they overlap like a hand of cards, or lie edge to edge."""
    beside, count = rng.random() < 0.4, int(rng.integers(2, 5))
    x, y = rng.uniform([0.09, 0.12], [0.17, 0.24])
    first, bodies, z = cover(rng), [], 0.0
    for k in range(count):
        page = first if rng.random() < 0.15 else cover(rng)
        thick = rng.uniform(0.002, 0.012)
        at = (
            [(k % 2 - 0.5) * (x + 0.001), (k // 2 - 0.5) * (y + 0.001)]
            if beside
            else rng.uniform(-0.45, 0.45, 2) * (x, y)
        )
        turn = spin(0 if beside else rng.uniform(-40, 40))
        side = tex.plaster(rng, 60, 80, tex.rgb_code(np.full(3, rng.uniform(0.6, 0.95))))
        part = block(rng, (x, y, thick), (*at, z + thick / 2), side, rng.uniform(0, 0.6), top=page, turn=turn)
        part.light_texels = (6 * 20, 20)
        bodies.append(Body("magazine", [], [part]))
        z += 0 if beside else thick
    return [(body, float(max(x, y))) for body in bodies]


def books(rng: np.random.Generator) -> Group:
    """Upright books in a row, of one series, of two, or each of its own; some lean back a little."""
    count, series = int(rng.integers(4, 10)), rng.integers(3)
    deep, tall, gap = rng.uniform(0.07, 0.16), rng.uniform(0.1, 0.22), rng.choice([0.0, 0.0005, 0.002])
    spines, reach, rows = [cover(rng, 400, 80) for _ in range(2)], 0.0, []
    for _ in range(count):
        spine = spines[0] if series == 0 else spines[rng.integers(2)] if series == 1 else cover(rng, 400, 80)
        if series == 0 and rng.random() < 0.5:
            spine = tex.draw_text(
                spine, str(rng.choice(WORDS)), (40, rng.uniform(60, 340)), 30, tex.rgb_code(color(rng))
            )
        thick, high = rng.uniform(0.008, 0.035), tall * (1 if series == 0 else rng.uniform(0.75, 1))
        rows.append((reach + thick / 2, thick, high, spine, rng.uniform(-0.006, 0.006)))
        reach += thick + gap
    bodies = []
    for middle, thick, high, spine, forward in rows:
        tile = np.broadcast_to(spine[200:201, :1], (40, 60, 3)) * np.ones((40, 60, 1), np.float32)
        part = block(
            rng, (thick, deep, high), (middle - reach / 2, forward, high / 2), tile, rng.uniform(0, 0.4), front=spine
        )
        part.light_texels = (6 * 16, 16)
        bodies.append(Body("book", [], [part]))
    return [(body, max(reach, deep) / 2) for body in bodies]
