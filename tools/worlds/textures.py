"""Procedural textures: wood, glaze, fruit peel, balls, posters. All are [h, w, 3] float32 sRGB in [0, 1]."""

from __future__ import annotations

from itertools import combinations, pairwise

import cv2
import numpy as np
from PIL import Image, ImageDraw, ImageFont

SKIES = {  # of landscapes: sky, hills
    "mountain": (["#f4b183", "#f7e1b5"], ["#8a5a83", "#5d3f72", "#3c2f5c", "#241f42"]),
    "lake": (["#a9d6e5", "#eef4f7"], ["#61a5c2", "#2a6f97", "#014f86", "#013a63"]),
    "desert": (["#f6d7a7", "#fbeccb"], ["#d98e4a", "#b5622e", "#8a431f", "#5a2a15"]),
}
ABSTRACT = ["#264653", "#2a9d8f", "#e9c46a", "#f4a261", "#e76f51", "#6d597a"]


def rgb(code: str) -> np.ndarray:
    """'#rrggbb' -> [3] float32 in [0, 1]."""
    return np.array([int(code[i : i + 2], 16) for i in (1, 3, 5)], np.float32) / 255


def noise(
    rng: np.random.Generator, height: int, width: int, cells: tuple[float, float], octaves: int = 4
) -> np.ndarray:
    """Fractal value noise [h, w] float32 with zero mean and about unit standard deviation, periodic along the width.
    cells: lattice cells of the first octave (vertical, horizontal). Each octave doubles them and halves the weight."""
    total = np.zeros((height, width), np.float32)
    weight = 1.0
    for octave in range(octaves):
        rows = int(np.clip(round(cells[0] * 2**octave), 2, height))
        columns = int(np.clip(round(cells[1] * 2**octave), 2, width))
        grid = np.tile(rng.standard_normal((rows, columns)).astype(np.float32), (1, 3))
        wide = cv2.resize(grid, (3 * width, height), interpolation=cv2.INTER_CUBIC)
        total += weight * wide[:, width : 2 * width]
        weight *= 0.55
    return total / max(float(total.std()), 1e-6)


