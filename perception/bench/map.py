"""Minutes against quality: the Pareto front over presets, budget, resolution, iterations, harmonics, features.

Held-out views are scored at each variant's own resolution; those of another resolution than the default's are marked
and kept off the front, since a smaller picture is an easier one.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from perception.bench.output import Column, finish, save_plot, table
from perception.bench.sweep import Variant, run_sweep, sweep_parser

COLUMNS: tuple[Column, ...] = (
    ("PSNR", "psnr", ".2f"),
    ("SSIM", "ssim", ".4f"),
    ("AP", "ap", ".3f"),
    ("AP50", "ap50", ".3f"),
    ("AP25", "ap25", ".3f"),
    ("mIoU", "miou", ".3f"),
    ("minutes", "minutes", ".2f"),
    ("CPU min", "cpu_minutes", ".2f"),
    ("Gaussians", "gaussians", "d"),
    ("MiB", "peak_mib", ".0f"),
    ("front", "front", "s"),
)
QUALITY = {"psnr": "held-out PSNR, dB", "ssim": "SSIM", "ap": "AP"}
PRESETS = ("default", "fast", "quality")
VALUES = {
    "train.budget": (12_500, 25_000, 50_000, 200_000),
    "train.iterations": (750, 1500, 6000),
    "train.sh_degree": (0, 1, 2, 3),
    "photos.max_side": (240, 360),
    "losses.feature_dim": (4, 16),
}
"""Values of each setting that is varied alone."""


def variants() -> list[Variant]:
    """The presets, followed by the default settings with one setting changed at a time."""
    cells = [Variant("preset", name, preset=name) for name in PRESETS]
    return cells + [
        Variant(key.partition(".")[2], str(value), (f"{key}={value}",))
        for key, values in VALUES.items()
        for value in values
    ]


def pareto(points: Sequence[tuple[float, float | None]]) -> list[int]:
    """Indices of the Pareto-optimal (cost, value) pairs by rising cost: lower cost and higher value are better."""
    kept: list[int] = []
    best = -np.inf
    for _, loss, index in sorted((cost, -value, i) for i, (cost, value) in enumerate(points) if value is not None):
        if -loss > best:
            kept.append(index)
            best = -loss
    return kept


def main(arguments: Sequence[str] | None = None) -> None:
    """Prints the table; JSON and a plot go to the output folder."""
    options = sweep_parser("map", __doc__).parse_args(arguments)
    rows = run_sweep(options, variants())
    comparable = [row["max_side"] == rows[0]["max_side"] for row in rows]
    fronts = {
        key: pareto(
            [(r["cpu_minutes"], r.get(key) if same else None) for r, same in zip(rows, comparable, strict=True)]
        )
        for key in QUALITY
    }
    for index, row in enumerate(rows):
        on = " ".join(key for key, front in fronts.items() if index in front)
        row["front"] = on if comparable[index] else "other resolution"
    text = f"{options.scene.name}; on the front (CPU minutes against ...):\n{table(rows, COLUMNS)}"
    _plot(options.output / "map.png", options.scene.name, rows, fronts)
    finish("map", options, {"scene": options.scene.name, "rows": rows}, text)


def _plot(path: Path, scene: str, rows: Sequence[dict[str, Any]], fronts: dict[str, list[int]]) -> None:
    """One axis for each measure of quality: all rows, the front as a line, and names on it."""

    def draw(figure: Any) -> None:
        shown = [key for key in QUALITY if any(row.get(key) is not None for row in rows)]
        for axis, key in zip(figure.subplots(1, len(shown), squeeze=False)[0], shown, strict=True):
            for index, row in enumerate(rows):
                if row.get(key) is None:
                    continue
                color = "0.7" if row["front"] == "other resolution" else "#4477aa"
                axis.scatter(row["cpu_minutes"], row[key], color=color, marker="*" if row["group"] == "preset" else "o")
                if index in fronts[key] or row["group"] == "preset":
                    axis.annotate(f"{row['group']} {row['name']}", (row["cpu_minutes"], row[key]), fontsize=7)
            front = [rows[index] for index in fronts[key]]
            axis.plot([row["cpu_minutes"] for row in front], [row[key] for row in front], color="#4477aa")
            axis.set(xscale="log", xlabel="CPU minutes", ylabel=QUALITY[key])
            axis.grid(alpha=0.3)
        figure.suptitle(f"{scene}: grey points were scored at another resolution", fontsize=10)

    if any(row.get("psnr") is not None for row in rows):
        save_plot(path, draw, (12, 4.6))
