"""Repeats of a variant with other seeds, and their median and spread."""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from perception.bench.sweep import Variant


def seeded(variants: Sequence[Variant], count: int) -> list[Variant]:
    """Each variant with seeds 0 to count − 1, the seeds of a variant side by side."""
    return [replace(variant, seed=seed) for variant in variants for seed in range(max(1, count))]


def over_seeds(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """One row a variant: medians of its figures, their largest difference in `spread`, the seeds' rows in `runs`."""
    groups: dict[tuple[Any, ...], list[dict[str, Any]]] = {}
    for row in rows:
        groups.setdefault((row["scene"], row["group"], row["name"]), []).append(row)
    return [_merged(runs) for runs in groups.values()]


def _merged(runs: list[dict[str, Any]]) -> dict[str, Any]:
    row, spread = dict(runs[0]), {}
    for key, value in runs[0].items():
        values: list[Any] = [run.get(key) for run in runs]
        if isinstance(value, (int, float)) and not isinstance(value, bool) and None not in values:
            middle = statistics.median(values)
            row[key] = round(middle) if isinstance(value, int) else middle
            spread[key] = max(values) - min(values)
    runs_kept = [{key: run.get(key) for key in ("seed", "psnr", "ssim", "ap", "seconds")} for run in runs]
    return row | {"spread": spread, "runs": runs_kept}
