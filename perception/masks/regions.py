"""Object-sized regions of a photo: many small ones first, then merged on evidence, with or without depth.

The weights are log odds fitted by `python -m perception.bench.fit_masks` on two rendered scenes; they are all
that was learned. Order: constant, border gradient, colour distance, colour histograms' distance, texture
difference, smaller area, common share of the border, texture; with depth also: step, broken border, concave
border, convex border, turn of the normals, offset of the planes, patches concave, patches convex, same plane.
"""

from __future__ import annotations

import warnings

import numpy as np

from perception.masks.cues import DepthCues, PhotoCues, depth_cues, filled_depth, photo_cues
from perception.masks.region_graph import RegionGraph, Watcher, agglomerate

PHOTO_WEIGHTS = np.array([5.21, -0.86, 0.01, -5.22, 0.41, -0.32, 1.52, 0.83])
# The second row judges by shape alone and can only forbid (the lower log odds count): a white wall ends at a
# white floor. Its constant is 2 above the fitted one, since in the scenes fitted on colour mostly tells too.
DEPTH_WEIGHTS = np.array(
    [
        [
            7.05,
            -0.03,
            0.16,
            -5.82,
            -0.95,
            -0.63,
            1.48,
            -0.67,
            0.41,
            -2.84,
            -0.59,
            3.98,
            -2.38,
            -1.57,
            0.33,
            2.84,
            1.28,
        ],
        [3.47, 0.0, 0.0, 0.0, 0.0, -0.4, 1.19, 0.0, 0.85, -2.94, 0.6, 4.22, -2.25, -1.88, 0.79, 2.68, 2.06],
    ]
)
# Log odds over which regions merge. Both lie above even odds: a merged pair is lost, a split one can still be
# joined by the contrastive loss.
PHOTO_THRESHOLD = 1.5
DEPTH_THRESHOLD = 1.5

_WORKING_SIDE = 640  # pixels of the long side, so that blurs and reaches mean the same everywhere
_SMALLEST = 5e-4  # share of the image under which a region joins its likeliest neighbour
_LEAST_DEPTH = 0.05  # share of pixels that must have depth for it to be used


def segment_photo(photo: np.ndarray) -> np.ndarray:
    """photo: [h, w, 3] uint8 RGB. Returns [h, w] int32 labels 1.., every pixel in a region."""
    return _segment(photo, None, None)


def refine_with_geometry(photo: np.ndarray, depth: np.ndarray, K: np.ndarray) -> np.ndarray:
    """As segment_photo, with what the surface says: steps, concave creases, planes that go on behind things.

    photo: [h, w, 3] uint8 RGB; depth: [h, w] z-depth in any unit, 0 = none; K: [3, 3] in pixels.
    """
    known = np.isfinite(depth) & (depth > 0)
    if depth.shape != photo.shape[:2]:
        raise ValueError(f"depth is {depth.shape}, its photo {photo.shape[:2]}")
    if known.mean() < _LEAST_DEPTH:
        return segment_photo(photo)
    return _segment(photo, np.where(known, depth, 0.0), K)


def first_regions(photo: PhotoCues, depth: DepthCues | None) -> np.ndarray:
    """[h, w] int, a few hundred 0.., by Felzenszwalb & Huttenlocher 2004 in colour, normals and log depth."""
    import cv2
    from skimage.segmentation import felzenszwalb

    colour = cv2.bilateralFilter(photo.lab, 5, 40, 5)
    channels, scale = colour / 255.0, 80.0
    if depth is not None:
        log_depth = np.log(depth.points[..., 2:])
        channels, scale = np.dstack([colour, depth.normals * 60.0, log_depth * 1500.0]) / 255.0, 60.0
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Got image with third dimension")
        return felzenszwalb(channels.astype(np.float64), scale=scale, sigma=0.8, min_size=60)


def merge_regions(
    regions: np.ndarray, photo: PhotoCues, depth: DepthCues | None, weights: np.ndarray, threshold: float,
    watch: Watcher | None = None,
) -> np.ndarray:  # fmt: skip
    """regions: [h, w] int 0... Returns [h, w] int32 labels 1.. of what is left after merging."""
    graph = RegionGraph(regions, photo, depth)
    ends = agglomerate(graph, weights, threshold, _SMALLEST * regions.size, watch)
    return (np.unique(ends, return_inverse=True)[1].astype(np.int32) + 1)[regions]


def _segment(photo: np.ndarray, depth: np.ndarray | None, K: np.ndarray | None) -> np.ndarray:
    import cv2

    height, width = photo.shape[:2]
    ratio = _WORKING_SIDE / max(height, width)
    size = (max(1, round(width * ratio)), max(1, round(height * ratio)))
    surface = None
    if depth is not None and K is not None:
        scaled = np.diag([size[0] / width, size[1] / height, 1.0]) @ K
        smooth = cv2.INTER_LINEAR if ratio > 1 else cv2.INTER_NEAREST
        surface = depth_cues(cv2.resize(filled_depth(depth), size, interpolation=smooth), scaled)
    look = photo_cues(cv2.resize(photo, size, interpolation=cv2.INTER_CUBIC if ratio > 1 else cv2.INTER_AREA))
    weights, threshold = (PHOTO_WEIGHTS, PHOTO_THRESHOLD) if surface is None else (DEPTH_WEIGHTS, DEPTH_THRESHOLD)
    labels = merge_regions(first_regions(look, surface), look, surface, weights, threshold)
    return cv2.resize(labels, (width, height), interpolation=cv2.INTER_NEAREST)
