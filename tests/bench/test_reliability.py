"""Calibration error by hand, and a picture whose dots lie where the bins say."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from perception.bench.output import draw_reliability, reliability


def test_calibration_error_by_hand(tmp_path: Path) -> None:
    p = np.array([0.05, 0.15, 0.15, 0.95, 1.0])
    right = np.array([False, True, False, True, True])
    found = reliability(p, right)
    # bin 0: |.05 − 0|, bin 1: |.30 − 1|, bin 9: |1.95 − 2|, over five events
    assert found["ece"] == pytest.approx((0.05 + 0.7 + 0.05) / 5)
    assert [(row["low"], row["count"]) for row in found["bins"]] == [(0.0, 1), (0.1, 2), (0.9, 2)]
    assert found["bins"][1]["mean"] == pytest.approx(0.15) and found["bins"][1]["right"] == 0.5
    draw_reliability(tmp_path / "r.png", found)
    picture = cv2.imread(str(tmp_path / "r.png"))
    for row in found["bins"]:  # 30 pixels of margin around 340
        x, y = 30 + round(340 * row["mean"]), 370 - round(340 * row["right"])
        assert picture[y, x].tolist() == [180, 110, 40]


def test_frequencies_that_are_the_probabilities_have_no_error() -> None:
    rng = np.random.default_rng(0)
    p = rng.random(200_000)
    assert reliability(p, rng.random(len(p)) < p)["ece"] < 0.01
    assert reliability(p, rng.random(len(p)) < p**2)["ece"] == pytest.approx(1 / 2 - 1 / 3, abs=0.01)
    assert reliability(np.zeros(0), np.zeros(0, bool)) == {"ece": 0.0, "count": 0, "bins": []}
