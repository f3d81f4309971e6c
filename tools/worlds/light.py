"""Baked lighting (light maps): disc lamps with soft shadows, and ambient light with occlusion.

The scene is static and its surfaces are diffuse, so the light leaving a surface point is equal in every photo. It is
computed once per texel of a light map: rendering equation, one diffuse bounce off the body that an ambient ray hits.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace

import cv2
import numpy as np

from perception.machine import cores
from worlds.cameras import Camera
from worlds.shapes import Box, Shape, placed, spin, to_local, to_world

WORKERS = min(cores(), 8)  # one photo being rendered needs about 150 MB


@dataclass(frozen=True)
class Lamp:
    """A disc lamp at `center` [3] facing the origin. radius in metres; color [3]: irradiance at one metre."""

    center: np.ndarray
    radius: float
    color: np.ndarray


@dataclass(frozen=True)
class Lighting:
    """Lamps, and uniform ambient light `ambient` [3], occluded by bodies within `reach` metres. Highlights come from
    the first lamp only."""

    lamps: list[Lamp]
    ambient: np.ndarray
    reach: float = 0.8


@dataclass
class Part:
    """One surface: its paint (albedo, sRGB [h, w, 3] float32) and, once baked, the lit uint8 texture (`lit`).

    gloss: strength of the highlight. light_texels: rows and columns of the light map. casts: whether it casts shadows.
    """

    shape: Shape
    paint: np.ndarray
    gloss: float = 0.0
    light_texels: tuple[int, int] = (32, 48)
    casts: bool = True
    lit: np.ndarray = field(default_factory=lambda: np.zeros((1, 1, 3), np.uint8))


@dataclass
class Body:
    """An instance of the scene: name, further prompts that name it, and its surfaces. on, hangs_on: name of the body
    that it stands on, that it is attached to."""

    name: str
    prompts: list[str]
    parts: list[Part]
    is_stuff: bool = False
    kind: str = ""
    on: str | None = None
    hangs_on: str | None = None

    @property
    def category(self) -> str:
        """`kind`, or the last word of the name."""
        return self.kind or self.name.split()[-1]

    def placed(self, turn: float, shift: np.ndarray, scale: float = 1.0) -> Body:
        """The body scaled about the origin, turned by `turn` degrees about z and moved by `shift` [3]."""
        rotation = spin(turn)
        parts = [replace(part, shape=placed(part.shape, rotation, shift, scale)) for part in self.parts]
        return replace(self, parts=parts)


@dataclass(frozen=True)
class Scene:
    """Lit bodies (id = index + 1), cameras(views, width, height), and the prompts of the demo."""

    bodies: list[Body]
    lighting: Lighting
    cameras: Callable[[int, int, int], list[Camera]]
    asked: list[str]


@dataclass(frozen=True)
class Caster:
    """A body as shadow rays need it: shapes, bounding sphere, and mean reflected colour for the diffuse bounce."""

    shapes: list[Shape]
    center: np.ndarray
    radius: float
    tint: np.ndarray


def casters(bodies: list[Body]) -> list[Caster]:
    """The bodies that cast shadows, prepared for `first_hits`."""
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
    """Linear light -> sRGB in [0, 1]. Values above 0.8 are compressed smoothly to avoid clipping."""
    soft = np.where(linear > 0.8, 1 - 0.2 * np.exp(-(linear - 0.8) / 0.2), linear)
    return np.where(soft <= 0.0031308, 12.92 * soft, 1.055 * np.maximum(soft, 0) ** (1 / 2.4) - 0.055)


_STEPS = 4096  # table entries per unit of linear light
_RECORD = np.round(255 * np.clip(to_srgb(np.arange(2 * _STEPS) / _STEPS), 0, 1)).astype(np.uint8)
_LINEAR = to_linear(np.arange(1024) / 1023).astype(np.float32)


def first_hits(around: list[Caster], origins: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distance [N] to the first caster along each unit ray (inf = none) and its index in the list (-1 = none)."""
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


def bake_all(bodies: list[Body], lighting: Lighting, rng: np.random.Generator, samples: int) -> None:
    """Bakes the light of every part of every body. samples: rays per texel, for each lamp and for ambient light."""
    parts = [part for body in bodies for part in body.parts]
    seeds = rng.integers(0, 2**31, len(parts))
    around = casters(bodies)

    def one(k: int) -> None:
        bake(around, parts[k], lighting, np.random.default_rng(seeds[k]), samples)

    with ThreadPoolExecutor(WORKERS) as pool:  # numpy releases the GIL in its loops
        list(pool.map(one, range(len(parts))))


