"""Leaves out cameras that lie far from all others: structure from motion now and then registers one kilometres away."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from perception.errors import InputError
from perception.geometry import camera_centres, far_from_most
from perception.types import View


def without_far(
    views: list[View], points: np.ndarray, shared: set[str], strict: bool, source: Path
) -> tuple[list[View], list[dict[str, str]]]:
    """The views without those that lie far from the others and share nothing with them, and these as left out.
    points [P, 3] of the scene, in its frame. shared: names of views that see points that others see as well.
    InputError for such a view if `strict`."""
    centres = camera_centres(np.stack([view.camera_from_world for view in views]))
    middle = np.median(centres, axis=0)
    depth = float(np.median(np.linalg.norm(points - middle, axis=1))) if len(points) else 0.0
    far = far_from_most(centres, depth) & [view.name not in shared for view in views]
    why = "lies {:.3g} units from the other cameras, far beyond the scene, and shares no points with them"
    distance = np.linalg.norm(centres - middle, axis=1)
    out = [{"name": views[i].name, "why": why.format(distance[i])} for i in np.flatnonzero(far)]
    if out and strict:
        raise InputError(f"{source}: the camera of {out[0]['name']} {out[0]['why']}; repair or remove it")
    return [view for view, is_far in zip(views, far, strict=True) if not is_far], out
