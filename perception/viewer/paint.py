"""The colours of the Gaussians in the viewer, by display mode."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from perception.colors import instance_palette, rgb8_from_sh
from perception.io.store import Map
from perception.pictures import features_to_rgb

MODES = ("photo", "instances", "parts", "features")
HIGHLIGHT = np.array([255, 214, 10], np.uint8)


def base_colors(gmap: Map) -> np.ndarray:
    """[N, 3] uint8: the part of each Gaussian's colour that does not depend on the view (harmonic of degree 0)."""
    return rgb8_from_sh(gmap.sh[:, 0])


def paint(gmap: Map, ids: np.ndarray, mode: str) -> np.ndarray:
    """[N, 3] uint8 colours in a mode of MODES; ids [N]: instance (or part) of each Gaussian, −1 = none (grey)."""
    if mode in ("instances", "parts"):
        return instance_palette(ids)
    if mode == "features":
        return features_to_rgb(gmap.features[None])[0]
    return base_colors(gmap)


def highlight(colors: np.ndarray, ids: np.ndarray, chosen: Collection[int]) -> np.ndarray:
    """colors [N, 3] with the chosen instances in HIGHLIGHT's hue and all others dimmed; unchanged if none is chosen."""
    if not chosen:
        return colors
    lit = np.isin(ids, list(chosen))
    dimmed = (0.35 * colors + 28).astype(np.uint8)
    glowing = (0.35 * colors + 0.65 * HIGHLIGHT).astype(np.uint8)
    return np.asarray(np.where(lit[:, None], glowing, dimmed))
