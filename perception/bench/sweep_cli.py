"""What the sweeping benches share on the command line: scenes, limits, where results go, a table, JSON and a plot."""

from __future__ import annotations

import argparse
import json
import os
import platform
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from perception.bench.sweep import Limits, Sweep, SweepScene
from perception.errors import InputError
from perception.io.atomic import atomic_file

QUICK = {"shorten": 6.0, "max_side": 320, "budget": 20_000}
"""--quick: a sixth of the iterations on small photos. Shows tendencies; a figure to quote comes from a full run."""

Column = tuple[str, str, str]
"""(head, key of the row, format)."""
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


def sweep_parser(name: str, about: str | None, *, many: bool = False) -> argparse.ArgumentParser:
    """The shared options; `many` scenes, or one."""
    parser = argparse.ArgumentParser(prog=f"perception bench {name}", description=about)
    parser.add_argument("scenes", nargs="+" if many else 1, type=Path, metavar="SCENE", help="input of `map`")
    parser.add_argument("-o", "--output", type=Path, default=Path(f"bench-{name}"), help="folder for rows and plots")
    parser.add_argument("--quick", action="store_true", help="a sixth of the iterations, 320 pixels, 20 k Gaussians")
    parser.add_argument("--shorten", type=float, metavar="F", help="divide every variant's iterations by F")
    parser.add_argument("--iterations", type=int, metavar="N")
    parser.add_argument("--max-side", type=int, metavar="PX", help="most pixels a side, for every variant")
    parser.add_argument("--budget", type=int, metavar="N", help="most Gaussians, for every variant")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", dest="pairs")
    parser.add_argument("--masks", default="labels", metavar="DIR", help="label images inside SCENE, or none")
    parser.add_argument("--only", metavar="TEXT", help="only variants with TEXT in their group or name")
    return parser


def limits_of(options: argparse.Namespace) -> Limits:
    """--quick, and single options over it."""
    quick = QUICK if options.quick else {}
    given = {key: getattr(options, key) for key in ("shorten", "iterations", "max_side", "budget")}
    values: dict[str, Any] = {**quick, **{key: value for key, value in given.items() if value is not None}}
    if values.get("shorten", 1) <= 0:
        raise InputError(f"--shorten: found {values['shorten']}, expected above 0")
    return Limits(**values, settings=tuple(options.pairs))


def prepare(options: argparse.Namespace) -> tuple[Sweep, list[SweepScene], str | None]:
    """The sweep, its scenes, and the folder of masks (None: photos alone). Progress goes to stderr."""
    for scene in options.scenes:
        if not scene.exists():
            raise InputError(f"{scene}: does not exist; give a scene as `perception map` takes it")
    sweep = Sweep(options.output, limits_of(options), lambda text: print(text, file=sys.stderr, flush=True))
    scenes = []
    for folder in options.scenes:
        scene = SweepScene(folder, Path())
        scene.work = options.output / "scenes" / scene.name
        scenes.append(scene)
    return sweep, scenes, None if options.masks == "none" else options.masks


def chosen(variants: Sequence[Any], only: str | None) -> list[Any]:
    """Those whose group or name holds `only`; the first, which all are compared with, always."""
    return [v for i, v in enumerate(variants) if i == 0 or only is None or only in f"{v.group} {v.name}"]


def with_minutes(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Adds minutes of mapping (training and clustering) and CPU minutes of training."""
    return [r | {"minutes": r["seconds"] / 60, "cpu_minutes": r["cpu_seconds"] / 60} for r in rows]


def table(rows: Sequence[dict[str, Any]], columns: Sequence[Column], heads: Sequence[str] = ("group", "name")) -> str:
    """Rows as aligned text; '-' where a figure is missing."""
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
    """Processor, cores, and nanoseconds of one addition that waits for the last (numpy.cumsum of float64, the least
    of five): three or four cycles, so it tells how fast this machine really was, shared or throttled as it may be."""
    import numpy as np

    numbers, least = np.ones(1_000_000), float("inf")
    for _ in range(5):
        start = time.thread_time_ns()
        np.cumsum(numbers, out=numbers)
        least = min(least, (time.thread_time_ns() - start) / numbers.size)
        numbers[:] = 1
    return {"processor": _processor(), "cores": os.cpu_count(), "serial_add_ns": least}


def _processor() -> str:
    """Name and the widest instruction set our kernels use on it."""
    from perception.gaussians.rasterize import simd_levels

    name = platform.processor() or platform.machine()
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        name = next(line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        pass  # not Linux, or a processor that does not say
    return f"{name}, {simd_levels()[0]}"


def finish(name: str, options: argparse.Namespace, report: dict[str, Any], text: str) -> None:
    """Prints the table; keeps table and JSON (machine, versions, settings beside the rows) in the output folder."""
    from perception.pipeline.record import versions

    facts = {"bench": name, "arguments": vars(options), "machine": machine(), "versions": versions(), **report}
    with atomic_file(options.output / f"{name}.json") as aside:
        aside.write_text(json.dumps(facts, indent=1, default=str), encoding="utf-8")
    with atomic_file(options.output / f"{name}.txt") as aside:
        aside.write_text(text + "\n", encoding="utf-8")
    print(text)
    print(f"kept in {options.output}: {name}.json, {name}.txt, rows.json", file=sys.stderr)


def save_plot(path: Path, draw: Callable[[Any], None], size: tuple[float, float] = (9, 5)) -> None:
    """`draw(figure)` to a PNG; without matplotlib one line says so and the figures stay in the JSON."""
    try:
        from matplotlib.figure import Figure
    except ModuleNotFoundError:
        print(f"no {path.name}: plots need matplotlib (pip install '.[bench]' in the clone)", file=sys.stderr)
        return
    figure = Figure(figsize=size, dpi=120, layout="constrained")
    draw(figure)
    with atomic_file(path) as aside:
        figure.savefig(aside, format="png")