def blend(amount: np.ndarray, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Linear interpolation: `first` where amount [h, w] is 0, `second` where it is 1."""
    a = np.clip(amount, 0, 1)[..., None].astype(np.float32)
    return first * (1 - a) + second * a


def speckle(
    rng: np.random.Generator, picture: np.ndarray, count: int, sizes: tuple[int, int], colors: list[str]
) -> np.ndarray:
    """A copy of the image with `count` random blots of the given radii (pixels) and colours."""
    out = np.ascontiguousarray(picture, np.float32).copy()
    height, width = out.shape[:2]
    for _ in range(count):
        center = int(rng.integers(width)), int(rng.integers(height))
        axes = int(rng.integers(sizes[0], sizes[1] + 1)), int(rng.integers(sizes[0], sizes[1] + 1))
        color = colors[rng.integers(len(colors))]
        disc(out, center, axes, color, float(rng.uniform(0, 180)))
    return out


def disc(
    picture: np.ndarray, center: tuple[int, int], radius: int | tuple[int, int], color: str, turn: float = 0.0
) -> None:
    """Draws a disc, or an ellipse with two semi-axes turned by `turn` degrees, into an image."""
    if isinstance(radius, tuple):
        cv2.ellipse(picture, center, radius, turn, 0, 360, rgb(color).tolist(), -1, cv2.LINE_AA)
    else:
        cv2.circle(picture, center, radius, rgb(color).tolist(), -1, cv2.LINE_AA)


def polygon(picture: np.ndarray, corners: np.ndarray, color: str) -> None:
    """Draws a filled polygon with corners [n, 2] in pixels, rounded down, into an image."""
    cv2.fillPoly(picture, [corners.astype(np.int32)], rgb(color).tolist(), cv2.LINE_AA)


def paper(color: str, height: int, width: int) -> np.ndarray:
    """An image of one colour to draw into."""
    return np.ascontiguousarray(np.broadcast_to(rgb(color), (height, width, 3)), np.float32).copy()


def wood(rng: np.random.Generator, height: int, width: int, planks: int, light: str, dark: str) -> np.ndarray:
    """Planks with grain along the width, knots, pores and dark joints."""
    edges = pairwise(np.linspace(0, height, planks + 1).astype(int))
    rows = [_plank(rng, bottom - top, width, rgb(light), rgb(dark)) for top, bottom in edges]
    return np.clip(np.concatenate(rows), 0, 1)


def _plank(rng: np.random.Generator, height: int, width: int, light: np.ndarray, dark: np.ndarray) -> np.ndarray:
    y, x = np.mgrid[0:height, 0:width].astype(np.float32)
    warp = noise(rng, height, width, (2, 4), 3) * height * 0.05
    for _ in range(int(rng.integers(1, 4))):  # the grain bends around knots
        ky, kx, r = rng.uniform(0, height), rng.uniform(0, width), rng.uniform(0.06, 0.12) * height
        warp += 2.2 * r * np.exp(-(((y - ky) / r) ** 2 + ((x - kx) / (3 * r)) ** 2) / 2) * np.sign(y - ky)
    rings = 0.5 + 0.5 * np.sin((y + warp) / height * rng.uniform(30, 46) + rng.uniform(0, 6))
    grain = noise(rng, height, width, (height / 5, width / 60), 3)
    tone = 0.42 * rings + 0.13 * grain + 0.10 * noise(rng, height, width, (3, 6), 4) + rng.uniform(0.05, 0.35)
    plank = blend(tone, light, dark)
    pores = noise(rng, height, width, (height / 2, width / 14), 1) > 2.1
    plank[pores] *= 0.72
    joint = np.minimum(y, height - 1 - y) < 1.2
    plank[joint] *= 0.45
    return plank


def directions(height: int, width: int) -> np.ndarray:
    """[h, w, 3] unit vectors of the longitude-latitude chart of an ellipsoid."""
    lat = (np.arange(height) + 0.5) / height * np.pi
    lon = (np.arange(width) + 0.5) / width * 2 * np.pi
    sin = np.sin(lat)[:, None]
    return np.stack([sin * np.cos(lon), sin * np.sin(lon), np.broadcast_to(np.cos(lat)[:, None], (height, width))], -1)


def basketball(rng: np.random.Generator, height: int, width: int) -> np.ndarray:
    """Orange pebbled leather with the black ribs of a basketball."""
    x, y, z = np.moveaxis(directions(height, width), -1, 0)
    pebbles = noise(rng, height, width, (height / 5, width / 5), 1)
    skin = blend(0.5 + 0.22 * pebbles + 0.16 * noise(rng, height, width, (6, 12), 4), rgb("#d9681d"), rgb("#a8430c"))
    bow = np.abs(np.arccos(np.clip(np.abs(y), 0, 1)) - 0.85 + 0.12 * x * x)
    rib = np.minimum(np.minimum(np.abs(x), np.abs(z)), bow)
    return blend(1.6 - rib / 0.022, skin, rgb("#17120f"))


def soccer_ball(rng: np.random.Generator, height: int, width: int) -> np.ndarray:
    """White hexagons and black pentagons: the central projection of a truncated icosahedron."""
    golden = (1 + 5**0.5) / 2
    corners = np.array([(0, a, b * golden) for a in (1, -1) for b in (1, -1)])
    pentagons = np.concatenate([np.roll(corners, k, 1) for k in range(3)]) / np.hypot(1, golden)
    near = pentagons @ pentagons.T > 0.4  # neighbours on the icosahedron
    triples = [t for t in combinations(range(12), 3) if all(near[pair] for pair in combinations(t, 2))]
    hexagons = np.array([pentagons[list(triple)].mean(0) for triple in triples])
    hexagons /= np.linalg.norm(hexagons, axis=1, keepdims=True)
    # Face distances of the solid with unit edge. A direction hits the face with the largest n·c / distance.
    heights = np.concatenate([np.full(12, 2.3274), np.full(20, 2.2673)])
    score = directions(height, width) @ (np.concatenate([pentagons, hexagons]) / heights[:, None]).T
    face = score.argmax(-1)
    best = np.partition(score, -2, axis=-1)
    seam = (best[..., -1] - best[..., -2]) < 0.004
    grime = 0.10 * noise(rng, height, width, (8, 16), 5)[..., None]
    ball = np.where((face < 12)[..., None], rgb("#16181c") + 0.3 * np.abs(grime), rgb("#eeece6") - np.abs(grime))
    ball[seam] = rgb("#6d6a66")
    return np.clip(ball, 0, 1).astype(np.float32)


def peel(rng: np.random.Generator, height: int, width: int, light: str, dark: str, pores: float = 4) -> np.ndarray:
    """The skin of a fruit: pores and blotches, darker at the two poles."""
    dots = noise(rng, height, width, (height / pores, width / pores), 1)
    skin = blend(0.35 + 0.16 * dots + 0.22 * noise(rng, height, width, (4, 8), 4), rgb(light), rgb(dark))
    v = (np.arange(height) + 0.5) / height
    pole = np.exp(-((np.minimum(v, 1 - v) / 0.035) ** 2))[:, None] * np.ones((1, width))
    return blend(0.9 * pole, skin, rgb("#4c5a1e"))


def glaze(rng: np.random.Generator, height: int, width: int, color: str, specks: list[str], count: int) -> np.ndarray:
    """Fired ceramic: one colour with clouds and specks."""
    cloud = 0.055 * noise(rng, height, width, (4, 8), 5)[..., None] + 0.02 * rng.standard_normal((height, width, 1))
    return np.clip(speckle(rng, rgb(color) * (1 + cloud), count, (1, 2), specks), 0, 1).astype(np.float32)


def draw_text(picture: np.ndarray, text: str, center: tuple[float, float], size: int, color: str) -> np.ndarray:
    """A copy of the image with text centred at (x, y) pixels, `size` pixels high."""
    image = Image.fromarray((np.clip(picture, 0, 1) * 255).astype(np.uint8))
    font = ImageFont.load_default(size=size)
    ImageDraw.Draw(image).text(center, text, fill=color, font=font, anchor="mm")
    return np.asarray(image, np.float32) / 255


def wallpaper(rng: np.random.Generator, height: int, width: int, ground: str, leaves: list[str]) -> np.ndarray:
    """Plaster-coloured wallpaper with random leaves. No two leaves are equal, so image features are unambiguous."""
    clouds = 1 + 0.035 * noise(rng, height, width, (height / 40, width / 40), 5)[..., None]
    paper = np.ascontiguousarray(rgb(ground) * clouds, np.float32)
    for _ in range(height * width // 3600):
        x, y, turn = rng.uniform(0, width), rng.uniform(0, height), rng.uniform(0, 2 * np.pi)
        color, reach = leaves[rng.integers(len(leaves))], rng.uniform(9, 24)
        for side in (-0.55, 0.0, 0.55):
            a = turn + side
            tip = int(x + reach * np.cos(a)), int(y + reach * np.sin(a))
            axes = int(reach * 0.55) + 1, max(2, int(reach * rng.uniform(0.12, 0.24)))
            disc(paper, tip, axes, color, np.degrees(a))
    return np.clip(paper, 0, 1)


def landscape(
    rng: np.random.Generator, height: int, width: int, sky: list[str], hills: list[str], title: str
) -> np.ndarray:
    """A travel poster: a sun over ranges of hills, a title beneath."""
    y = np.linspace(0, 1, height)[:, None] * np.ones((1, width))
    art = blend(y * 1.4, rgb(sky[0]), rgb(sky[1])).astype(np.float32)
    sun = int(width * rng.uniform(0.25, 0.75)), int(height * 0.3)
    disc(art, sun, width // 8, "#fff3cf")
    for i, color in enumerate(hills):
        crest = height * (0.38 + 0.13 * i) + height * 0.05 * noise(rng, 2, width, (1, 3 + i), 5)[0]
        below = np.arange(height)[:, None] > crest[None]
        shade = 1 + 0.08 * noise(rng, height, width, (12, 12), 4)
        art = np.where(below[..., None], rgb(color) * shade[..., None], art).astype(np.float32)
    art = speckle(rng, art, 60, (1, 3), ["#fff3cf", "#1f2a36"])
    border = max(4, width // 24)
    art[:border] = art[-3 * border :] = rgb("#f4efe2")
    art[:, :border] = art[:, -border:] = rgb("#f4efe2")
    return draw_text(np.clip(art, 0, 1), title, (width / 2, height - 1.5 * border), int(1.9 * border), "#22303c")


def mosaic(rng: np.random.Generator, height: int, width: int, colors: list[str]) -> np.ndarray:
    """An abstract poster of overlapping discs, bars and triangles."""
    art = paper("#f3ead7", height, width)
    for i in range(42):
        color = colors[rng.integers(len(colors))]
        x, y = int(rng.uniform(0.08, 0.92) * width), int(rng.uniform(0.08, 0.92) * height)
        r = int(rng.uniform(0.04, 0.16) * width)
        if i % 3 == 0:
            cv2.circle(art, (x, y), r, rgb(color).tolist(), -1 if i % 2 else max(3, r // 4), cv2.LINE_AA)
        elif i % 3 == 1:
            polygon(art, cv2.boxPoints(((x, y), (2.4 * r, 0.5 * r), float(rng.uniform(0, 180)))), color)
        else:
            polygon(art, np.array([[x, y]]) + rng.uniform(-r, r, (3, 2)), color)
    return np.clip(art * (1 + 0.02 * noise(rng, height, width, (60, 60), 3)[..., None]), 0, 1)


def fur(rng: np.random.Generator, height: int, width: int, light: str, dark: str) -> np.ndarray:
    """Short hair: fine noise over clouds."""
    hair, clouds = noise(rng, height, width, (height / 3, width / 3), 1), noise(rng, height, width, (6, 9), 3)
    return np.clip(blend(0.4 + 0.2 * hair + 0.12 * clouds, rgb(light), rgb(dark)), 0, 1)


def fabric(rng: np.random.Generator, height: int, width: int, color: str, dots: list[str] | None = None) -> np.ndarray:
    """Woven cloth of one colour, slightly mottled. dots: colours of small figures scattered over it."""
    y, x = np.mgrid[:height, :width]
    weave = 0.05 * (np.sin(1.9 * x) * np.sin(1.7 * y)) + 0.07 * noise(rng, height, width, (height / 6, width / 6), 2)
    cloth = rgb(color) * (1 + weave + 0.045 * noise(rng, height, width, (5, 7), 5))[..., None]
    if dots:
        cloth = speckle(rng, cloth, height * width // 700, (3, 9), dots)
    return np.clip(cloth, 0, 1).astype(np.float32)


def plaster(rng: np.random.Generator, height: int, width: int, color: str) -> np.ndarray:
    """A painted wall: patches, trowel marks, specks."""
    patches = 0.05 * noise(rng, height, width, (7, 11), 6) + 0.02 * rng.standard_normal((height, width))
    strokes = 0.03 * noise(rng, height, width, (height / 9, width / 70), 2)
    wall = rgb(color) * (1 + patches + strokes)[..., None]
    tones = [rgb_code(rgb(color) * f) for f in (0.80, 0.88, 1.08)]
    return np.clip(speckle(rng, wall, height * width // 1500, (1, 4), tones), 0, 1).astype(np.float32)


def rgb_code(color: np.ndarray) -> str:
    """[3] in [0, 1] -> '#rrggbb'."""
    return "#" + "".join(f"{round(255 * float(np.clip(c, 0, 1))):02x}" for c in color)


def bricks(rng: np.random.Generator, height: int, width: int, color: str, course: int = 34) -> np.ndarray:
    """A brick wall with a random tone per brick. course: height of a row in pixels."""
    wall = paper("#b9ada0", height, width)
    length = int(2.9 * course)
    for row, top in enumerate(range(0, height, course)):
        for left in range(-length, width, length):
            start = left + (row % 2) * length // 2
            tone = rgb(color) * rng.uniform(0.72, 1.18) + rng.normal(0, 0.02, 3)
            wall[top + 3 : top + course, max(start + 3, 0) : max(start + length, 0)] = tone
    grain = 0.08 * noise(rng, height, width, (height / 5, width / 5), 3) + 0.05 * noise(rng, height, width, (6, 9), 3)
    return np.clip(wall * (1 + grain)[..., None], 0, 1).astype(np.float32)


def rug(rng: np.random.Generator, height: int, width: int, colors: list[str]) -> np.ndarray:
    """A woven rug: a field of figures mirrored both ways, a medallion, borders, fringes at the short ends."""
    half_h, half_w = (height + 1) // 2, (width + 1) // 2
    field = paper(colors[0], half_h, half_w)
    for _ in range(120):
        center = int(rng.integers(half_w)), int(rng.integers(half_h))
        color, reach = colors[rng.integers(1, len(colors))], int(rng.integers(5, 18))
        size = (reach, reach * float(rng.uniform(0.4, 1.6)))
        polygon(field, cv2.boxPoints((center, size, float(rng.choice([0, 45])))), color)
    upper = np.concatenate([field, field[:, ::-1]], 1)
    rug = np.concatenate([upper, upper[::-1]])[:height, :width].copy()
    for scale, color in ((0.55, colors[1]), (0.42, colors[2]), (0.25, colors[3 % len(colors)])):
        w, h = scale * width / 2, scale * height / 2
        diamond = np.array([[-w, 0], [0, -h], [w, 0], [0, h]]) + np.array([width, height]) / 2
        cv2.polylines(rug, [diamond.astype(np.int32)], True, rgb(color).tolist(), 7, cv2.LINE_AA)
    for inset, color in ((0, colors[1]), (10, colors[2]), (26, colors[1]), (34, colors[3 % len(colors)])):
        cv2.rectangle(rug, (inset, inset), (width - 1 - inset, height - 1 - inset), rgb(color).tolist(), 7)
    for x in range(18, width - 18, 22):
        for y in (19, height - 20):
            disc(rug, (x, y), 4, colors[3 % len(colors)])
    wool = 0.07 * noise(rng, height, width, (height / 4, width / 4), 1) + 0.05 * noise(rng, height, width, (5, 8), 4)
    return np.clip(rug * (1 + wool)[..., None], 0, 1).astype(np.float32)


def spines(rng: np.random.Generator, height: int, width: int, pitch: float = 9.0) -> np.ndarray:
    """A row of book spines of about `pitch` pixels each, with bands and marks, some books lower than the row."""
    colors = ["#7a1f1f", "#1f3f7a", "#2d6b3f", "#c9a227", "#3a3a3f", "#e4ddca", "#7d4a8c", "#b5562b", "#4d8a94"]
    row = np.zeros((height, width, 3), np.float32) + rgb("#1b1512")
    left = 0
    while left < width:
        thick = max(4, int(rng.normal(pitch, 0.3 * pitch)))
        color, top = rgb(colors[rng.integers(len(colors))]) * rng.uniform(0.8, 1.15), int(rng.uniform(0, 0.25) * height)
        row[top:, left : left + thick - 1] = color
        mark = rgb("#f2e2b0") if color.mean() < 0.5 else rgb("#2a2320")
        for level in rng.uniform(0.1, 0.9, int(rng.integers(2, 5))):
            y = top + int(level * (height - top))
            row[y : y + max(2, height // 40), left + 1 : left + thick - 2] = mark
        left += thick
    return np.clip(row * (1 + 0.05 * noise(rng, height, width, (20, 40), 3))[..., None], 0, 1).astype(np.float32)


def crop(rng: np.random.Generator, tile: np.ndarray, height: int, width: int) -> np.ndarray:
    """A random crop [height, width] of a texture, its width along the longer side; repeated where it is too small."""
    if height > width:
        return np.ascontiguousarray(crop(rng, tile, width, height).transpose(1, 0, 2))
    down, across = -(-height // tile.shape[0]), -(-width // tile.shape[1])
    if down > 1 or across > 1:
        tile = np.tile(np.concatenate([tile, tile[:, ::-1]], 1), (down, (across + 1) // 2, 1))
    top, left = int(rng.integers(tile.shape[0] - height + 1)), int(rng.integers(tile.shape[1] - width + 1))
    return tile[top : top + height, left : left + width]
