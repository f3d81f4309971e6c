"""Divides the photos of a large scene into overlapping submodels, by the numbers of their verified matches."""

from __future__ import annotations

import networkx as nx
import numpy as np
from scipy import sparse
from scipy.sparse.linalg import LinearOperator, eigsh, splu

LARGEST, OVERLAP = 100, 15
"""Photos of a submodel at most, and photos that each submodel next to it adds."""
NUDGE = 1e-6
"""Added to the eigenvalues of a Laplacian, of which the least is 0, so that it has an inverse."""
SIDE = 0.25
"""Least share of the photos on either side of a cut."""

Matches = dict[tuple[int, int], int]
"""Number of verified matches of each pair of image ids."""


def divide(matches: Matches, most: int) -> list[list[int]]:
    """Image ids of the photos of each submodel, at most `most`, together all photos with matches.

    Connected photos are cut in two, again and again, where the normalised cut is least (Shi and Malik, "Normalized cuts
    and image segmentation", PAMI 2000) among the cuts along the second eigenvector, with SIDE of the photos on either
    side at least.
    """
    ids = sorted({image for pair in matches for image in pair})
    row = {image: n for n, image in enumerate(ids)}
    pairs = np.array([(row[i], row[j]) for i, j in matches]).reshape(-1, 2)
    half = sparse.coo_matrix((np.array(list(matches.values()), float), pairs.T), shape=(len(ids), len(ids)))
    weights = sparse.csr_matrix(half + half.T)
    label = sparse.csgraph.connected_components(weights, directed=False)[1]
    parts = [np.flatnonzero(label == n) for n in range(label.max() + 1)]
    done = []
    while parts:
        part = parts.pop(0)
        if len(part) <= most:
            done.append([ids[n] for n in part.tolist()])
        else:
            above = _upper_half(weights[part][:, part])
            parts += [part[~above], part[above]]
    return sorted(done)


def _upper_half(weights: sparse.csr_matrix) -> np.ndarray:
    """[n] bool of symmetric weights [n, n]."""
    count = weights.shape[0]
    degree = np.maximum(np.asarray(weights.sum(axis=1)).ravel(), 1)  # a photo whose matches a cut took has none
    scaled = sparse.diags(degree**-0.5)
    start = np.random.default_rng(0).normal(size=count)  # ARPACK's own is random
    # The Laplacian's two least eigenvalues, near each other along a walk, as the largest of its inverse: by the matrix
    # itself, 4,000 photos took a minute.
    laplacian = (1 + NUDGE) * sparse.identity(count) - scaled @ weights @ scaled
    solve = splu(laplacian.tocsc(), "MMD_AT_PLUS_A", diag_pivot_thresh=0, options={"SymmetricMode": True}).solve
    vector = eigsh(LinearOperator(laplacian.shape, solve), k=2, v0=start)[1][:, 0] * degree**-0.5
    order = np.argsort(vector, kind="stable")
    rank = np.argsort(order, kind="stable")
    upper = sparse.triu(weights).tocoo()
    ends = np.sort([rank[upper.row], rank[upper.col]], axis=0)
    # crossing[k]: weight of the pairs between the first k photos in this order and the others
    begun, ended = (np.bincount(end + 1, upper.data, count + 1) for end in ends)
    crossing = np.cumsum(begun - ended)
    volume = np.concatenate([[0], np.cumsum(degree[order])])
    least = max(1, int(SIDE * count))
    cuts = np.arange(least, count - least + 1)
    cost = crossing[cuts] * (1 / volume[cuts] + 1 / (volume[-1] - volume[cuts]))
    return np.asarray(rank >= cuts[cost.argmin()])


def with_overlap(submodels: list[list[int]], matches: Matches) -> list[list[int]]:
    """The photos of each submodel, and OVERLAP photos of each next to it, those that lead into it.
    Next to each other are the neighbours in the maximum spanning tree by the strongest pair of photos of two submodels:
    submodels that only look alike are not."""
    submodel_of = {image: n for n, images in enumerate(submodels) for image in images}
    linked: dict[int, dict[int, int]] = {image: {} for image in submodel_of}
    graph = nx.Graph()
    graph.add_nodes_from(range(len(submodels)))
    for (i, j), count in sorted(matches.items()):
        linked[i][j] = linked[j][i] = count
        a, b = submodel_of[i], submodel_of[j]
        if a != b and count > graph.get_edge_data(a, b, {"weight": 0})["weight"]:
            graph.add_edge(a, b, weight=count)
    tree = nx.maximum_spanning_tree(graph)
    return [
        sorted([*images, *(image for other in tree[n] for image in _leading(images, set(submodels[other]), linked))])
        for n, images in enumerate(submodels)
    ]


def _leading(images: list[int], other: set[int], linked: dict[int, dict[int, int]]) -> list[int]:
    """OVERLAP photos of `other`, each the one with the strongest pair with `images` or those before it."""
    chosen: list[int] = []
    waiting = [(count, -image) for known in images for image, count in linked[known].items() if image in other]
    while waiting and len(chosen) < OVERLAP:
        chosen.append(-max(waiting)[1])
        waiting += [(count, -image) for image, count in linked[chosen[-1]].items() if image in other]
        waiting = [pair for pair in waiting if -pair[1] not in chosen]
    return chosen
