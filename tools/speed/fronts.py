"""Measures minutes against quality over presets and settings of `map`, and draws the Pareto front.

python tools speed.fronts SCENE [--set KEY=VALUE] [--only TEXT] [-o OUTPUT] [--plot FILE.png]

`perception map` runs in a process of its own for each variant. A finished map stays in OUTPUT/maps with its row, named
by a key of the scene, the settings and the source code, so a stopped sweep goes on. Held-out views are scored at each
variant's own resolution; those of another resolution than the default's are marked and kept off the front, since a
smaller picture is an easier one.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

import perception
from perception.bench.output import Column, bench_parser, finish, table
from perception.config import load_config
from perception.errors import InputError
from perception.io.atomic import atomic_file
from score.instances import score_map

COLUMNS: tuple[Column, ...] = (
    ("PSNR", "psnr", ".2f"),
    ("SSIM", "ssim", ".4f"),
    ("AP", "ap", ".3f"),
    ("AP50", "ap50", ".3f"),
    ("AP25", "ap25", ".3f"),
    ("mIoU", "miou", ".3f"),
    ("minutes", "minutes", ".2f"),
    ("CPU min", "cpu_minutes", ".2f"),
    ("masks s", "masks_seconds", ".1f"),
    ("Gaussians", "gaussians", "d"),
    ("MiB", "peak_mib", ".0f"),
    ("front", "front", "s"),
)
QUALITY = ("psnr", "ssim", "ap")
PRESETS = ("default", "fast", "quality")
VALUES = {
    "train.budget": (12_500, 25_000, 50_000, 200_000),
    "train.iterations": (750, 1500, 6000),
    "train.sh_degree": (0, 1, 2, 3),
    "photos.max_side": (240, 360),
    "losses.feature_dim": (4, 16),
}
"""Values of each setting that is varied alone."""


@dataclass(frozen=True)
class Variant:
    """One row: the varied setting (group), its value (name), and the KEY=VALUE pairs that produce it."""

    group: str
    name: str
    settings: tuple[str, ...] = ()
    preset: str = "default"


def variants() -> list[Variant]:
    """The presets, followed by the default settings with one setting changed at a time."""
    cells = [Variant("preset", name, preset=name) for name in PRESETS]
    return cells + [
        Variant(key.partition(".")[2], str(value), (f"{key}={value}",))
        for key, values in VALUES.items()
        for value in values
    ]


def settings_of(variant: Variant, options: argparse.Namespace) -> list[str]:
    """The variant's KEY=VALUE pairs."""
    labels = options.scene / "labels"
    masks = options.masks or (f"labels:{labels}" if labels.is_dir() else "auto")
    return [f"masks={masks}", "language.encoder=none", *options.pairs, *variant.settings]


def run_sweep(options: argparse.Namespace, cells: Sequence[Variant]) -> list[dict[str, Any]]:
    """The rows of the variants that --only names and of the first, which is the reference; kept rows are reused."""
    if not options.scene.exists():
        raise InputError(f"{options.scene}: does not exist; give a scene as `perception map` takes it")
    chosen = [v for i, v in enumerate(cells) if not i or (options.only or "") in f"{v.group} {v.name}"]
    rows, code = [], _code_digest()
    for number, variant in enumerate(chosen, start=1):
        pairs = settings_of(variant, options)
        parts = json.dumps([str(options.scene.resolve()), pairs, variant.preset, code])
        kept = options.output / "maps" / f"{hashlib.sha256(parts.encode()).hexdigest()[:16]}.json"
        known = kept.is_file()
        if not known:
            with atomic_file(kept, parents=True) as aside:
                aside.write_text(json.dumps(map_variant(options.scene, variant, pairs, kept)), encoding="utf-8")
        rows.append({**asdict(variant), **json.loads(kept.read_text(encoding="utf-8"))})
        line = f"{number}/{len(chosen)} {variant.group} {variant.name}: {60 * rows[-1]['minutes']:.0f} s"
        print(line + (" (kept)" if known else ""), file=sys.stderr, flush=True)
    return rows


