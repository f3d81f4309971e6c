"""Minutes against quality: the Pareto front over presets, budget, resolution, iterations, harmonics, features.

Held-out views are scored at each variant's own resolution; those of another resolution than the default's are marked
and kept off the front, since a smaller picture is an easier one.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from perception.bench.output import Column, finish, save_plot, table
from perception.bench.sweep import Variant, chosen, pareto, prepare, sweep_parser, with_minutes

FIGURES: tuple[Column, ...] = (
    ("PSNR", "psnr", ".2f"),
    ("SSIM", "ssim", ".4f"),
    ("AP", "ap", ".3f"),
    ("AP50", "ap50", ".3f"),
    ("AP25", "ap25", ".3f"),
    ("mIoU", "miou", ".3f"),
)
COSTS: tuple[Column, ...] = (
    ("minutes", "minutes", ".2f"),
    ("CPU min", "cpu_minutes", ".2f"),
    ("Gaussians", "gaussians", "d"),
    ("MiB", "peak_mib", ".0f"),
)
PRESET_NAMES = ("default", "fast", "quality")
BUDGETS = (12_500, 25_000, 50_000, 200_000)
ITERATIONS = (750, 1500, 6000)
SIDES = (240, 360)


def variants(masks: str | None) -> list[Variant]:
    """The presets, followed by the default settings with one setting changed at a time."""

    def one(group: str, name: object, *pairs: str) -> Variant:
        return Variant(group, str(name), pairs, masks)

    return [
        *(Variant("preset", name, (), masks, preset=name) for name in PRESET_NAMES),
        *(one("budget", n, f"train.budget={n}") for n in BUDGETS),
        *(one("iterations", n, f"train.iterations={n}") for n in ITERATIONS),
        *(one("harmonics", d, f"train.sh_degree={d}") for d in range(4)),
        *(one("max_side", n, f"photos.max_side={n}") for n in SIDES),
        *(one("d", n, f"losses.feature_dim={n}") for n in (4, 16) if masks is not None),
    ]


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line entry point."""
    options = sweep_parser("map", __doc__).parse_args(arguments)
    sweep, scene, masks = prepare(options)
    rows = with_minutes(sweep.run(scene, chosen(variants(masks), options.only)))
    native = rows[0]["pixels"]
    for key in ("psnr", "ssim", "ap"):
        points = [(row["cpu_minutes"], row.get(key) if row["pixels"] == native else None) for row in rows]
        front = set(pareto(points))
        for index, row in enumerate(rows):
            row[f"front_{key}"] = index in front
    for row in rows:
        row["front"] = " ".join(key for key in ("psnr", "ssim", "ap") if row[f"front_{key}"])
        row["note"] = row["front"] if row["pixels"] == native else "other resolution"
    text = f"{scene.name}; on the front (CPU minutes against ...):\n"
    text += table(rows, (*FIGURES, *COSTS, ("front", "note", "s")))
    _plot(options.output / "map.png", scene.name, rows, native)
    finish("map", options, {"scene": scene.name, "rows": rows}, text)
    return 0


def _plot(path: Path, scene: str, rows: Sequence[dict[str, Any]], native: int) -> None:
    def draw(figure: Any) -> None:
        from matplotlib.ticker import LogLocator, NullFormatter

        parts = [(key, label) for key, label in (("psnr", "held-out PSNR, dB"), ("ssim", "SSIM"), ("ap", "AP"))]
        parts = [(key, label) for key, label in parts if any(row.get(key) is not None for row in rows)]
        for axis, (key, label) in zip(figure.subplots(1, len(parts), squeeze=False)[0], parts, strict=True):
            held = [row for row in rows if row.get(key) is not None]
            for row in held:
                preset = row["group"] == "preset"
                style = {"marker": "*" if preset else "o", "s": 130 if preset else 28}
                color = "#cc3311" if preset else "#4477aa" if row["pixels"] == native else "0.7"
                axis.scatter(row["cpu_minutes"], row[key], color=color, zorder=3 if preset else 2, **style)
                if preset or row[f"front_{key}"]:  # labels of the other variants would overlap near the default
                    name = row["name"] if preset else f"{row['group']} {row['name']}"
                    place = {"ha": "left", "xytext": (7, -9)} if preset else {"ha": "right", "xytext": (-4, 4)}
                    at = (row["cpu_minutes"], row[key])
                    axis.annotate(name, at, fontsize=7, textcoords="offset points", annotation_clip=False, **place)
            front = sorted((row["cpu_minutes"], row[key]) for row in held if row[f"front_{key}"])
            axis.plot(*zip(*front, strict=True), color="#4477aa", linewidth=1, zorder=1)
            axis.set_xscale("log")
            axis.margins(x=0.15)
            axis.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
            axis.xaxis.set_major_formatter("{x:g}")
            axis.xaxis.set_minor_formatter(NullFormatter())
            axis.set_xlabel("CPU minutes of training")
            axis.set_ylabel(label)
            axis.grid(alpha=0.3)
        figure.suptitle(f"{scene}: grey points were scored at another resolution", fontsize=10)

    if any(row.get("psnr") is not None for row in rows):
        save_plot(path, draw, (12, 4.6))


if __name__ == "__main__":
    raise SystemExit(main())
