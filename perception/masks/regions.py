"""Regions of a photo by efficient graph-based segmentation (Felzenszwalb & Huttenlocher 2004) in Lab."""

from __future__ import annotations

import numpy as np


def segment_photo(photo: np.ndarray, scale: float = 300.0, min_area: float = 6.5e-4) -> np.ndarray:
    """photo: [h, w, 3] uint8 RGB. Returns [h, w] int32 labels 1.., every pixel in a region.

    scale: larger prefers larger regions. min_area: share of the image below which regions join a neighbour.
    """
    import cv2
    from skimage.segmentation import felzenszwalb

    lab = cv2.cvtColor(photo, cv2.COLOR_RGB2LAB)
    smallest = max(int(min_area * photo.shape[0] * photo.shape[1]), 20)
    return felzenszwalb(lab, scale=scale, sigma=0.8, min_size=smallest).astype(np.int32) + 1
