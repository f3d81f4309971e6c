"""Shared by the scores of maps: pairs of a map and its scene, and reliability: of what is given probability p, the
share p should be right (Guo et al. 2017).
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from perception.bench.output import Column, finish, table
from perception.errors import InputError

SCORED = "scored"
BINS = 10
PRIOR = 0.1  # events, of `fitted`
COLUMNS: tuple[Column, ...] = (("count", "count", "d"), ("mean p", "mean", ".3f"), ("right", "right", ".3f"))


def parse_pairs(
    parser: argparse.ArgumentParser, names: str, arguments: Sequence[str] | None
) -> tuple[argparse.Namespace, list[tuple[Path, Path]]]:
    """The options, and the arguments `names` (a map and its scene's folder) by twos; InputError for an odd number."""
    parser.add_argument("paths", type=Path, nargs="+", metavar=names, help="a map and its scene's folder, in turns")
    parser.add_argument("--plot", type=Path, metavar="FILE.png", help="draws the reliability (matplotlib)")
    parser.prog = f"python {sys.argv[0]}"
    options = parser.parse_args(arguments)
    if len(options.paths) % 2:
        raise InputError(f"expected {names} in turns, found {len(options.paths)} paths")
    return options, list(zip(options.paths[::2], options.paths[1::2], strict=True))


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


def fitted(x: np.ndarray, right: np.ndarray, knots: Sequence[float]) -> np.ndarray:
    """The probabilities at `knots`, from 0 at the first to 1 at the last, strictly rising and linear between them, that
    make the outcomes right [N] bool of events at x [N] most likely. PRIOR on each rise keeps it above 0."""
    from scipy.optimize import minimize
    from scipy.special import log_softmax

    def values(rises: np.ndarray) -> np.ndarray:
        return np.append(0.0, np.cumsum(np.exp(log_softmax(rises))))

    def loss(rises: np.ndarray) -> float:
        p = np.interp(x, knots, values(rises)).clip(1e-4, 1 - 1e-4)
        return float(-np.log(np.where(right, p, 1 - p)).sum() - PRIOR * log_softmax(rises).sum())

    return values(minimize(loss, np.zeros(len(knots) - 1)).x)


def draw(found: dict[str, Any], what: str, file: Path) -> None:
    """The share right against mean p, of bins with their counts, beside the line where both are equal."""
    from matplotlib import pyplot as plt

    _, axis = plt.subplots(figsize=(4, 4), layout="constrained")
    axis.plot([0, 1], [0, 1], "-", color="0.7")
    axis.plot([row["mean"] for row in found["bins"]], [row["right"] for row in found["bins"]], "o-")
    for row in found["bins"]:
        axis.annotate(row["count"], (row["mean"], row["right"]), (5, -10), textcoords="offset points", fontsize=7)
    error = f"{what}: calibration error {found['ece']:.3f} over {found['count']}"
    axis.set(xlabel="score", ylabel="share right", xlim=(0, 1), ylim=(0, 1.02), title=error)
    axis.grid(alpha=0.3)
    plt.savefig(file, dpi=110)


def finish_reliability(
    name: str, options: argparse.Namespace, reports: list[dict[str, Any]], lines: list[str], what: str
) -> None:
    """As `finish`, with the table of the reliability of all pairs (p, right) in `reports` by SCORED."""
    found = reliability(*np.array([pair for report in reports for pair in report[SCORED]]).reshape(-1, 2).T)
    if options.plot:
        draw(found, what, options.plot)
    rows = [{"p": f"{row['low']:.1f} to {row['low'] + 1 / BINS:.1f}", **row} for row in found["bins"]]
    lines = [*lines, f"{what}: expected calibration error {found['ece']:.3f} over {found['count']}"]
    report = (reports[0] if len(reports) == 1 else {"reports": reports}) | {"reliability": found}
    finish(name, options, report, "\n".join([*lines, table(rows, COLUMNS, ("p",))]))
