"""Calibration error by hand, and of frequencies that are known."""

from __future__ import annotations

import numpy as np
import pytest

from score.reliability import reliability


def test_calibration_error_by_hand() -> None:
    p = np.array([0.05, 0.15, 0.15, 0.95, 1.0])
    right = np.array([False, True, False, True, True])
    found = reliability(p, right)
    # bin 0: |.05 − 0|, bin 1: |.30 − 1|, bin 9: |1.95 − 2|, over five events
    assert found["ece"] == pytest.approx((0.05 + 0.7 + 0.05) / 5)
    assert [(row["low"], row["count"]) for row in found["bins"]] == [(0.0, 1), (0.1, 2), (0.9, 2)]
    assert found["bins"][1]["mean"] == pytest.approx(0.15) and found["bins"][1]["right"] == 0.5


def test_frequencies_that_are_the_probabilities_have_no_error() -> None:
    rng = np.random.default_rng(0)
    p = rng.random(200_000)
    assert reliability(p, rng.random(len(p)) < p)["ece"] < 0.01
    assert reliability(p, rng.random(len(p)) < p**2)["ece"] == pytest.approx(1 / 2 - 1 / 3, abs=0.01)
    assert reliability(np.zeros(0), np.zeros(0, bool)) == {"ece": 0.0, "count": 0, "bins": []}
