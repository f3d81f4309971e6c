"""Picking: the instance that a ray through the map shows."""

from __future__ import annotations

import numpy as np

from perception.io.store import Map

PIXEL = 0.0015
"""Angle of a click in radians: about a pixel of a laptop's window. Thinner Gaussians are widened to it."""
SEEN = 0.15
"""Smallest summed weight on the ray, in [0, 1], at which an instance is picked."""


def responses(
    means: np.ndarray, quats: np.ndarray, scales: np.ndarray, origin: np.ndarray, direction: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The ray parameter t [N] where each Gaussian is largest, and its value exp(−½ d²) [N]; 0 behind the origin.

    In the Gaussian's own axes, scaled to a unit ball, the ray o + t d is nearest the centre at t = −o·d / d·d.
    """
    from scipy.spatial.transform import Rotation

    direction = direction / np.linalg.norm(direction)
    away = means - origin
    width = PIXEL * np.abs(away @ direction)
    radii = np.sqrt(scales**2 + (width**2)[:, None])
    world_from_own = Rotation.from_quat(quats[:, [1, 2, 3, 0]]).as_matrix()
    o = np.einsum("nij,ni->nj", world_from_own, -away) / radii
    d = np.einsum("nij,i->nj", world_from_own, direction) / radii
    dd = np.einsum("ni,ni->n", d, d)
    t = -np.einsum("ni,ni->n", o, d) / dd
    nearest = o + t[:, None] * d
    strength = np.exp(-0.5 * np.einsum("ni,ni->n", nearest, nearest))
    return t, np.where(t > 0, strength, 0)


def pick(gmap: Map, ids: np.ndarray, shown: np.ndarray, origin: np.ndarray, direction: np.ndarray) -> int | None:
    """The instance id that a ray (origin [3], direction [3], map frame) shows, None when it meets none.

    Alpha compositing along the ray, front to back: the instance with the largest summed weight. shown [N] bool:
    Gaussians that are visible.
    """
    origin, direction = np.asarray(origin, np.float64), np.asarray(direction, np.float64)
    if not np.isfinite([origin, direction]).all() or not direction.any():
        return None
    # A cheap test first: only Gaussians within four radii of the ray contribute.
    unit = direction / np.linalg.norm(direction)
    away = gmap.means - origin
    along = away @ unit
    off = np.linalg.norm(away - along[:, None] * unit, axis=1)
    reach = 4 * (gmap.scales.max(axis=1) + PIXEL * np.abs(along))
    near = np.flatnonzero(shown & (off < reach))
    if len(near) == 0:
        return None
    quats = gmap.quats[near].astype(np.float64)
    quats = np.where(np.linalg.norm(quats, axis=1, keepdims=True) > 0, quats, [1.0, 0, 0, 0])
    t, strength = responses(gmap.means[near].astype(np.float64), quats, gmap.scales[near], origin, direction)
    order = np.argsort(t, kind="stable")
    alpha = np.minimum(gmap.opacities[near] * strength, 0.999)[order]
    light = np.concatenate([[1.0], np.cumprod(1 - alpha)[:-1]])
    owners = ids[near][order]
    totals = np.bincount(owners + 1, weights=alpha * light)[1:]
    if len(totals) == 0 or totals.max() < SEEN:
        return None
    return int(totals.argmax())


def covariances(gmap: Map) -> np.ndarray:
    """[N, 3, 3] float32 covariance matrices R S Sᵀ Rᵀ of the Gaussians."""
    norms = np.linalg.norm(gmap.quats, axis=1, keepdims=True)
    quats = np.where(norms > 0, gmap.quats / np.where(norms > 0, norms, 1), np.array([1, 0, 0, 0], np.float32))
    w, x, y, z = quats.astype(np.float32).T
    a, b, c = (gmap.scales.astype(np.float32) ** 2).T
    columns = (  # of the rotation, each times its axis' variance; written out, it is ten times as fast as matmul
        (1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y), a),
        (2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x), b),
        (2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y), c),
    )
    found = np.empty((len(gmap), 3, 3), np.float32)
    for i in range(3):
        for j in range(i, 3):
            found[:, i, j] = found[:, j, i] = sum(column[i] * column[j] * column[3] for column in columns)
    return found
