"""Object-sized regions of one photo by its colours alone: many small ones first, then merged on evidence.

The weights are log odds: a logistic regression on pairs of regions met while merging every 8th photo of two rendered
scenes with exact truth. Nothing else was learned. Order: constant, border gradient, colour distance, distance of the
colour histograms, texture difference, smaller area, common share of the border, texture.
"""

from __future__ import annotations

import numpy as np

from perception.masks.cues import PhotoCues, photo_cues
from perception.masks.region_graph import RegionGraph, Watcher, agglomerate

PHOTO_WEIGHTS = np.array([5.21, -0.86, 0.01, -5.22, 0.41, -0.32, 1.52, 0.83])
# Log odds over which regions merge: above even odds, since a merged pair is lost, a split one can still be joined by
# the contrastive loss.
PHOTO_THRESHOLD = 1.5

_WORKING_SIDE = 640  # pixels of the long side, so that blurs and reaches mean the same everywhere
SMALLEST = 5e-4  # share of the image under which a region joins its likeliest neighbour


def segment_photo(photo: np.ndarray) -> np.ndarray:
    """photo: [h, w, 3] uint8 RGB. Returns [h, w] int32 labels 1.., every pixel in a region."""
    import cv2

    height, width = photo.shape[:2]
    ratio = _WORKING_SIDE / max(height, width)
    size = (max(1, round(width * ratio)), max(1, round(height * ratio)))
    look = photo_cues(cv2.resize(photo, size, interpolation=cv2.INTER_CUBIC if ratio > 1 else cv2.INTER_AREA))
    labels = merge_regions(first_regions(look), look, PHOTO_WEIGHTS, PHOTO_THRESHOLD)
    return cv2.resize(labels, (width, height), interpolation=cv2.INTER_NEAREST)


def first_regions(photo: PhotoCues) -> np.ndarray:
    """[h, w] int, a few hundred 0.., by Felzenszwalb & Huttenlocher 2004 in colour."""
    import cv2
    from skimage.segmentation import felzenszwalb

    colour = cv2.bilateralFilter(photo.lab, 5, 40, 5) / 255.0
    return felzenszwalb(colour.astype(np.float64), scale=80.0, sigma=0.8, min_size=60)


def merge_regions(
    regions: np.ndarray, photo: PhotoCues, weights: np.ndarray, threshold: float, watch: Watcher | None = None
) -> np.ndarray:
    """regions: [h, w] int 0... Returns [h, w] int32 labels 1.. of what is left after merging."""
    ends = agglomerate(RegionGraph(regions, photo), weights, threshold, SMALLEST * regions.size, watch)
    return (np.unique(ends, return_inverse=True)[1].astype(np.int32) + 1)[regions]
