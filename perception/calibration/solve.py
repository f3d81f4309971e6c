"""Lens parameters and board poses of least reprojection error, with their uncertainty.

OpenCV solves for all intrinsics and poses jointly: its pinhole model (plumb_bob) and its fisheye model (equidistant,
Kannala-Brandt). The covariance of the estimate is σ² (JᵀJ)⁻¹ at the solution, σ² from the residuals, poses included.
"""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from perception.calibration.board import Detection
from perception.errors import InputError

NAMES = {
    "pinhole": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3"),
    "fisheye": ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"),
}
_STOP = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 100, 1e-9)
_GUESSED = sum(  # OpenCV 5 has the flags of the fisheye model elsewhere, with other values
    getattr(cv2.fisheye, name, getattr(cv2, name, 0))
    for name in ("CALIB_USE_INTRINSIC_GUESS", "CALIB_RECOMPUTE_EXTRINSIC", "CALIB_FIX_SKEW")
)
_FOCALS = (0.4, 0.28, 0.6, 1.0)
"""Focal lengths in widths from which the fisheye model is solved, until one fits."""


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
    are removed, and the rest is solved again. InputError when the model does not fit."""
    free = np.arange(len(NAMES[model])) < 8  # k3 is the last of the pinhole's
    try:
        solution = _solved(model, views, size, free)
        solution = _solved(model, _without_outliers(views, solution), size, free)
        if model == "pinhole":
            fuller = _solved(model, solution.views, size, np.ones_like(free))
            solution = fuller if abs(fuller.values[8]) > 3 * fuller.sigmas[8] else solution
    except (cv2.error, np.linalg.LinAlgError) as error:
        why = "is the board flat, and are its sizes right?"
        raise InputError(f"no {model} camera explains the boards found; {why}") from error
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


def _solved(model: str, views: Sequence[Detection], size: tuple[int, int], free: np.ndarray) -> Solution:
    """The solution with the free parameters; the others are 0. Raises cv2.error when OpenCV finds none."""
    if model == "fisheye":
        K, distortion, turns, shifts = _fisheye(views, size)
    else:
        points, pixels = ([getattr(v, name).astype(np.float32) for v in views] for name in ("board_points", "pixels"))
        flags = 0 if free[8] else cv2.CALIB_FIX_K3
        found = cv2.calibrateCamera(points, pixels, size, None, None, None, None, flags, _STOP)  # type: ignore[call-overload]
        K, distortion, turns, shifts = found[1:]
    values = np.concatenate([[K[0, 0], K[1, 1], K[0, 2], K[1, 2]], np.ravel(distortion)[: len(free) - 4]])
    poses = np.hstack([np.reshape(turns, (-1, 3)), np.reshape(shifts, (-1, 3))])
    residuals, normal = _linearised(model, views, values, poses, free)
    cost, count = sum(float((r**2).sum()) for r in residuals), sum(r.size for r in residuals)
    scale = np.sqrt(np.maximum(np.diag(normal), 1e-12))
    covariance = np.linalg.pinv(normal / np.outer(scale, scale), rcond=1e-15, hermitian=True)
    variances = np.diag(covariance) / scale**2 * cost / max(count - len(normal), 1)
    sigmas = np.zeros(len(values))
    sigmas[free] = np.sqrt(np.maximum(variances[: free.sum()], 0))
    return Solution(model, size, list(views), values, sigmas, free, poses, residuals, float(np.sqrt(cost / count)))


def _fisheye(views: Sequence[Detection], size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray, Any, Any]:
    """(K, k1..k4, rotation vectors, translations); OpenCV needs a first focal length for this: some are tried."""
    points = [np.asarray(view.board_points, np.float64)[None] for view in views]
    pixels = [np.asarray(view.pixels, np.float64)[None] for view in views]
    found: list[tuple[float, Any]] = []
    for focal in _FOCALS:
        K = np.array([[focal * size[0], 0, (size[0] - 1) / 2], [0, focal * size[0], (size[1] - 1) / 2], [0, 0, 1]])
        with contextlib.suppress(cv2.error):
            rms, *rest = cv2.fisheye.calibrate(points, pixels, size, K, np.zeros(4), flags=_GUESSED, criteria=_STOP)
            found.append((rms, rest))
            if rms < 1:
                break
    if not found:
        raise cv2.error("no focal length fits")
    return tuple(min(found, key=lambda pair: pair[0])[1])


def _linearised(
    model: str, views: Sequence[Detection], values: np.ndarray, poses: np.ndarray, free: np.ndarray
) -> tuple[list[np.ndarray], np.ndarray]:
    """(residuals of each view, JᵀJ); unknowns: the free parameters, then each view's pose."""
    inner = int(free.sum())
    normal, residuals = np.zeros((inner + 6 * len(views),) * 2), []
    for v, (view, pose) in enumerate(zip(views, poses, strict=True)):
        pixels, jacobian = project(model, values, pose, view.board_points)
        residuals.append(view.pixels - pixels)
        columns = np.concatenate([np.arange(inner), inner + 6 * v + np.arange(6)])
        local = np.hstack([jacobian[:, 6:][:, free], jacobian[:, :6]])
        normal[np.ix_(columns, columns)] += local.T @ local
    return residuals, normal
