"""What each choice of the instance losses buys on scenes with exact truth: AP and mIoU against minutes.

One setting is changed at a time: the weight of the variance loss, feature dimension, margin, the losses' variants, and
the masks (perfect against those with a segmenter's errors). The first row is the default; with --seeds N the spread
of equal settings stands beside the differences.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from perception.bench.sweep import Variant
from perception.bench.sweep_cli import COSTS, FIGURES, finish, prepare, save_plot, sweep_parser, table, with_minutes
from perception.bench.sweep_cli import chosen as choose
from perception.bench.sweep_seeds import over_seeds, seeded

VARIANCE_WEIGHTS = (0.0, 0.01, 0.1, 0.5, 1.0, 4.0)
DIMENSIONS = (4, 8, 16)
MARGINS = (0.25, 0.5, 1.0, 2.0)


def variants(masks: str | None) -> list[Variant]:
    """The default, then one choice changed at a time, then SAM-like masks with the choices that meet their errors."""

    def one(group: str, name: object, *settings: str, of: str | None = masks) -> Variant:
        return Variant(group, str(name), settings, of)

    sam = "labels_sam"
    return [
        one("default", "labels"),
        *(one("lambda_var", w, f"losses.variance_weight={w}") for w in VARIANCE_WEIGHTS),
        *(one("d", d, f"losses.feature_dim={d}") for d in DIMENSIONS),
        *(one("margin", m, f"losses.margin={m}") for m in MARGINS),
        one("loss", "L_pos per pixel", "losses.positive=per-pixel"),
        one("loss", "L_neg unsquared", "losses.negative=unsquared"),
        one("loss", "as the authors' tool", "losses.positive=per-pixel", "losses.negative=unsquared"),
        one("masks", "labels_sam", of=sam),
        one("masks", "labels_sam, lambda_var 0", "losses.variance_weight=0", of=sam),
        one("masks", "labels_sam, per pixel", "losses.positive=per-pixel", of=sam),
        one("masks", "labels_sam, unsquared", "losses.negative=unsquared", of=sam),
    ]


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line."""
    parser = sweep_parser("ablation", __doc__, many=True)
    options = parser.parse_args(arguments)
    sweep, scenes, masks = prepare(options)
    cells = choose(variants(masks), options.only)
    report: dict[str, Any] = {"scenes": {}}
    texts = []
    for scene in scenes:
        here = [v for v in cells if v.masks is None or (scene.root / v.masks).is_dir()] or [replace(cells[0])]
        rows = with_minutes(over_seeds(sweep.run(scene, seeded(here, options.seeds))))
        report["scenes"][scene.name] = rows
        texts.append(f"{scene.name}\n{table(rows, (*FIGURES, *COSTS))}")
        _plot(options.output / f"ablation-{scene.name}.png", scene.name, rows)
    finish("ablation", options, report, "\n\n".join(texts))
    return 0


def _plot(path: Any, scene: str, rows: Sequence[dict[str, Any]]) -> None:
    groups = list(
        dict.fromkeys(row["group"] for row in rows if row.get("ap") is not None and row["group"] != "default")
    )
    if not groups:
        return

    def draw(figure: Any) -> None:
        axes = figure.subplots(2, len(groups), squeeze=False)
        for column, group in enumerate(groups):
            held = [row for row in rows if row["group"] == group and row.get("ap") is not None]
            top, below = axes[0][column], axes[1][column]
            top.errorbar(
                range(len(held)), [r["ap"] for r in held], [r["spread"].get("ap", 0) / 2 for r in held], fmt="o-"
            )
            names = [row["name"].removeprefix("labels_sam, ") for row in held]
            top.set_xticks(range(len(held)), names, rotation=40, ha="right", fontsize=7)
            top.set_title(group, fontsize=9)
            below.plot([row["minutes"] for row in held], [row["ap"] for row in held], "o")
            for row, name in zip(held, names, strict=True):
                below.annotate(name, (row["minutes"], row["ap"]), fontsize=6, xytext=(3, 3), textcoords="offset points")
            below.set_xlabel("minutes", fontsize=8)
            for axis in (top, below):
                axis.axhline(rows[0]["ap"], color="0.7", linewidth=0.8, zorder=0)
                axis.tick_params(labelsize=7)
        axes[0][0].set_ylabel("AP")
        axes[1][0].set_ylabel("AP")
        figure.suptitle(f"{scene}: one choice changed at a time; grey: the default", fontsize=10)

    save_plot(path, draw, (2.6 * len(groups) + 0.6, 5.4))


if __name__ == "__main__":
    raise SystemExit(main())
