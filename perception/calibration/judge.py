"""Checks whether views suffice: number of distinct views, tilt, coverage, and uncertainty of the focal length."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from perception.calibration.board import Detection
from perception.calibration.solve import Solution
from perception.errors import InputError

MIN_VIEWS = 5
MIN_TILT_SPREAD = 20.0
"""Required angle in degrees between two board normals. Parallel views do not separate focal length and distance."""
MAX_FOCAL_SIGMA = 0.01
"""Maximum relative standard deviation of the focal length of an accepted calibration."""
MIN_COVERAGE, GOOD_COVERAGE = 0.25, 0.6
"""Share of the image area inside the convex hull of all corners: error below the first, warning below the second."""
SAME_VIEW = 0.03
"""Views count as equal if their corners move by less than this share of the image width."""


def distinct_views(views: Sequence[Detection], width: int) -> list[Detection]:
    """The views without those that repeat an earlier one (static video, burst photos)."""
    kept: list[Detection] = []
    for view in views:
        if all(_motion(view, other) > SAME_VIEW * width for other in kept):
            kept.append(view)
    return kept


def _motion(a: Detection, b: Detection) -> float:
    """Median displacement in pixels of the corners that both views show; infinite if they share fewer than 4."""
    places = {tuple(p): q for p, q in zip(a.board_points.round(6).tolist(), a.pixels, strict=True)}  # type: ignore[misc]
    shared = [
        float(np.linalg.norm(places[tuple(p)] - q))
        for p, q in zip(b.board_points.round(6).tolist(), b.pixels, strict=True)
        if tuple(p) in places
    ]
    return float(np.median(shared)) if len(shared) >= 4 else float("inf")


def coverage(solution: Solution) -> float:
    """Share of the image area within the convex hull of all corners."""
    hull = cv2.convexHull(np.concatenate([view.pixels for view in solution.views]).astype(np.float32))
    return float(cv2.contourArea(hull)) / (solution.size[0] * solution.size[1])


def tilt_spread(solution: Solution) -> float:
    """Largest angle in degrees between the board normals of two views."""
    normals = np.stack([cv2.Rodrigues(pose[:3])[0][:, 2] for pose in solution.poses])
    return float(np.degrees(np.arccos(np.clip((normals @ normals.T).min(), -1, 1))))


def check_count(views: Sequence[Detection], found: int, looked_at: int, what: str, source: str) -> None:
    """Raises InputError if no board was found, or too few distinct views of it."""
    if found == 0:
        raise InputError(
            f"{source}: no {what} was found in {looked_at} pictures; check --board, --squares (of squares, not "
            "corners) and --dictionary, and that the board is sharp and wholly lit"
        )
    if len(views) < MIN_VIEWS:
        raise InputError(
            f"{source}: the board is seen in {found} of {looked_at} pictures, {len(views)} of them different; at least "
            f"{MIN_VIEWS} different views are needed: move and tilt it (20 are good)"
        )


def check_solution(solution: Solution, source: str) -> list[str]:
    """Returns warnings. Raises InputError if the views do not determine the camera."""
    spread = tilt_spread(solution)
    if spread < MIN_TILT_SPREAD:
        raise InputError(
            f"{source}: the views are too alike: the board's directions differ by {spread:.0f} degrees at most, at "
            f"least {MIN_TILT_SPREAD:.0f} are needed; tilt it by 30 to 45 degrees to all sides"
        )
    sigma = float((solution.sigmas[:2] / solution.values[:2]).max())
    if not sigma <= MAX_FOCAL_SIGMA:
        raise InputError(
            f"{source}: the views do not fix the focal length (uncertain by {100 * sigma:.1f} %, at most "
            f"{100 * MAX_FOCAL_SIGMA:.0f} % is accepted); add views with the board tilted and near the corners"
        )
    share = coverage(solution)
    if share < MIN_COVERAGE:
        raise InputError(
            f"{source}: the board covers {share:.0%} of the picture over all views, at least {MIN_COVERAGE:.0%} is "
            "needed; move it into the corners of the picture, or nearer"
        )
    notes = []
    if share < GOOD_COVERAGE:
        notes.append(f"the board covers {share:.0%} of the picture; beyond that the distortion is a guess")
    if solution.rms > 1.0:
        notes.append(f"reprojection error is {solution.rms:.2f} px; is the board flat, and the pictures sharp?")
    return notes
