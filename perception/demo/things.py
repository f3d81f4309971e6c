"""Small household objects built from primitives. Metres; z up; they stand on z = 0."""

from __future__ import annotations

import cv2
import numpy as np

from perception.demo import textures as tex
from perception.demo.light import Body, Part
from perception.demo.shapes import Ellipsoid, Lathe, Sheet, Tube, rotation_from_axes, spin

Place = tuple[float, float]


def _at(place: Place, height: float = 0.0) -> np.ndarray:
    return np.array([*place, height])


def mug(rng: np.random.Generator, name: str, place: Place, turn: float, paint: np.ndarray) -> Body:
    """A mug of coffee: a surface of revolution with a thick rim, and a bent handle at angle `turn` (degrees)."""
    profile = [
        (0.0, 0.0), (0.034, 0.0), (0.040, 0.005), (0.0425, 0.015), (0.0435, 0.092), (0.0425, 0.0965),
        (0.0405, 0.0965), (0.0395, 0.092), (0.039, 0.078), (0.0, 0.078),
    ]  # fmt: skip
    turned = spin(turn)
    cup = Lathe(np.array(profile), turned, _at(place))
    outward, up = turned[:, 0], np.array([0, 0, 1.0])
    handle = Tube(
        0.0295, np.radians(-90), np.radians(90), np.full(9, 0.0064),
        np.stack([outward, up, np.cross(outward, up)], 1), _at(place, 0.05) + 0.0455 * outward,
    )  # fmt: skip
    grip = np.ascontiguousarray(paint[110:150, :60])
    return Body(name, ["mug", "coffee mug"], [Part(cup, paint, 0.5, (40, 48)), Part(handle, grip, 0.5, (12, 32))])


def mug_paint(rng: np.random.Generator, color: str, ink: str, hearts: bool) -> np.ndarray:
    """Texture of a mug: hearts or dots outside, cream colour inside, coffee (the last fifth of the profile)."""
    height, width = 480, 560
    paint = tex.glaze(rng, height, width, color, [ink, "#1c1c1c"], 60)
    for i in range(3 if hearts else 14):
        x, y = int((i + 0.5) * width / (3 if hearts else 14)), (232 if hearts else 195 + 75 * (i % 2))
        if hearts:
            a = np.linspace(0, 2 * np.pi, 60)
            rise = 13 * np.cos(a) - 5 * np.cos(2 * a) - 2 * np.cos(3 * a) - np.cos(4 * a)
            shape = np.stack([x + 2.6 * 16 * np.sin(a) ** 3, y + 3.6 * rise], 1)  # row 0 is the bottom of the profile
            cv2.fillPoly(paint, [shape.astype(np.int32)], tex.rgb(ink).tolist(), cv2.LINE_AA)
        else:
            cv2.ellipse(paint, (x, y), (11, 15), 0, 0, 360, tex.rgb(ink).tolist(), -1, cv2.LINE_AA)
    inside = int(0.73 * height)
    paint[inside:] = tex.glaze(rng, height - inside, width, "#efe6d2", ["#cdbf9f"], 40)
    coffee = int(0.80 * height)
    brown = tex.rgb("#3a1f10") * np.ones((height - coffee, width, 3), np.float32)
    foam = tex.noise(rng, height - coffee, width, (4, 10), 5)
    paint[coffee:] = tex.blend(0.12 * foam + 0.05, brown, tex.rgb("#a8743e"))
    return paint


def vase(
    rng: np.random.Generator, name: str, place: Place, inks: tuple[str, str, str] = ("#1f3f94", "#2f62b8", "#5b8ccf")
) -> Body:
    """A bellied vase with a narrow neck, white with painted bands, dots and leaves."""
    z = np.linspace(0, 1, 22)
    radius = 0.034 + 0.036 * np.exp(-(((z - 0.42) / 0.26) ** 2)) - 0.012 * np.exp(-(((z - 0.86) / 0.13) ** 2))
    radius[-3:] += [0.0015, 0.005, 0.009]
    outer = np.stack([radius, 0.26 * z], 1)
    inner = np.array([(radius[-1] - 0.004, 0.26), (radius[-4] - 0.005, 0.215), (0.05, 0.11), (0.0, 0.1)])
    height, width = 620, 800
    paint = tex.glaze(rng, height, width, "#ebe9e0", ["#c9ccd0", "#b9b3a2"], 260)
    paint = _painted_bands(rng, paint, inks)
    body = Lathe(np.concatenate([[(0.0, 0.0)], outer, inner]), spin(0), _at(place))
    words = ["blue and white vase", "ceramic vase"] if name == "vase" else ["vase", "ceramic vase"]
    return Body(name, words, [Part(body, paint, 0.6, (64, 56))])


