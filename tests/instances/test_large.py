"""Grouping of a made building, whose objects are known."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import sparse

pytest.importorskip("perception._core")
from perception.instances import assign
from perception.masks import consensus
from perception.masks.votes import MaskVotes
from speed.grouping import building, grouped
from support.blob_scenes import rand_index


@pytest.mark.parametrize("together", [None, 100])
def test_the_objects_of_a_building_are_found(together: int | None, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also where the segments of parts of the building are found one after the other."""
    if together:
        monkeypatch.setattr("perception.instances.segments.TOGETHER", together)
    means, features, votes, truth = building(12_000, 12)
    found = grouped(means, features, votes)
    known = found.ids >= 0
    assert known.mean() > 0.95 and rand_index(truth[known], found.ids[known]) > 0.97


def test_tables_of_many_photos_are_made_in_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    """The instances are the same, bit for bit, and no part is larger than it may be."""
    made = building(6_000, 120)[:3]
    expected, nodes, weights = grouped(*made), list[int](), list[int]()
    evidence, affinities = consensus.evidence, assign.affinities
    monkeypatch.setattr(consensus, "evidence", lambda table: nodes.append(table.pixels.nnz) or evidence(table))
    monkeypatch.setattr(
        assign,
        "affinities",
        lambda votes, shares, rows: weights.append(votes.pixels[rows].nnz) or affinities(votes, shares, rows),
    )
    monkeypatch.setattr(consensus, "ENTRIES", 5_000)
    monkeypatch.setattr(assign, "ENTRIES", 100_000)
    found = grouped(*made)
    for name, value in vars(expected).items():
        np.testing.assert_array_equal(getattr(found, name), value)
    masks = made[2].pixels.shape[1]
    assert len(nodes) > 100 and max(nodes) <= 5_000 + masks
    assert len(weights) > 10 and max(weights) < 1.5 * 100_000 / 4  # of 60 weights for each Gaussian


def test_membership_is_the_share_of_the_pixels_in_the_masks_of_the_instance() -> None:
    """By an oracle of dense tables."""
    rng = np.random.default_rng(3)
    view = np.repeat(np.arange(5), 3)
    pixels = rng.random((80, 15)) * (rng.random((80, 15)) < 0.4)
    ids = rng.integers(-1, 6, 80).astype(np.int32)
    tables = [sparse.csr_matrix(table.astype(np.float32)) for table in (pixels, np.zeros((80, 5)))]
    found = assign.memberships(ids, MaskVotes(*tables, view, np.full(15, 9.0)))
    of_group = np.array([pixels[ids == k].sum(axis=0) for k in range(6)])
    shares = of_group / np.maximum(of_group @ (view[:, None] == view), 1e-12)
    expected = (pixels * shares[ids]).sum(axis=1) / np.maximum(pixels.sum(axis=1), 1e-12)
    np.testing.assert_allclose(found, np.where(ids >= 0, expected, 0), atol=1e-6)
