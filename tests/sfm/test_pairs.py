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
    """Features [F, 128] uint8 of each photo of a walk along a loop, and the share of landmarks each two share [n, n].

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
        found.append((512 * rows / np.linalg.norm(rows, axis=1, keepdims=True)).clip(0, 255).astype(np.uint8))
    return found, (seen.astype(int) @ seen.T) / SEEN


def table(similar: list[np.ndarray]) -> np.ndarray:
    """[n, n] bool of what `similar_photos` returns."""
    result = np.zeros((len(similar), len(similar)), bool)
    for row, columns in zip(result, similar, strict=True):
        assert (np.diff(columns) > 0).all()
        row[columns] = True
    return result


def test_photos_of_one_place_are_similar_also_rounds_apart() -> None:
    descriptors, shared = walk(300)
    similar = table(module.similar_photos(descriptors))
    assert (similar == similar.T).all() and similar.diagonal().all()
    apart = np.abs(np.subtract.outer(np.arange(300), np.arange(300))) > 100
    assert similar[shared >= 0.3].mean() > 0.98 and similar[(shared >= 0.3) & apart].mean() > 0.98
    assert np.triu(similar, 1).sum() <= 300 * module.RETRIEVED


def test_pairs_of_many_photos_are_those_that_overlap(monkeypatch: pytest.MonkeyPatch) -> None:
    descriptors, shared = walk(205)
    monkeypatch.setattr(module, "largest_features", lambda *_: descriptors)
    pairs = module.select_pairs(Path(), [""] * 205, 205, Told())
    assert pairs == sorted({(i, j) for i, j in pairs if i < j})
    chosen = np.zeros((205, 205), bool)
    chosen[tuple(np.transpose(pairs))] = True
    overlap = np.triu(shared >= 0.3, 1)
    assert chosen[overlap].mean() > 0.98


def test_of_few_photos_all_pairs_are_compared(monkeypatch: pytest.MonkeyPatch) -> None:
    """With the same votes as comparing each two photos alone."""
    descriptors, _ = walk(30)
    monkeypatch.setattr(module, "largest_features", lambda *_: descriptors)
    monkeypatch.setattr(module, "similar_photos", None)
    module.select_pairs(Path(), [""] * 30, 30, Told())
    votes = module.coarse_votes(descriptors, [np.arange(30)] * 30, Told())
    unit = [rows / np.linalg.norm(rows.astype(np.float32), axis=1, keepdims=True) for rows in descriptors]
    for i, j in ((0, 1), (3, 8), (2, 29)):
        assert votes[i, j] == votes[j, i] == len(module.mutual_matches(unit[i] @ unit[j].T))


def test_each_photo_is_compared_with_those_of_the_largest_cosine(monkeypatch: pytest.MonkeyPatch) -> None:
    """With one centre a descriptor is the direction of the sum of residuals to the mean, here in float64."""
    descriptors, _ = walk(240)
    descriptors[7], descriptors[9] = descriptors[7][:0], np.zeros_like(descriptors[9])
    monkeypatch.setattr(module, "WORDS", 1)
    rows = [
        rows / np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), 1e-9) for rows in map(np.float64, descriptors)
    ]
    rng = np.random.default_rng(0)
    every = np.concatenate(rows)
    centre = every[np.sort(rng.permutation(len(every))[:200])].mean(axis=0)
    sums = np.array([(each - centre).sum(axis=0) for each in rows])
    sums /= np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), 1e-9)
    cosine = sums @ sums.T
    similar = table(module.similar_photos(descriptors))
    border = np.sort(cosine, axis=1)[:, -module.RETRIEVED - 2 : -module.RETRIEVED].mean(axis=1, keepdims=True)
    clear, expected = np.abs(cosine - border) > 1e-6, cosine > border
    both = clear & clear.T
    assert both.mean() > 0.99
    assert (similar == (expected | expected.T))[both].all()


def test_photos_without_features_are_all_compared() -> None:
    assert table(module.similar_photos([np.zeros((0, 128), np.uint8)] * 3)).all()
