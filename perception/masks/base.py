"""The interface of mask sources."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import numpy as np

from perception.io.memory import Keep
from perception.masks.merging import Segmentation
from perception.progress import Progress
from perception.types import View

LoadImage = Callable[[View], np.ndarray]
"""View -> its photo [h, w, 3] uint8 RGB, undistorted, or its z-depth [h, w] in scene units, 0 = none."""


class MaskSource(Protocol):
    """Gives each photo a label image. Ids need not be consistent across photos.

    name: short, for messages. identity: cache key; it changes whenever the label images could change.
    needs_depth: labels are made from the depth of all photos, so the map's geometry must be trained first.
    remote: labels are slow and need nothing but the photo, so other machines may make them.
    photos_at_once: number of threads in which `label_image` is called.
    """

    name: str
    identity: str
    needs_depth: bool = False
    remote: bool = False
    photos_at_once: int = 1

    def check(self, views: list[View]) -> list[str]:
        """Validates everything that can be checked before any work. Returns warnings. Raises InputError."""
        return []

    def prepare(
        self, views: list[View], load_photo: LoadImage, load_depth: LoadImage, progress: Progress, keep: Keep
    ) -> Segmentation | None:
        """With `needs_depth`, called once before `label_image`: segments the surface that all photos show, if it finds
        one. keep: where its images are held."""
        return None

    def label_image(self, view: View, photo: np.ndarray) -> np.ndarray:
        """photo: [h, w, 3] uint8 RGB, undistorted. Returns [h, w] int32, 0 = unlabelled."""
        ...