def bake(around: list[Caster], part: Part, lighting: Lighting, rng: np.random.Generator, samples: int = 20) -> None:
    """Sets `part.lit` to paint × light, as an 8-bit sRGB texture."""
    rows, columns = part.light_texels
    v, u = np.mgrid[0:rows, 0:columns]
    u, v = (u.ravel() + 0.5) / columns, (v.ravel() + 0.5) / rows
    points, normals = part.shape.point_normal(u, v)
    points, normals = to_world(part.shape, points), normals @ part.shape.rotation.T
    start = points + 1e-3 * normals
    light = np.zeros((len(start), 3))
    middle = (start.min(0) + start.max(0)) / 2
    for lamp in lighting.lamps:
        between = _near(around, start, lamp.radius, lamp.center - middle)
        light += _from_lamp(between, start, normals, lamp, rng, samples)
    light += _from_around(_near(around, start, lighting.reach), start, normals, lighting, rng, samples)
    grid = light.reshape(rows, columns, 3).astype(np.float32)
    faces = 6 if isinstance(part.shape, Box) else 1  # faces are filtered apart: light must not bleed into the next one
    strips = zip(np.split(part.paint, faces), np.split(grid, faces), strict=True)
    part.lit = np.concatenate([_recorded(paint, strip) for paint, strip in strips])


def _recorded(paint: np.ndarray, light: np.ndarray) -> np.ndarray:
    columns = light.shape[1]
    wide = np.concatenate([light[:, -4:], light, light[:, :4]], 1)  # the chart of a round surface is periodic along u
    wide = cv2.GaussianBlur(wide if wide.shape[1] > 12 else light, (0, 0), 0.8, borderType=cv2.BORDER_REPLICATE)
    light = wide[:, 4:-4] if wide.shape[1] > columns else wide
    height, width = paint.shape[:2]
    light = cv2.resize(light, (width, height), interpolation=cv2.INTER_LINEAR)
    linear = _LINEAR[(np.clip(paint, 0, 1) * 1023 + 0.5).astype(np.int32)]  # `to_linear` by table
    return _RECORD[(linear * light * _STEPS).astype(np.int32).clip(0, len(_RECORD) - 1)]


def _near(around: list[Caster], start: np.ndarray, reach: float, axis: np.ndarray | None = None) -> list[Caster]:
    """The casters within `reach` metres of the start points, and of these moved along `axis` [3]."""
    center = (start.min(0) + start.max(0)) / 2
    radius, axis = np.linalg.norm(start - center, axis=1).max() + reach, np.zeros(3) if axis is None else axis
    kept = []
    for caster in around:
        share = np.clip((caster.center - center) @ axis / max(axis @ axis, 1e-12), 0, 1)
        if np.linalg.norm(center + share * axis - caster.center) < radius + caster.radius:
            kept.append(caster)
    return kept


def _from_lamp(
    around: list[Caster], start: np.ndarray, normals: np.ndarray, lamp: Lamp, rng: np.random.Generator, samples: int
) -> np.ndarray:
    """Irradiance [N, 3] from a lamp: mean over its disc of visibility × cosine / distance²."""
    total = np.zeros(len(start))
    shift = rng.random((len(start), 2))
    down = -lamp.center / np.linalg.norm(lamp.center)
    side = np.cross(down, [0, 0, 1.0])
    side /= np.linalg.norm(side)
    up = np.cross(side, down)
    for k in range(samples):
        a, b = _sequence(k, shift)
        r, angle = lamp.radius * np.sqrt(a), 2 * np.pi * b
        target = lamp.center + (r * np.cos(angle))[:, None] * side + (r * np.sin(angle))[:, None] * up
        ray = target - start
        length = np.linalg.norm(ray, axis=1)
        ray = ray / length[:, None]
        cosine = np.einsum("nk,nk->n", ray, normals)
        facing = np.flatnonzero(cosine > 0)
        blocked = first_hits(around, start[facing], ray[facing])[0] < length[facing]
        total[facing] += np.where(blocked, 0, cosine[facing] / length[facing] ** 2)
    return total[:, None] / samples * lamp.color


def _from_around(
    around: list[Caster],
    start: np.ndarray,
    normals: np.ndarray,
    lighting: Lighting,
    rng: np.random.Generator,
    samples: int,
) -> np.ndarray:
    """Ambient irradiance [N, 3] from cosine-distributed rays. A ray that hits a body adds part of its colour."""
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
        shade = np.clip(1 - distance / lighting.reach, 0, 1)[:, None]
        height = 0.72 + 0.28 * ray[:, 2:]
        total += height * lighting.ambient * (1 - shade) + shade * 0.55 * tints[index]
    return total / samples


def _sequence(k: int, shift: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The k-th point of the R2 low-discrepancy sequence (Roberts 2018), shifted per texel."""
    return (shift[:, 0] + 0.7548776662466927 * k) % 1, (shift[:, 1] + 0.5698402909980532 * k) % 1
