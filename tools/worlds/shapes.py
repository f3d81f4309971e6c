"""Primitives with ray intersection: sheets, boxes, ellipsoids, surfaces of revolution (lathe) and bent tubes.

Every shape is defined in a local frame, `world_from_local = (rotation, origin)`, with chart coordinates u, v in
[0, 1]: `point_normal` evaluates the surface at (u, v); `hit` gives the first ray hit and its (u, v). Metres.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Protocol

import numpy as np

LENGTHS = ("width", "height", "extent", "radii", "profile", "bend")  # fields of shapes that scale with them
NEAR = 1e-4  # hits closer than this (metres along the ray) are self-intersections at the ray's start


class Shape(Protocol):
    """Interface of a surface for the renderer and the light baker."""

    rotation: np.ndarray
    origin: np.ndarray

    def hit(self, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Rays [N, 3] in the local frame -> t [N] (inf = miss, in units of the direction), u [N], v [N]."""

    def point_normal(self, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Chart coordinates [N] -> local points [N, 3] and outward unit normals [N, 3]."""

    def bounds(self) -> np.ndarray:
        """[2, 3] smallest and largest local coordinates."""

    def size(self) -> tuple[float, float]:
        """Typical lengths of the chart along u and v in metres, used to scale textures."""


def to_local(shape: Shape, points: np.ndarray) -> np.ndarray:
    """World points [N, 3] in the frame of the shape."""
    return (points - shape.origin) @ shape.rotation


def to_world(shape: Shape, points: np.ndarray) -> np.ndarray:
    """Local points [N, 3] in the world frame."""
    return points @ shape.rotation.T + shape.origin


def placed(shape: Any, turn: np.ndarray, shift: np.ndarray, scale: float = 1.0) -> Any:
    """The shape scaled about the origin, turned by the rotation `turn` [3, 3] and moved by `shift` [3]."""
    lengths = {name: scale * np.asarray(getattr(shape, name)) for name in LENGTHS if hasattr(shape, name)}
    return replace(shape, rotation=turn @ shape.rotation, origin=scale * turn @ shape.origin + shift, **lengths)


_identity, _zero = partial(np.eye, 3), partial(np.zeros, 3)


def _quadratic(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Both roots of a t² + 2 b t + c = 0, ascending where a > 0; nan where there is no real root."""
    with np.errstate(invalid="ignore", divide="ignore"):
        # Numerically stable: first the root without cancellation, then the other from the product of the roots.
        q = -(b + np.copysign(np.sqrt(b * b - a * c), b))
        return q / a, c / q


@dataclass
class Sheet:
    """A rectangle in the local xy plane, or the ellipse inscribed in it. Normal +z; u along x, v along -y."""

    width: float
    height: float
    rotation: np.ndarray = field(default_factory=_identity)
    origin: np.ndarray = field(default_factory=_zero)
    elliptic: bool = False

    def hit(self, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        with np.errstate(divide="ignore", invalid="ignore"):
            t = -origins[..., 2] / directions[..., 2]
            u = (origins[..., 0] + t * directions[..., 0]) / self.width + 0.5
            v = 0.5 - (origins[..., 1] + t * directions[..., 1]) / self.height
            inside = (t > NEAR) & (u >= 0) & (u <= 1) & (v >= 0) & (v <= 1)
            if self.elliptic:
                inside &= (u - 0.5) ** 2 + (v - 0.5) ** 2 <= 0.25
        return np.where(inside, t, np.inf), u, v

    def point_normal(self, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        zero = np.zeros_like(u)
        points = np.stack([(u - 0.5) * self.width, (0.5 - v) * self.height, zero], -1)
        return points, np.stack([zero, zero, zero + 1], -1)

    def bounds(self) -> np.ndarray:
        half = np.array([self.width, self.height, 0.0]) / 2
        return np.stack([-half, half])

    def size(self) -> tuple[float, float]:
        return self.width, self.height


_FACES = np.array([  # of a box: axis and sign of the normal, of u, and of v
    (2, 1, 0, 1, 1, -1), (2, -1, 0, 1, 1, 1), (1, -1, 0, 1, 2, -1),
    (0, 1, 1, 1, 2, -1), (1, 1, 0, -1, 2, -1), (0, -1, 1, -1, 2, -1),
])  # fmt: skip
_FACE_OF = np.array([[5, 3], [2, 4], [1, 0]])  # by axis and sign of the normal
_RIM = 0.01  # margin of each face's chart that is not sampled: the texture of the next face would bleed in


@dataclass
class Box:
    """A cuboid with edge lengths `extent` [3], centred on its origin. v covers six charts: +z, -z, -y, +x, +y, -x."""

    extent: np.ndarray
    rotation: np.ndarray = field(default_factory=_identity)
    origin: np.ndarray = field(default_factory=_zero)

    def hit(self, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        half = (np.asarray(self.extent) / 2).astype(directions.dtype)
        with np.errstate(divide="ignore", invalid="ignore"):
            one, other = (-half - origins) / directions, (half - origins) / directions
        enter, leave = np.fmin(one, other).max(-1), np.fmax(one, other).min(-1)
        t = np.where(enter > NEAR, enter, leave)
        t = np.where((enter <= leave) & (t > NEAR), t, np.inf)
        u, v = np.zeros_like(t), np.zeros_like(t)
        found = np.isfinite(t)
        share = ((np.broadcast_to(origins, directions.shape)[found] + t[found, None] * directions[found]) / half) / 2
        axis = np.abs(share).argmax(-1)
        rows = np.arange(len(share))
        face = _FACE_OF[axis, (share[rows, axis] > 0).astype(int)]
        _, _, along, along_sign, down, down_sign = _FACES[face].T
        u[found] = share[rows, along] * along_sign + 0.5
        v[found] = (face + _RIM + (1 - 2 * _RIM) * np.clip(share[rows, down] * down_sign + 0.5, 0, 1)) / 6
        return t, u, v

    def point_normal(self, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        face = np.minimum((6 * v).astype(int), 5)
        down_share = np.clip((6 * v - face - _RIM) / (1 - 2 * _RIM), 0, 1)
        axis, sign, along, along_sign, down, down_sign = _FACES[face].T
        rows = np.arange(len(face))
        points, normals = np.zeros((2, len(face), 3))
        normals[rows, axis] = sign
        points[rows, axis] = 0.5 * sign
        points[rows, along] = (u - 0.5) * along_sign
        points[rows, down] = (down_share - 0.5) * down_sign
        return points * self.extent, normals

    def bounds(self) -> np.ndarray:
        return np.stack([-np.asarray(self.extent), np.asarray(self.extent)]) / 2

    def face_sizes(self) -> np.ndarray:
        """[6, 2] width and height of each face's chart."""
        return np.asarray(self.extent)[_FACES[:, [2, 4]]]

    def size(self) -> tuple[float, float]:
        side = float(np.sqrt(self.face_sizes().prod(1).sum()))
        return side, side


@dataclass
class Ellipsoid:
    """An ellipsoid with semi-axes `radii`; u is the longitude, v runs from the +z pole to the -z pole."""

    radii: np.ndarray
    rotation: np.ndarray = field(default_factory=_identity)
    origin: np.ndarray = field(default_factory=_zero)

    def hit(self, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        o = origins / self.radii.astype(origins.dtype)
        d = directions / self.radii.astype(directions.dtype)
        t0, t1 = _quadratic((d * d).sum(-1), (o * d).sum(-1), (o * o).sum(-1) - 1)
        t = np.fmin(np.where(t0 > NEAR, t0, np.inf), np.where(t1 > NEAR, t1, np.inf))
        found = np.isfinite(t)
        p = o + np.where(found, t, 0)[..., None] * d
        u = np.arctan2(p[..., 1], p[..., 0]) / (2 * np.pi) % 1.0
        return t, u, np.arccos(np.clip(p[..., 2], -1, 1)) / np.pi

    def point_normal(self, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        lon, lat = 2 * np.pi * u, np.pi * v
        unit = np.stack([np.sin(lat) * np.cos(lon), np.sin(lat) * np.sin(lon), np.cos(lat)], -1)
        normals = unit / self.radii
        return unit * self.radii, normals / np.linalg.norm(normals, axis=-1, keepdims=True)

    def bounds(self) -> np.ndarray:
        return np.stack([-self.radii, self.radii])

    def size(self) -> tuple[float, float]:
        return 2 * np.pi * float(self.radii[:2].mean()), np.pi * float(self.radii.mean())


@dataclass
class Lathe:
    """A surface of revolution about z. The profile [S + 1, 2] holds (radius, height); its segments are cones or rings.
    u is the angle, v the arc length along the profile. Normals point outwards if the outer profile runs upwards."""

    profile: np.ndarray
    rotation: np.ndarray = field(default_factory=_identity)
    origin: np.ndarray = field(default_factory=_zero)

    def __post_init__(self) -> None:
        self.profile = np.asarray(self.profile, dtype=np.float64)
        length = np.linalg.norm(np.diff(self.profile, axis=0), axis=1)
        self._v = np.concatenate([[0], np.cumsum(length)]) / length.sum()
        self._length = float(length.sum())

    def hit(self, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        shape = np.broadcast_shapes(origins.shape, directions.shape)[:-1]
        best = np.full(shape, np.inf, dtype=directions.dtype)
        v = np.zeros(shape, dtype=directions.dtype)
        (ox, oy, oz), (dx, dy, dz) = np.moveaxis(origins, -1, 0), np.moveaxis(directions, -1, 0)
        dd, od, oo = dx * dx + dy * dy, ox * dx + oy * dy, ox * ox + oy * oy
        for i in range(len(self.profile) - 1):
            (r0, z0), (r1, z1) = self.profile[i].tolist(), self.profile[i + 1].tolist()
            for t, share in _segment_roots(r0, z0, r1, z1, (oz, dz, dd, od, oo)):
                with np.errstate(invalid="ignore"):
                    nearer = (share >= 0) & (share <= 1) & (t > NEAR) & (t < best)
                best = np.where(nearer, t, best)
                v = np.where(nearer, self._v[i] + (self._v[i + 1] - self._v[i]) * share, v)
        found = np.where(np.isfinite(best), best, 0)
        u = np.arctan2(oy + found * dy, ox + found * dx) / (2 * np.pi) % 1.0
        return best, u, v.astype(best.dtype, copy=False)

    def point_normal(self, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        r, z = np.interp(v, self._v, self.profile[:, 0]), np.interp(v, self._v, self.profile[:, 1])
        tangent = np.diff(self.profile, axis=0) / np.diff(self._v)[:, None]
        middle = (self._v[1:] + self._v[:-1]) / 2
        # Facet normals are interpolated along the profile, for smooth shading.
        nr, nz = np.interp(v, middle, tangent[:, 1]), -np.interp(v, middle, tangent[:, 0])
        scale = 1 / np.maximum(np.hypot(nr, nz), 1e-12)
        cos, sin = np.cos(2 * np.pi * u), np.sin(2 * np.pi * u)
        return np.stack([r * cos, r * sin, z], -1), np.stack([nr * cos, nr * sin, nz], -1) * scale[..., None]

    def bounds(self) -> np.ndarray:
        r, (low, high) = self.profile[:, 0].max(), (self.profile[:, 1].min(), self.profile[:, 1].max())
        return np.array([[-r, -r, low], [r, r, high]])

    def size(self) -> tuple[float, float]:
        return 2 * np.pi * float(self.profile[:, 0].max()), self._length


def _segment_roots(
    r0: float, z0: float, r1: float, z1: float, ray: tuple[np.ndarray, ...]
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Intersections of rays with one cone or ring of a lathe: (t, position along the segment) for each root.
    ray: (o_z, d_z, d_xy·d_xy, o_xy·d_xy, o_xy·o_xy)."""
    oz, dz, dd, od, oo = ray
    with np.errstate(invalid="ignore", divide="ignore"):
        if abs(z1 - z0) < 1e-9:
            t = (z0 - oz) / dz
            radius = np.sqrt(np.maximum(oo + 2 * t * od + t * t * dd, 0))
            return [(t, (radius - r0) / (r1 - r0))]
        slope = (r1 - r0) / (z1 - z0)
        radius = r0 + slope * (oz - z0)
        roots = _quadratic(dd - (slope * slope) * dz * dz, od - slope * dz * radius, oo - radius * radius)
        return [(t, (oz + t * dz - z0) / (z1 - z0)) for t in roots]


@dataclass
class Tube:
    """A tube along an arc of radius `bend` in the local xy plane, from angle `start` to `stop` in radians.

    radii [S]: tube radii at equal steps along the arc. u: angle around the tube; v: position along the arc. Hits are
    found by sphere tracing. The distance bound is exact for constant radii and damped for varying ones.
    """

    bend: float
    start: float
    stop: float
    radii: np.ndarray
    rotation: np.ndarray = field(default_factory=_identity)
    origin: np.ndarray = field(default_factory=_zero)
    steps: int = 48

    def _chart(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Position along the arc in [0, 1], clamped to its ends."""
        middle = (self.start + self.stop) / 2
        angle = (np.arctan2(y, x) - middle + np.pi) % (2 * np.pi) - np.pi + middle
        return np.clip((angle - self.start) / (self.stop - self.start), 0, 1)

    def _radius(self, v: np.ndarray) -> np.ndarray:
        return np.interp(v, np.linspace(0, 1, len(self.radii)), self.radii)

    def distance(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Distance bound [N] of local points [N, 3] to the tube, and their position along the arc [N]."""
        v = self._chart(points[..., 0], points[..., 1])
        angle = self.start + v * (self.stop - self.start)
        dx, dy = points[..., 0] - self.bend * np.cos(angle), points[..., 1] - self.bend * np.sin(angle)
        return np.sqrt(dx * dx + dy * dy + points[..., 2] ** 2) - self._radius(v), v

    def hit(self, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        speed = np.linalg.norm(directions, axis=-1)
        low, high = self.bounds()
        with np.errstate(divide="ignore", invalid="ignore"):
            slabs = np.stack([(low - origins) / directions, (high - origins) / directions])
        enter = np.maximum(np.nanmax(slabs.min(0), -1), NEAR * 5)
        leave = np.nanmin(slabs.max(0), -1)
        t = np.full(enter.shape, np.inf)
        alive = np.flatnonzero(enter.ravel() < leave.ravel())
        o = np.broadcast_to(origins, directions.shape).reshape(-1, 3)[alive].astype(np.float64)
        d = directions.reshape(-1, 3)[alive].astype(np.float64)
        s, v_at = enter.ravel()[alive].astype(np.float64), np.zeros(len(alive))
        running = np.arange(len(alive))
        for _ in range(self.steps):
            gap, v_at[running] = self.distance(o[running] + s[running, None] * d[running])
            s[running] += 0.9 * gap / speed.ravel()[alive[running]]
            running = running[(gap > 2e-5) & (s[running] < leave.ravel()[alive[running]])]
            if not len(running):
                break
        s[running] = np.inf  # grazing rays that did not converge
        s[s >= leave.ravel()[alive]] = np.inf
        t.ravel()[alive] = s
        ok = np.isfinite(s)
        u, v = np.zeros(t.shape), np.zeros(t.shape)
        p = o[ok] + s[ok, None] * d[ok]
        u.ravel()[alive[ok]] = np.arctan2(p[:, 2], np.hypot(p[:, 0], p[:, 1]) - self.bend) / (2 * np.pi) % 1.0
        v.ravel()[alive[ok]] = v_at[ok]
        return t, u, v

    def point_normal(self, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        angle, r = self.start + v * (self.stop - self.start), self._radius(v)
        out, up = np.cos(2 * np.pi * u), np.sin(2 * np.pi * u)
        normals = np.stack([out * np.cos(angle), out * np.sin(angle), up], -1)
        centers = self.bend * np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], -1)
        return centers + r[..., None] * normals, normals

    def bounds(self) -> np.ndarray:
        angle = np.linspace(self.start, self.stop, 65)
        ring = self.bend * np.stack([np.cos(angle), np.sin(angle), 0 * angle], -1)
        reach = float(self.radii.max()) * 1.02
        return np.stack([ring.min(0) - reach, ring.max(0) + reach])

    def size(self) -> tuple[float, float]:
        return 2 * np.pi * float(self.radii.max()), abs(self.stop - self.start) * self.bend


def rotation_from_axes(x: np.ndarray | Sequence[float], z: np.ndarray | Sequence[float]) -> np.ndarray:
    """[3, 3] world_from_local rotation whose z axis is `z` and whose x axis is as near `x` as it can be."""
    z_axis = np.asarray(z, float) / np.linalg.norm(z)
    y_axis = np.cross(z_axis, np.asarray(x, float))
    y_axis /= np.linalg.norm(y_axis)
    return np.stack([np.cross(y_axis, z_axis), y_axis, z_axis], 1)


def spin(degrees: float) -> np.ndarray:
    """[3, 3] rotation about +z."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
