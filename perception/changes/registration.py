"""Registration of the coloured points of two things (ICP, Besl and McKay 1992) from many starting rotations, and rigid
motions of Gaussians."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import permutations
from typing import Any

import numpy as np
import torch

from perception.gaussians.model import Gaussians
from perception.geometry import nearest_rotation, rotations, transform

YAWS = 12
"""Starting rotations about the vertical; the 24 that map a cube's axes to each other are tried as well."""
ROUGH, FINE, BEST, MOST = 100, 300, 4, 1500
"""Points of the new thing in the first rounds of all starts, in the last rounds of the BEST ones; of the old one."""
ROUNDS = (6, 25)
TRIMMED = 0.8
"""Share of the new points that are compared: the rest are of neighbours, or were hidden in the first visit."""
TURNED = 15.0
"""Degrees from which two motions are different ones."""
COLOUR = 1.0
"""Radii of a thing that a difference of colour of 1 counts as."""
SOLID = 0.1
"""Least opacity of a Gaussian that shows a surface."""
REACH = 2.2
"""Radii of a thing (root of the mean squared distance to its centre) within which all of it lies."""
STRAY = 3.0
"""Median distances to the middle of a thing from which a point is a stray: the ends of a rod or a cross are at 2."""
FRINGE, BESIDE = 0.02, 0.2
"""Share of the points of a thing that lie within so many radii of one that it touches: parts of an armchair, that masks
of made rooms split, .06 to .13."""
ROUND, DARKEST = 1.6, 0.1
"""Distance of the points of a thing after a turn, relative to that between its halves, up to which it may be round: of
bowls and plates 1.1 to 1.4, of cans and cartons 1.4 to 2.4. Least sum of colours of a hue."""


@dataclass(frozen=True)
class Points:
    """Of one thing: points [P, 3] float64, colors [P, 3] in [0, 1]."""

    points: np.ndarray
    colors: np.ndarray

    @classmethod
    def of(cls, gaussians: Gaussians) -> Points:
        """The means and colours of the solid Gaussians."""
        solid = gaussians.opacities.numpy() >= SOLID
        return cls(gaussians.means.double().numpy()[solid], gaussians.base_colors.double().numpy()[solid].clip(0, 1))

    def within(self, radius: float) -> Points:
        """The points in the ball about the densest spot in which a thing of this `radius` fits; strays are left out."""
        from scipy.spatial import cKDTree

        if len(self.points) == 0:
            return self
        counts = cKDTree(self.points).query_ball_point(self.points, radius, return_length=True)
        centre = self.points[int(np.argmax(counts))]
        for _ in range(ROUNDS[0]):
            kept = np.linalg.norm(self.points - centre, axis=1) <= REACH * radius
            centre = np.median(self.points[kept], axis=0)
        return Points(self.points[kept], self.colors[kept])

    @property
    def radius(self) -> float:
        """Root of the mean squared distance to the centre."""
        return float(np.sqrt(((self.points - self.points.mean(axis=0)) ** 2).sum(axis=1).mean()))

    def some(self, count: int) -> Points:
        """An even selection of at most about `count` points."""
        every = max(1, len(self.points) // count)
        return Points(self.points[::every], self.colors[::every])


def touching(things: Sequence[Points], beside: float = BESIDE) -> np.ndarray:
    """[T, T] bool: which two things come as near to each other as parts of one do, or within `beside` radii."""
    from scipy.spatial import cKDTree

    near = np.zeros((len(things), len(things)), bool)
    for a, b in permutations(range(len(things)), 2):
        if len(things[a].points) and len(things[b].points):
            away = cKDTree(things[a].points).query(things[b].points)[0]
            near[a, b] = np.quantile(away, FRINGE) < beside * min(things[a].radius, things[b].radius)
    return near | near.T


def compact(points: np.ndarray) -> np.ndarray:
    """[P] bool: points [P, 3] of a thing that are no strays, such as floaters on the rays to it."""
    kept = np.ones(len(points), bool)
    for _ in range(2 if len(points) else 0):
        distance = np.linalg.norm(points - np.median(points[kept], axis=0), axis=1)
        kept = distance <= STRAY * np.median(distance[kept])
    return kept


def register(old: Points, new: Points, up: np.ndarray) -> list[tuple[float, np.ndarray]]:
    """(mean residual in radii of the old thing, new_from_old [4, 4]) of the best motions, the best first, and of all
    turns about the vertical that differ from them, as points of a half hidden thing cannot tell."""
    from scipy.spatial import cKDTree

    radius, old = max(old.radius, 1e-9), old.some(MOST)
    tree = cKDTree(np.concatenate([old.points / radius, COLOUR * old.colors], axis=1))
    middle_old, middle_new = (np.median(each.points, axis=0) for each in (old, new))
    starts = []
    for rotation in _starts(up):
        start = transform(rotation, middle_new - rotation @ middle_old)
        starts.append(_icp(tree, old, new.some(ROUGH), start, radius, ROUNDS[0]))
    likely = sorted(starts, key=lambda found: found[0])[: 2 * BEST]
    fine = [_icp(tree, old, new.some(FINE), start, radius, ROUNDS[1]) for _, start in likely]
    distinct: list[tuple[float, np.ndarray]] = []
    for found in [*sorted(fine, key=lambda found: found[0]), *starts[:YAWS]]:
        if all(angle_between(found[1], other[1]) > TURNED for other in distinct):
            distinct.append(found)
    return distinct


def turns(axis: np.ndarray, count: int) -> np.ndarray:
    """[count, 3, 3] rotations about a unit vector [3], evenly over a full turn, from none on."""
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_rotvec(np.arange(count)[:, None] * (2 * np.pi / count) * axis).as_matrix())


