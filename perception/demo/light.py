"""Light baked once into small maps: a soft window lamp with shadows, a sky dimmed by what stands around.

The scene is matte and still, so the light that leaves a surface point is the same in every photo: it is
computed
per map texel (rendering equation, one diffuse bounce off the object a sky ray meets) and kept.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np

from perception.demo.shapes import Shape, to_local, to_world

LAMP_CENTER = np.array([-1.0, -0.9, 1.75])
LAMP_RADIUS = 0.34
LAMP_COLOR = np.array([1.0, 0.93, 0.82]) * 6.4  # irradiance at one metre
SKY_COLOR = np.array([0.36, 0.41, 0.48])
SKY_REACH = 0.8  # metres beyond which an object no longer dims the sky


@dataclass
class Part:
    """One surface with its paint (sRGB [h, w, 3] float32) and, once lit, the uint8 picture a camera sees.

    gloss: strength of the highlight. light_texels: resolution of the baked light, rows and columns.
    """

    shape: Shape
    paint: np.ndarray
    gloss: float = 0.0
    light_texels: tuple[int, int] = (32, 48)
    casts: bool = True
    lit: np.ndarray = field(default_factory=lambda: np.zeros((1, 1, 3), np.uint8))


@dataclass
class Body:
    """A thing in the scene: its instance id, its name and the surfaces it is made of."""

    id: int
    name: str
    prompts: list[str]
    parts: list[Part]
    is_stuff: bool = False


@dataclass(frozen=True)
class Caster:
    """What a shadow ray needs of a body: its shapes, a ball around them, the colour it lends to its
    neighbours."""

    shapes: list[Shape]
    center: np.ndarray
    radius: float
    tint: np.ndarray


def casters(bodies: list[Body]) -> list[Caster]:
    """The bodies that stand in the light, ready for `first_hits`."""
    found = []
    for body in bodies:
        shapes = [part.shape for part in body.parts if part.casts]
        if shapes:
            points = np.concatenate([to_world(shape, corners(shape)) for shape in shapes])
            center = (points.min(0) + points.max(0)) / 2
            paint = np.mean([to_linear(part.paint[::4, ::4]).mean((0, 1)) for part in body.parts], axis=0)
            radius = float(np.linalg.norm(points - center, axis=1).max())
            found.append(Caster(shapes, center, radius, 0.6 * paint))
    return found


def corners(shape: Shape) -> np.ndarray:
    """[8, 3] corners of the shape's local bounds."""
    low, high = shape.bounds()
    return np.array([[(low, high)[b >> i & 1][i] for i in range(3)] for b in range(8)])


def to_linear(srgb: np.ndarray) -> np.ndarray:
    """sRGB in [0, 1] -> linear light (IEC 61966-2-1)."""
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def to_srgb(linear: np.ndarray) -> np.ndarray:
    """Linear light -> sRGB in [0, 1], highlights rolled off above 0.8 so that nothing clips hard."""
    soft = np.where(linear > 0.8, 1 - 0.2 * np.exp(-(linear - 0.8) / 0.2), linear)
    return np.where(soft <= 0.0031308, 12.92 * soft, 1.055 * np.maximum(soft, 0) ** (1 / 2.4) - 0.055)


_STEPS = 4096  # of the table below, per unit of linear light
_RECORD = np.round(255 * np.clip(to_srgb(np.arange(2 * _STEPS) / _STEPS), 0, 1)).astype(np.uint8)
_LINEAR = to_linear(np.arange(1024) / 1023).astype(np.float32)


def _linear(srgb: np.ndarray) -> np.ndarray:
    """`to_linear` by table, for whole textures."""
    return _LINEAR[(np.clip(srgb, 0, 1) * 1023 + 0.5).astype(np.int32)]


