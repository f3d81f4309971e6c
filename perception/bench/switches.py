"""What each economy of the mapper saves and what it costs: minutes, dB and AP, each switch turned against the default.

The first row is the default; every other row changes one switch. Differences are "with this change" minus "default": a
row that says +0.40 min and +0.02 dB says that the default's economy saves 0.40 minutes for 0.02 dB.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from perception.bench.sweep import Variant, difference
from perception.bench.sweep_cli import (
    COSTS,
    FIGURES,
    Column,
    chosen,
    finish,
    prepare,
    save_plot,
    sweep_parser,
    table,
    with_minutes,
)
from perception.bench.sweep_seeds import over_seeds, seeded

SWITCHES: tuple[tuple[str, str, tuple[str, ...]], ...] = (
    ("coarse-to-fine", "off", ("train.coarse_until=0",)),
    ("coarse-to-fine", "twice as long", ("train.coarse_until=0.3",)),
    ("features at half resolution", "off", ("losses.half_resolution=false",)),
    ("features every 2nd iteration", "every", ("losses.every=1", "train.lr_features=5e-3")),
    ("features from 30 % on", "from the start", ("losses.start=0",)),
    ("harmonics on trial", "always 3", ("train.sh_min_gain_db=-100",)),
    ("harmonics on trial", "none", ("train.sh_degree=0",)),
    ("opacity decay", "off", ("densify.opacity_decay=0",)),
    ("growth by gradient", "off", ("densify.grad_threshold=1e9",)),
    ("growth by gradient", "half the threshold", ("densify.grad_threshold=1e-4",)),
    ("growth by gradient", "twice the threshold", ("densify.grad_threshold=4e-4",)),
    ("random background", "off", ("train.random_background=false",)),
    ("variance loss", "off", ("losses.variance_weight=0",)),
    ("rates cool down", "off", ("train.cooldown=0",)),
    (
        "rates of scales and colours",
        "as Kerbl et al.",
        ("train.lr_scales=5e-3", "train.lr_colors=2.5e-3", "train.lr_harmonics=1.25e-4"),
    ),
    ("rate of means at the end", "a hundredth", ("train.lr_means_final=1.6e-6",)),
    ("rate of harmonics", "a twentieth of colours'", ("train.lr_harmonics=2.5e-4",)),
    ("holes are filled", "off", ("densify.fill_every=0",)),
    ("exchange rate", "off: no early end", ("train.exchange_db=-1000",)),
    ("exchange rate", "0.1 dB", ("train.exchange_db=0.1",)),
    (
        "the scene decides",
        "off: whole budget, degree 3, to the end",
        ("densify.grad_threshold=0", "densify.opacity_decay=0", "train.sh_min_gain_db=-100", "train.exchange_db=-1000"),
    ),
)
CHOSEN: tuple[Column, ...] = (("iterations", "iterations", "d"), ("SH", "sh_degree", "d"))


def variants(masks: str | None) -> list[Variant]:
    """The default, then each switch."""
    return [Variant("default", "", (), masks), *(Variant(g, name, pairs, masks) for g, name, pairs in SWITCHES)]


def with_differences(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Adds what each row costs and gains against the first."""
    keys = ("minutes", "cpu_minutes", "psnr", "ssim", "ap", "miou")
    return [row | {f"{key}_more": difference(row, rows[0], key) for key in keys} for row in rows]


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line."""
    options = sweep_parser("switches", __doc__).parse_args(arguments)
    sweep, scenes, masks = prepare(options)
    cells = chosen(variants(masks), options.only)
    rows = with_differences(with_minutes(over_seeds(sweep.run(scenes[0], seeded(cells, options.seeds)))))
    changes = (
        ("min", "minutes_more", "+.2f"),
        ("CPU min", "cpu_minutes_more", "+.2f"),
        ("dB", "psnr_more", "+.2f"),
        ("SSIM", "ssim_more", "+.4f"),
        ("AP", "ap_more", "+.3f"),
        ("mIoU", "miou_more", "+.3f"),
    )
    text = f"{scenes[0].name}, as measured\n{table(rows, (*FIGURES, *COSTS, *CHOSEN))}"
    text += f"\n\n{scenes[0].name}, against the default\n{table(rows[1:], changes)}"
    _plot(options.output / "switches.png", scenes[0].name, rows[1:])
    finish("switches", options, {"scene": scenes[0].name, "rows": rows}, text)
    return 0


def _plot(path: Path, scene: str, rows: Sequence[dict[str, Any]]) -> None:
    def draw(figure: Any) -> None:
        names = [f"{row['group']}: {row['name']}" for row in rows]
        parts = [("cpu_minutes_more", "CPU minutes"), ("psnr_more", "dB"), ("ap_more", "AP")]
        parts = [(key, label) for key, label in parts if any(row[key] is not None for row in rows)]
        for axis, (key, label) in zip(
            figure.subplots(1, len(parts), sharey=True, squeeze=False)[0], parts, strict=True
        ):
            axis.barh(names[::-1], [row[key] or 0 for row in rows[::-1]], color="#4477aa")
            axis.axvline(0, color="0.3", linewidth=0.8)
            axis.set_xlabel(f"{label} more than the default", fontsize=8)
            axis.tick_params(labelsize=7)
        figure.suptitle(f"{scene}: one switch changed at a time", fontsize=10)

    if rows:
        save_plot(path, draw, (10, 0.32 * len(rows) + 1.4))


if __name__ == "__main__":
    raise SystemExit(main())
