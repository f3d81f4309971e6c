"""Small household objects built from primitives. Metres; z up; they stand on z = 0, about the origin."""

from __future__ import annotations

import cv2
import numpy as np

from worlds import textures as tex
from worlds.light import Body, Part
from worlds.shapes import Ellipsoid, Lathe, Sheet, Tube, rotation_from_axes, spin

COLORS = {
    "red": "#c3161c", "blue": "#1c4fb5", "green": "#2c7a3f", "yellow": "#e3b81d", "white": "#e9e6dc",
    "black": "#26262a", "purple": "#6b3a8c", "pink": "#d97a9c",
}  # fmt: skip
FRUITS = {  # light, dark
    "orange": ("#f7921e", "#dd6a07"),
    "lemon": ("#f5dd3f", "#dcb71f"),
    "lime": ("#8fc23c", "#5d8f24"),
    "red apple": ("#c8202b", "#8e1320"),
    "green apple": ("#a8c84a", "#7fa32e"),
}
BOOKS = {  # cover colours from dark to light, title
    "green book": (None, ("FIELD GUIDE", "BIRDS", "OF THE NORTH")),
    "blue book": (("#0e2a5c", "#3d76c9"), ("ATLAS", "OCEANS", "AND ISLANDS")),
    "red book": (("#6e1016", "#c9474a"), ("A NOVEL", "EMBERS", "OF AUTUMN")),
    "yellow book": (("#b07d10", "#f0cf55"), ("COOKING", "BREAD", "AND SALT")),
}
GREEN_BOOK = ["#0d4f4a", "#1c8a78", "#2a9a7d", "#166b5d", "#0f4c46", "#0a3330"]
"""Book cover colours: sky, horizon, then hills; the last colour is the binding."""
INKS = {
    "blue": ("#1f3f94", "#2f62b8", "#5b8ccf"),
    "red": ("#8e1d22", "#b8332f", "#cf6a5b"),
    "green": ("#1f6b3a", "#2f9457", "#5bbf83"),
}
BALLS = {  # paint, its size, direction of the pole
    "basketball": (tex.basketball, (480, 960), [0.5, -0.45, 0.75]),
    "soccer ball": (tex.soccer_ball, (440, 880), [0.2, -0.3, 1]),
}
Printed = tuple[str, str, str, tuple[float, float, float]]  # colour, name, word; width, depth, height in metres
UPRIGHT = np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])
"""Rotation of a tube that bends in the plane of x and z."""


def lathe(millimetres: str) -> Lathe:
    """A surface of revolution from a text of (radius, height) pairs."""
    return Lathe(np.array(millimetres.split(), float).reshape(-1, 2) / 1000)


def mug(rng: np.random.Generator, color: str, hearts: bool | None = None, ink: str | None = None) -> Body:
    """A mug of coffee in one of COLORS, with hearts or dots (None: random): thick rim, bent handle towards +x."""
    hearts = bool(rng.integers(2)) if hearts is None else hearts
    ink = ink or ("#1d2f66" if color in ("white", "yellow", "pink") else "#f6efe0")
    paint = _mug_paint(rng, COLORS[color], ink, hearts)
    cup = lathe("0 0 34 0 40 5 42.5 15 43.5 92 42.5 96.5 40.5 96.5 39.5 92 39 78 0 78")
    grip = np.ascontiguousarray(paint[110:150, :60])
    place = np.array([0.0455, 0, 0.05])
    handle = Tube(0.0295, np.radians(-90), np.radians(90), np.full(9, 0.0064), UPRIGHT, place)
    parts = [Part(cup, paint, 0.5, (40, 48)), Part(handle, grip, 0.5, (12, 32))]
    return Body(f"{color} mug", ["mug", "coffee mug"], parts)


def _mug_paint(rng: np.random.Generator, color: str, ink: str, hearts: bool) -> np.ndarray:
    """Hearts or dots outside, cream colour inside, coffee (the last fifth of the profile)."""
    height, width, count = 480, 560, 3 if hearts else 14
    paint = tex.glaze(rng, height, width, color, [ink, "#1c1c1c"], 60)
    a = np.linspace(0, 2 * np.pi, 60)
    rise = 13 * np.cos(a) - 5 * np.cos(2 * a) - 2 * np.cos(3 * a) - np.cos(4 * a)
    for i in range(count):
        x = int((i + 0.5) * width / count)
        if hearts:  # row 0 is the bottom of the profile
            tex.polygon(paint, np.stack([x + 2.6 * 16 * np.sin(a) ** 3, 232 + 3.6 * rise], 1), ink)
        else:
            tex.disc(paint, (x, 195 + 75 * (i % 2)), (11, 15), ink)
    inside, coffee = int(0.73 * height), int(0.80 * height)
    paint[inside:] = tex.glaze(rng, height - inside, width, "#efe6d2", ["#cdbf9f"], 40)
    foam = tex.noise(rng, height - coffee, width, (4, 10), 5)
    paint[coffee:] = tex.blend(0.12 * foam + 0.05, tex.rgb("#3a1f10"), tex.rgb("#a8743e"))
    return paint


