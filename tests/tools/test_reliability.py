"""Calibration error by hand, and of frequencies that are known."""

from __future__ import annotations

import numpy as np
import pytest

from score.reliability import fitted, reliability


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


def test_fitted_probabilities_are_the_shares_right() -> None:
    knots = (0.0, 0.25, 0.5, 1.0)
    x = np.repeat([0.25, 0.5], [1000, 2000])  # at the knots, the likeliest value is the share right
    right = np.concatenate([np.arange(1000) < 200, np.arange(2000) < 1500])
    assert fitted(x, right, knots) == pytest.approx([0, 0.2, 0.75, 1], abs=0.002)
    swapped = fitted(x, np.concatenate([np.arange(1000) < 750, np.arange(2000) < 400]), knots)
    assert (np.diff(swapped) > 0).all() and swapped[1:3] == pytest.approx([1150 / 3000] * 2, abs=0.002)  # it must rise
    rng = np.random.default_rng(0)
    x = rng.random(100_000)
    true = np.array([0, 0.1, 0.9, 1])
    assert fitted(x, rng.random(len(x)) < np.interp(x, knots, true), knots) == pytest.approx(true, abs=0.02)