def _painted_bands(rng: np.random.Generator, paint: np.ndarray, inks: tuple[str, str, str]) -> np.ndarray:
    height, width = paint.shape[:2]
    ink = [tex.rgb(color) for color in inks]
    for top, thick in ((0.11, 9), (0.135, 4), (0.47, 7), (0.50, 3), (0.61, 8)):
        paint[int(top * height) : int(top * height) + thick] = ink[0]
    for i in range(26):
        x, y = int((i + 0.5) * width / 26), int((0.30 + 0.055 * np.sin(i * 2 * np.pi / 6.5)) * height)
        for leaf in range(int(rng.integers(4, 7))):
            a = float(rng.uniform(0, 360))
            r = int(rng.integers(10, 22))
            tip = int(x + r * np.cos(np.radians(a))), int(y + r * np.sin(np.radians(a)))
            cv2.ellipse(paint, tip, (r // 2 + 3, 4), a, 0, 360, ink[leaf % 3].tolist(), -1, cv2.LINE_AA)
        cv2.circle(paint, (x, y), 5, tex.rgb("#d8b13c").tolist(), -1, cv2.LINE_AA)
    for i in range(40):
        color = ink[int(rng.integers(3))].tolist()
        cv2.circle(paint, (int((i + 0.5) * width / 40), int(0.555 * height)), 5, color, -1, cv2.LINE_AA)
    return paint


def ball(name: str, place: Place, radius: float, paint: np.ndarray, tilt: list[float]) -> Body:
    """A sphere standing on the table. Its pole points along `tilt`."""
    rotation = rotation_from_axes([1, 0.3, 0.1], tilt)
    part = Part(Ellipsoid(np.full(3, radius), rotation, _at(place, radius)), paint, 0.18, (36, 64))
    return Body(name, ["ball"], [part])


def fruit(rng: np.random.Generator, name: str, place: Place, light: str = "#f7921e", dark: str = "#dd6a07") -> Body:
    """A round fruit, slightly flattened."""
    radii = np.array([0.040, 0.040, 0.037])
    shape = Ellipsoid(radii, rotation_from_axes([1, 0, 0.2], [0.25, -0.35, 1]), _at(place, 0.0375))
    paint = tex.peel(rng, 280, 560, light, dark)
    return Body(name, [f"{name} fruit", "fruit"], [Part(shape, paint, 0.25, (32, 56))])


def banana(rng: np.random.Generator, name: str, place: Place, turn: float) -> Body:
    """A banana lying on its side: a tapering bent tube with a stem and brown tips."""
    radii = np.array([0.0045, 0.005, 0.0095, 0.0155, 0.0178, 0.0185, 0.0185, 0.0175, 0.0145, 0.008, 0.004])
    shape = Tube(0.115, np.radians(28), np.radians(137), radii, spin(turn), _at(place, 0.0186), steps=64)
    height, width = 520, 260
    paint = tex.peel(rng, height, width, "#f6d335", "#e2b41d", 9)
    across = np.arange(width) / width
    ridge = np.exp(-((((across * 5) % 1) - 0.5) ** 2) / 0.006)[None] * np.ones((height, 1))
    paint = tex.blend(0.45 * ridge, paint, tex.rgb("#b98f1c"))
    paint = tex.speckle(rng, paint, 150, (1, 5), ["#6b4716", "#8a611d", "#a87d22"])
    v = np.linspace(0, 1, height)[:, None] * np.ones((1, width))
    paint = tex.blend((0.10 - v) / 0.06, paint, tex.rgb("#8d8a3a"))
    paint = tex.blend((v - 0.955) / 0.02, paint, tex.rgb("#33240f"))
    paint = tex.blend((0.018 - v) / 0.01, paint, tex.rgb("#33240f"))
    return Body(name, ["yellow banana", "fruit"], [Part(shape, paint, 0.1, (48, 20))])


def box_parts(
    center: np.ndarray, extent: tuple[float, float, float], rotation: np.ndarray, paints: list[np.ndarray],
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
        local = rotation_from_axes(along, normal)
        origin = center + rotation @ (np.array(normal) * depth / 2)
        shape = Sheet(width, height, rotation @ local, origin)
        parts.append(Part(shape, paints[i % len(paints)], 0.0, texels, casts))
    return parts


GREEN_BOOK = ["#0d4f4a", "#1c8a78", "#2a9a7d", "#166b5d", "#0f4c46", "#0a3330"]
"""Book cover colours: sky, horizon, then hills; the last colour is the binding."""


def book(
    rng: np.random.Generator, name: str, place: Place, turn: float, colors: list[str] = GREEN_BOOK,
    title: tuple[str, str, str] = ("FIELD GUIDE", "BIRDS", "OF THE NORTH"),
) -> Body:  # fmt: skip
    """A thick hardback book lying flat, with the title up."""
    width, depth, thick = 0.150, 0.205, 0.036
    cover = tex.landscape(rng, 560, 410, colors[:2], colors[2:], title[0])
    cover = tex.draw_text(cover, title[1], (205, 320), 88, "#fff3cf")
    cover = tex.draw_text(cover, title[2], (205, 385), 34, "#f2d98a")
    spine = tex.glaze(rng, 100, 560, colors[0], [colors[1]], 200)
    spine = tex.draw_text(spine, " ".join(title[1:]), (280, 50), 38, "#f2d98a")
    lines = tex.noise(rng, 100, 560, (50, 3), 2)
    pages = tex.blend(0.35 + 0.25 * lines, tex.rgb("#f1e8d2") * np.ones((100, 560, 3), np.float32), tex.rgb("#a8946a"))
    for edge in (slice(0, 8), slice(-8, None)):
        pages[edge] = tex.rgb(colors[-1])
    parts = box_parts(
        _at(place, thick / 2), (width, depth, thick), spin(turn), [cover, spine, pages, pages, pages, spine]
    )
    return Body(name, ["green book", "hardback book"] if name == "book" else ["book", "hardback book"], parts)


def cactus(rng: np.random.Generator, name: str, place: Place) -> Body:
    """A ribbed cactus with two arms in a terracotta pot."""
    profile = [
        (0.0, 0.0), (0.034, 0.0), (0.046, 0.062), (0.051, 0.063), (0.053, 0.085), (0.048, 0.086),
        (0.046, 0.074), (0.0, 0.073),
    ]  # fmt: skip
    pot = Lathe(np.array(profile), spin(0), _at(place))
    clay = tex.blend(
        0.4 + 0.25 * tex.noise(rng, 360, 560, (8, 12), 5),
        tex.rgb("#c76b3f") * np.ones((360, 560, 3), np.float32),
        tex.rgb("#9a4a29"),
    )
    clay[250:] = tex.speckle(
        rng,
        tex.rgb("#3b2a1d") * np.ones((110, 560, 3), np.float32),
        900,
        (1, 4),
        ["#6d5137", "#1f150e", "#8d7454"],
    )
    stem = Ellipsoid(np.array([0.027, 0.027, 0.075]), spin(20), _at(place, 0.128))
    parts = [Part(pot, clay, 0.0, (32, 40)), Part(stem, _ribs(rng, 400, 460, 13), 0.0, (32, 52))]
    for side, height, size in ((15.0, 0.135, 0.026), (195.0, 0.115, 0.024)):
        outward = spin(side)[:, 0]
        axes = np.stack([outward, np.array([0, 0, 1.0]), np.cross(outward, [0, 0, 1.0])], 1)
        # An arm bends by 90 degrees: out of the stem sideways, then upwards.
        origin = _at(place, height + size) + 0.028 * outward
        radii = np.array([0.009, 0.011, 0.0115, 0.0115, 0.011])
        bend = Tube(size, np.radians(-100), np.radians(20), radii, axes, origin)
        parts.append(Part(bend, _ribs(rng, 160, 160, 7), 0.0, (20, 24)))
    return Body(name, ["potted cactus", "flowerpot"], parts)


def _ribs(rng: np.random.Generator, height: int, width: int, count: int) -> np.ndarray:
    """Cactus texture: light ribs with pale spines, dark valleys."""
    u = (np.arange(width) + 0.5) / width * count
    ridge = (0.5 + 0.5 * np.cos(2 * np.pi * u))[None] * np.ones((height, 1))
    skin = tex.blend(ridge + 0.12 * tex.noise(rng, height, width, (8, 8), 4), tex.rgb("#1f4a26"), tex.rgb("#5f9a4a"))
    rows = np.arange(6, height - 4, 13)
    for k in range(count):
        for y in rows + int(rng.integers(0, 7)):
            x = round(k * width / count)
            skin[y - 1 : y + 2, max(x - 2, 0) : x + 3] = tex.rgb("#efe6c0")
    return skin.astype(np.float32)


def clock(rng: np.random.Generator, name: str, center: np.ndarray) -> Body:
    """A wall clock facing -y: a black case (surface of revolution) and a white dial that shows 10:10."""
    facing = rotation_from_axes([1, 0, 0], [0, -1, 0])
    case = Lathe(np.array([(0.132, 0.0), (0.135, 0.02), (0.128, 0.03), (0.120, 0.029), (0.117, 0.018)]), facing, center)
    dial = tex.glaze(rng, 480, 480, "#f3f1ea", ["#dedacd", "#c8c4b8"], 120)
    for i in range(60):
        a = np.radians(6 * i)
        inner = 0.86 if i % 5 else 0.80
        ends = [(int(240 + 225 * r * np.sin(a)), int(240 - 225 * r * np.cos(a))) for r in (inner, 0.93)]
        cv2.line(dial, ends[0], ends[1], tex.rgb("#22262b").tolist(), 2 if i % 5 else 7, cv2.LINE_AA)
    for hour in range(1, 13):
        a = np.radians(30 * hour)
        dial = tex.draw_text(dial, str(hour), (240 + 152 * np.sin(a), 240 - 152 * np.cos(a)), 46, "#22262b")
    for turn, reach, wide in ((305.0, 105, 13), (60.0, 165, 9)):
        a = np.radians(turn)
        tip = (int(240 + reach * np.sin(a)), int(240 - reach * np.cos(a)))
        cv2.line(dial, (240, 240), tip, tex.rgb("#22262b").tolist(), wide, cv2.LINE_AA)
    cv2.circle(dial, (240, 240), 14, tex.rgb("#b3271e").tolist(), -1, cv2.LINE_AA)
    face = Sheet(0.236, 0.236, facing, center + np.array([0, -0.019, 0]), elliptic=True)
    wood = tex.wood(rng, 120, 600, 1, "#4a2c1a", "#23130a")
    parts = [Part(case, wood, 0.3, (12, 56)), Part(face, dial, 0.0, (24, 24))]
    return Body(name, ["clock", "round clock"], parts)


def _binding(dark: str, light: str) -> list[str]:
    """Cover colours in the layout of GREEN_BOOK, interpolated between two colours."""
    shares = (0.0, 0.7, 1.0, 0.6, 0.3, -0.2)
    return [tex.rgb_code(tex.rgb(dark) * (1 - share) + tex.rgb(light) * share) for share in shares]


COLORS = {
    "red": "#c3161c", "blue": "#1c4fb5", "green": "#2c7a3f", "yellow": "#e3b81d", "white": "#e9e6dc",
    "black": "#26262a", "purple": "#6b3a8c", "pink": "#d97a9c",
}  # fmt: skip
FRUITS = {
    "orange": ("#f7921e", "#dd6a07"),
    "lemon": ("#f5dd3f", "#dcb71f"),
    "lime": ("#8fc23c", "#5d8f24"),
    "red apple": ("#c8202b", "#8e1320"),
    "green apple": ("#a8c84a", "#7fa32e"),
}
BOOKS = {
    "green book": (GREEN_BOOK, ("FIELD GUIDE", "BIRDS", "OF THE NORTH")),
    "blue book": (_binding("#0e2a5c", "#3d76c9"), ("ATLAS", "OCEANS", "AND ISLANDS")),
    "red book": (_binding("#6e1016", "#c9474a"), ("A NOVEL", "EMBERS", "OF AUTUMN")),
    "yellow book": (_binding("#b07d10", "#f0cf55"), ("COOKING", "BREAD", "AND SALT")),
}


def colored_mug(rng: np.random.Generator, color: str) -> Body:
    """A mug of one of COLORS, with hearts or dots."""
    ink = "#1d2f66" if color in ("white", "yellow", "pink") else "#f6efe0"
    paint = mug_paint(rng, COLORS[color], ink, hearts=bool(rng.integers(2)))
    return mug(rng, f"{color} mug", (0, 0), 0, paint)


def colored_fruit(rng: np.random.Generator, name: str) -> Body:
    """One of FRUITS."""
    return fruit(rng, name, (0, 0), *FRUITS[name])


def named_book(rng: np.random.Generator, name: str) -> Body:
    """One of BOOKS."""
    return book(rng, name, (0, 0), 0, *BOOKS[name])


def named_vase(rng: np.random.Generator) -> Body:
    """A white vase painted in blue, red or green."""
    inks = {
        "blue": ("#1f3f94", "#2f62b8", "#5b8ccf"),
        "red": ("#8e1d22", "#b8332f", "#cf6a5b"),
        "green": ("#1f6b3a", "#2f9457", "#5bbf83"),
    }
    color = str(rng.choice(list(inks)))
    return vase(rng, f"{color} vase", (0, 0), inks[color])


def bowl(rng: np.random.Generator, name: str, color: str, filling: list[str] | None = None) -> Body:
    """A bowl. filling: names of FRUITS that lie in it and belong to the same instance."""
    profile = [
        (0.0, 0.0), (0.040, 0.0), (0.044, 0.006), (0.066, 0.030), (0.086, 0.062), (0.088, 0.066),
        (0.085, 0.066), (0.062, 0.034), (0.040, 0.012), (0.0, 0.010),
    ]  # fmt: skip
    paint = tex.glaze(rng, 360, 640, color, ["#f4efe2", "#1c1c1c"], 260)
    for row in (90, 104, 150):
        paint[row : row + 6] = tex.rgb("#f4efe2") if color != COLORS["white"] else tex.rgb("#31549b")
    parts = [Part(Lathe(np.array(profile)), paint, 0.5, (40, 48))]
    for k, kind in enumerate(filling or []):
        spot = (0.036 * np.cos(2.1 * k), 0.036 * np.sin(2.1 * k)) if k < 3 else (0.0, 0.0)
        lift = np.array([0, 0, 0.020 if k < 3 else 0.072])
        parts += colored_fruit(rng, kind).placed(40 * k, np.array([*spot, 0.0]) + lift, 0.85).parts
    return Body(name, ["bowl", "fruit bowl"] if filling else ["bowl"], parts, kind="bowl")


def plate(rng: np.random.Generator, name: str, color: str) -> Body:
    """A flat plate with painted rings."""
    profile = [(0.0, 0.0), (0.060, 0.0), (0.115, 0.014), (0.118, 0.017), (0.112, 0.017), (0.065, 0.006), (0.0, 0.006)]
    paint = tex.glaze(rng, 360, 640, "#ece9df", ["#c9c4b4"], 120)
    for row in (196, 214, 226):
        paint[row : row + 7] = tex.rgb(color)
    return Body(name, ["plate", "dinner plate"], [Part(Lathe(np.array(profile)), paint, 0.5, (32, 48))])


def bottle(rng: np.random.Generator, name: str, color: str) -> Body:
    """A bottle with a paper label and a cap."""
    profile = [
        (0.0, 0.0), (0.033, 0.0), (0.036, 0.004), (0.036, 0.150), (0.030, 0.178), (0.014, 0.205), (0.013, 0.240),
        (0.015, 0.241), (0.015, 0.258), (0.0, 0.258),
    ]  # fmt: skip
    paint = tex.glaze(rng, 640, 480, color, ["#111111", "#ffffff"], 120)
    label = tex.mosaic(rng, 140, 480, ["#d1495b", "#edae49", "#00798c", "#30638e"])
    for x in (120, 360):
        label = tex.draw_text(label, "CIDER", (x, 70), 54, "#22262b")
    paint[190:330] = label[::-1]  # row 0 is the bottom of a surface of revolution
    paint[570:] = tex.rgb("#b08d2e")
    return Body(name, ["bottle"], [Part(Lathe(np.array(profile)), paint, 0.7, (48, 36))])


def tin(rng: np.random.Generator, name: str) -> Body:
    """A food tin with a printed label."""
    profile = [(0.0, 0.0), (0.037, 0.0), (0.037, 0.108), (0.035, 0.110), (0.034, 0.106), (0.0, 0.106)]
    paint = tex.glaze(rng, 420, 560, "#b9bcc0", ["#8b8f94", "#e6e8ea"], 200)
    label = tex.glaze(rng, 220, 560, "#c8302a", ["#e9c46a", "#7c1512"], 160)
    for x in (90, 280, 470):
        cv2.circle(label, (x, 80), 46, tex.rgb("#e8e3d2").tolist(), -1, cv2.LINE_AA)
        cv2.circle(label, (x, 80), 34, tex.rgb("#d3271f").tolist(), -1, cv2.LINE_AA)
        label = tex.draw_text(label, "TOMATO", (x, 170), 42, "#fff3cf")
    paint[96:316] = label[::-1]  # row 0 is the bottom of a surface of revolution
    return Body(name, ["tin", "food tin", "can"], [Part(Lathe(np.array(profile)), paint, 0.4, (32, 40))])


def carton(rng: np.random.Generator) -> Body:
    """A food carton, printed on its four sides."""
    color, name, word = [("#d9782d", "cereal box", "OATS"), ("#2d6fb0", "milk carton", "MILK")][int(rng.integers(2))]
    width, depth, height = (0.125, 0.055, 0.19) if name == "cereal box" else (0.075, 0.075, 0.18)
    top = tex.glaze(rng, 120, 200, color, ["#fff3cf"], 40)
    sides = []
    for across in (width, depth, width, depth):
        side = tex.mosaic(rng, 560, int(3000 * across), [color, "#fff3cf", "#8f1d14", "#e9c46a"])
        side = 0.45 * side + 0.55 * tex.rgb(color)
        sides.append(tex.draw_text(side, word, (1500 * across, 170), int(900 * across), "#fff8e6"))
    parts = box_parts(np.array([0, 0, height / 2]), (width, depth, height), np.eye(3), [top, top, *sides])
    return Body(name, ["carton", "food box"], parts)


def teddy(rng: np.random.Generator, name: str) -> Body:
    """A sitting plush bear."""
    fur = tex.fur(rng, 240, 480, "#b5814b", "#7c5228")
    dark = tex.fur(rng, 80, 160, "#3a2716", "#20150b")
    balls = [  # radii, centre, paint
        ((0.050, 0.043, 0.058), (0, 0, 0.058), fur), ((0.041, 0.039, 0.038), (0, -0.006, 0.142), fur),
        ((0.016, 0.010, 0.016), (-0.033, 0, 0.176), fur), ((0.016, 0.010, 0.016), (0.033, 0, 0.176), fur),
        ((0.018, 0.018, 0.042), (-0.056, -0.012, 0.080), fur), ((0.018, 0.018, 0.042), (0.056, -0.012, 0.080), fur),
        ((0.021, 0.044, 0.021), (-0.034, -0.052, 0.022), fur), ((0.021, 0.044, 0.021), (0.034, -0.052, 0.022), fur),
        ((0.017, 0.014, 0.014), (0, -0.043, 0.134), fur), ((0.006, 0.005, 0.005), (0, -0.057, 0.139), dark),
        ((0.005, 0.005, 0.005), (-0.015, -0.040, 0.154), dark), ((0.005, 0.005, 0.005), (0.015, -0.040, 0.154), dark),
    ]  # fmt: skip
    parts = [Part(Ellipsoid(np.array(r), spin(0), np.array(c, float)), paint, 0.0, (20, 28)) for r, c, paint in balls]
    return Body(name, ["plush bear", "stuffed animal", "toy"], parts)
