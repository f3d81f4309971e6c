"""Scores in [0, 1] that rank."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import sparse

pytest.importorskip("perception._core")
from perception.instances.confidence import CALIBRATION, calibrated, raw_scores
from perception.masks.consensus import evidence
from perception.masks.votes import MaskVotes


def table(*rows: list[float], area: list[float], view: list[int]) -> MaskVotes:
    void = sparse.csr_matrix((len(rows), max(view) + 1), dtype=np.float32)
    return MaskVotes(sparse.csr_matrix(np.array(rows, np.float32)), void, np.array(view), np.array(area))


def test_calibration_rises_strictly_within_its_bounds() -> None:
    raw = np.linspace(0, 1, 101)
    score = calibrated(raw)
    assert (np.diff(score) > 0).all() and score[0] == 0 and score[-1] == 1
    assert all(list(row) == sorted(row) for row in CALIBRATION)


def test_evidence_by_hand() -> None:
    # Two views. Group 0 fills all of mask 0 (100 px) in view 0 and half of mask 2 (200 px) in view 1.
    # Group 1 fills mask 1 (50 px) in view 0 and the other half of mask 2 in view 1.
    found = evidence(table([100, 0, 100], [0, 50, 100], area=[100, 50, 200], view=[0, 0, 1]))
    assert found.matched.tolist() == [100 * 1 + 100 * 0.5, 50 * 1 + 100 * 0.5]
    assert found.support.tolist() == [1, 1] and found.views.tolist() == [2, 2]
    assert found.agreement.tolist() == pytest.approx([0.75, 100 / 150])


def test_unmasked_pixels_are_part_of_the_extent() -> None:
    seen = table([100.0], area=[100], view=[0])
    half_blank = MaskVotes(seen.pixels, sparse.csr_matrix([[100.0]], dtype=np.float32), seen.view, seen.area)
    assert evidence(seen).agreement[0] == 1 and evidence(half_blank).agreement[0] == 0.5


def test_better_evidence_scores_higher() -> None:
    found = evidence(
        table([90.0, 0, 90, 0, 90, 0], [0, 40.0, 0, 40, 0, 40], area=[100.0, 100] * 3, view=[0, 0, 1, 1, 2, 2])
    )
    ids, membership = np.repeat([0, 1], 10).astype(np.int32), np.repeat([0.9, 0.8], 10)
    raw = raw_scores(ids, membership, found)
    assert 1 > raw[0] > raw[1] > 0
