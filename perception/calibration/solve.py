"""Lens parameters and board poses of least reprojection error, with their uncertainty.

Levenberg-Marquardt over all intrinsics and poses jointly. Jacobians are from OpenCV: its pinhole model (plumb_bob) and
its fisheye model (equidistant, Kannala-Brandt). The covariance of the estimate is σ² (JᵀJ)⁻¹, with σ² from the
residuals and poses included.

The solver accumulates JᵀJ view by view: 60 views of 70 corners take 0.3 s. With the same Jacobians,
scipy.optimize.least_squares finds the same camera in 6 to 23 s ("lm"); with sparse Jacobians ("trf", "lsmr") it takes
9 to 23 s and is less precise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from perception.calibration.board import Detection
from perception.errors import InputError

NAMES = {
    "pinhole": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3"),
    "fisheye": ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"),
}
_ITERATIONS = 60


@dataclass(frozen=True)
class Solution:
    """A calibrated camera.

    model: "pinhole" or "fisheye"; values and sigmas [P] in the order of NAMES[model], pixels in OpenCV's convention;
    free [P]: which ones were estimated (the others are 0). views: without outliers. poses [V, 6]: camera_from_board as
    rotation vector and translation. residuals: per view [N, 2] pixels, detected − predicted. rms: pixels.
    """

    model: str
    size: tuple[int, int]
    views: list[Detection]
    values: np.ndarray
    sigmas: np.ndarray
    free: np.ndarray
    poses: np.ndarray
    residuals: list[np.ndarray]
    rms: float

    @property
    def view_errors(self) -> np.ndarray:
        """Root mean square length [V] of each view's residuals, pixels."""
        return np.array([np.sqrt((r**2).sum(axis=1).mean()) for r in self.residuals])


