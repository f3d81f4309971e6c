"""Rotations under which the surface normals of one cloud lie on those of another (extended Gaussian images)."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

COUNT, KEPT, APART = 12_000, 40, 12.0
"""Rotations tried, which leave none farther than about 8° away; kept, at least APART degrees from one another."""
SHARPNESS = 25.0
"""Concentration of the kernel about each normal: a standard deviation of 8°."""
_SIDE = 33


def likely_rotations(normals: np.ndarray, onto: np.ndarray) -> list[np.ndarray]:
    """Up to KEPT rotations [3, 3], best first, that turn unit normals [P, 3] onto unit normals [Q, 3], signs ignored.

    Zero normals are left out. Score: the mean root density of `onto` at the turned normals.
    """
    table = _density(onto[:: max(len(onto) // 1000, 1)])
    known = normals[np.linalg.norm(normals, axis=1) > 0]
    chosen = known[:: max(len(known) // 250, 1)]
    quats = _grid(COUNT)
    kept: list[np.ndarray] = []
    for row in np.argsort(-_scores(table, quats, chosen), kind="stable")[: COUNT // 6]:
        if all(abs(float(quats[row] @ other)) < np.cos(np.radians(APART) / 2) for other in kept):
            kept.append(quats[row])
            if len(kept) == KEPT:
                break
    return [_climbed(table, quat, chosen) for quat in kept]


def _grid(count: int) -> np.ndarray:
    """Quaternions [count, 4] xyzw spread evenly over all rotations (super-Fibonacci spirals, Alexa 2022)."""
    s = np.arange(count) + 0.5
    r, R = np.sqrt(s / count), np.sqrt(1 - s / count)
    a, b = 2 * np.pi * s / np.sqrt(2), 2 * np.pi * s / 1.533751168755204288118041
    return np.stack([r * np.sin(a), r * np.cos(a), R * np.sin(b), R * np.cos(b)], axis=1)


def _density(normals: np.ndarray) -> np.ndarray:
    """Root of the density of directions, [33³] float32, at index (n + 1) · 16 by axis."""
    axis = np.linspace(-1, 1, _SIDE)
    directions = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    length = np.linalg.norm(directions, axis=1)
    shell = np.abs(length - 1) < 0.12
    cosine = np.einsum("ic,jc->ij", directions[shell] / length[shell, None], normals)
    table = np.zeros(len(directions), np.float32)
    table[shell] = np.sqrt(np.exp(SHARPNESS * (cosine**2 - 1)).mean(axis=1))
    return table


def _scores(table: np.ndarray, quats: np.ndarray, normals: np.ndarray) -> np.ndarray:
    scores = np.empty(len(quats))
    for begin in range(0, len(quats), 500):
        turned = np.einsum("qij,nj->qni", Rotation.from_quat(quats[begin : begin + 500]).as_matrix(), normals)
        cell = np.rint((turned + 1) * (_SIDE // 2)).astype(np.int64)
        scores[begin : begin + 500] = table[(cell[..., 0] * _SIDE + cell[..., 1]) * _SIDE + cell[..., 2]].mean(axis=1)
    return scores


def _climbed(table: np.ndarray, quat: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """The rotation [3, 3] at the local maximum near `quat`."""
    steps = np.stack(np.meshgrid(*[[-1.0, 0, 1]] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    for degrees in (5.0, 3.0, 2.0, 1.0):
        near = (Rotation.from_rotvec(np.radians(degrees) * steps) * Rotation.from_quat(quat)).as_quat()
        quat = near[int(np.argmax(_scores(table, near, normals)))]
    return np.asarray(Rotation.from_quat(quat).as_matrix())
