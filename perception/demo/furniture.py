"""Furniture built from primitives, centred on the origin: metres, z up, standing on z = 0, front towards -y."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import cv2
import numpy as np

from perception.demo import textures as tex
from perception.demo.light import Body, Part
from perception.demo.shapes import Box, Ellipsoid, Lathe, Tube, rotation_from_axes, spin

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


def four_legs(
    rng: np.random.Generator, width: float, depth: float, height: float, thick: float, tile: np.ndarray
) -> list[Part]:
    """Four legs at the corners of a rectangle centred on the origin."""
    x, y = width / 2 - thick / 2, depth / 2 - thick / 2
    places = [(sx * x, sy * y, height / 2) for sx in (-1, 1) for sy in (-1, 1)]
    return [block(rng, (thick, thick, height), place, tile) for place in places]


def table(
    rng: np.random.Generator, name: str, extent: Point, kind: str, prompts: list[str], shelf: bool = False
) -> Body:
    """A table of size (width, depth, height) with four legs. shelf: adds a board below the top."""
    width, depth, height = extent
    tile = wood(rng, kind)
    parts = [block(rng, (width, depth, 0.035), (0, 0, height - 0.0175), tile, 0.1)]
    parts += four_legs(rng, width - 0.06, depth - 0.06, height - 0.035, 0.055, tile)
    apron = (0, height - 0.075)
    parts += [
        block(rng, (width - 0.12, 0.02, 0.08), (0, side * (depth / 2 - 0.06), apron[1]), tile) for side in (-1, 1)
    ]
    if shelf:
        parts.append(block(rng, (width - 0.12, depth - 0.12, 0.02), (0, 0, 0.16), tile))
    return Body(name, prompts, parts, kind="table")


def chair(rng: np.random.Generator, name: str, kind: str, cloth: str) -> Body:
    """A dining chair with an upholstered seat and a slatted back. The back is at +y."""
    tile, seat = wood(rng, kind), tex.fabric(rng, 200, 300, CLOTHS[cloth])
    parts = [
        block(rng, (0.43, 0.43, 0.05), (0, 0, 0.445), seat),
        *four_legs(rng, 0.42, 0.42, 0.42, 0.04, tile),
        *(block(rng, (0.035, 0.03, 0.47), (x, 0.2, 0.69), tile) for x in (-0.19, 0.19)),
        *(block(rng, (0.36, 0.02, 0.07), (0, 0.2, z), tile) for z in (0.62, 0.75, 0.88)),
    ]
    return Body(name, ["chair", f"{kind} chair", "wooden chair", "dining chair"], parts, kind="chair")


def sofa(rng: np.random.Generator, name: str, width: float, cloth: str, seats: int) -> Body:
    """A sofa. With one seat it is an armchair."""
    tile = tex.fabric(rng, 420, 760, CLOTHS[cloth])
    seam = tex.fabric(rng, 300, 300, tex.rgb_code(0.9 * tex.rgb(CLOTHS[cloth])))
    depth, inner = 0.86, width - 0.36
    parts = [
        block(rng, (width, depth, 0.28), (0, 0, 0.22), tile),
        block(rng, (width, 0.22, 0.52), (0, depth / 2 - 0.11, 0.60), tile),
        *(block(rng, (0.18, depth - 0.02, 0.30), (s * (width / 2 - 0.09), -0.02, 0.47), tile) for s in (-1, 1)),
        *four_legs(rng, width - 0.1, depth - 0.1, 0.08, 0.05, wood(rng, "walnut")),
    ]
    for k in range(seats):
        x, across = (k + 0.5) / seats * inner - inner / 2, inner / seats - 0.02
        parts.append(block(rng, (across, depth - 0.26, 0.13), (x, -0.10, 0.425), seam))
        parts.append(block(rng, (across, 0.13, 0.36), (x, depth / 2 - 0.28, 0.66), seam))
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
    pitch = (height - board) / count
    inner = width - 2 * board
    parts = [block(rng, (board, depth, height), (s * (width - board) / 2, 0, height / 2), tile) for s in (-1, 1)]
    parts += [block(rng, (inner, depth, board), (0, 0, board / 2 + k * pitch), tile) for k in range(count + 1)]
    parts.append(block(rng, (inner, 0.01, height), (0, depth / 2 - 0.005, height / 2), tile))
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
    parts = [
        block(rng, (1.02, 0.035, 0.60), (0, 0, 0.37), shell, 0.3, front=screen.astype(np.float32)),
        block(rng, (0.06, 0.03, 0.09), (0, 0, 0.05), shell),
        block(rng, (0.40, 0.20, 0.015), (0, 0, 0.0075), shell),
    ]
    return Body(name, ["tv", "flat screen"], parts, kind="television")


def laptop(rng: np.random.Generator, name: str) -> Body:
    """An open laptop. The screen faces -y."""
    shell = tex.fabric(rng, 200, 300, "#9fa3a8")
    keys = np.ascontiguousarray(tex.fabric(rng, 240, 340, "#9fa3a8"))
    for row in range(5):
        for column in range(13):
            corner = 16 + 24 * column, 24 + 24 * row
            cv2.rectangle(keys, corner, (corner[0] + 19, corner[1] + 18), tex.rgb("#26282c").tolist(), -1)
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
    pole = [(0.0, 0.0), (0.15, 0.0), (0.15, 0.02), (0.03, 0.035), (0.013, 0.06), (0.013, 1.42), (0.0, 1.42)]
    shade = [(0.21, 1.28), (0.215, 1.28), (0.12, 1.60), (0.115, 1.60)]
    cloth = tex.fabric(rng, 200, 600, color)
    parts = [Part(Lathe(np.array(pole)), metal, 0.3, (40, 16)), Part(Lathe(np.array(shade)), cloth, 0.0, (16, 32))]
    return Body(name, ["lamp", "standing lamp"], parts, kind="lamp")


def desk_lamp(rng: np.random.Generator, name: str, color: str) -> Body:
    """A lamp with a bent arm and a conical shade."""
    paint = tex.glaze(rng, 240, 240, color, ["#ffffff", "#222222"], 60)
    foot = [(0.0, 0.0), (0.085, 0.0), (0.085, 0.012), (0.015, 0.022), (0.010, 0.05), (0.010, 0.24), (0.0, 0.24)]
    upright = np.stack([np.array([0, -1.0, 0]), np.array([0, 0, 1.0]), np.array([-1.0, 0, 0])], 1)
    arm = Tube(0.11, np.radians(10), np.radians(175), np.full(9, 0.009), upright, np.array([0, -0.11, 0.24]))
    shade = [(0.075, 0.0), (0.078, 0.0), (0.030, 0.09), (0.0, 0.10)]
    tilt = rotation_from_axes([1, 0, 0], [0, 0.35, 1])
    parts = [
        Part(Lathe(np.array(foot)), paint, 0.4, (24, 24)),
        Part(arm, paint, 0.4, (10, 24)),
        Part(Lathe(np.array(shade), tilt, np.array([0, -0.235, 0.17])), paint, 0.4, (16, 24)),
    ]
    return Body(name, ["lamp", f"{name.split()[0]} lamp", "desk lamp"], parts, kind="lamp")


def plant(rng: np.random.Generator, name: str, leaves: int = 15) -> Body:
    """A pot with long arching leaves."""
    pot = [(0.0, 0.0), (0.11, 0.0), (0.15, 0.24), (0.16, 0.25), (0.165, 0.29), (0.15, 0.29), (0.145, 0.26), (0.0, 0.26)]
    clay = tex.fabric(rng, 300, 500, str(rng.choice(["#b5623a", "#d8d2c4", "#5a6f86"])))
    clay[235:] = tex.rgb("#2e2118") * (1 + 0.2 * tex.noise(rng, 65, 500, (12, 60), 3))[..., None]
    parts = [Part(Lathe(np.array(pot)), np.clip(clay, 0, 1), 0.1, (24, 32))]
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
    front = np.pad(art, ((border, border), (border, border), (0, 0)))
    for edge in (np.s_[:border], np.s_[-border:], np.s_[:, :border], np.s_[:, -border:]):
        front[edge] = tex.rgb(WOODS[frame][1])
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
    top = np.ascontiguousarray(tex.crop(rng, tile, 240, 320))
    top[108:132] = tex.rgb("#cdb78d")
    front = np.ascontiguousarray(tex.crop(rng, tile, 240, 320))
    front = tex.draw_text(front, str(rng.choice(["FRAGILE", "BOOKS", "KITCHEN"])), (160, 110), 52, "#4a3520")
    width, depth, height = extent
    part = block(rng, (width, depth, height), (0, 0, height / 2), tile, front=front, top=top)
    return Body(name, ["box", "brown box"], [part], kind="box")


def speaker(rng: np.random.Generator, name: str) -> Body:
    """A loudspeaker."""
    tile = tex.fabric(rng, 200, 300, "#26262a")
    front = np.ascontiguousarray(tex.crop(rng, tile, 320, 321))
    for y, r in ((95, 52), (225, 82)):
        for radius, color in ((r, "#111113"), (r - 10, "#4a4a50"), (r // 3, "#17171a")):
            cv2.ellipse(
                front, (160, y), (int(1.5 * radius), radius), 0, 0, 360, tex.rgb(color).tolist(), -1, cv2.LINE_AA
            )
    return Body(name, ["loudspeaker"], [block(rng, (0.2, 0.22, 0.34), (0, 0, 0.17), tile, front=front)], kind="speaker")


def turned(name: str, profile: list[tuple[float, float]], paint: np.ndarray, words: list[str]) -> Body:
    """A body with a single surface of revolution."""
    return Body(name, words, [Part(Lathe(np.array(profile)), paint, 0.2, (24, 36))])


BIN = [(0.0, 0.0), (0.12, 0.0), (0.15, 0.32), (0.155, 0.33), (0.148, 0.33), (0.115, 0.02), (0.0, 0.02)]
STOOL = [(0.0, 0.0), (0.14, 0.0), (0.15, 0.02), (0.04, 0.05), (0.03, 0.38), (0.17, 0.41), (0.17, 0.45), (0.0, 0.46)]
waste_bin = partial(turned, profile=BIN, words=["bin", "waste paper basket"])
stool = partial(turned, profile=STOOL, words=["stool"])


def door(rng: np.random.Generator, name: str, kind: str) -> Body:
    """A panelled door with its back at y = 0."""
    front = np.ascontiguousarray(tex.crop(rng, wood(rng, kind), 820, 360))
    for x, y, w, h in ((40, 50, 120, 300), (200, 50, 120, 300), (40, 430, 120, 330), (200, 430, 120, 330)):
        cv2.rectangle(front, (x, y), (x + w, y + h), (tex.rgb(WOODS[kind][1]) * 0.75).tolist(), 6)
    cv2.circle(front, (334, 410), 13, tex.rgb("#c8a642").tolist(), -1, cv2.LINE_AA)
    part = block(rng, (0.88, 0.04, 2.02), (0, -0.02, 1.01), wood(rng, kind), 0.1, front=front)
    return Body(name, ["door", "room door"], [part], is_stuff=True, kind="door")
