"""Shared by all benchmarks: argument parser, text table, output files, a description of the machine; and reliability:
of what is given probability p, the share p should be right (Guo et al. 2017).
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import sys
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from perception.errors import InputError
from perception.io.atomic import atomic_file

Column = tuple[str, str, str]
"""(column header, key in the row, format specification)."""


def bench_parser(name: str, about: str | None) -> argparse.ArgumentParser:
    """An argument parser with the options of all benchmarks: -o FOLDER and --json."""
    parser = argparse.ArgumentParser(
        prog=f"perception bench {name}", description=about, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    folder = Path(f"bench-{name}")
    parser.add_argument("-o", "--output", type=Path, default=folder, metavar="DIR", help=f"for results ({folder})")
    parser.add_argument("--json", action="store_true", help="print one JSON object in place of the table")
    return parser


def parse_pairs(
    parser: argparse.ArgumentParser, names: str, arguments: Sequence[str] | None
) -> tuple[argparse.Namespace, list[tuple[Path, Path]]]:
    """The options, and the arguments `names` (a map and its scene's folder) by twos; InputError for an odd number."""
    parser.add_argument("paths", type=Path, nargs="+", metavar=names, help="a map and its scene's folder, in turns")
    options = parser.parse_args(arguments)
    if len(options.paths) % 2:
        raise InputError(f"bench: expected {names} in turns, found {len(options.paths)} paths")
    return options, list(zip(options.paths[::2], options.paths[1::2], strict=True))


def table(rows: Sequence[dict[str, Any]], columns: Sequence[Column], heads: Sequence[str] = ("group", "name")) -> str:
    """Rows as aligned text; '-' marks a missing value."""
    cells = [[*heads, *(head for head, _, _ in columns)]]
    for row in rows:
        figures = ["-" if row.get(key) is None else format(row[key], form) for _, key, form in columns]
        cells.append([str(row[head]) for head in heads] + figures)
    widths = [max(len(line[i]) for line in cells) for i in range(len(cells[0]))]
    left = len(heads)
    lines = [
        "  ".join(c.ljust(w) if i < left else c.rjust(w) for i, (c, w) in enumerate(zip(line, widths, strict=True)))
        for line in cells
    ]
    return "\n".join(line.rstrip() for line in lines)


def machine() -> dict[str, Any]:
    """Processor, cores, and the widest SIMD level that our kernels use on it."""
    from perception.gaussians.rasterize import simd_levels

    name = platform.processor() or platform.machine()
    with suppress(OSError, StopIteration):  # not Linux, or no model name in /proc/cpuinfo
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        name = next(line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    return {"processor": name, "cores": os.cpu_count(), "simd": simd_levels()[0]}


def finish(name: str, options: argparse.Namespace, report: dict[str, Any], text: str) -> None:
    """Prints `text`, or JSON with --json. Writes both to the output folder, with machine, versions and arguments."""
    from perception.io.tasks import versions

    facts = {"bench": name, "arguments": dict(vars(options)), "machine": machine(), "versions": versions(), **report}
    with atomic_file(options.output / f"{name}.json") as aside:
        aside.write_text(json.dumps(facts, indent=1, default=str), encoding="utf-8")
    with atomic_file(options.output / f"{name}.txt") as aside:
        aside.write_text(text + "\n", encoding="utf-8")
    print(json.dumps(facts, default=str) if options.json else text)
    print(f"kept in {options.output}: {name}.json, {name}.txt", file=sys.stderr)


SCORED = "scored"
BINS = 10
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
    """As `finish`, with the table of the reliability of all pairs (p, right) in `reports` by SCORED."""
    found = reliability(*np.array([pair for report in reports for pair in report[SCORED]]).reshape(-1, 2).T)
    rows = [{"p": f"{row['low']:.1f} to {row['low'] + 1 / BINS:.1f}", **row} for row in found["bins"]]
    lines = [*lines, f"{what}: expected calibration error {found['ece']:.3f} over {found['count']}"]
    report = (reports[0] if len(reports) == 1 else {"reports": reports}) | {"reliability": found}
    finish(name, options, report, "\n".join([*lines, table(rows, COLUMNS, ("p",))]))