def map_variant(scene: Path, variant: Variant, pairs: list[str], row: Path) -> dict[str, Any]:
    """Maps the scene beside `row` and scores the map. Minutes are of the whole run, CPU minutes of all its threads."""
    path = row.with_suffix(".gsmap")
    command = [sys.executable, "-m", "perception.cli", "map", str(scene.resolve()), "-o", str(path.resolve())]
    command += ["--json", "--resume", "--preset", variant.preset, *(w for pair in pairs for w in ("--set", pair))]
    # Started in a repository root, Python would import the sources without _core.
    paths = [str(Path(perception.__file__).resolve().parents[1]), *filter(None, sys.path)]
    env = {**os.environ, "PYTHONPATH": os.pathsep.join(dict.fromkeys(paths))}
    before = os.times()
    done = subprocess.run(command, capture_output=True, text=True, cwd=tempfile.gettempdir(), env=env)
    after = os.times()
    if done.returncode:
        raise RuntimeError(f"perception map ended with {done.returncode}: {done.stderr.strip()}")
    facts = json.loads(done.stdout)
    found = {
        "map": str(path),
        "max_side": load_config(None, pairs, variant.preset).photos.max_side,
        "minutes": facts["seconds"]["total"] / 60,
        "cpu_minutes": (sum(after[2:4]) - sum(before[2:4])) / 60,
        "masks_seconds": facts["seconds"].get("masks"),
        "gaussians": facts["gaussians"],
        "peak_mib": facts["peak_memory_mib"],
        **{key: facts["quality"].get(key) for key in ("psnr", "ssim")},
    }
    if (scene / "scene.json").is_file():
        scores = score_map(scene, path)
        found |= scores["ap"]["all, calibrated"] | {"miou": scores["rendered_miou"]}
    return found


def _code_digest() -> str:
    """Digest of the package, any file of which can change a row."""
    root = Path(perception.__file__).resolve().parent
    files = sorted([*root.rglob("*.py"), *root.glob("_core*.so")])
    return hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()[:16]


def pareto(points: Sequence[tuple[float, float | None]]) -> list[int]:
    """Indices of the Pareto-optimal (cost, value) pairs by rising cost: lower cost and higher value are better."""
    kept: list[int] = []
    best = -np.inf
    for _, loss, index in sorted((cost, -value, i) for i, (cost, value) in enumerate(points) if value is not None):
        if -loss > best:
            kept.append(index)
            best = -loss
    return kept


def sweep_parser() -> argparse.ArgumentParser:
    """The options of the command."""
    parser = bench_parser("fronts", __doc__)
    parser.add_argument("scene", type=Path, metavar="SCENE", help="input of `map`; its truth, where there, gives AP")
    parser.add_argument("--masks", metavar="SOURCE", help="as of `map`; default: SCENE/labels where there, else auto")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", dest="pairs")
    parser.add_argument("--only", metavar="TEXT", help="only variants with TEXT in their group or name")
    parser.add_argument("--plot", type=Path, metavar="FILE.png", help="draws PSNR and AP against minutes (matplotlib)")
    return parser


def draw(rows: Sequence[dict[str, Any]], file: Path) -> None:
    """PSNR and AP against CPU minutes: a sign for each group, a line through the front; other sizes hollow."""
    from matplotlib import pyplot as plt

    drawn = [key for key in ("psnr", "ap") if any(row.get(key) is not None for row in rows)]
    _, axes = plt.subplots(1, len(drawn), figsize=(5.2 * len(drawn), 4.2), layout="constrained", squeeze=False)
    groups = list(dict.fromkeys(row["group"] for row in rows))
    for axis, key in zip(axes[0], drawn, strict=True):
        for n, (group, sign) in enumerate(zip(groups, "osD^vP*", strict=False)):
            of = [row for row in rows if row["group"] == group and row.get(key) is not None]
            for row in of:
                place, fill = (row["cpu_minutes"], row[key]), "none" if "other" in row["front"] else f"C{n}"
                axis.plot(*place, sign, color=f"C{n}", markerfacecolor=fill, label=group if row is of[0] else None)
                axis.annotate(row["name"], place, (4, 4), textcoords="offset points", fontsize=7)
        front = sorted((row["cpu_minutes"], row[key]) for row in rows if key in row["front"].split())
        axis.plot(*zip(*front, strict=True), "-", color="0.7", zorder=0)
        axis.set(xlabel="CPU minutes of the whole run", ylabel={"psnr": "held-out PSNR, dB", "ap": "AP"}[key])
        axis.grid(alpha=0.3)
    axes[0, -1].legend(fontsize=7, loc="lower right")
    plt.savefig(file, dpi=110)


def main(arguments: Sequence[str] | None = None) -> None:
    """Prints the table; JSON goes to the output folder."""
    options = sweep_parser().parse_args(arguments)
    if options.plot:
        import matplotlib  # noqa: F401  before minutes of work
    rows = run_sweep(options, variants())
    comparable = [row["max_side"] == rows[0]["max_side"] for row in rows]
    for row, same in zip(rows, comparable, strict=True):
        row["front"] = "" if same else "other resolution"
    for key in QUALITY:
        values = [row.get(key) if same else None for row, same in zip(rows, comparable, strict=True)]
        for index in pareto(list(zip((row["cpu_minutes"] for row in rows), values, strict=True))):
            rows[index]["front"] = f"{rows[index]['front']} {key}".strip()
    if options.plot:
        draw(rows, options.plot)
    text = f"{options.scene.name}; on the front (CPU minutes against ...):\n{table(rows, COLUMNS)}"
    finish("fronts", options, {"scene": options.scene.name, "rows": rows}, text)


if __name__ == "__main__":
    main()
