"""Where things are lost, on six patches of four things whose merges are written down."""

from __future__ import annotations

import numpy as np
import pytest

from perception.masks.merging import REGION_COLUMNS, MergeTree
from score.segments import best_iou, joined_by, share_passed, union_iou
from training.masks import Reading

# Voxels of each patch by thing; 0 is unknown. Thing 4 lies in a patch that is mostly of thing 3.
VOTES = np.array(
    [[0, 9, 1, 0, 0], [0, 8, 0, 0, 0], [2, 0, 10, 0, 0], [0, 0, 0, 20, 5], [0, 0, 0, 6, 1], [3, 0, 0, 0, 0]]
)


def tree_of(odds: list[float]) -> MergeTree:
    """Merges of patches 0 and 1 (thing 1), of that and 2, and of 3 and 4."""
    features = np.zeros((9, len(REGION_COLUMNS)), np.float32)
    features[6:, REGION_COLUMNS.index("last_odds")] = odds
    return MergeTree(6, np.array([[0, 1], [6, 2], [3, 4]]), features)


def test_best_sets_by_hand() -> None:
    assert union_iou(VOTES)[1:] == pytest.approx([17 / 18, 10 / 13, 26 / 32, 0])
    regions = np.concatenate([VOTES, [VOTES[:2].sum(axis=0), VOTES[:3].sum(axis=0), VOTES[3:5].sum(axis=0)]])
    assert best_iou(regions, VOTES.sum(axis=0))[1:] == pytest.approx([17 / 18, 10 / 13, 26 / 32, 5 / 26])


@pytest.mark.parametrize(("odds", "cause"), [(1.5, "network"), (-0.5, "cut")])
def test_what_joins_two_things(odds: float, cause: str) -> None:
    things, tree = [1, 2, 3, 4], tree_of([3.0, odds, 2.0])
    together = np.stack([VOTES[:3].sum(axis=0), VOTES[3:5].sum(axis=0), VOTES[5]])
    assert joined_by(VOTES, tree, together, things) == {"patches": 1, "network": 0, "cut": 0} | {cause: 1}
    apart = np.stack([VOTES[:2].sum(axis=0), VOTES[2], VOTES[3:5].sum(axis=0), VOTES[5]])
    assert joined_by(VOTES, tree, apart, things) == {"patches": 1, "network": 0, "cut": 0}


def test_share_of_thresholds_by_hand() -> None:
    """Two labels of two things, each with pixels of the other; a third thing is tiny and does not count."""
    ids, labels = np.ones((40, 40), np.int64), np.ones((40, 40), np.int64)
    ids[:15], labels[:11], labels[11, :10], labels[30, :], labels[31, :10] = 2, 2, 2, 2, 2
    ids[39, :5] = 3
    reading = Reading([], [ids], 4.0, [])
    # IoU of thing 2: 450 / (600 + 50), above .5 to .65; of thing 1: 945 / (995 + 155), above .5 to .8
    assert share_passed(reading, [labels]) == pytest.approx((4 + 7) / 20)
