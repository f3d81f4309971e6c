"""The segmentation that needs no weights: `builtin`, from the photo alone, or from all photos and their geometry."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from perception.masks.regions import segment_photo
from perception.masks.scene import SceneSegmentation
from perception.types import View

VERSION = 6  # raised whenever the label images change, so that cached ones are made anew


class PhotoSegmentation:
    """Regions that look like one object, each photo by itself: what the second round is measured against."""

    def __init__(self) -> None:
        self.name = "builtin:photos"
        self.identity = f"builtin photos {VERSION}"

    def check(self, views: list[View]) -> list[str]:
        """Nothing can be wrong up front."""
        return []

    def label_image(self, view: View, photo: np.ndarray) -> np.ndarray:
        """photo: [h, w, 3] uint8 RGB. Returns [h, w] int32, 0 = unlabelled."""
        return segment_photo(photo)


class BuiltinSegmentation(PhotoSegmentation):
    """Once the map can say how far things are: whole objects in all photos together."""

    def __init__(self) -> None:
        self.name = "builtin"
        self.identity = f"builtin {VERSION}"
        self._scene: SceneSegmentation | None = None

    def survey(
        self,
        views: list[View],
        load_photo: Callable[[View], np.ndarray],
        load_depth: Callable[[View], np.ndarray],
        progress: Callable[[int, int], None] | None = None,
    ) -> None:
        """Segments the surface that all photos show together; load_depth gives [h, w] z-depths, 0 = none."""
        self._scene = SceneSegmentation.of(views, load_photo, load_depth, progress)

    def label_image_with_geometry(self, view: View, photo: np.ndarray) -> np.ndarray:
        """As label_image, after `survey`: ids agree between photos. A photo without depth is judged alone."""
        labels = None if self._scene is None else self._scene.label_image(view, photo)
        return segment_photo(photo) if labels is None else labels
