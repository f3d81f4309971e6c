"""Run record: peak memory, and what a run made of depth images: how much was measured, and
how far rendered depth is from it.
"""

from __future__ import annotations

import math
import resource
import sys
from typing import Any

import numpy as np

from perception.gaussians.model import Gaussians
from perception.gaussians.views import TrainingView, depth_image


def peak_memory_mib() -> float:
    """Largest resident memory of this process so far, MiB."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return round(peak / (1024 * 1024 if sys.platform == "darwin" else 1024), 1)


def finite(value: Any) -> Any:
    """JSON-able `value` with None for every float that is NaN or infinite, which JSON cannot hold."""
    if isinstance(value, dict):
        return {key: finite(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [finite(inner) for inner in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


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
