"""The colours of the Gaussians in the viewer, by display mode."""

from __future__ import annotations

from collections.abc import Collection, Mapping

import cv2
import numpy as np

from perception.colors import instance_palette, rgb8_from_sh
from perception.io.store import Map
from perception.pictures import features_to_rgb

MODES = ("photo", "instances", "parts", "features", "confidence", "depth")
HIGHLIGHT = np.array([255, 214, 10], np.uint8)


def base_colors(gmap: Map) -> np.ndarray:
    """[N, 3] uint8: the part of each Gaussian's colour that does not depend on the view (harmonic of degree 0)."""
    return rgb8_from_sh(gmap.sh[:, 0])


def paint(
    gmap: Map, ids: np.ndarray, mode: str, scores: Mapping[int, float], from_above: np.ndarray | None = None
) -> np.ndarray:
    """[N, 3] uint8 colours in a mode of MODES.

    ids [N]: instance (or part) of each Gaussian, −1 = none (grey in those modes). scores: confidence by instance id.
    from_above: camera_from_world [4, 4] of the camera that depth is measured from; None = identity.
    """
    if mode in ("instances", "parts"):
        return instance_palette(ids)
    if mode == "features":
        return features_to_rgb(gmap.features[None])[0]
    if mode == "confidence":
        known = np.array([scores.get(int(i), -1.0) for i in range(int(ids.max(initial=-1)) + 1)] + [-1.0])
        return _ramp(known[ids], cv2.COLORMAP_VIRIDIS)
    if mode == "depth":
        view = np.eye(4) if from_above is None else from_above
        depth = gmap.means @ view[2, :3] + view[2, 3]
        low, high = np.percentile(depth[depth > 0], [2, 98]) if (depth > 0).any() else (0.0, 1.0)
        near = 1 - np.clip((depth - low) / max(high - low, 1e-9), 0, 1)
        return _ramp(np.where(depth > 0, near, -1), cv2.COLORMAP_TURBO)
    return base_colors(gmap)


def highlight(colors: np.ndarray, ids: np.ndarray, chosen: Collection[int]) -> np.ndarray:
    """colors [N, 3] with the chosen instances in HIGHLIGHT's hue and all others dimmed; unchanged if none is chosen."""
    if not chosen:
        return colors
    lit = np.isin(ids, list(chosen))
    dimmed = (0.35 * colors + 28).astype(np.uint8)
    glowing = (0.35 * colors + 0.65 * HIGHLIGHT).astype(np.uint8)
    return np.asarray(np.where(lit[:, None], glowing, dimmed))


def _ramp(level: np.ndarray, name: int) -> np.ndarray:
    """Levels in [0, 1] as colours, grey below 0."""
    steps = np.round(255 * np.clip(level, 0, 1)).astype(np.uint8)
    colors = cv2.applyColorMap(steps.reshape(-1, 1), name)[:, 0, ::-1]
    return np.asarray(np.where(level[:, None] < 0, np.uint8(128), colors))
