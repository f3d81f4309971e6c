"""Label images that follow the learned borders of the photo where the surface tells nothing, and at its outlines."""

from __future__ import annotations

import numpy as np

BAND = 1.0  # pixels to either side of an outline within which it is moved
_STEP = 0.001  # cost of one pixel, beside the probability of a border: without borders the nearest label wins
_CORE = 0.5  # share of the half width of a narrow region that keeps its label


def follow_borders(labels: np.ndarray, known: np.ndarray, direct: np.ndarray) -> np.ndarray:
    """labels: [h, w] int; known: [h, w] bool, pixels whose label is more than that of the nearest one; direct:
    [2, h, w] log odds of a border between a pixel and its right neighbour, its lower one. Pixels near outlines, and
    those not known, take the label to which the cheapest path leads; a path costs the probabilities of the borders that
    it crosses. Every connected region of known pixels keeps its core, so none is lost."""
    from scipy.ndimage import maximum
    from scipy.sparse.csgraph import connected_components, dijkstra

    index = np.arange(labels.size).reshape(labels.shape)
    flat = labels.ravel()
    before = np.concatenate([index[:, :-1].ravel(), index[:-1].ravel()])
    after = np.concatenate([index[:, 1:].ravel(), index[1:].ravel()])
    odds = np.concatenate([direct[0, :, :-1].ravel(), direct[1, :-1].ravel()])
    sure = known.ravel()
    cut = (flat[before] != flat[after]) | (sure[before] != sure[after])
    if not sure.any() or (sure.all() and not cut.any()):
        return labels
    inner = _inner(labels, before[cut], after[cut])
    count, region = connected_components(_graph(before[~cut], after[~cut], np.ones((~cut).sum()), labels.size), False)
    widest = maximum(inner, region, np.arange(count))
    moved = ~sure | (inner < np.minimum(BAND, _CORE * widest[region]))
    within = moved[before] | moved[after]
    costs = _STEP + 1 / (1 + np.exp(-odds[within].astype(np.float64)))
    graph = _graph(before[within], after[within], costs, labels.size)
    cores = np.unique(np.concatenate([before[within], after[within]]))
    sources = dijkstra(graph, False, cores[~moved[cores]], min_only=True, return_predecessors=True)[2]
    found = np.where(moved & (sources >= 0), flat[np.maximum(sources, 0)], flat)
    return found.reshape(labels.shape).astype(labels.dtype)


def _inner(labels: np.ndarray, before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """[h · w] distance of each pixel from the outlines, in pixels; 0 beside one."""
    import cv2

    away = np.ones(labels.size, np.uint8)
    away[before] = away[after] = 0
    return np.asarray(cv2.distanceTransform(away.reshape(labels.shape), cv2.DIST_L2, 5)).ravel()


def _graph(before: np.ndarray, after: np.ndarray, costs: np.ndarray, count: int):  # type: ignore[no-untyped-def]
    """Sparse matrix [count, count] of the costs of edges."""
    from scipy.sparse import csr_array

    return csr_array((costs, (before, after)), (count, count))
