"""Reliability of probabilities: of what is given probability p, the share p should be right (Guo et al. 2017)."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np

from perception.bench.output import Column, finish, table
from perception.io.atomic import atomic_file

SCORED = "scored"
BINS = 10
SIDE, EDGE = 400, 30  # of the picture, pixels
COLUMNS: tuple[Column, ...] = (("count", "count", "d"), ("mean p", "mean", ".3f"), ("right", "right", ".3f"))


def reliability(p: np.ndarray, right: np.ndarray) -> dict[str, Any]:
    """Of N events with probability p [N] and outcome right [N] bool: `ece`, the expected calibration error
    Σ_b |Σ_{n in b} (p_n − right_n)| / N over BINS bins of equal width; `bins` with low, count, mean p and share right.
    """
    p, right = np.asarray(p, np.float64), np.asarray(right, bool)
    place = np.minimum((p * BINS).astype(int), BINS - 1)
    count = np.bincount(place, minlength=BINS)
    sums = [np.bincount(place, weights=x, minlength=BINS) for x in (p, right)]
    bins = [
        {"low": b / BINS, "count": int(count[b]), "mean": sums[0][b] / count[b], "right": sums[1][b] / count[b]}
        for b in np.flatnonzero(count).tolist()
    ]
    return {"ece": float(np.abs(sums[0] - sums[1]).sum() / max(len(p), 1)), "count": len(p), "bins": bins}


def finish_reliability(
    name: str, options: argparse.Namespace, reports: list[dict[str, Any]], lines: list[str], what: str
) -> None:
    """As `finish`, with the table and picture of the reliability of all pairs (p, right) in `reports` by SCORED."""
    found = reliability(*np.array([pair for report in reports for pair in report[SCORED]]).reshape(-1, 2).T)
    draw_reliability(options.output / f"{name}.png", found)
    rows = [{"p": f"{row['low']:.1f} to {row['low'] + 1 / BINS:.1f}", **row} for row in found["bins"]]
    lines = [*lines, f"{what}: expected calibration error {found['ece']:.3f} over {found['count']}"]
    report = (reports[0] if len(reports) == 1 else {"reports": reports}) | {"reliability": found}
    finish(name, options, report, "\n".join([*lines, table(rows, COLUMNS, ("p",))]))


def draw_reliability(file: Path, found: dict[str, Any]) -> None:
    """A PNG: share that is right over mean p, one dot a bin, its area by the number of events."""
    import cv2

    picture = np.full((SIDE, SIDE, 3), 255, np.uint8)

    def at(x: float, y: float) -> tuple[int, int]:
        inner = SIDE - 2 * EDGE
        return EDGE + round(x * inner), SIDE - EDGE - round(y * inner)

    for k in (0.0, 0.2, 0.4, 0.6, 0.8, 1.0):
        for ends in ((at(k, 0), at(k, 1)), (at(0, k), at(1, k))):
            cv2.line(picture, *ends, (220, 220, 220), 1, cv2.LINE_AA)
        for place in (at(k - 0.03, -0.06), at(-0.08, k - 0.01)):
            cv2.putText(picture, f"{k:.1f}", place, cv2.FONT_HERSHEY_SIMPLEX, 0.35, (90, 90, 90), 1, cv2.LINE_AA)
    cv2.line(picture, at(0, 0), at(1, 1), (160, 160, 160), 1, cv2.LINE_AA)
    for row in found["bins"]:
        radius = 3 + round(25 * (row["count"] / found["count"]) ** 0.5)
        cv2.circle(picture, at(row["mean"], row["right"]), radius, (180, 110, 40), -1, cv2.LINE_AA)
    with atomic_file(file) as aside:
        aside.write_bytes(cv2.imencode(".png", picture)[1].tobytes())
