"""Measures the grouping of a made building with known objects: those found, CPU time, peak memory.

python tools speed.grouping --gaussians 1000000 --views 1000
"""

from __future__ import annotations

import argparse
import resource
import time

import numpy as np
from scipy import sparse
from sklearn.metrics import adjusted_rand_score

from perception.config import InstanceConfig
from perception.instances.group import Grouping, group
from perception.masks.votes import MaskVotes

SEEN = 100  # objects that a view shows
PIXELS = 5.0  # of a Gaussian in a view, on average


def building(gaussians: int, views: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray, MaskVotes, np.ndarray]:
    """means [N, 3], features [N, 8], votes and object [N] of objects along a corridor of four rows.

    Each view stands at one place of the corridor and shows the SEEN nearest objects, each by one mask or, in one of
    five cases, two halves. A Gaussian is visible in every other view; one weight in fifty lies in a wrong mask.
    """
    rng = np.random.default_rng(seed)
    objects = max(gaussians // 500, SEEN)
    object_of = np.sort(rng.integers(0, objects, gaussians))
    centres = np.stack([np.arange(objects) // 4, np.arange(objects) % 4, np.zeros(objects)], axis=1)
    means = (centres[object_of] + rng.normal(0, 0.12, (gaussians, 3))).astype(np.float32)
    codes = rng.normal(0, 0.6, (objects, 8))
    features = (codes[object_of] + rng.normal(0, 0.1, (gaussians, 8))).astype(np.float32)
    starts = np.searchsorted(object_of, np.arange(objects + 1))
    side = means[:, 2] > 0
    parts, areas, owners = [], [], []
    for view in range(views):
        first = round(view / max(views - 1, 1) * (objects - SEEN))
        rows = np.arange(starts[first], starts[first + SEEN])
        rows = rows[rng.random(len(rows)) < 0.5]
        halved = rng.random(SEEN) < 0.2
        mask = np.cumsum(1 + np.append(0, halved[:-1]))  # number of the first mask of each object, from 1
        column = mask[object_of[rows] - first] + (halved[object_of[rows] - first] & side[rows]) - 1
        count = int(mask[-1] + halved[-1])
        wrong = rng.random(len(rows)) < 0.02
        column = np.where(wrong, rng.integers(0, count, len(rows)), column)
        pixels = rng.exponential(PIXELS, len(rows)).astype(np.float32)
        parts.append(sparse.csc_matrix((pixels, (rows, column)), shape=(gaussians, count)))
        areas.append(np.bincount(column, pixels, count))
        owners.append(np.full(count, view))
    weights = sparse.hstack(parts, format="csr")
    void = sparse.csr_matrix((gaussians, views), dtype=np.float32)
    return means, features, MaskVotes(weights, void, np.concatenate(owners), np.concatenate(areas)), object_of


def grouped(means: np.ndarray, features: np.ndarray, votes: MaskVotes) -> Grouping:
    scales, opacities = np.full_like(means, 0.05), np.full(len(means), 0.9, np.float32)
    return group(means, scales, opacities, features, votes, InstanceConfig())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--gaussians", type=int, default=1_000_000)
    parser.add_argument("--views", type=int, default=1000)
    options = parser.parse_args()
    means, features, votes, truth = building(options.gaussians, options.views)
    votes_mib = (votes.pixels.data.nbytes + votes.pixels.indices.nbytes) >> 20
    before, cpu, wall = _peak_mib(), time.process_time(), time.monotonic()
    found = grouped(means, features, votes)
    known = found.ids >= 0
    print(
        f"{len(means)} Gaussians, {len(votes.area)} masks in {options.views} views, {votes_mib} MiB of votes: "
        f"{found.count} instances of {truth.max() + 1} objects, "
        f"adjusted Rand index {adjusted_rand_score(truth[known], found.ids[known]):.3f}, "
        f"{time.process_time() - cpu:.0f} s of CPU, {time.monotonic() - wall:.0f} s, "
        f"peak {_peak_mib()} MiB ({before} MiB before grouping)"
    )


def _peak_mib() -> int:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss >> 10


if __name__ == "__main__":
    main()
