"""Parts of an alignment: likely rotations (extended Gaussian images), and the steps of Gauss-Newton on a pose."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from perception.export.depth_views import DepthView
from perception.geometry import nearest_rotation

COUNT, KEPT, APART = 12_000, 64, 12.0
"""Rotations tried, which leave none farther than about 8° away; kept, at least APART degrees from one another."""
SHARPNESS = 25.0  # concentration of the kernel about each normal: a standard deviation of 8°
TUKEY = 4.5  # cut-off of Tukey's weights in medians of |r|, about three standard deviations
_SIDE = 33


@dataclass(frozen=True)
class Similarity:
    """x ↦ linear x + shift; linear [3, 3] a rotation times a scale, shift [3]; score: higher is better."""

    linear: np.ndarray
    shift: np.ndarray
    score: float = 0.0

    def __call__(self, points: np.ndarray) -> np.ndarray:
        return np.einsum("nj,ij->ni", points, self.linear) + self.shift

    @property
    def scale(self) -> float:
        return float(np.cbrt(np.linalg.det(self.linear)))

    def stepped(self, delta: np.ndarray, middle: np.ndarray, extent: float) -> Similarity:
        """Turned, shifted and, with 7 numbers, scaled about `middle`; delta: lengths, at the distance `extent`."""
        turn = Rotation.from_rotvec(delta[:3] / extent).as_matrix()
        grow = float(np.exp(delta[6] / extent)) if len(delta) == 7 else 1.0
        rotation = nearest_rotation(turn @ self.linear / self.scale)
        return Similarity(grow * self.scale * rotation, grow * turn @ (self.shift - middle) + middle + delta[3:6])


def jacobian(points: np.ndarray, slopes: np.ndarray, middle: np.ndarray, extent: float, similar: bool) -> np.ndarray:
    """[P, 6 or 7] derivative of f by `Similarity.stepped`, given its slopes [P, 3] at points [P, 3]."""
    arm = (points - middle) / extent
    parts = [np.cross(arm, slopes), slopes]
    return np.concatenate([*parts, np.einsum("ij,ij->i", arm, slopes)[:, None]] if similar else parts, axis=1)


Images = list[tuple[DepthView, np.ndarray, np.ndarray, np.ndarray]]


def gray_images(views: Sequence[DepthView], blur: float) -> Images:
    """Each view with its blurred brightness and the derivatives of that by u and v, [H, W]; blur: pixels."""
    found: Images = []
    for view in views:
        image = cv2.GaussianBlur(view.brightness, (0, 0), blur)
        by_u, by_v = (cv2.Sobel(image, cv2.CV_32F, *axes, ksize=3) / 8 for axes in ((1, 0), (0, 1)))
        found.append((view, image, by_u, by_v))
    return found


def robust_gain(I: np.ndarray, g: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Gain a, residuals a I + b − g [P] and weights [P] of the line through (I, g), three rounds of reweighting."""
    gain, r, w = 0.0, I, np.ones(len(I))
    for _ in range(3):
        total = max(float(w.sum()), 1e-12)
        i, h = I - (w * I).sum() / total, g - (w * g).sum() / total
        gain = float((w * i * h).sum() / max((w * i * i).sum(), 1e-9))
        r = gain * i - h
        spread = TUKEY * float(np.median(np.abs(r))) + 1e-6
        w = np.maximum(1 - (r / spread) ** 2, 0) ** 2
    return gain, r, w / spread**2


def likely_rotations(normals: np.ndarray, onto: np.ndarray) -> list[np.ndarray]:
    """Up to KEPT rotations [3, 3], best first, that turn unit normals [P, 3] onto unit normals [Q, 3], signs ignored.
    Zero normals are left out. Score: the mean root density of `onto` at the turned normals."""
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
