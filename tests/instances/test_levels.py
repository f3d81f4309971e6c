"""Scores, parts and groups of instances whose place on a segmented surface is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("perception._core")
from scipy import sparse

from perception.instances.group import Grouping
from perception.instances.levels import ODDS, with_levels, without_faint
from perception.masks.merging import Segmentation
from perception.masks.votes import MaskVotes


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


def test_what_is_hardly_an_object_joins_the_neighbour_whose_masks_show_it() -> None:
    """Segment 1: 40 Gaussians below x = 1.1 are instance 0, its last 4 instance 1, of an IoU of .09."""
    cuts = Segmentation(
        points=np.array([[0, 0, 0], [1, 0, 0], [9, 0, 0]], np.float32),
        segment=np.array([1, 1, 2], np.int32),
        probability=np.array([0, 0.2, 0.9]),
        part=np.arange(3),
        part_probability=np.zeros(3),
        group=np.arange(3),
        group_probability=np.zeros(3),
    )
    x = np.concatenate([np.linspace(0, 1.1, 40), np.linspace(1.1, 1.2, 4), np.linspace(8.9, 9.1, 40)])
    means = np.stack([x, np.zeros(84), np.zeros(84)], axis=1)
    ids = np.repeat([0, 1, 2], [40, 4, 40]).astype(np.int32)
    shown = np.repeat([0, 1], [44, 40])  # one photo with two masks, of which the first shows both pieces
    pixels = sparse.csr_matrix((np.full(84, 9.0, np.float32), (np.arange(84), shown)), shape=(84, 2))
    votes = MaskVotes(
        pixels, sparse.csr_matrix((84, 1), dtype=np.float32), np.zeros(2, np.int64), np.array([396.0, 360])
    )
    grouping = Grouping(ids, np.ones(84), np.ones(3), np.full(84, -1))
    found = without_faint(grouping, means, np.ones(84), votes, cuts)
    assert found.ids.tolist() == [0] * 44 + [1] * 40
    np.testing.assert_allclose(found.scores, ODDS * (q := np.array([0.2, 0.9])) / (1 - q + ODDS * q))


def test_of_other_masks_the_faint_join_too_but_not_what_no_mask_shows() -> None:
    """One photo with two masks: of 44 Gaussians of which 4 are instance 1, and of 40. 20 more lie in no mask."""
    lines = [np.linspace(*line) for line in ((0, 1.1, 40), (1.1, 1.2, 4), (8.9, 9.1, 40), (50, 50, 20))]
    x = np.concatenate(lines)
    means = np.stack([x, np.zeros(104), np.zeros(104)], axis=1)
    ids, masked = np.repeat([0, 3, 1, 2], [40, 4, 40, 20]).astype(np.int32), np.arange(84)
    pixels = sparse.csr_matrix((np.full(84, 9.0, np.float32), (masked, np.repeat([0, 1], [44, 40]))), shape=(104, 2))
    void = sparse.csr_matrix((np.full(20, 9.0, np.float32), (np.arange(84, 104), np.zeros(20, int))), shape=(104, 1))
    votes = MaskVotes(pixels, void, np.zeros(2, np.int64), np.array([396.0, 360]))
    parts = np.where((x > 1.05) & (x < 1.15), 5, np.where(x > 9, np.where(x < 10, 4, -1), -1))  # of 3 and of 1
    scores, of_parts = np.array([0.9, 0.9, 0, 0.01]), ([1, 3], [0.5, 0.5], [1, 1])
    grouping = Grouping(ids, np.ones(104), scores, parts.astype(np.int32), *of_parts)
    found = without_faint(grouping, means, np.ones(104), votes)
    assert found.ids.tolist() == [0] * 44 + [1] * 40 + [2] * 20 and found.scores[2] == 0
    assert found.parents == [1] and (np.flatnonzero(found.part_ids == 3) == np.flatnonzero(parts == 4)).all()
    sure = replace(grouping, scores=np.array([0.9, 0.9, 0, 0.9]))
    assert without_faint(sure, means, np.ones(104), votes) is sure
