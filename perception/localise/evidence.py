"""Whether a photo shows what the map says that it should: a thing or texture that is elsewhere as well agrees with a
pose by itself, and what is around it does not."""

from __future__ import annotations

import numpy as np

from perception.localise.pose import Matched, Pose
from perception.localise.reference import Reference
from perception.photos.lens import camera_from_lens

ANGLE, SCALE = np.cos(np.radians(30.0)), 2.0
"""A point is expected in a photo if a photo of the map shows it from a direction that differs by less than this angle,
from at most SCALE times nearer or farther: features match that much."""
SAME_RAY = 0.01
"""Relative difference of rays up to which they are one; those that a lens confuses differ by far more."""
GRID = 8
"""The picture is judged in GRID × GRID cells; one with at least LEAST_POINTS expected points should show a feature."""
LEAST_POINTS = 3
MIN_CELLS, MIN_SHARE = 6, 0.35
"""Least cells with features that agree, and least share of those that should show some. Read of right poses, with
changed scenes and other light: 0.64 to 0.96; of wrong ones at most 0.2."""


def doubt(reference: Reference, matched: Matched, pose: Pose) -> str | None:
    """One line if the features that agree with a pose are in too few parts of the picture; else None."""
    size = np.array([pose.lens.width, pose.lens.height])
    shown = _cells(matched.pixel[pose.inliers], size) > 0
    expected = _cells(_expected(reference, pose), size) >= LEAST_POINTS
    hits, cells = int(shown.sum()), int((shown | expected).sum())
    if hits >= MIN_CELLS and hits >= MIN_SHARE * cells:
        return None
    return f"{pose.count} features agree with one pose, in {hits} of {cells} parts of the picture that should show some"


def _expected(reference: Reference, pose: Pose) -> np.ndarray:
    """Pixels [E, 2] of the map's points that the photo should show."""
    rotation, shift = pose.camera_from_map[:3, :3], pose.camera_from_map[:3, 3]
    rows = np.flatnonzero(reference.point >= 0)
    point, view = reference.point[rows], reference.described.features.view[rows]
    before = reference.points[point] - reference.poses.center[view]
    now = reference.points[point] + rotation.T @ shift
    far, near = np.linalg.norm(before, axis=1), np.linalg.norm(now, axis=1)
    alike = ((before * now).sum(axis=1) > ANGLE * far * near) & (near < SCALE * far) & (far < SCALE * near)
    x = reference.points[np.unique(point[alike])] @ rotation.T + shift
    x, camera = x[x[:, 2] > 0], camera_from_lens(pose.lens)
    pixel = np.asarray(camera.img_from_cam(x), np.float64).reshape(-1, 2)
    inside = ((pixel >= 0) & (pixel < (pose.lens.width, pose.lens.height))).all(axis=1)
    pixel, rays = pixel[inside], x[inside, :2] / x[inside, 2:]
    back = np.asarray(camera.cam_from_img(pixel), np.float64).reshape(-1, 2)
    # A polynomial of distortion leads rays from far outside the picture into it: those do not come back.
    return pixel[np.linalg.norm(back - rays, axis=1) < SAME_RAY * (1 + np.linalg.norm(rays, axis=1))]


def _cells(pixel: np.ndarray, size: np.ndarray) -> np.ndarray:
    """[GRID²] number of pixels [M, 2] in each part of a picture of this size (width, height)."""
    inside = pixel[((pixel >= 0) & (pixel < size)).all(axis=1)]
    return np.bincount((inside / size * GRID).astype(np.int64) @ (1, GRID), minlength=GRID * GRID)
