"""A table with small things between a few larger ones: coins, dice, rings, cutlery, keys, pens, batteries, beads."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np

from worlds import textures as tex
from worlds import things
from worlds.cameras import orbit
from worlds.furniture import block
from worlds.light import Body, Part, Scene, bake_all
from worlds.shapes import Ellipsoid, Shape, Tube, spin
from worlds.tabletop import FOCAL_35MM as FOCAL_35MM
from worlds.tabletop import LIGHTING, VIEWS, room_around, spots

__all__ = ["FOCAL_35MM", "POINTS", "VIEWS", "build"]
POINTS = 80_000
METALS = ["#b9bcc0", "#c9a54b", "#a5673f"]


def build(seed: int, light_samples: int = 20) -> Scene:
    """The painted and lit scene; every seed places other things. light_samples: see `tabletop.build`."""
    rng = np.random.default_rng((seed, 50))
    first, second = rng.permutation(list(things.COLORS))[:2]
    large = [
        (0.135, things.book(rng, str(rng.choice(list(things.BOOKS))))),
        (0.090, things.bowl(rng, f"{first} bowl", things.COLORS[first])),
        (0.066, things.mug(rng, second)),
        (0.042, things.fruit(rng, str(rng.choice(list(things.FRUITS))))),
    ]
    small = [(0.035, coin(rng, n)) for n in range(3)] + [(0.035, die(rng, n)) for n in range(3)]
    small += [(0.035, ring(rng, n)) for n in range(2)] + [(0.04, bead(rng, n)) for n in range(2)]
    small += [(0.09, fork(rng)), (0.05, key(rng)), (0.07, pen(rng, "red")), (0.07, pen(rng, "blue"))]
    small += [(0.04, battery(rng)), (0.04, eraser(rng)), (0.035, button(rng, "white")), (0.035, button(rng, "black"))]
    wanted, bodies = [*large, *small], []
    for (_, body), spot in zip(wanted, spots(rng, [radius for radius, _ in wanted]), strict=True):
        if spot is not None:
            turn = float(rng.uniform(0, 360))
            bodies.append(replace(body, on="table").placed(turn, np.array([*spot, 0.0])))
    bodies += room_around(rng, True)
    bake_all(bodies, LIGHTING, rng, light_samples)
    return Scene(bodies, LIGHTING, partial(orbit, focal_35mm=FOCAL_35MM), [body.name for body in bodies[:3]])


def _plain(rng: np.random.Generator, color: str) -> np.ndarray:
    return tex.plaster(rng, 80, 120, color)


def _body(name: str, prompts: list[str], *shapes: tuple[Shape, np.ndarray], gloss: float = 0.4) -> Body:
    return Body(name, prompts, [Part(shape, paint, gloss, (12, 16)) for shape, paint in shapes])


def coin(rng: np.random.Generator, n: int) -> Body:
    radius, metal = rng.uniform(10, 13.5), METALS[n % 3]
    face = tex.glaze(rng, 80, 120, metal, ["#6e6a60"], 20)
    return _body(f"coin {n + 1}", ["coin"], (things.lathe(f"0 0 {radius} 0 {radius} 2.2 0 2.2"), face), gloss=0.7)


def die(rng: np.random.Generator, n: int) -> Body:
    side = rng.uniform(0.014, 0.018)
    paint = _plain(rng, ["#e9e6dc", "#b3202a", "#1c4fb5"][n % 3])
    for x, y in ((30, 20), (60, 40), (90, 60)):
        tex.disc(paint, (x, y), 6, "#f4f1e8" if n else "#26262a")
    return Body(f"die {n + 1}", ["die", "dice"], [block(rng, (side,) * 3, (0, 0, side / 2), paint, 0.4)])


def ring(rng: np.random.Generator, n: int) -> Body:
    thick = 0.0016 + 0.0004 * n
    band = Tube(rng.uniform(0.0095, 0.012), -np.pi, np.pi, np.full(5, thick), spin(0), np.array([0, 0, thick]))
    return _body(f"ring {n + 1}", ["ring"], (band, _plain(rng, METALS[n % 2])), gloss=0.8)


def bead(rng: np.random.Generator, n: int) -> Body:
    radius = 0.006 + 0.002 * n
    ball = Ellipsoid(np.full(3, radius), np.eye(3), np.array([0, 0, radius]))
    return _body(f"bead {n + 1}", ["bead", "marble"], (ball, _plain(rng, ["#2c7a3f", "#e3b81d"][n % 2])), gloss=0.7)


def _rod(length: float, thick: float, x: float, y: float = 0.0) -> Tube:
    """A straight rod along x that begins at (x, y) and lies on the ground."""
    bend = 40 * length
    angle = length / bend
    return Tube(bend, -angle / 2, angle / 2, np.full(5, thick), spin(90), np.array([x + length / 2, y - bend, thick]))


def fork(rng: np.random.Generator) -> Body:
    steel = _plain(rng, "#b4b6ba")
    tines = [(_rod(0.05, 0.0012, 0.03, y), steel) for y in (-0.0075, -0.0025, 0.0025, 0.0075)]
    return _body("fork", ["fork", "cutlery"], (_rod(0.11, 0.003, -0.08), steel), *tines, gloss=0.7)


def key(rng: np.random.Generator) -> Body:
    brass = _plain(rng, "#c2a055")
    bow = Tube(0.009, -np.pi, np.pi, np.full(5, 0.0016), spin(0), np.array([-0.02, 0, 0.0016]))
    bit = block(rng, (0.008, 0.007, 0.003), (0.018, -0.005, 0.0016), brass, 0.5)
    made = _body("key", ["key"], (bow, brass), (_rod(0.035, 0.0016, -0.011), brass), gloss=0.6)
    return replace(made, parts=[*made.parts, bit])


def pen(rng: np.random.Generator, color: str) -> Body:
    barrel, tip = _plain(rng, things.COLORS[color]), _plain(rng, "#26262a")
    return _body(f"{color} pen", ["pen"], (_rod(0.11, 0.0045, -0.06), barrel), (_rod(0.014, 0.002, 0.05), tip))


def battery(rng: np.random.Generator) -> Body:
    paint = _plain(rng, "#c57a2b")
    paint[:, :40] = tex.rgb("#26262a")
    return _body("battery", ["battery"], (things.lathe("0 0 7 0 7 48 2.5 48 2.5 50 0 50"), paint))


def eraser(rng: np.random.Generator) -> Body:
    return Body("eraser", ["eraser"], [block(rng, (0.04, 0.018, 0.011), (0, 0, 0.0055), _plain(rng, "#d97a9c"), 0.1)])


def button(rng: np.random.Generator, color: str) -> Body:
    disc = things.lathe("0 0 8 0 9 1.5 7 3 0 2.2")
    return _body(f"{color} button", ["button"], (disc, _plain(rng, things.COLORS[color])))
