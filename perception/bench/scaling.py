"""How cost grows: seconds per 1000 iterations and peak memory over budgets, pixels and threads.

Growth fills each budget (no threshold), so that the cost is of that many Gaussians.
"""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from typing import Any

from perception.bench.output import Column, finish, save_plot, table
from perception.bench.sweep import Variant, run_sweep, sweep_parser

BUDGETS = (25_000, 50_000, 100_000, 200_000)
PIXELS = (1, 2, 4)
COLUMNS: tuple[Column, ...] = (
    ("Gaussians", "gaussians", "d"),
    ("s / 1000 it", "seconds_per_1000", ".1f"),
    ("CPU min", "cpu_minutes", ".1f"),
    ("MiB", "peak_mib", ".0f"),
    ("PSNR", "psnr", ".2f"),
    ("load", "load", ".1f"),
)


def variants(long_side: int, threads: Sequence[int]) -> list[Variant]:
    """Budgets at `long_side`, pixels at 50 k Gaussians (the most being those of `long_side`), numbers of threads."""

    def one(group: str, name: object, budget: int, side: float = long_side, n: int = 0) -> Variant:
        fill = ("densify.grad_threshold=0", "train.exchange_db=0")
        return Variant(group, str(name), (*fill, f"train.budget={budget}", f"photos.max_side={round(side)}"), n)

    cells = [one("budget", budget, budget) for budget in BUDGETS]
    cells += [one("pixels", f"x{n}", 50_000, long_side * math.sqrt(n / PIXELS[-1])) for n in PIXELS]
    return cells + [one("threads", n, 50_000, long_side, n) for n in threads]


def main(arguments: Sequence[str] | None = None) -> None:
    """Prints the table; JSON and a plot go to the output folder."""
    parser = sweep_parser("scaling", __doc__)
    parser.add_argument("--side", type=int, default=640, metavar="PX", help="long side at the most pixels")
    options = parser.parse_args(arguments)
    cores = os.cpu_count() or 1
    rows = run_sweep(options, variants(options.side, sorted({1, min(2, cores), cores})))

    def draw(figure: Any) -> None:
        groups = list(dict.fromkeys(row["group"] for row in rows))
        axes = figure.subplots(2, len(groups), squeeze=False, sharey="row")
        for column, group in enumerate(groups):
            held = [row for row in rows if row["group"] == group]
            names = [row["name"] for row in held]
            for axis, key, label in zip(
                axes[:, column], ("seconds_per_1000", "peak_mib"), ("s / 1000 iterations", "peak MiB"), strict=True
            ):
                axis.plot(names, [row[key] for row in held], "o-")
                axis.set(xlabel=group, ylabel=label, ylim=(0, None))
        figure.suptitle(options.scene.name, fontsize=10)

    text = f"{options.scene.name}; load: other work on the machine\n{table(rows, COLUMNS)}"
    save_plot(options.output / "scaling.png", draw, (9, 5.5))
    finish("scaling", options, {"scene": options.scene.name, "rows": rows}, text)
