"""Exposure and white balance of photos relative to each other, from the colours of matched features."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import cv2
import numpy as np

from perception.geometry import sums_by
from perception.photos.decode import load_photo, scaled_K
from perception.sfm.tracks import Tracks
from perception.types import View

SIDE = 400
"""Long side in pixels at which colours are read: averages around the features, which lie on corners."""
DARK, BRIGHT = 0.05, 0.95
"""Colours outside this range are clipped or mostly noise."""
ROUNDS, LEAST_NOISE = 20, 0.01
"""Rounds of reweighting; smallest standard error of a logarithm of a colour."""
TIED = 0.02
"""Weight of each photo's gain of 1, in observations: (noise of a colour 0.03 / usual spread of gains 0.2)²."""
VARIES, REMAINS = 0.03, 0.7
"""Gains are used if the standard deviation of their logarithms is above VARIES, and if they leave at most the share
REMAINS of the differences between colours of the same point. Read: 0.2 and 0.45 in an RGB-D camera's walk, where gains
are worth 0.8 dB; 0.1 and 0.8 with a phone that also maps tones locally, 0.1 dB; 0.005 and 0.99 with fixed exposure."""
LEAST = 30
"""Observations of points that another photo sees as well, for gains to be judged."""


def with_gains(views: list[View], tracks: Tracks) -> tuple[list[View], dict[str, Any]]:
    """`views` with gains if exposure varies, else as given; an entry "exposure" for the scene's report."""
    logs, usable = _colors(views, tracks)
    gains = photo_gains(logs, usable, tracks, len(views))
    spread = float(gains.std(axis=0).mean())
    before, after = (_difference(colors, usable, tracks) for colors in (logs, logs - gains[tracks.view]))
    varies = spread > VARIES and after < REMAINS * before
    facts = {"exposure": {"spread": spread, "difference": before, "difference_with_gains": after, "varies": varies}}
    if not varies:
        return views, facts
    return [replace(view, gain=tuple(np.exp(g).tolist())) for view, g in zip(views, gains, strict=True)], facts


def _difference(logs: np.ndarray, usable: np.ndarray, tracks: Tracks) -> float:
    """Median distance of the colours of a point in the first photo that sees it and in the others."""
    first = np.searchsorted(tracks.point, tracks.point)
    other = usable & usable[first] & (first != np.arange(len(first)))
    return float(np.median(np.linalg.norm(logs - logs[first], axis=1)[other])) if other.sum() >= LEAST else 0.0


def photo_gains(logs: np.ndarray, usable: np.ndarray, tracks: Tracks, count: int) -> np.ndarray:
    """Logarithms of gains [count, 3], zero in the mean, that explain the logarithms of colours [O, 3] of the tracks.
    Minimises Σ ρ(|log c − a_point − g_photo|) by reweighted least squares; the a are eliminated. ρ is the Huber loss,
    which is convex, and in the second half of the rounds the Cauchy loss. usable: [O] mask of observations."""
    from scipy.sparse import csr_matrix, diags
    from scipy.sparse.linalg import spsolve

    gains, albedo = np.zeros((count, 3)), np.zeros((tracks.size, 3))
    weight = usable.astype(np.float64)
    for number in range(ROUNDS):
        W = csr_matrix((weight, (tracks.view, tracks.point)), shape=(count, tracks.size))
        total = np.maximum(np.asarray(W.sum(axis=0)).ravel(), 1e-12)
        system = diags(np.asarray(W.sum(axis=1)).ravel() + TIED) - W @ diags(1 / total) @ W.T
        means = sums_by(tracks.point, logs, tracks.size, weight) / total[:, None]
        right = sums_by(tracks.view, logs, count, weight) - W @ means
        gains = spsolve(system.tocsc(), right).reshape(count, 3)
        albedo = means - W.T @ gains / total[:, None]
        distance = np.linalg.norm(logs - albedo[tracks.point] - gains[tracks.view], axis=1)
        noise = max(float(np.median(distance[usable])), LEAST_NOISE) if usable.any() else 1.0
        outlying = distance / noise
        weight = usable / (np.maximum(outlying, 1.0) if 2 * number < ROUNDS else 1 + outlying**2)
    return gains - gains.mean(axis=0)


def _colors(views: list[View], tracks: Tracks) -> tuple[np.ndarray, np.ndarray]:
    """Logarithms of the colours [O, 3] in (0, 1] of the tracks' observations, and a mask [O] of usable ones."""
    colors = np.zeros((len(tracks.view), 3), np.float32)
    for index, view in enumerate(views):
        mine = tracks.view == index
        if not mine.any():
            continue
        photo = load_photo(view, SIDE)
        K = scaled_K(view, *photo.shape[1::-1])
        at = (tracks.rays[mine] * (K[0, 0], K[1, 1]) + K[:2, 2] - 0.5).astype(np.float32)  # cv2 has centres at integers
        x, y = np.ascontiguousarray(at[:, :1]), np.ascontiguousarray(at[:, 1:])
        colors[mine] = cv2.remap(photo, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)[:, 0] / np.float32(255)
    usable = np.all((colors > DARK) & (colors < BRIGHT), axis=1)
    return np.log(np.maximum(colors.astype(np.float64), DARK)), usable
