"""Pairs of many photos, against the truth of a made walk: which photos see the same landmarks."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("pycolmap")
from perception.sfm import pairs as module
from support.progress import Told

SEEN, STEP, LANDMARKS = 100, 14, 2100
"""Landmarks that a photo sees, and by which it moves on; those of the whole loop. Two rounds of 150 photos."""


def walk(photos: int, seed: int = 0) -> tuple[list[np.ndarray], np.ndarray]:
    """Unit features [F, 128] of each photo of a walk along a loop, and the share of landmarks each two share [n, n].

    A feature is its landmark's with noise; of the landmarks in sight a fifth is not found, and a fifth is clutter.
    """
    rng = np.random.default_rng(seed)
    looks = rng.exponential(1.0, (LANDMARKS, 128)).astype(np.float32)
    seen = np.zeros((photos, LANDMARKS), bool)
    found = []
    for photo in range(photos):
        ids = (photo * STEP + np.arange(SEEN)) % LANDMARKS
        seen[photo, ids] = True
        chosen = ids[rng.random(SEEN) < 0.8]
        clutter = rng.exponential(1.0, (SEEN // 5, 128))
        rows = np.concatenate([looks[chosen] + rng.normal(0, 0.25, (len(chosen), 128)), clutter]).astype(np.float32)
        found.append(rows / np.linalg.norm(rows, axis=1, keepdims=True))
    return found, (seen.astype(int) @ seen.T) / SEEN


def test_photos_of_one_place_are_similar_also_rounds_apart() -> None:
    descriptors, shared = walk(300)
    similar = module.similar_photos(descriptors)
    assert (similar == similar.T).all() and similar.diagonal().all()
    apart = np.abs(np.subtract.outer(np.arange(300), np.arange(300))) > 100
    assert similar[shared >= 0.3].mean() > 0.98 and similar[(shared >= 0.3) & apart].mean() > 0.98
    assert np.triu(similar, 1).sum() <= 300 * module.RETRIEVED


def test_pairs_of_many_photos_are_those_that_overlap(monkeypatch: pytest.MonkeyPatch) -> None:
    descriptors, shared = walk(205)
    monkeypatch.setattr(module, "_largest_features", lambda *_: descriptors)
    pairs = module.select_pairs(Path(), [""] * 205, 205, Told())
    assert pairs == sorted({(i, j) for i, j in pairs if i < j})
    chosen = np.zeros((205, 205), bool)
    chosen[tuple(np.transpose(pairs))] = True
    overlap = np.triu(shared >= 0.3, 1)
    assert chosen[overlap].mean() > 0.98


def test_of_few_photos_all_pairs_are_compared(monkeypatch: pytest.MonkeyPatch) -> None:
    """With the same votes as comparing each two photos alone."""
    descriptors, _ = walk(30)
    monkeypatch.setattr(module, "_largest_features", lambda *_: descriptors)
    monkeypatch.setattr(module, "similar_photos", None)
    module.select_pairs(Path(), [""] * 30, 30, Told())
    votes = module.coarse_votes(descriptors, np.ones((30, 30), bool), Told())
    for i, j in ((0, 1), (3, 8), (2, 29)):
        assert votes[i, j] == votes[j, i] == len(module.mutual_matches(descriptors[i] @ descriptors[j].T))


def test_photos_without_features_are_all_compared() -> None:
    assert module.similar_photos([np.zeros((0, 128), np.float32)] * 3).all()
