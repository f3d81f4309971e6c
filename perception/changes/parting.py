"""Which part of an instance does not stand where it stood, though the rest does.

Masks join things that touch and look alike, and then one of them leaves. The signs of `evidence` alone, without
outlines, tell it of each Gaussian and those beside it in its instance.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from perception.changes.evidence import AGREE, WEIGHTS, at_surface, sharpness
from perception.changes.look import Look

BESIDE = 32
"""Nearest Gaussians of its instance that are judged with one."""
CHUNK = 20_000
"""Gaussians judged at once, for memory."""


def local_sums(looks: Sequence[Look], means: np.ndarray, scales: np.ndarray, ids: np.ndarray) -> np.ndarray:
    """[N, 7] of each Gaussian (means [N, 3], largest scales [N], instances ids [N]) summed over the photos that look at
    it: pixels, covariance, variances (2), colour, rays measured and through, at the pixels of its centre."""
    sums = np.zeros((len(means), 7))
    for shown in looks:
        inside, (row, column), z = shown.view.seen(means)
        mapped, measured = shown.mapped[row, column], shown.measured[row, column]
        hidden = (measured > 0) & (measured < mapped * (1 - AGREE))
        front = at_surface(mapped, z[inside], scales[inside]) & (shown.ids[row, column] == ids[inside]) & ~hidden
        row, column, known = row[front], column[front], measured[front] > 0
        through = known & (measured[front] > (1 + AGREE) * mapped[front])
        images = (image[row, column] for image in (shown.product, shown.rendered, shown.shown, shown.colour))
        sums[inside[front]] += np.column_stack([np.ones(len(row)), *images, known, through])
    return sums


def local_odds(sums: np.ndarray) -> np.ndarray:
    """[P] log-odds of standing where it stood, of sums [P, 7] as of `local_sums`; a blurred map and rays that were not
    measured count as little as in `Signs.log_odds`. NaN where no photo looks."""
    pixels, product, a, b, colour, rays, through = np.where(sums[:, :1] > 0, sums, np.nan).T
    (slope, middle), (per_colour, usual), (per_ray, free) = (WEIGHTS[s] for s in ("correlation", "colour", "through"))
    told = slope * (product / np.maximum(np.sqrt(a * b), 1e-9) - middle)
    told = np.where(told < 0, sharpness(a / np.maximum(b, 1e-12)), 1) * told
    return np.asarray(
        told + per_colour * (colour / pixels - usual) + per_ray * (through / np.maximum(rays, 1) - free) * rays / pixels
    )


def smoothed_odds(means: np.ndarray, sums: np.ndarray) -> np.ndarray:
    """[M] log-odds of the Gaussians of one instance, means [M, 3] and sums [M, 7], each with those BESIDE it."""
    from scipy.spatial import cKDTree

    tree, count, odds = cKDTree(means), min(BESIDE, len(means)), np.full(len(means), np.nan)
    for begin in range(0, len(means), CHUNK):
        part = slice(begin, begin + CHUNK)
        near = tree.query(means[part], k=np.arange(1, count + 1))[1]
        odds[part] = local_odds(np.column_stack([column[near].sum(axis=1) for column in sums.T]))
    return odds
