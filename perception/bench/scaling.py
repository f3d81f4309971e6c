"""How cost grows: seconds per 1000 iterations and peak memory over budgets, pixels and threads, harmonics and growth by
settings as they are. Growth fills each budget (no threshold), so that the cost is of that many Gaussians.
"""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from perception.bench.output import finish, save_plot, table
from perception.bench.sweep import Variant, chosen, prepare, sweep_parser, with_minutes

BUDGETS = (25_000, 50_000, 100_000, 200_000)
PIXELS = (1, 2, 4)


def variants(masks: str | None, long_side: int, threads: Sequence[int]) -> list[Variant]:
    """Budgets at `long_side`, pixels at 50 k Gaussians (the most being those of `long_side`), numbers of threads."""
    fill = ("densify.grad_threshold=0", "train.exchange_db=0")

    def one(group: str, name: str, budget: int, side: float, n: int = 0) -> Variant:
        pairs = (*fill, f"train.budget={budget}", f"photos.max_side={round(side)}")
        return Variant(group, name, pairs, masks, threads=n)

    cells = [one("budget", str(budget), budget, long_side) for budget in BUDGETS]
    cells += [one("pixels", f"x{n}", 50_000, long_side * math.sqrt(n / PIXELS[-1])) for n in PIXELS]
    return cells + [one("threads", str(n), 50_000, long_side, n) for n in threads]


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line entry point."""
    parser = sweep_parser("scaling", __doc__)
    parser.add_argument("--side", type=int, default=640, metavar="PX", help="long side at the most pixels")
    options = parser.parse_args(arguments)
    sweep, scene, masks = prepare(options)
    threads = sorted({1, 2, os.cpu_count() or 1} & set(range(1, (os.cpu_count() or 1) + 1)))
    cells = chosen(variants(masks, options.side, threads), options.only)
    rows = with_minutes(sweep.run(scene, cells))
    columns = (
        ("Gaussians", "gaussians", "d"),
        ("s / 1000 it", "wall_per_1000", ".1f"),
        ("CPU s / 1000 it", "seconds_per_1000", ".1f"),
        ("MiB", "peak_mib", ".0f"),
        ("PSNR", "psnr", ".2f"),
        ("load", "load", ".1f"),
    )
    text = f"{scene.name}; load: other work on the machine shows there, CPU seconds feel it less\n"
    text += table(rows, columns)
    _plot(options.output / "scaling.png", scene.name, rows)
    finish("scaling", options, {"scene": scene.name, "rows": rows}, text)
    return 0


def _plot(path: Path, scene: str, rows: Sequence[dict[str, Any]]) -> None:
    def draw(figure: Any) -> None:
        groups = list(dict.fromkeys(row["group"] for row in rows))
        axes = figure.subplots(2, len(groups), squeeze=False, sharey="row")
        for column, group in enumerate(groups):
            held = [row for row in rows if row["group"] == group]
            places = [row["gaussians"] / 1000 if group == "budget" else float(row["name"].strip("x")) for row in held]
            label = {"budget": "thousand Gaussians", "pixels": "times the pixels"}.get(group, group)
            axes[0][column].plot(places, [row["wall_per_1000"] for row in held], "o-", label="wall clock")
            axes[0][column].plot(places, [row["seconds_per_1000"] for row in held], "s--", label="CPU")
            axes[1][column].plot(places, [row["peak_mib"] for row in held], "o-")
            axes[1][column].set_xlabel(label)
            for axis in axes[:, column]:
                axis.grid(alpha=0.3)
                axis.set_xticks(places, [f"{place:.0f}" for place in places])
        for axis in axes[:, 0]:  # the limits are shared by a row, so they are set after all of it is drawn
            axis.set_ylim(bottom=0)
        axes[0][0].set_ylabel("seconds per 1000 iterations")
        axes[1][0].set_ylabel("peak memory, MiB")
        axes[0][0].legend(fontsize=8)
        figure.suptitle(scene, fontsize=10)

    save_plot(path, draw, (9, 5.5))


if __name__ == "__main__":
    raise SystemExit(main())