def project(model: str, values: np.ndarray, pose: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels [N, 2] of board points [N, 3] under camera_from_board `pose` [6], and their Jacobian [2N, 6 + P]:
    rotation vector, translation, then the parameters in the order of NAMES."""
    K = np.array([[values[0], 0, values[2]], [0, values[1], values[3]], [0, 0, 1.0]])
    points = np.ascontiguousarray(points, np.float64).reshape(-1, 1, 3)
    if model == "fisheye":
        # OpenCV's columns: fx fy, cx cy, k1..k4, rotation, translation, skew
        pixels, jacobian = cv2.fisheye.projectPoints(points, pose[:3], pose[3:], K, values[4:])
        return pixels.reshape(-1, 2), np.hstack([jacobian[:, 8:14], jacobian[:, :8]])
    # OpenCV's columns: rotation, translation, fx fy, cx cy, k1 k2 p1 p2 k3
    pixels, jacobian = cv2.projectPoints(points, pose[:3], pose[3:], K, values[4:])[:2]
    return pixels.reshape(-1, 2), jacobian[:, : 6 + len(values)]


def solve(model: str, views: Sequence[Detection], size: tuple[int, int]) -> Solution:
    """Calibrates from at least two views of a board. size: (width, height) of the images.

    k3 of the pinhole model is kept only if it differs from 0 by more than three standard deviations. Outlier corners
    are removed, and the rest is solved again.
    """
    free = np.ones(len(NAMES[model]), bool)
    if model == "pinhole":
        free[8] = False
    values, poses = _start(model, views, size)
    solution = _descend(model, views, size, values, poses, free)
    views = _without_outliers(views, solution)
    solution = _descend(model, views, size, solution.values, solution.poses, free)
    if model == "pinhole":
        fuller = _descend(model, views, size, solution.values, solution.poses, np.ones(len(free), bool))
        if abs(fuller.values[8]) > 3 * fuller.sigmas[8]:
            return fuller
    return solution


def _without_outliers(views: Sequence[Detection], solution: Solution) -> list[Detection]:
    """The views without corners whose error exceeds six robust standard deviations (at least a pixel)."""
    lengths = [np.linalg.norm(r, axis=1) for r in solution.residuals]
    limit = max(6 * 1.4826 * float(np.median(np.concatenate(lengths))), 1.0)
    kept = []
    for view, length in zip(views, lengths, strict=True):
        good = length <= limit
        good = good if good.sum() >= 4 else np.ones_like(good)
        kept.append(Detection(view.name, view.board_points[good], view.pixels[good]))
    return kept


def _descend(
    model: str,
    views: Sequence[Detection],
    size: tuple[int, int],
    values: np.ndarray,
    poses: np.ndarray,
    free: np.ndarray,
) -> Solution:
    """Levenberg-Marquardt from initial values; parameters that are not free are set to 0."""
    values, poses = np.where(free, values, 0.0), poses.copy()
    damping = 1e-3
    residuals, normal, gradient = _linearised(model, views, values, poses, free)
    cost = sum(float((r**2).sum()) for r in residuals)
    for _ in range(_ITERATIONS):
        scale = np.sqrt(np.maximum(np.diag(normal), 1e-12))
        system = normal / np.outer(scale, scale) + damping * np.eye(len(normal))
        step = np.linalg.solve(system, gradient / scale) / scale
        tried = values.copy()
        tried[free] += step[: free.sum()]
        moved = poses + step[free.sum() :].reshape(-1, 6)
        trial = _linearised(model, views, tried, moved, free)
        trial_cost = sum(float((r**2).sum()) for r in trial[0])
        if not np.isfinite(trial_cost) or trial_cost > cost:
            damping *= 8
            if damping > 1e8:
                break
            continue
        gain = cost - trial_cost
        values, poses, cost = tried, moved, trial_cost
        residuals, normal, gradient = trial
        damping = max(damping / 5, 1e-12)
        if gain < 1e-10 * max(cost, 1e-12):
            break
    count = sum(r.size for r in residuals)
    sigmas = np.zeros(len(values))
    freedom = count - len(normal)
    if freedom > 0:
        scale = np.sqrt(np.maximum(np.diag(normal), 1e-12))
        covariance = np.linalg.pinv(normal / np.outer(scale, scale), rcond=1e-15, hermitian=True)
        variances = np.diag(covariance) / scale**2 * cost / freedom
        sigmas[free] = np.sqrt(np.maximum(variances[: free.sum()], 0))
    return Solution(model, size, list(views), values, sigmas, free, poses, residuals, float(np.sqrt(cost / count)))


def _linearised(
    model: str, views: Sequence[Detection], values: np.ndarray, poses: np.ndarray, free: np.ndarray
) -> tuple[list[np.ndarray], np.ndarray, np.ndarray]:
    """(residuals of each view, JᵀJ, Jᵀr); unknowns: the free parameters, then each view's pose."""
    inner = int(free.sum())
    total = inner + 6 * len(views)
    normal, gradient = np.zeros((total, total)), np.zeros(total)
    residuals = []
    for v, (view, pose) in enumerate(zip(views, poses, strict=True)):
        pixels, jacobian = project(model, values, pose, view.board_points)
        r = view.pixels - pixels
        residuals.append(r)
        columns = np.concatenate([np.arange(inner), inner + 6 * v + np.arange(6)])
        local = np.hstack([jacobian[:, 6:][:, free], jacobian[:, :6]])
        normal[np.ix_(columns, columns)] += local.T @ local
        gradient[columns] += local.T @ r.ravel()
    return residuals, normal, gradient


def _start(model: str, views: Sequence[Detection], size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Initial parameters and poses: from a list of focal lengths, the one with the smallest reprojection error."""
    width, height = size
    best: tuple[float, np.ndarray, np.ndarray] | None = None
    for factor in (0.25, 0.32, 0.4, 0.5, 0.65, 0.8, 1.0, 1.3, 1.7, 2.3, 3.0):
        values = np.zeros(len(NAMES[model]))
        values[:4] = factor * width, factor * width, (width - 1) / 2, (height - 1) / 2
        poses = [_pose(model, values, view) for view in views]
        known = [(view, pose) for view, pose in zip(views, poses, strict=True) if pose is not None]
        if len(known) < len(views):
            continue
        errors = [
            np.median(np.linalg.norm(view.pixels - project(model, values, pose, view.board_points)[0], axis=1))
            for view, pose in known
        ]
        error = float(np.mean(errors))
        if np.isfinite(error) and (best is None or error < best[0]):
            best = error, values, np.array([pose for _, pose in known])
    if best is None:
        raise InputError(f"no {model} camera explains the boards found; is the board flat, and are its sizes right?")
    return best[1], best[2]


def _pose(model: str, values: np.ndarray, view: Detection) -> np.ndarray | None:
    """camera_from_board [6] of a view for given parameters; None if the view does not fit them."""
    K = np.array([[values[0], 0, values[2]], [0, values[1], values[3]], [0, 0, 1.0]])
    pixels = view.pixels.astype(np.float64).reshape(-1, 1, 2)
    if model == "fisheye":
        radius = np.linalg.norm((view.pixels - values[2:4]) / values[:2], axis=1)
        if radius.max() > 1.5:  # 86 degrees from the axis: a plane cannot be imaged beyond 90
            return None
        rays = cv2.fisheye.undistortPoints(pixels, K, values[4:])
    else:
        rays = cv2.undistortPoints(pixels, K, values[4:])
    if not np.isfinite(rays).all():
        return None
    found, rotation, translation = cv2.solvePnP(
        view.board_points.astype(np.float64), rays, np.eye(3), None, flags=cv2.SOLVEPNP_IPPE
    )
    if not found or not np.isfinite(rotation).all() or translation.ravel()[2] <= 0:
        return None
    return np.concatenate([rotation.ravel(), translation.ravel()])
