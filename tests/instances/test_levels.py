"""Scores, parts and groups of instances whose place on a segmented surface is known."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("perception._core")
from scipy import sparse

from perception.instances.group import Grouping
from perception.instances.levels import ODDS, with_levels
from perception.instances.votes import MaskVotes
from perception.masks.merging import Segmentation


def test_scores_parts_and_groups_by_the_nearest_voxels() -> None:
    """Voxels at x = 0 … 5. Segments 1 = {0, 1}, 2 = {2, 3}, 3 = {4, 5}; parts by voxel; 1 and 2 are one group."""
    cuts = Segmentation(
        points=np.array([[x, 0, 0] for x in range(6)], np.float32),
        segment=np.array([1, 1, 2, 2, 3, 3], np.int32),
        probability=np.array([0, 0.9, 0.6, 0.5]),
        part=np.arange(6),
        part_probability=np.linspace(0.1, 0.6, 6),
        group=np.array([0, 1, 1, 2]),
        group_probability=np.array([0, 0.7, 0.2]),
    )
    # instance 0: 64 at both voxels of segment 1; instance 1: 64 at voxel 2 and 60 at voxel 4; instance 2: 32 at voxel 5
    counts = [64, 64, 64, 60, 32, 5]
    at, ids = np.repeat([0, 1, 2, 4, 5, 3], counts), np.repeat([0, 0, 1, 1, 2, -1], counts).astype(np.int32)
    means = np.stack([at + 0.2, np.zeros(len(at)), np.zeros(len(at))], axis=1)
    none = sparse.csr_matrix((len(ids), 0), dtype=np.float32)
    votes = MaskVotes(none, none, np.zeros(0, np.int64), np.zeros(0))
    grouping = Grouping(ids, np.ones(len(ids)), np.zeros(3), np.full(len(ids), -1))
    found = with_levels(grouping, means, votes, cuts)
    odds = [0.9 / 0.1, 0.6 * 64 / 124 / (1 - 0.6 * 64 / 124), 0.5 * 32 / 92 / (1 - 0.5 * 32 / 92)]
    np.testing.assert_allclose(found.scores / (1 - found.scores), ODDS * np.array(odds))
    assert found.groups.tolist() == [0, 0, -1] and found.group_scores.tolist() == [np.float32(0.7)]
    # each of two voxels is about half of its instance; the part of instance 2 would be the whole
    assert found.parents == [0, 0, 1, 1] and found.part_scores == pytest.approx([0.1, 0.2, 0.3, 0.5])
    assert (found.part_ids == np.select([at == v for v in (0, 1, 2, 4)], [3, 4, 5, 6], -1)).all()
    assert found.ids is grouping.ids