def first_hits(around: list[Caster], origins: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distance [N] to the first caster along each unit ray (inf = none) and its index in the list (-1 =
    none)."""
    origins, rays = origins.astype(np.float32), rays.astype(np.float32)
    distance = np.full(len(origins), np.inf, np.float32)
    index = np.full(len(origins), -1, np.int32)
    for i, caster in enumerate(around):
        offset = caster.center.astype(np.float32) - origins
        along = np.maximum(np.einsum("nk,nk->n", offset, rays), 0)
        gap = offset - along[:, None] * rays
        near = np.flatnonzero(np.einsum("nk,nk->n", gap, gap) < caster.radius**2)
        if not len(near):
            continue
        for shape in caster.shapes:
            local = to_local(shape, origins[near]).astype(np.float32)
            t = shape.hit(local, rays[near] @ shape.rotation.astype(np.float32))[0]
            closer = t < distance[near]
            distance[near[closer]] = t[closer]
            index[near[closer]] = i
    return distance, index


def bake(around: list[Caster], part: Part, rng: np.random.Generator, samples: int = 20) -> None:
    """Fills `part.lit` with paint × light, as the 8-bit sRGB picture a camera would record."""
    rows, columns = part.light_texels
    v, u = np.mgrid[0:rows, 0:columns]
    u, v = (u.ravel() + 0.5) / columns, (v.ravel() + 0.5) / rows
    points, normals = part.shape.point_normal(u, v)
    points, normals = to_world(part.shape, points), normals @ part.shape.rotation.T
    start = points + 1e-3 * normals
    light = _lamp(around, start, normals, rng, samples) + _sky(around, start, normals, rng, samples)
    light = light.reshape(rows, columns, 3).astype(np.float32)
    wide = np.concatenate([light[:, -4:], light, light[:, :4]], 1)  # the chart of a round thing closes on itself
    wide = cv2.GaussianBlur(wide if wide.shape[1] > 12 else light, (0, 0), 0.8, borderType=cv2.BORDER_REPLICATE)
    light = wide[:, 4:-4] if wide.shape[1] > columns else wide
    height, width = part.paint.shape[:2]
    light = cv2.resize(light, (width, height), interpolation=cv2.INTER_LINEAR)
    part.lit = _RECORD[(_linear(part.paint) * light * _STEPS).astype(np.int32).clip(0, len(_RECORD) - 1)]


def _lamp(
    around: list[Caster], start: np.ndarray, normals: np.ndarray, rng: np.random.Generator, samples: int
) -> np.ndarray:
    """Light [N, 3] of the round lamp: mean over its disc of visibility × cosine / distance²."""
    total = np.zeros(len(start))
    shift = rng.random((len(start), 2))
    down = -LAMP_CENTER / np.linalg.norm(LAMP_CENTER)
    side = np.cross(down, [0, 0, 1.0])
    side /= np.linalg.norm(side)
    up = np.cross(side, down)
    for k in range(samples):
        a, b = _sequence(k, shift)
        r, angle = LAMP_RADIUS * np.sqrt(a), 2 * np.pi * b
        target = LAMP_CENTER + (r * np.cos(angle))[:, None] * side + (r * np.sin(angle))[:, None] * up
        ray = target - start
        length = np.linalg.norm(ray, axis=1)
        ray = ray / length[:, None]
        cosine = np.einsum("nk,nk->n", ray, normals)
        facing = np.flatnonzero(cosine > 0)
        blocked = first_hits(around, start[facing], ray[facing])[0] < length[facing]
        total[facing] += np.where(blocked, 0, cosine[facing] / length[facing] ** 2)
    return total[:, None] / samples * LAMP_COLOR


def _sky(
    around: list[Caster], start: np.ndarray, normals: np.ndarray, rng: np.random.Generator, samples: int
) -> np.ndarray:
    """Light [N, 3] from all around: cosine-spread rays; one that meets a body brings a little of its
    colour."""
    tints = np.array([caster.tint for caster in around] + [np.zeros(3)])
    helper = np.where(np.abs(normals[:, :1]) > 0.7, [[0.0, 1, 0]], [[1.0, 0, 0]])
    side = np.cross(helper, normals)
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    up = np.cross(normals, side)
    shift = rng.random((len(start), 2))
    total = np.zeros((len(start), 3))
    for k in range(samples):
        a, b = _sequence(k, shift)
        r, angle = np.sqrt(a), 2 * np.pi * b
        ray = (r * np.cos(angle))[:, None] * side + (r * np.sin(angle))[:, None] * up
        ray += np.sqrt(1 - a)[:, None] * normals
        distance, index = first_hits(around, start, ray.astype(np.float32))
        shade = np.clip(1 - distance / SKY_REACH, 0, 1)[:, None]
        height = 0.72 + 0.28 * ray[:, 2:]
        total += height * SKY_COLOR * (1 - shade) + shade * 0.55 * tints[index]
    return total / samples


def _sequence(k: int, shift: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The k-th point of the R2 low-discrepancy sequence (Roberts 2018), shifted per texel."""
    return (shift[:, 0] + 0.7548776662466927 * k) % 1, (shift[:, 1] + 0.5698402909980532 * k) % 1
