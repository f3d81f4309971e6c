"""Several segmentations of one surface, each wrong in another place, against the true one."""

from __future__ import annotations

import tracemalloc
from collections import Counter

import numpy as np
import pytest

from perception.masks.averaging import averaged
from perception.masks.merging import Segmentation, nested

TRUE = np.repeat([1, 2, 3, 4, 5], [500, 300, 120, 80, 40])


def cuts(segment, probability, part=None, group=None) -> Segmentation:
    """part: [V], of segments alone where not given; group: of each segment, one for all where not given."""
    part = np.unique(segment, return_inverse=True)[1] if part is None else np.asarray(part)
    group = np.zeros(len(probability), int) if group is None else np.asarray(group)
    chances = np.linspace(0.1, 0.9, part.max() + 1), np.linspace(0.2, 0.8, group.max() + 1)
    return Segmentation(
        np.zeros((len(segment), 3)), segment, np.asarray(probability), part, chances[0], group, chances[1]
    )


def changed(pairs: dict[int, int]) -> np.ndarray:
    """TRUE with other names: of two segments one, and numbered from 1."""
    segment = TRUE.copy()
    for old, new in pairs.items():
        segment[old == TRUE] = new
    return np.unique(segment, return_inverse=True)[1] + 1


def certain(segment: np.ndarray, value: float = 0.9) -> np.ndarray:
    return np.append(0, np.full(segment.max(), value))


def test_errors_that_one_of_three_makes_are_outvoted() -> None:
    joined, torn, moved = changed({2: 1}), TRUE.copy(), TRUE.copy()
    torn[100:250] = 6
    moved[480:520] = 2  # the border between the first two, on both sides
    moved[900:930] = 0  # and a piece of none
    found = averaged(cuts(joined, certain(joined)), [(torn, certain(torn)), (moved, certain(moved))])
    expected = TRUE.copy()
    expected[480:500] = found.segment[490]  # of three, one says 1, one 2, one has both together
    np.testing.assert_array_equal(found.segment, expected)
    assert found.probability[0] == 0 and (found.probability[1:] > 0.5).all() and (found.probability < 0.9 + 1e-9).all()


def test_equal_segmentations_stay_whatever_their_numbers() -> None:
    probability = np.array([0, 0.9, 0.7, 0.5, 0.3, 0.1])
    turned = np.array([0, 3, 1, 5, 2, 4])
    other = np.zeros(6)
    other[turned] = probability
    found = averaged(cuts(TRUE, probability), [(turned[TRUE], other)] * 2)
    np.testing.assert_array_equal(found.segment, TRUE)
    np.testing.assert_allclose(found.probability, probability)


def test_alone_it_is_itself_with_parts_and_groups() -> None:
    part = np.where(np.arange(len(TRUE)) < 200, 0, TRUE)
    first = cuts(TRUE, np.array([0, 0.9, 0.7, 0.5, 0.3, 0.1]), part, [0, 0, 1, 1, 2, 2])
    found = averaged(first, [])
    for name in ("segment", "probability", "part_probability", "group_probability"):
        np.testing.assert_allclose(getattr(found, name), getattr(first, name))
    assert len(np.unique(np.stack([found.part, part]), axis=1).T) == 6  # one to one
    np.testing.assert_array_equal(found.group, first.group)


def test_parts_are_cut_by_new_segments_and_nothing_is_smaller_than_before() -> None:
    joined = changed({2: 1})
    slivers = TRUE.copy()
    slivers[498:502] = 6  # four voxels of which another grid makes a segment of their own
    found = averaged(cuts(joined, certain(joined)), [(slivers, certain(slivers)), (slivers, certain(slivers))])
    assert found.segment[0] != found.segment[600] and (found.segment[498:502] == 0).all()
    for part in np.unique(found.part):
        assert len(np.unique(found.segment[found.part == part])) == 1
    assert len(found.part_probability) == found.part.max() + 1


@pytest.mark.parametrize("count", [0, 1])
def test_surfaces_with_nothing_or_one_thing(count: int) -> None:
    segment = np.full(50, count)
    found = averaged(cuts(segment, np.append(0, np.ones(count))), [(segment, np.append(0, np.ones(count)))])
    np.testing.assert_array_equal(found.segment, segment)
    assert len(found.probability) == count + 1


def test_many_segments_take_memory_for_those_that_overlap_alone() -> None:
    segment = np.repeat(np.arange(1, 1201), 3)
    tracemalloc.start()
    found = averaged(cuts(segment, certain(segment)), [(segment, certain(segment))] * 2)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert len(np.unique(found.segment * 2000 + segment)) == 1200 and found.probability[1:] == pytest.approx(0.9)
    assert peak < 10e6  # a number for each two of them would take 35 MB


def test_groups_are_the_regions_of_most_voxels_and_take_memory_for_those_of_the_cut_alone() -> None:
    rng = np.random.default_rng(0)
    tree, segments = 50_000, 200
    segment = np.append(np.arange(segments + 1), rng.integers(0, segments + 1, 3000))
    region = rng.choice(tree, 40, replace=False)[rng.integers(0, 40, len(segment))]
    odds = rng.random(tree)
    tracemalloc.start()
    found = nested(np.zeros((len(segment), 3)), segment, np.ones(segments + 1), (region, odds), (region, odds))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    counts = [Counter(sorted(region[segment == s].tolist())) for s in range(segments + 1)]
    expected = [odds[max(count, key=lambda r: (count[r], -r))] for count in counts]
    np.testing.assert_array_equal(found.group_probability[found.group], expected)
    assert peak < 10e6  # a number for each segment and region of the tree would take 80 MB
