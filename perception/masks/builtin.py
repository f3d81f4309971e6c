"""The segmentation that needs no weights: `builtin`, from the photo alone or with depth from the map."""

from __future__ import annotations

import numpy as np

from perception.masks.regions import refine_with_geometry, segment_photo
from perception.types import View

VERSION = 3  # raised whenever the label images change, so that cached ones are made anew


class BuiltinSegmentation:
    """Regions that look like one object: even colour and texture, and on one surface once depth is known."""

    def __init__(self) -> None:
        self.name = "builtin"
        self.identity = f"builtin {VERSION}"

    def check(self, views: list[View]) -> list[str]:
        """Nothing can be wrong up front."""
        return []

    def label_image(self, view: View, photo: np.ndarray) -> np.ndarray:
        """photo: [h, w, 3] uint8 RGB. Returns [h, w] int32, 0 = unlabelled."""
        return segment_photo(photo)

    def label_image_with_geometry(self, view: View, photo: np.ndarray, depth: np.ndarray) -> np.ndarray:
        """depth: [h, w] z-depth rendered for this view, 0 = none (expected depth divided by alpha)."""
        return refine_with_geometry(photo, depth, _intrinsics_at(view, photo.shape[1], photo.shape[0]))


def _intrinsics_at(view: View, width: int, height: int) -> np.ndarray:
    """K [3, 3] of the view at another size of its picture, by the true ratio per axis."""
    return np.diag([width / view.width, height / view.height, 1.0]) @ view.K
