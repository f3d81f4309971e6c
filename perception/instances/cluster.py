"""Clusters Gaussians into instances: HDBSCAN on the features, then (by default) a split into connected components.

HDBSCAN (Campello et al. 2013) as in the paper (§3.2.1). It finds the number of instances; noise has the label −1.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from perception.config import InstanceConfig
from perception.geometry import nearest

NEIGHBOURS = 12
MIN_OPACITY = 0.1  # of Gaussians that are clustered; fainter ones are mostly noise between objects
MAX_CLUSTERED = 60_000  # maximum number of rows for exact HDBSCAN, whose time and memory grow faster than linearly


def cluster_gaussians(
    means: np.ndarray,
    scales: np.ndarray,
    opacities: np.ndarray,
    features: np.ndarray,
    config: InstanceConfig,
    seed: int = 0,
) -> np.ndarray:
    """Instance ids [N] int32 of N Gaussians: −1 = noise, 0 … M − 1 by falling size.

    means [N, 3], scales [N, 3], opacities [N], features [N, D] float. Gaussians with non-finite features are not
    clustered and stay noise. So do those fainter than MIN_OPACITY, unless nothing settles them later (`config.settle`).
    """
    count = len(means)
    ids = np.full(count, -1, np.int32)
    least = MIN_OPACITY if config.settle else 0.0
    solid = np.flatnonzero((opacities >= least) & np.isfinite(features).all(axis=1))
    if len(solid) < config.min_cluster_size:
        return ids
    labels = cluster_features(features[solid], config, seed)
    if config.split:
        labels = split_disconnected(means[solid], scales[solid], labels, config.min_cluster_size)
    ids[solid] = by_falling_size(labels)
    return ids


def cluster_features(features: np.ndarray, config: InstanceConfig, seed: int = 0) -> np.ndarray:
    """Labels of rows [N, D]. Above MAX_CLUSTERED rows, HDBSCAN runs on a random sample."""
    import hdbscan

    # Equal rows have distance 0, which HDBSCAN turns into infinite density. All features equal: one cluster.
    if np.ptp(features, axis=0).max() < 1e-6:
        return np.zeros(len(features), np.int64)
    chosen = np.arange(len(features))
    if len(features) > MAX_CLUSTERED:
        chosen = np.sort(np.random.default_rng(seed).choice(len(features), MAX_CLUSTERED, replace=False))
    share = len(chosen) / len(features)
    model = hdbscan.HDBSCAN(
        min_cluster_size=max(2, round(config.min_cluster_size * share)),
        min_samples=config.min_samples,
        core_dist_n_jobs=1,
        approx_min_span_tree=False,
        allow_single_cluster=False,
    ).fit(features[chosen].astype(np.float64))
    labels = model.labels_
    if labels.max(initial=-1) < 0:  # no cluster found: treat all rows as one object
        labels = np.zeros(len(chosen), np.int64)
    if len(chosen) < len(features):
        labels = _spread(features, chosen, labels, config.min_samples)
    return np.asarray(labels)


def _spread(features: np.ndarray, chosen: np.ndarray, labels: np.ndarray, samples: int) -> np.ndarray:
    """Extends the labels of the rows `chosen` [S] to all rows [N, D] with HDBSCAN's density criterion.

    A row's core distance is its distance to the `samples`-th nearest sampled row. A row joins the cluster of its
    nearest labelled neighbour if its core distance is at most the largest one in that cluster. Otherwise it is noise.
    """
    sampled = np.zeros(len(features), bool)
    sampled[chosen] = True
    distance, sample = nearest(cKDTree(features[chosen]), features, range(1, samples + 2))
    core = np.where(sampled, distance[:, samples], distance[:, samples - 1])  # a sampled row finds itself first
    limit = np.zeros(labels.max() + 1)
    member = labels >= 0
    np.maximum.at(limit, labels[member], core[chosen[member]])
    first = (labels[sample] >= 0).argmax(axis=1)
    source = sample[np.arange(len(features)), first]
    joins = (labels[source] >= 0) & (core <= limit[labels[source]])
    return np.where(joins, labels[source], -1)


def split_disconnected(means: np.ndarray, scales: np.ndarray, ids: np.ndarray, smallest: int) -> np.ndarray:
    """Gives each spatially connected component of a cluster its own id. Components under `smallest` become noise.

    Two Gaussians are connected if one is among the NEIGHBOURS nearest of the other, and the distance of their means is
    at most max(s, twice the sum of their largest scales) and at most 4 s, with s = 3 × the 95th percentile of
    nearest-neighbour distances. Objects that share no photo need this: the loss does not separate their features.
    """
    out = np.full(len(ids), -1, np.int64)
    following = 0
    radius = scales.max(axis=1)
    for cluster in range(int(ids.max(initial=-1)) + 1):
        rows = np.flatnonzero(ids == cluster)
        if len(rows) < max(smallest, 2):
            continue
        near = range(1, min(NEIGHBOURS + 1, len(rows)) + 1)
        distance, neighbour = nearest(cKDTree(means[rows]), means[rows], near)
        spacing = 3 * float(np.quantile(distance[:, 1], 0.95))
        reach = np.maximum(spacing, 2 * (radius[rows][:, None] + radius[rows][neighbour]))
        source, column = np.nonzero(distance <= np.minimum(reach, 4 * spacing))
        links = coo_matrix((np.ones(len(source)), (source, neighbour[source, column])), shape=(len(rows), len(rows)))
        _, part = connected_components(links, directed=False)
        for piece, size in enumerate(np.bincount(part)):
            if size >= smallest:
                out[rows[part == piece]] = following
                following += 1
    return out


def by_falling_size(ids: np.ndarray) -> np.ndarray:
    """Renumbers ids to 0, 1, … by falling size (ties: the smaller old id first). −1 is kept."""
    count = int(ids.max(initial=-1)) + 1
    sizes = np.bincount(ids[ids >= 0], minlength=count)
    rank = np.full(count + 1, -1, np.int32)  # id −1 indexes the last entry
    rank[np.argsort(-sizes, kind="stable")] = np.arange(count)
    rank[:count][sizes == 0] = -1
    return rank[ids]
