"""Where a scan lies in a map: by a known transform, or by registration."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from perception.errors import InputError
from perception.export.align import align
from perception.export.depth_views import DepthView, depth_views
from perception.geometry import check_similarity, scale_of
from perception.io.store import Map
from perception.pipeline.rendering import as_gaussians, map_views
from perception.types import PointCloud

MOST_VIEWS, LONG_SIDE = 90, 320
"""Views rendered for a registration, and their size in pixels."""


def rendered_depth(gmap: Map, most: int, long_side: int) -> list[DepthView]:
    """Depth from up to `most` of the map's views, evenly chosen, in the map's frame; InputError without views."""
    views = map_views(gmap, held_out=False)
    if not views:
        raise InputError(f"{gmap.path}: holds no views, and depth is rendered from those; map again from photos")
    return depth_views(as_gaussians(gmap), views[:: -(-len(views) // most)], long_side)


def aligned(gmap: Map, scan: PointCloud, name: str) -> tuple[np.ndarray, dict[str, Any]]:
    """(map_from_scan [4, 4], facts); InputError naming the scan if refused.

    With a scale where the map's unit is not known to be the metre.
    """
    found = align(rendered_depth(gmap, MOST_VIEWS, LONG_SIDE), scan, similar=not gmap.metric)
    if found.refusal is not None:
        raise InputError(
            f"{name}: cannot be aligned with the map: {found.refusal}; give the place with --transform FILE"
        )
    facts = {
        key: round(float(getattr(found, key)), 6) for key in ("scale", "agreement", "overlap", "cover", "rms", "rival")
    }
    return found.map_from_scan, {"verdict": "accepted", **facts}


def read_transform(path: Path) -> np.ndarray:
    """map_from_scan [4, 4] float64: four rows of four numbers as text or JSON, or a JSON object that holds them as
    `map_from_scan`, as `export` writes. InputError unless it is a rotation, a positive scale and a translation."""
    try:
        text = path.read_text(encoding="utf-8")
        if text.lstrip()[:1] in ("[", "{"):
            rows = json.loads(text)
            rows = rows["map_from_scan"] if isinstance(rows, dict) else rows
        else:
            rows = [
                [float(word) for word in line.replace(",", " ").split()] for line in text.splitlines() if line.strip()
            ]
    except (OSError, ValueError, KeyError) as error:
        raise InputError(f"{path}: expected a 4 × 4 matrix as text or JSON ({error})") from error
    matrix = check_similarity(rows, str(path))
    if not 1e-9 < scale_of(matrix) < 1e9:
        raise InputError(f"{path}: its scale is {scale_of(matrix):g}, expected 1e-9 to 1e9")
    return matrix