def vase(rng: np.random.Generator, color: str | None = None) -> Body:
    """A bellied vase with a narrow neck, white, painted in one of INKS (None: random)."""
    color = str(rng.choice(list(INKS))) if color is None else color
    z = np.linspace(0, 1, 22)
    radius = 0.034 + 0.036 * np.exp(-(((z - 0.42) / 0.26) ** 2)) - 0.012 * np.exp(-(((z - 0.86) / 0.13) ** 2))
    radius[-3:] += [0.0015, 0.005, 0.009]
    outer = np.stack([radius, 0.26 * z], 1)
    inner = np.array([(radius[-1] - 0.004, 0.26), (radius[-4] - 0.005, 0.215), (0.05, 0.11), (0.0, 0.1)])
    height, width, ink = 620, 800, INKS[color]
    paint = tex.glaze(rng, height, width, "#ebe9e0", ["#c9ccd0", "#b9b3a2"], 260)
    for top, thick in ((0.11, 9), (0.135, 4), (0.47, 7), (0.50, 3), (0.61, 8)):
        paint[int(top * height) : int(top * height) + thick] = tex.rgb(ink[0])
    for i in range(26):
        x, y = int((i + 0.5) * width / 26), int((0.30 + 0.055 * np.sin(i * 2 * np.pi / 6.5)) * height)
        for leaf in range(int(rng.integers(4, 7))):
            a, r = float(rng.uniform(0, 360)), int(rng.integers(10, 22))
            tip = int(x + r * np.cos(np.radians(a))), int(y + r * np.sin(np.radians(a)))
            tex.disc(paint, tip, (r // 2 + 3, 4), ink[leaf % 3], a)
        tex.disc(paint, (x, y), 5, "#d8b13c")
    for i in range(40):
        tex.disc(paint, (int((i + 0.5) * width / 40), int(0.555 * height)), 5, ink[int(rng.integers(3))])
    body = Lathe(np.concatenate([[(0.0, 0.0)], outer, inner]))
    return Body(f"{color} vase", ["vase", "ceramic vase"], [Part(body, paint, 0.6, (64, 56))])


def ball(rng: np.random.Generator, name: str, radius: float) -> Body:
    """One of BALLS."""
    paint, size, tilt = BALLS[name]
    shape = Ellipsoid(np.full(3, radius), rotation_from_axes([1, 0.3, 0.1], tilt), np.array([0, 0, radius]))
    return Body(name, ["ball"], [Part(shape, paint(rng, *size), 0.18, (36, 64))])


def fruit(rng: np.random.Generator, name: str) -> Body:
    """One of FRUITS: round, slightly flattened."""
    tilt = rotation_from_axes([1, 0, 0.2], [0.25, -0.35, 1])
    shape = Ellipsoid(np.array([0.040, 0.040, 0.037]), tilt, np.array([0, 0, 0.0375]))
    return Body(name, [f"{name} fruit", "fruit"], [Part(shape, tex.peel(rng, 280, 560, *FRUITS[name]), 0.25, (32, 56))])


def banana(rng: np.random.Generator) -> Body:
    """A banana lying on its side: a tapering bent tube with a stem and brown tips."""
    radii = np.array([0.0045, 0.005, 0.0095, 0.0155, 0.0178, 0.0185, 0.0185, 0.0175, 0.0145, 0.008, 0.004])
    shape = Tube(0.115, np.radians(28), np.radians(137), radii, spin(0), np.array([0, 0, 0.0186]), steps=64)
    height, width = 520, 260
    paint = tex.peel(rng, height, width, "#f6d335", "#e2b41d", 9)
    across = np.arange(width) / width
    ridge = np.exp(-((((across * 5) % 1) - 0.5) ** 2) / 0.006)[None] * np.ones((height, 1))
    paint = tex.blend(0.45 * ridge, paint, tex.rgb("#b98f1c"))
    paint = tex.speckle(rng, paint, 150, (1, 5), ["#6b4716", "#8a611d", "#a87d22"])
    v = np.linspace(0, 1, height)[:, None] * np.ones((1, width))
    for amount, color in (
        ((0.10 - v) / 0.06, "#8d8a3a"),
        ((v - 0.955) / 0.02, "#33240f"),
        ((0.018 - v) / 0.01, "#33240f"),
    ):
        paint = tex.blend(amount, paint, tex.rgb(color))
    return Body("banana", ["yellow banana", "fruit"], [Part(shape, paint, 0.1, (48, 20))])


def box_parts(
    center: np.ndarray, extent: tuple[float, float, float], paints: list[np.ndarray],
    texels: tuple[int, int] = (24, 24), casts: bool = True,
) -> list[Part]:  # fmt: skip
    """Six sheets forming a box. paints: for +z, -z and the four sides (-y, +x, +y, -x), repeated if fewer."""
    x, y, z = extent
    faces = [
        ([0, 0, 1], [1, 0, 0], z, x, y), ([0, 0, -1], [1, 0, 0], z, x, y), ([0, -1, 0], [1, 0, 0], y, x, z),
        ([1, 0, 0], [0, 1, 0], x, y, z), ([0, 1, 0], [-1, 0, 0], y, x, z), ([-1, 0, 0], [0, -1, 0], x, y, z),
    ]  # fmt: skip
    parts = []
    for i, (normal, along, depth, width, height) in enumerate(faces):
        shape = Sheet(width, height, rotation_from_axes(along, normal), center + np.array(normal) * depth / 2)
        parts.append(Part(shape, paints[i % len(paints)], 0.0, texels, casts))
    return parts


def book(rng: np.random.Generator, name: str) -> Body:
    """One of BOOKS, a thick hardback lying flat with the title up."""
    shades, title = BOOKS[name]
    colors = GREEN_BOOK if shades is None else [
        tex.rgb_code(tex.rgb(shades[0]) * (1 - share) + tex.rgb(shades[1]) * share)
        for share in (0.0, 0.7, 1.0, 0.6, 0.3, -0.2)
    ]  # fmt: skip
    cover = tex.landscape(rng, 560, 410, colors[:2], colors[2:], title[0])
    cover = tex.draw_text(cover, title[1], (205, 320), 88, "#fff3cf")
    cover = tex.draw_text(cover, title[2], (205, 385), 34, "#f2d98a")
    spine = tex.glaze(rng, 100, 560, colors[0], [colors[1]], 200)
    spine = tex.draw_text(spine, " ".join(title[1:]), (280, 50), 38, "#f2d98a")
    pages = tex.blend(0.35 + 0.25 * tex.noise(rng, 100, 560, (50, 3), 2), tex.rgb("#f1e8d2"), tex.rgb("#a8946a"))
    pages[:8] = pages[-8:] = tex.rgb(colors[-1])
    parts = box_parts(np.array([0, 0, 0.018]), (0.150, 0.205, 0.036), [cover, spine, pages, pages, pages, spine])
    return Body(name, ["book", "hardback book"], parts)


def cactus(rng: np.random.Generator) -> Body:
    """A ribbed cactus with two arms in a terracotta pot."""
    clay = tex.blend(0.4 + 0.25 * tex.noise(rng, 360, 560, (8, 12), 5), tex.rgb("#c76b3f"), tex.rgb("#9a4a29"))
    earth = tex.rgb("#3b2a1d") * np.ones((110, 560, 3), np.float32)
    clay[250:] = tex.speckle(rng, earth, 900, (1, 4), ["#6d5137", "#1f150e", "#8d7454"])
    stem = Ellipsoid(np.array([0.027, 0.027, 0.075]), spin(20), np.array([0, 0, 0.128]))
    parts = [
        Part(lathe("0 0 34 0 46 62 51 63 53 85 48 86 46 74 0 73"), clay, 0.0, (32, 40)),
        Part(stem, _ribs(rng, 400, 460, 13), 0.0, (32, 52)),
    ]
    for side, height, size in ((15.0, 0.135, 0.026), (195.0, 0.115, 0.024)):
        outward, radii = spin(side)[:, 0], np.array([0.009, 0.011, 0.0115, 0.0115, 0.011])
        axes = np.stack([outward, np.array([0, 0, 1.0]), np.cross(outward, [0, 0, 1.0])], 1)
        # An arm bends by 90 degrees: out of the stem sideways, then upwards.
        origin = np.array([0, 0, height + size]) + 0.028 * outward
        bend = Tube(size, np.radians(-100), np.radians(20), radii, axes, origin)
        parts.append(Part(bend, _ribs(rng, 160, 160, 7), 0.0, (20, 24)))
    return Body("cactus", ["potted cactus", "flowerpot"], parts)


def _ribs(rng: np.random.Generator, height: int, width: int, count: int) -> np.ndarray:
    """Cactus texture: light ribs with pale spines, dark valleys."""
    u = (np.arange(width) + 0.5) / width * count
    ridge = (0.5 + 0.5 * np.cos(2 * np.pi * u))[None] * np.ones((height, 1))
    skin = tex.blend(ridge + 0.12 * tex.noise(rng, height, width, (8, 8), 4), tex.rgb("#1f4a26"), tex.rgb("#5f9a4a"))
    for x in (round(k * width / count) for k in range(count)):
        for y in np.arange(6, height - 4, 13) + int(rng.integers(0, 7)):
            skin[y - 1 : y + 2, max(x - 2, 0) : x + 3] = tex.rgb("#efe6c0")
    return skin.astype(np.float32)


def clock(rng: np.random.Generator) -> Body:
    """A wall clock facing -y: a black case (surface of revolution) and a white dial that shows 10:10."""
    facing = rotation_from_axes([1, 0, 0], [0, -1, 0])
    case = Lathe(lathe("132 0 135 20 128 30 120 29 117 18").profile, facing)
    dial, black = tex.glaze(rng, 480, 480, "#f3f1ea", ["#dedacd", "#c8c4b8"], 120), tex.rgb("#22262b").tolist()

    def at(degrees: float, reach: float) -> tuple[float, float]:
        return 240 + reach * np.sin(np.radians(degrees)), 240 - reach * np.cos(np.radians(degrees))

    def hand(start: tuple[float, float], end: tuple[float, float], wide: int) -> None:
        cv2.line(dial, (int(start[0]), int(start[1])), (int(end[0]), int(end[1])), black, wide, cv2.LINE_AA)

    for i in range(60):
        hand(at(6 * i, 225 * (0.86 if i % 5 else 0.80)), at(6 * i, 225 * 0.93), 2 if i % 5 else 7)
    for hour in range(1, 13):
        dial = tex.draw_text(dial, str(hour), at(30 * hour, 152), 46, "#22262b")
    for turn, reach, wide in ((305.0, 105, 13), (60.0, 165, 9)):
        hand((240, 240), at(turn, reach), wide)
    tex.disc(dial, (240, 240), 14, "#b3271e")
    face = Sheet(0.236, 0.236, facing, np.array([0, -0.019, 0]), elliptic=True)
    wood = tex.wood(rng, 120, 600, 1, "#4a2c1a", "#23130a")
    parts = [Part(case, wood, 0.3, (12, 56)), Part(face, dial, 0.0, (24, 24))]
    return Body("wall clock", ["clock", "round clock"], parts)


def bowl(rng: np.random.Generator, name: str, color: str, filling: list[str] | None = None) -> Body:
    """A bowl. filling: names of FRUITS that lie in it and belong to the same instance."""
    paint = tex.glaze(rng, 360, 640, color, ["#f4efe2", "#1c1c1c"], 260)
    for row in (90, 104, 150):
        paint[row : row + 6] = tex.rgb("#f4efe2" if color != COLORS["white"] else "#31549b")
    shape = lathe("0 0 40 0 44 6 66 30 86 62 88 66 85 66 62 34 40 12 0 10")
    parts = [Part(shape, paint, 0.5, (40, 48))]
    for k, kind in enumerate(filling or []):
        spot = (0.036 * np.cos(2.1 * k), 0.036 * np.sin(2.1 * k), 0.020) if k < 3 else (0, 0, 0.072)
        parts += fruit(rng, kind).placed(40 * k, np.array(spot), 0.85).parts
    return Body(name, ["bowl", "fruit bowl"] if filling else ["bowl"], parts, kind="bowl")


def plate(rng: np.random.Generator, color: str) -> Body:
    """A flat plate with painted rings."""
    paint = tex.glaze(rng, 360, 640, "#ece9df", ["#c9c4b4"], 120)
    for row in (196, 214, 226):
        paint[row : row + 7] = tex.rgb(color)
    shape = lathe("0 0 60 0 115 14 118 17 112 17 65 6 0 6")
    return Body("dinner plate", ["plate", "dinner plate"], [Part(shape, paint, 0.5, (32, 48))])


def bottle(rng: np.random.Generator, name: str, color: str, word: str = "CIDER") -> Body:
    """A bottle with a paper label, which bears the word twice, and a cap."""
    paint = tex.glaze(rng, 640, 480, color, ["#111111", "#ffffff"], 120)
    label = tex.mosaic(rng, 140, 480, ["#d1495b", "#edae49", "#00798c", "#30638e"])
    for x in (120, 360):
        label = tex.draw_text(label, word, (x, 70), 270 // len(word), "#22262b")
    paint[190:330] = label[::-1]  # row 0 is the bottom of a surface of revolution
    paint[570:] = tex.rgb("#b08d2e")
    shape = lathe("0 0 33 0 36 4 36 150 30 178 14 205 13 240 15 241 15 258 0 258")
    return Body(name, ["bottle"], [Part(shape, paint, 0.7, (48, 36))])


def tin(rng: np.random.Generator, name: str, word: str = "TOMATO") -> Body:
    """A food tin with a printed label: a short word three times, a long word once around it."""
    paint = tex.glaze(rng, 420, 560, "#b9bcc0", ["#8b8f94", "#e6e8ea"], 200)
    label = tex.glaze(rng, 220, 560, "#c8302a", ["#e9c46a", "#7c1512"], 160)
    for x in (90, 280, 470):
        tex.disc(label, (x, 80), 46, "#e8e3d2")
        tex.disc(label, (x, 80), 34, "#d3271f")
        if len(word) < 7 or x == 280:
            label = tex.draw_text(label, word, (x, 170), 42 if len(word) < 7 else 800 // len(word), "#fff3cf")
    paint[96:316] = label[::-1]  # row 0 is the bottom of a surface of revolution
    shape = lathe("0 0 37 0 37 108 35 110 34 106 0 106")
    return Body(name, ["tin", "food tin", "can"], [Part(shape, paint, 0.4, (32, 40))])


def carton(rng: np.random.Generator, printed: Printed | None = None) -> Body:
    """A food carton, oats or milk unless told what is printed on its four sides; a long word runs downwards."""
    color, name, word, extent = (
        printed
        or (
            ("#d9782d", "cereal box", "OATS", (0.125, 0.055, 0.19)),
            ("#2d6fb0", "milk carton", "MILK", (0.075, 0.075, 0.18)),
        )[int(rng.integers(2))]
    )
    top = tex.glaze(rng, 120, 200, color, ["#fff3cf"], 40)
    sides = []
    for across in (*extent[:2], *extent[:2]):
        side = tex.mosaic(rng, 560, int(3000 * across), [color, "#fff3cf", "#8f1d14", "#e9c46a"])
        side = 0.45 * side + 0.55 * tex.rgb(color)
        if len(word) < 6:
            sides.append(tex.draw_text(side, word, (1500 * across, 170), int(900 * across), "#fff8e6"))
        else:
            down = tex.draw_text(np.rot90(side), word, (280, 1500 * across), 800 // len(word), "#fff8e6")
            sides.append(np.rot90(down, -1))
    return Body(name, ["carton", "food box"], box_parts(np.array([0, 0, extent[2] / 2]), extent, [top, top, *sides]))


def teddy(rng: np.random.Generator) -> Body:
    """A sitting plush bear."""
    fur, dark = tex.fur(rng, 240, 480, "#b5814b", "#7c5228"), tex.fur(rng, 80, 160, "#3a2716", "#20150b")
    balls = [  # radii and centre in millimetres; the last three, nose and eyes, are dark
        (50, 43, 58, 0, 0, 58), (41, 39, 38, 0, -6, 142), (16, 10, 16, -33, 0, 176), (16, 10, 16, 33, 0, 176),
        (18, 18, 42, -56, -12, 80), (18, 18, 42, 56, -12, 80), (21, 44, 21, -34, -52, 22), (21, 44, 21, 34, -52, 22),
        (17, 14, 14, 0, -43, 134), (6, 5, 5, 0, -57, 139), (5, 5, 5, -15, -40, 154), (5, 5, 5, 15, -40, 154),
    ]  # fmt: skip
    parts = [
        Part(Ellipsoid(row[:3], spin(0), row[3:]), fur if k < 9 else dark, 0.0, (20, 28))
        for k, row in enumerate(np.array(balls) / 1000)
    ]
    return Body("teddy bear", ["plush bear", "stuffed animal", "toy"], parts)
