"""The segmentation that needs no weights: `builtin`."""

from __future__ import annotations

import numpy as np

from perception.masks.regions import segment_photo
from perception.types import View

VERSION = 1  # raised whenever the label images change, so that cached ones are made anew


class BuiltinSegmentation:
    """Regions of even colour and texture, from the photo alone."""

    def __init__(self) -> None:
        self.name = "builtin"
        self.identity = f"builtin {VERSION}"

    def check(self, views: list[View]) -> list[str]:
        """Nothing can be wrong up front."""
        return []

    def label_image(self, view: View, photo: np.ndarray) -> np.ndarray:
        """photo: [h, w, 3] uint8 RGB. Returns [h, w] int32, 0 = unlabelled."""
        return segment_photo(photo)
