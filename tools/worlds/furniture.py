"""Furniture built from primitives, centred on the origin: metres, z up, standing on z = 0, front towards -y."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from worlds import textures as tex
from worlds.light import Body, Part
from worlds.shapes import Box, Ellipsoid, Lathe, Tube, rotation_from_axes, spin
from worlds.things import lathe

PIXELS = 260  # pixels per metre of a box's texture
WOODS = {
    "oak": ("#c9925a", "#7d4a24"),
    "walnut": ("#7a4f30", "#3d2415"),
    "pine": ("#dfb985", "#a97a45"),
    "white": ("#e2ddd2", "#b8b0a2"),
}
CLOTHS = {
    "grey": "#8a8c90", "blue": "#34568f", "green": "#4f7a52", "red": "#a13a38", "beige": "#bfa987", "brown": "#6f4c34",
}  # fmt: skip
Point = Sequence[float]


def wood(rng: np.random.Generator, kind: str) -> np.ndarray:
    """A texture of one of WOODS. The grain runs along the width."""
    return tex.wood(rng, 260, 720, 2, *WOODS[kind])


def block(
    rng: np.random.Generator,
    extent: Point,
    center: Point,
    tile: np.ndarray,
    gloss: float = 0.0,
    front: np.ndarray | None = None,
    top: np.ndarray | None = None,
    turn: np.ndarray | None = None,
) -> Part:
    """A box with a material texture [h, w, 3]. front, top: images for its faces towards -y and +z."""
    shape = Box(np.array(extent, float), np.eye(3) if turn is None else turn, np.array(center, float))
    sizes = np.clip(np.round(shape.face_sizes() * PIXELS).astype(int), 12, 560)
    width, height = sizes.max(0)
    if front is not None or top is not None:
        width, height = max(width, 320), max(height, 320)
    faces = [tex.crop(rng, tile, h, w) for w, h in sizes]
    faces[2] = faces[2] if front is None else front
    faces[0] = faces[0] if top is None else top
    strips = [cv2.resize(face, (int(width), int(height)), interpolation=cv2.INTER_AREA) for face in faces]
    texels = int(np.clip(max(extent) / 0.06, 6, 22))
    return Part(shape, np.concatenate(strips).astype(np.float32), gloss, (6 * texels, texels))


def blocks(rng: np.random.Generator, tile: np.ndarray, *rows: Point) -> list[Part]:
    """Boxes of one material. rows: extent (x, y, z) and centre (x, y, z) of each."""
    return [block(rng, row[:3], row[3:], tile) for row in rows]


def four_legs(
    rng: np.random.Generator, width: float, depth: float, height: float, thick: float, tile: np.ndarray
) -> list[Part]:
    """Four legs at the corners of a rectangle centred on the origin."""
    x, y = width / 2 - thick / 2, depth / 2 - thick / 2
    rows = [(thick, thick, height, sx * x, sy * y, height / 2) for sx in (-1, 1) for sy in (-1, 1)]
    return blocks(rng, tile, *rows)


def table(
    rng: np.random.Generator, name: str, extent: Point, kind: str, prompts: list[str], shelf: bool = False
) -> Body:
    """A table of size (width, depth, height) with four legs. shelf: adds a board below the top."""
    width, depth, height = extent
    tile = wood(rng, kind)
    parts = [block(rng, (width, depth, 0.035), (0, 0, height - 0.0175), tile, 0.1)]
    parts += four_legs(rng, width - 0.06, depth - 0.06, height - 0.035, 0.055, tile)
    aprons = [(width - 0.12, 0.02, 0.08, 0, side * (depth / 2 - 0.06), height - 0.075) for side in (-1, 1)]
    parts += blocks(rng, tile, *aprons, *([(width - 0.12, depth - 0.12, 0.02, 0, 0, 0.16)] if shelf else []))
    return Body(name, prompts, parts, kind="table")


def chair(rng: np.random.Generator, name: str, kind: str, cloth: str) -> Body:
    """A dining chair with an upholstered seat and a slatted back. The back is at +y."""
    tile, seat = wood(rng, kind), tex.fabric(rng, 200, 300, CLOTHS[cloth])
    back = [(0.035, 0.03, 0.47, x, 0.2, 0.69) for x in (-0.19, 0.19)]
    back += [(0.36, 0.02, 0.07, 0, 0.2, z) for z in (0.62, 0.75, 0.88)]
    parts = blocks(rng, seat, (0.43, 0.43, 0.05, 0, 0, 0.445))
    parts += four_legs(rng, 0.42, 0.42, 0.42, 0.04, tile) + blocks(rng, tile, *back)
    return Body(name, ["chair", f"{kind} chair", "wooden chair", "dining chair"], parts, kind="chair")


def sofa(rng: np.random.Generator, name: str, width: float, cloth: str, seats: int) -> Body:
    """A sofa. With one seat it is an armchair."""
    tile = tex.fabric(rng, 420, 760, CLOTHS[cloth])
    seam = tex.fabric(rng, 300, 300, tex.rgb_code(0.9 * tex.rgb(CLOTHS[cloth])))
    depth, inner = 0.86, width - 0.36
    parts = blocks(
        rng, tile, (width, depth, 0.28, 0, 0, 0.22), (width, 0.22, 0.52, 0, depth / 2 - 0.11, 0.60),
        *((0.18, depth - 0.02, 0.30, s * (width / 2 - 0.09), -0.02, 0.47) for s in (-1, 1)),
    ) + four_legs(rng, width - 0.1, depth - 0.1, 0.08, 0.05, wood(rng, "walnut"))  # fmt: skip
    across = inner / seats - 0.02
    for x in ((k + 0.5) / seats * inner - inner / 2 for k in range(seats)):
        cushions = (across, depth - 0.26, 0.13, x, -0.10, 0.425), (across, 0.13, 0.36, x, depth / 2 - 0.28, 0.66)
        parts += blocks(rng, seam, *cushions)
    words = ["sofa", "couch"] if seats > 1 else ["armchair"]
    return Body(name, [*words, f"{cloth} {words[0]}"], parts, kind=words[0])


def cushion(rng: np.random.Generator, name: str, color: str) -> Body:
    """A pillow tilted backwards, with its lower edge on z = 0."""
    cloth = tex.fabric(rng, 260, 520, color, ["#f4efe2", "#22303c", "#e9c46a"])
    lean = rotation_from_axes([1, 0, 0], [0, 0.35, 1])
    pillow = Part(Ellipsoid(np.array([0.21, 0.075, 0.19]), lean, np.array([0, 0, 0.18])), cloth, 0.0, (24, 36))
    return Body(name, ["cushion", "pillow"], [pillow], kind="cushion")


def bookcase(rng: np.random.Generator, name: str, kind: str, width: float, height: float) -> Body:
    """Shelves with rows of books. The books belong to the same instance."""
    tile, depth, board = wood(rng, kind), 0.30, 0.022
    count = round(height / 0.36)
    pitch, inner = (height - board) / count, width - 2 * board
    rows = [(board, depth, height, s * (width - board) / 2, 0, height / 2) for s in (-1, 1)]
    rows += [(inner, depth, board, 0, 0, board / 2 + k * pitch) for k in range(count + 1)]
    parts = blocks(rng, tile, *rows, (inner, 0.01, height, 0, depth / 2 - 0.005, height / 2))
    pages = tex.fabric(rng, 120, 300, "#d8cdb2")
    for k in range(count):
        left, full = -inner / 2, rng.uniform(0.55, 0.97) * inner
        while left < -inner / 2 + full - 0.1:
            across, tall = min(rng.uniform(0.18, 0.45), -inner / 2 + full - left), rng.uniform(0.55, 0.82) * pitch
            spines = tex.spines(rng, int(700 * tall), int(700 * across), 22)
            center = (left + across / 2, rng.uniform(-0.03, 0.02), board + k * pitch + tall / 2)
            parts.append(block(rng, (across, 0.2, tall), center, pages, front=spines))
            left += across + 0.004
    return Body(name, ["bookshelf", "shelf with books", "bookcase full of books"], parts, kind="bookcase")


def cabinet(rng: np.random.Generator, name: str, kind: str, extent: Point, prompts: list[str], doors: int) -> Body:
    """A closed cabinet on short feet, with `doors` doors and handles on its front."""
    width, depth, height = extent
    tile = wood(rng, kind)
    front = tex.crop(rng, tile, 420, max(421, int(420 * width / height))).copy()
    for k in range(doors):
        a, b = (int((k + s) / doors * front.shape[1]) for s in (0, 1))
        cv2.rectangle(front, (a + 6, 8), (b - 6, 410), (tex.rgb(WOODS[kind][1]) * 0.6).tolist(), 4)
        x = b - 34 if k % 2 == 0 else a + 34
        cv2.line(front, (x, 170), (x, 250), tex.rgb("#c7c4bb").tolist(), 9, cv2.LINE_AA)
    parts = [block(rng, (width, depth, height - 0.06), (0, 0, height / 2 + 0.03), tile, 0.1, front=front)]
    return Body(name, prompts, parts + four_legs(rng, width - 0.06, depth - 0.06, 0.06, 0.05, tile), kind="cabinet")


def television(rng: np.random.Generator, name: str) -> Body:
    """A flat screen on a foot."""
    shell = tex.fabric(rng, 200, 300, "#1d1e21")
    y, x = np.mgrid[:360, :640] / 360
    glow = 0.09 + 0.10 * np.clip(1 - np.hypot(x - 1.3, y - 0.2), 0, 1) + 0.01 * tex.noise(rng, 360, 640, (6, 9), 4)
    screen = np.repeat(glow[..., None], 3, -1).astype(np.float32) * [0.9, 1.0, 1.15]
    cv2.rectangle(screen, (0, 0), (639, 359), (0.05, 0.05, 0.05), 12)
    parts = [block(rng, (1.02, 0.035, 0.60), (0, 0, 0.37), shell, 0.3, front=screen.astype(np.float32))]
    parts += blocks(rng, shell, (0.06, 0.03, 0.09, 0, 0, 0.05), (0.40, 0.20, 0.015, 0, 0, 0.0075))
    return Body(name, ["tv", "flat screen"], parts, kind="television")


def laptop(rng: np.random.Generator, name: str) -> Body:
    """An open laptop. The screen faces -y."""
    shell = tex.fabric(rng, 200, 300, "#9fa3a8")
    keys = np.ascontiguousarray(tex.fabric(rng, 240, 340, "#9fa3a8"))
    for y in range(24, 144, 24):
        for x in range(16, 328, 24):
            cv2.rectangle(keys, (x, y), (x + 19, y + 18), tex.rgb("#26282c").tolist(), -1)
    cv2.rectangle(keys, (120, 165), (220, 225), tex.rgb("#7f8388").tolist(), -1)
    picture = tex.landscape(rng, 320, 480, ["#355c9c", "#9fc1e8"], ["#2d6b4f", "#1f4f3c", "#173a2d"], "")
    lid = rotation_from_axes([1, 0, 0], [0, 0.28, 1])
    parts = [
        block(rng, (0.34, 0.24, 0.016), (0, 0, 0.008), shell, 0.2, top=keys),
        block(rng, (0.34, 0.010, 0.22), (0, 0.15, 0.118), shell, 0.2, front=picture, turn=lid),
    ]
    return Body(name, ["notebook computer", "computer"], parts, kind="laptop")


def floor_lamp(rng: np.random.Generator, name: str, color: str) -> Body:
    """A standing lamp with a cloth shade."""
    metal = tex.glaze(rng, 300, 200, "#3a3a3d", ["#77777c"], 80)
    parts = [
        Part(lathe("0 0 150 0 150 20 30 35 13 60 13 1420 0 1420"), metal, 0.3, (40, 16)),
        Part(lathe("210 1280 215 1280 120 1600 115 1600"), tex.fabric(rng, 200, 600, color), 0.0, (16, 32)),
    ]
    return Body(name, ["lamp", "standing lamp"], parts, kind="lamp")


def desk_lamp(rng: np.random.Generator, name: str, color: str) -> Body:
    """A lamp with a bent arm and a conical shade."""
    paint = tex.glaze(rng, 240, 240, color, ["#ffffff", "#222222"], 60)
    upright = np.array([[0, 0, -1.0], [-1.0, 0, 0], [0, 1.0, 0]])
    arm = Tube(0.11, np.radians(10), np.radians(175), np.full(9, 0.009), upright, np.array([0, -0.11, 0.24]))
    tilt = rotation_from_axes([1, 0, 0], [0, 0.35, 1])
    shade = Lathe(lathe("75 0 78 0 30 90 0 100").profile, tilt, np.array([0, -0.235, 0.17]))
    parts = [
        Part(lathe("0 0 85 0 85 12 15 22 10 50 10 240 0 240"), paint, 0.4, (24, 24)),
        Part(arm, paint, 0.4, (10, 24)),
        Part(shade, paint, 0.4, (16, 24)),
    ]
    return Body(name, ["lamp", f"{name.split()[0]} lamp", "desk lamp"], parts, kind="lamp")


def plant(rng: np.random.Generator, name: str, leaves: int = 15) -> Body:
    """A pot with long arching leaves."""
    clay = tex.fabric(rng, 300, 500, str(rng.choice(["#b5623a", "#d8d2c4", "#5a6f86"])))
    clay[235:] = tex.rgb("#2e2118") * (1 + 0.2 * tex.noise(rng, 65, 500, (12, 60), 3))[..., None]
    pot = lathe("0 0 110 0 150 240 160 250 165 290 150 290 145 260 0 260")
    parts = [Part(pot, np.clip(clay, 0, 1), 0.1, (24, 32))]
    for k in range(leaves):
        side = spin(360 * k / leaves + rng.uniform(-14, 14))[:, 0]
        bend, up = rng.uniform(0.28, 0.52), np.array([0, 0, 1.0])
        axes = np.stack([-side, up, np.cross(-side, up)], 1)
        origin = np.array([0, 0, 0.24]) + (bend + 0.02) * side
        skin = tex.fur(rng, 200, 100, str(rng.choice(["#4f8a3f", "#5f9a4a", "#3f7a3a"])), "#1f4a26")
        radii = np.array([0.008, 0.014, 0.021, 0.024, 0.023, 0.018, 0.010, 0.003])
        shape = Tube(bend, np.radians(4), np.radians(rng.uniform(80, 135)), radii, axes, origin, steps=36)
        parts.append(Part(shape, skin, 0.1, (16, 10)))
    return Body(name, ["plant", "house plant", "potted plant"], parts, kind="plant")


def picture(rng: np.random.Generator, name: str, art: np.ndarray, width: float, frame: str) -> Body:
    """A framed picture. Its back is at y = 0 and its centre at z = 0."""
    height = width * art.shape[0] / art.shape[1]
    border = max(14, art.shape[1] // 26)
    front = np.broadcast_to(tex.rgb(WOODS[frame][1]), (art.shape[0] + 2 * border, art.shape[1] + 2 * border, 3)).copy()
    front[border:-border, border:-border] = art
    part = block(rng, (width, 0.03, height), (0, -0.015, 0), wood(rng, frame), front=front)
    return Body(name, ["picture", "framed picture", "picture on the wall"], [part], kind="picture")


def rug(rng: np.random.Generator, name: str, width: float, depth: float, colors: list[str]) -> Body:
    """A rug on the floor."""
    woven = tex.rug(rng, int(300 * depth), int(300 * width), colors)
    part = block(rng, (width, depth, 0.012), (0, 0, 0.006), tex.fabric(rng, 200, 300, colors[0]), top=woven)
    part.light_texels = (6 * 40, 40)
    return Body(name, ["rug", "carpet"], [part], kind="rug")


def cardboard(rng: np.random.Generator, name: str, extent: Point) -> Body:
    """A closed carton with tape over its top."""
    tile = tex.fabric(rng, 300, 400, "#b08a5c")
    top, front = (np.ascontiguousarray(tex.crop(rng, tile, 240, 320)) for _ in range(2))
    top[108:132] = tex.rgb("#cdb78d")
    front = tex.draw_text(front, str(rng.choice(["FRAGILE", "BOOKS", "KITCHEN"])), (160, 110), 52, "#4a3520")
    return Body(
        name, ["box", "brown box"], [block(rng, extent, (0, 0, extent[2] / 2), tile, front=front, top=top)], kind="box"
    )


def speaker(rng: np.random.Generator, name: str) -> Body:
    """A loudspeaker."""
    tile = tex.fabric(rng, 200, 300, "#26262a")
    front = np.ascontiguousarray(tex.crop(rng, tile, 320, 321))
    for y, r in ((95, 52), (225, 82)):
        for radius, color in ((r, "#111113"), (r - 10, "#4a4a50"), (r // 3, "#17171a")):
            tex.disc(front, (160, y), (int(1.5 * radius), radius), color)
    return Body(name, ["loudspeaker"], [block(rng, (0.2, 0.22, 0.34), (0, 0, 0.17), tile, front=front)], kind="speaker")


TURNED = {  # name: profile, further prompts
    "waste bin": ("0 0 120 0 150 320 155 330 148 330 115 20 0 20", ["bin", "waste paper basket"]),
    "wooden stool": ("0 0 140 0 150 20 40 50 30 380 170 410 170 450 0 460", ["stool"]),
}


def turned(name: str, paint: np.ndarray) -> Body:
    """One of TURNED: a single surface of revolution."""
    profile, words = TURNED[name]
    return Body(name, words, [Part(lathe(profile), paint, 0.2, (24, 36))])


def door(rng: np.random.Generator, name: str, kind: str) -> Body:
    """A panelled door with its back at y = 0."""
    front = np.ascontiguousarray(tex.crop(rng, wood(rng, kind), 820, 360))
    for x, y, w, h in ((40, 50, 120, 300), (200, 50, 120, 300), (40, 430, 120, 330), (200, 430, 120, 330)):
        cv2.rectangle(front, (x, y), (x + w, y + h), (tex.rgb(WOODS[kind][1]) * 0.75).tolist(), 6)
    tex.disc(front, (334, 410), 13, "#c8a642")
    part = block(rng, (0.88, 0.04, 2.02), (0, -0.02, 1.01), wood(rng, kind), 0.1, front=front)
    return Body(name, ["door", "room door"], [part], is_stuff=True, kind="door")
