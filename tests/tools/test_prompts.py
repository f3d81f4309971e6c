"""The bench's own arithmetic: counted accuracy, returned sets by hand, prompts that nobody tuned on."""

from __future__ import annotations

import pytest

from perception.query.ranking import probes
from score.queries import ABSENT, HOUSEHOLD, accuracy, returned, singular


def test_accuracy_counts_first_and_first_three() -> None:
    ranked = [[0, 1, 2, 3], [3, 2, 1, 0], [1, 0, 2, 3]]
    assert accuracy(ranked, [{0}, {1}, {3}]) == (pytest.approx(1 / 3, abs=1e-3), pytest.approx(2 / 3, abs=1e-3))
    assert accuracy([[]], [{0}]) == (0.0, 0.0)


def test_returned_sets_by_hand() -> None:
    # two of three chairs and a table; nothing returned; one mug in two pieces
    found = returned([[1, 2, 9], [], [5, 5]], [{1, 2, 3}, {4}, {5}])
    assert (found["returned_hits"], found["returned_precision"]) == (5, 0.8)
    assert found["returned_recall"] == pytest.approx(3 / 5)
    assert found["returned_f1"] == pytest.approx((2 * 2 / 6 + 0 + 2 * 1 / 3) / 3, abs=1e-3)


def test_the_absent_prompts_did_not_set_the_threshold() -> None:
    known = {singular(text) for text in probes()}
    assert len(ABSENT) == len(set(ABSENT)) == 30
    assert not known & {singular(text) for text in ABSENT + HOUSEHOLD}
