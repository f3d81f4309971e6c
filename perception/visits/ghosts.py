"""Ghosts: Gaussians of no instance, or of one that stays, in free space of a visit, that its photos do not show.

Depth alone does not tell: behind a chair's leg or a leaf stereo measures the wall. So photos decide between a render
with the Gaussians, w, and one without them, o. The factor of their opacity that explains a photo p best is

    shown = Σ (p − o)·(w − o) / Σ |w − o|²        (least squares)

1 of what stands there and 0 of a ghost. The sums are over windows of all photos, of smoothed images, so that an error
of the pose by a pixel counts little; and over clusters, which go as a whole.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from perception.changes.evidence import AGREE, LOOKED
from perception.changes.look import Look, blurred
from perception.gaussians.model import Gaussians
from perception.gaussians.views import expected_depth, render
from perception.visits.visit import Visit

HITS, CLUSTERED = 0.5, 3.0
"""Rays that end at a point, relative to those that end behind it, from which it does not lie in free space; largest
scales of Gaussians, in the median, up to which two are of one cluster."""
SHOWN, OWNED, CLEAR = 0.5, 0.1, 1.0
"""Factor of opacity from which photos show a cluster; the same if most of it is of instances that stay (in a fox's fur
it is .2 to .7); that from which a Gaussian of a ghost stays (of those in free space of a kitchen the median is .84)."""
EVIDENCE, BEHIND = 0.03, 0.5
"""Squared difference of colours in [0, 1], summed over photos, that a Gaussian of a ghost makes in the mean; opacity of
what stays from which a pixel counts: where the map has nothing behind a ghost, photos do not tell."""
ROUNDS, MOST = 3, 0.5
"""What is left of a ghost is told once the rest no longer hides what is behind; share of an instance that stays of
which no more may be ghosts."""


def ghosts(visit: Visit, looks: Sequence[Look], stays: np.ndarray) -> np.ndarray:
    """[R] bool: of the visit's Gaussians that stay, `stays` [R] bool, those that are ghosts. looks: of the photos."""
    means, scales = visit.gaussians.means.double().numpy(), visit.gaussians.scales.max(dim=1).values.numpy()
    found, free = np.zeros(len(stays), bool), stays & seen_through(looks, means)
    for _ in range(ROUNDS):
        rows = np.flatnonzero(free & ~found)
        if not len(rows):
            break
        held = stays & ~found
        along, square = compared_without(visit.part(held), free[held], looks)
        cluster = clusters(means[rows], CLUSTERED * float(np.median(scales[rows])))
        sums = along, square, visit.ids[rows] >= 0, np.ones(len(rows))
        total, change, owned, count = (np.bincount(cluster, weights)[cluster] for weights in sums)
        shown = np.where(owned > 0.5 * count, OWNED, SHOWN) * change
        ghost = (total < shown) & (change > EVIDENCE * count)
        found[rows[ghost & (along < CLEAR * square)]] = True
    for i in np.unique(visit.ids[found & (visit.ids >= 0)]).tolist():
        own = visit.ids == i
        if np.sum(found & own) > MOST * np.sum(visit.gmap.instance_ids == i):
            found &= ~own
    return found


def seen_through(looks: Sequence[Look], means: np.ndarray) -> np.ndarray:
    """[N] bool: points [N, 3] behind which LOOKED photos measured a surface, and few at them."""
    through, hit = np.zeros((2, len(means)))
    for shown in looks:
        inside, (row, column), z = shown.view.seen(means)
        ratio = shown.measured[row, column] / z[inside]
        through[inside] += ratio > 1 + 2 * AGREE
        hit[inside] += np.abs(ratio - 1) < AGREE
    return np.asarray((through >= LOOKED) & (hit <= HITS * through))


def compared_without(held: Gaussians, free: np.ndarray, looks: Sequence[Look]) -> tuple[np.ndarray, np.ndarray]:
    """Of the Gaussians `free` [N] bool of those that are held, each [F]: Σ (p − o)·(w − o) and Σ |w − o|² where photos
    show them in front."""
    rest, means = held.rows(torch.from_numpy(np.flatnonzero(~free))), held.means.double().numpy()[free]
    along, square = np.zeros((2, len(means)))
    for look in looks:
        view, (height, width) = look.view, look.mapped.shape
        camera = view.camera_from_world, view.K, width, height
        outs = [render(each, *camera, harmonics=True, eps2d=view.eps2d) for each in (held, rest)]
        w, o = (view.exposed(out.colors[0]).clamp(0, 1).numpy() for out in outs)
        depth, p = expected_depth(outs[0]).numpy(), view.photo.numpy().astype(np.float32) / 255
        hidden = (look.measured > 0) & (look.measured < depth * (1 - AGREE))
        counts = (look.counts & ~hidden & (outs[1].alphas[0].numpy() > BEHIND)).astype(np.float32)
        change = blurred(w - o)
        inside, (row, column), z = view.seen(means)
        front = z[inside] <= (1 + AGREE) * depth[row, column]
        for sums, factor in ((along, blurred(p - o)), (square, change)):
            sums[inside] += front * blurred((factor * change).sum(axis=2) * counts)[row, column]
    return along, square


def clusters(points: np.ndarray, reach: float) -> np.ndarray:
    """[N] number of the cluster of each of the points [N, 3]: those within `reach` of each other are of one."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    pairs = cKDTree(points).query_pairs(reach, output_type="ndarray")
    joined = coo_matrix((np.ones(len(pairs)), pairs.T), shape=(len(points), len(points)))
    return np.asarray(connected_components(joined, directed=False)[1])