def _starts(up: np.ndarray) -> list[np.ndarray]:
    from scipy.spatial.transform import Rotation

    return [*turns(up, YAWS), *Rotation.create_group("O").as_matrix()]


def _icp(
    tree: Any, old: Points, new: Points, start: np.ndarray, radius: float, rounds: int
) -> tuple[float, np.ndarray]:
    pose, residual = start, np.inf
    for _ in range(rounds):
        back = (new.points - pose[:3, 3]) @ pose[:3, :3]
        distance, nearest = tree.query(np.concatenate([back / radius, COLOUR * new.colors], axis=1))
        kept = distance <= np.quantile(distance, TRIMMED)
        residual = float(distance[kept].mean())
        a, b = old.points[nearest[kept]], new.points[kept]
        rotation = nearest_rotation((b - b.mean(axis=0)).T @ (a - a.mean(axis=0)))
        pose = transform(rotation, b.mean(axis=0) - rotation @ a.mean(axis=0))
    return residual, pose


def angle_between(a: np.ndarray, b: np.ndarray) -> float:
    """Degrees between the rotations of two motions."""
    cosine = (np.trace(a[:3, :3] @ b[:3, :3].T) - 1) / 2
    return float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))


def carried(gaussians: Gaussians, new_from_old: np.ndarray) -> Gaussians:
    """The Gaussians of a thing moved by a rigid motion [4, 4], with their view-dependent colours."""
    from scipy.spatial.transform import Rotation

    rotation, shift = new_from_old[:3, :3], new_from_old[:3, 3]
    means = gaussians.means.double().numpy() @ rotation.T + shift
    turned = Rotation.from_matrix(rotation @ rotations(gaussians.quats.double().numpy())).as_quat()[:, [3, 0, 1, 2]]
    return replace(
        gaussians,
        means=torch.from_numpy(means.astype(np.float32)),
        quats=torch.from_numpy(np.ascontiguousarray(turned, np.float32)),
        sh=turned_harmonics(gaussians.sh, rotation),
    )


def turned_harmonics(sh: torch.Tensor, rotation: np.ndarray) -> torch.Tensor:
    """Coefficients [N, K, 3] of the same colours after a rotation [3, 3]: Y(d) sh' = Y(Rᵀ d) sh for
    many directions d."""
    count = sh.shape[1]
    if count == 1:
        return sh
    directions = np.random.default_rng(0).normal(size=(64, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    turn = np.linalg.lstsq(harmonics(directions)[:, :count], harmonics(directions @ rotation)[:, :count], rcond=None)[0]
    return torch.einsum("ij,njc->nic", torch.from_numpy(turn.astype(np.float32)), sh).contiguous()


def harmonics(d: np.ndarray) -> np.ndarray:
    """The real spherical harmonics [P, 16] of directions d [P, 3] as 3DGS orders and signs them."""
    x, y, z = d.T
    xx, yy, zz = x * x, y * y, z * z
    return np.stack([
        np.full_like(x, 0.28209479177387814),
        -0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x,
        1.0925484305920792 * x * y, -1.0925484305920792 * y * z, 0.31539156525252005 * (2 * zz - xx - yy),
        -1.0925484305920792 * x * z, 0.5462742152960396 * (xx - yy),
        -0.5900435899266435 * y * (3 * xx - yy), 2.890611442640554 * x * y * z,
        -0.4570457994644658 * y * (4 * zz - xx - yy), 0.3731763325901154 * z * (2 * zz - 3 * xx - 3 * yy),
        -0.4570457994644658 * x * (4 * zz - xx - yy), 1.445305721320277 * z * (xx - yy),
        -0.5900435899266435 * x * (xx - 3 * yy),
    ], axis=1)  # fmt: skip


def looks_round(points: Points, axis: np.ndarray) -> bool:
    """Whether turns about an axis [3] through the middle of a thing put its points, with their hues, onto each other
    about as well as one half of them lies on the other half."""
    from scipy.spatial import cKDTree

    x = points.points / max(points.radius, 1e-9)
    hues = points.colors / np.maximum(points.colors.sum(axis=1, keepdims=True), DARKEST)
    middle = np.quantile(x, [0.02, 0.98], axis=0).mean(axis=0)
    order = np.random.default_rng(0).permutation(len(x))[:MOST]
    one, other = order[::2], order[1::2]
    tree = cKDTree(np.concatenate([x[one], hues[one]], axis=1))

    def off(turn: np.ndarray) -> float:
        turned = (x[other] - middle) @ turn.T + middle
        return float(np.quantile(tree.query(np.concatenate([turned, hues[other]], axis=1))[0], 0.9))

    unturned, *turned = map(off, turns(axis, YAWS))
    return max(turned) < ROUND * unturned
