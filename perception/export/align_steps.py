"""One Gauss-Newton step of an alignment: on planes (ICP), and on the brightness of rendered pictures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.ndimage import map_coordinates
from scipy.spatial.transform import Rotation

from perception.export.depth_views import DepthView
from perception.geometry import nearest_rotation

FACING = 0.7
"""Least cosine of the normals of points that are matched."""
LEAST_GAIN = 0.2
"""Views whose brightness goes less than this with the scan's are left out of a step."""


@dataclass(frozen=True)
class Place:
    """x ↦ linear x + shift; linear [3, 3] a rotation times a scale, shift [3]; score: higher is better."""

    linear: np.ndarray
    shift: np.ndarray
    score: float = 0.0

    def __call__(self, points: np.ndarray) -> np.ndarray:
        return np.einsum("nj,ij->ni", points, self.linear) + self.shift

    @property
    def scale(self) -> float:
        return float(np.cbrt(np.linalg.det(self.linear)))

    def stepped(self, delta: np.ndarray, middle: np.ndarray, extent: float) -> Place:
        """Turned, shifted and, with 7 numbers, scaled about `middle`; delta: lengths, at the distance `extent`."""
        turn = Rotation.from_rotvec(delta[:3] / extent).as_matrix()
        grow = float(np.exp(delta[6] / extent)) if len(delta) == 7 else 1.0
        rotation = nearest_rotation(turn @ self.linear / self.scale)
        return Place(grow * self.scale * rotation, grow * turn @ (self.shift - middle) + middle + delta[3:6])


def _jacobian(points: np.ndarray, slopes: np.ndarray, middle: np.ndarray, extent: float, similar: bool) -> np.ndarray:
    """[P, 6 or 7] derivative of f by `Place.stepped`, given its slopes [P, 3] at points [P, 3]."""
    arm = (points - middle) / extent
    parts = [np.cross(arm, slopes), slopes]
    return np.concatenate([*parts, np.einsum("ij,ij->i", arm, slopes)[:, None]] if similar else parts, axis=1)


def plane_step(
    place: Place,
    points: np.ndarray,
    normals: np.ndarray,
    targets: np.ndarray,
    target_normals: np.ndarray,
    width: float,
    extent: float,
    similar: bool,
) -> tuple[Place, float, np.ndarray]:
    """A step that lowers Σ w r², r = n·(s R p + t − q), w = (1 − r²/width²)² for |r| < width, else 0 (Tukey).

    Points p and targets q [P, 3], with normals, are matched by row. Returns the new place, the weighted rms before the
    step, and the information matrix divided by Σ w.
    """
    moved = place(points)
    r = np.einsum("ij,ij->i", target_normals, moved - targets)
    facing = np.abs(np.einsum("ij,ij->i", target_normals, np.einsum("nj,ij->ni", normals, place.linear / place.scale)))
    w = np.maximum(1 - (r / width) ** 2, 0) ** 2 * (facing > FACING)
    total = max(float(w.sum()), 1e-12)
    middle = np.einsum("i,ij->j", w, moved) / total
    J = _jacobian(moved, target_normals, middle, extent, similar)
    A = np.einsum("i,ij,ik->jk", w, J, J) / total
    b = np.einsum("i,ij,i->j", w, J, r) / total
    delta = -np.linalg.solve(A + 1e-6 * np.eye(len(A)), b)
    return place.stepped(delta, middle, extent), float(np.sqrt(np.einsum("i,i,i->", w, r, r) / total)), A


Images = list[tuple[DepthView, np.ndarray, np.ndarray, np.ndarray]]


def gray_images(views: Sequence[DepthView], blur: float) -> Images:
    """Each view with its blurred brightness and the derivatives of that by u and v, [H, W]; blur: pixels."""
    found: Images = []
    for view in views:
        image = cv2.GaussianBlur(view.brightness, (0, 0), blur)
        by_u, by_v = (cv2.Sobel(image, cv2.CV_32F, *axes, ksize=3) / 8 for axes in ((1, 0), (0, 1)))
        found.append((view, image, by_u, by_v))
    return found


def photometric_step(
    place: Place,
    points: np.ndarray,
    brightness: np.ndarray,
    images: Images,
    tolerance: float,
    extent: float,
    similar: bool,
) -> Place:
    """A step that lowers Σ w (a_v I_v(π_v(s R p + t)) + b_v − g_p)² over views v and the points p on their depth.

    points [P, 3] with brightness g [P]; I_v: rendered brightness; a_v, b_v: gain and offset of each view; w: Tukey's
    weights by the spread of the view's residuals.
    """
    moved = place(points)
    middle, size = moved.mean(axis=0), 7 if similar else 6
    A, b = np.zeros((size, size)), np.zeros(size)
    for view, *layers in images:
        rows, u, v, own = view.seen(moved, tolerance)
        if len(rows) < 50:
            continue
        I, Iu, Iv = (map_coordinates(layer, [v - 0.5, u - 0.5], order=1, mode="nearest") for layer in layers)
        gain, r, w = _robust_gain(I.astype(np.float64), brightness[rows])
        if gain < LEAST_GAIN:
            continue
        x, y, z = own.T
        fx, fy = view.K[0, 0], view.K[1, 1]
        slopes = np.stack([Iu * fx / z, Iv * fy / z, -(Iu * fx * x + Iv * fy * y) / z**2], axis=1)
        slopes = gain * np.einsum("nj,ji->ni", slopes, view.camera_from_world[:3, :3])
        J = _jacobian(moved[rows], slopes, middle, extent, similar)
        A += np.einsum("i,ij,ik->jk", w, J, J)
        b += np.einsum("i,ij,i->j", w, J, r)
    if not np.trace(A) > 0:
        return place
    return place.stepped(-np.linalg.solve(A + 1e-6 * np.trace(A) * np.eye(size), b), middle, extent)


def _robust_gain(I: np.ndarray, g: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Gain a, residuals a I + b − g [P] and weights [P] of the line through (I, g), three rounds of reweighting."""
    gain, r, w = 0.0, I, np.ones(len(I))
    for _ in range(3):
        total = max(float(w.sum()), 1e-12)
        i, h = I - (w * I).sum() / total, g - (w * g).sum() / total
        gain = float((w * i * h).sum() / max((w * i * i).sum(), 1e-9))
        r = gain * i - h
        spread = 4.5 * float(np.median(np.abs(r))) + 1e-6
        w = np.maximum(1 - (r / spread) ** 2, 0) ** 2
    return gain, r, w / spread**2
