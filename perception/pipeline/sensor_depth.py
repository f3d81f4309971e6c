"""What a run made of depth images, for its record: how much was measured, and how far rendered depth is from it."""

from __future__ import annotations

from typing import Any

import numpy as np

from perception.gaussians.model import Gaussians
from perception.gaussians.train import TrainingView, depth_image

CLOSE_METRES, CLOSE_SHARE = 0.05, 0.025
"""Errors that count as close: in metres, or relative to the depth where the unit is not known to be the metre."""


def depth_used(views: list[TrainingView]) -> dict[str, Any] | None:
    """Number of training views with a depth image and the share of their pixels that has depth; None without any."""
    shares = [float((view.depth > 0).double().mean()) for view in views if view.depth is not None]
    return {"views": len(shares), "measured": round(float(np.mean(shares)), 4)} if shares else None


def depth_errors(gaussians: Gaussians, views: list[TrainingView], metric: bool) -> dict[str, Any] | None:
    """Errors of the rendered depth where a sensor measured, over all `views`; None when no pixel has both.

    median: absolute error in units of the map, or relative to the depth (unit "relative") where that is not the metre.
    close: share of the measured pixels with an error of at most `tolerance`; rendered: share that the map covers.
    """
    errors, measured = [], 0
    for view in views:
        if view.depth is None:
            continue
        rendered = depth_image(gaussians, view.camera_from_world, view.K, *view.photo.shape[1::-1]).numpy()
        known = view.depth.numpy() > 0
        measured += int(known.sum())
        both = known & (rendered > 0)
        true = view.depth.numpy()[both].astype(np.float64)
        errors.append(np.abs(rendered[both] - true) / (1 if metric else true))
    if not errors or not sum(map(len, errors)):
        return None
    error, tolerance = np.concatenate(errors), CLOSE_METRES if metric else CLOSE_SHARE
    return {
        "median": round(float(np.median(error)), 5),
        "close": round(float((error <= tolerance).sum() / measured), 4),
        "tolerance": tolerance,
        "unit": "m" if metric else "relative",
        "rendered": round(len(error) / measured, 4),
    }
