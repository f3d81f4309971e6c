"""The bench's own arithmetic: counted accuracy, the chance baseline by brute force, prompts that nobody tuned on."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from perception.bench.queries import ABSENT, HOUSEHOLD, accuracy, chance, singular
from perception.language.ranking import probes


def test_accuracy_counts_first_and_first_three() -> None:
    ranked = [[0, 1, 2, 3], [3, 2, 1, 0], [1, 0, 2, 3]]
    assert accuracy(ranked, [{0}, {1}, {3}]) == (pytest.approx(1 / 3, abs=1e-3), pytest.approx(2 / 3, abs=1e-3))
    assert accuracy([[]], [{0}]) == (0.0, 0.0)


def test_chance_is_the_mean_over_all_orders() -> None:
    orders = list(itertools.permutations(range(5)))
    for wanted in (set(), {0}, {0, 3}, {0, 1, 2, 3, 4}):
        first = np.mean([order[0] in wanted for order in orders])
        three = np.mean([bool(set(order[:3]) & wanted) for order in orders])
        assert chance([len(wanted)], 5) == (pytest.approx(first, abs=1e-3), pytest.approx(three, abs=1e-3))


def test_the_absent_prompts_did_not_set_the_threshold() -> None:
    known = {singular(text) for text in probes()}
    assert len(ABSENT) == len(set(ABSENT)) == 30
    assert not known & {singular(text) for text in ABSENT + HOUSEHOLD}
