"""Sweeps of `bench map` and `bench scaling`: `perception map` runs in a process of its own for each variant.

Every finished map stays in OUTPUT/maps with its row beside it. A key of the scene, the settings, the threads and the
source code names both, so a stopped sweep goes on, and rows of another version of the code are never reused.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from perception.bench.instances import score_map
from perception.bench.output import bench_parser
from perception.bench.processes import run_python
from perception.config import load_config
from perception.errors import InputError
from perception.io.atomic import atomic_file

_CODE = ("gaussians", "instances", "export", "evaluate", "pipeline", "config.py", "_core*")
QUICK_SHORTEN, QUICK_SIDE, QUICK_BUDGET = 6.0, 320, 20_000
"""--quick: a sixth of the iterations on small photos. It shows tendencies only; quote figures from a full run."""


@dataclass(frozen=True)
class Variant:
    """One cell of a sweep: the varied setting (group), its value (name), and the KEY=VALUE pairs that produce it.

    threads: 0 = all processors.
    """

    group: str
    name: str
    settings: tuple[str, ...] = ()
    threads: int = 0
    preset: str = "default"


def sweep_parser(name: str, about: str | None) -> argparse.ArgumentParser:
    """An argument parser with the options of a sweep over one scene."""
    parser = bench_parser(name, about)
    parser.add_argument("scene", type=Path, metavar="SCENE", help="input of `map`; its truth, where there, gives AP")
    parser.add_argument("--masks", metavar="SOURCE", help="as of `map`; default: SCENE/labels where there, else auto")
    parser.add_argument("--quick", action="store_true", help="a sixth of the iterations, 320 pixels, 20 k Gaussians")
    parser.add_argument("--shorten", type=float, metavar="F", help="divide every variant's iterations by F")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", dest="pairs")
    parser.add_argument("--only", metavar="TEXT", help="only variants with TEXT in their group or name")
    return parser


def settings_of(variant: Variant, options: argparse.Namespace) -> list[str]:
    """The variant's KEY=VALUE pairs, shortened as `options` say. A shorter run keeps its number of densifications."""
    labels = options.scene / "labels"
    masks = options.masks or (f"labels:{labels}" if labels.is_dir() else "auto")
    pairs = [f"masks={masks}", "language.encoder=none", *options.pairs, *variant.settings]
    shorten = options.shorten or (QUICK_SHORTEN if options.quick else 1.0)
    if not shorten > 0:
        raise InputError(f"--shorten: found {shorten}, expected above 0")
    config = load_config(None, pairs, variant.preset)
    iterations = max(1, round(config.train.iterations / shorten))
    every = max(20, round(config.densify.every * min(1.0, iterations / config.train.iterations)))
    pairs += [f"train.iterations={iterations}", f"densify.every={every}"]
    if options.quick:
        pairs.append(f"train.budget={min(config.train.budget, QUICK_BUDGET)}")
        pairs.append(f"photos.max_side={min(config.photos.max_side, QUICK_SIDE)}")
    return pairs


def run_sweep(options: argparse.Namespace, variants: Sequence[Variant]) -> list[dict[str, Any]]:
    """The rows of the variants that --only names and of the first, which is the reference; kept rows are reused."""
    if not options.scene.exists():
        raise InputError(f"{options.scene}: does not exist; give a scene as `perception map` takes it")
    chosen = [v for i, v in enumerate(variants) if not i or (options.only or "") in f"{v.group} {v.name}"]
    rows, code = [], code_digest()
    for number, variant in enumerate(chosen, start=1):
        pairs = settings_of(variant, options)
        parts = [str(options.scene.resolve()), pairs, variant.preset, variant.threads, code]
        kept = options.output / "maps" / f"{hashlib.sha256(json.dumps(parts).encode()).hexdigest()[:16]}.json"
        known = kept.is_file()
        if not known:
            with atomic_file(kept) as aside:
                aside.write_text(json.dumps(map_variant(options.scene, variant, pairs, kept)), encoding="utf-8")
        row = {**asdict(variant), **json.loads(kept.read_text(encoding="utf-8"))}
        rows.append(row)
        line = f"{number}/{len(chosen)} {variant.group} {variant.name}: {60 * row['minutes']:.0f} s"
        print(line + (" (kept)" if known else ""), file=sys.stderr, flush=True)
    return rows


def map_variant(scene: Path, variant: Variant, pairs: list[str], row: Path) -> dict[str, Any]:
    """Maps the scene beside `row` and scores the map. Minutes are of the whole run, CPU seconds of all its threads."""
    path, settings = row.with_suffix(".gsmap"), (word for pair in pairs for word in ("--set", pair))
    before = os.times()
    output = run_python(
        *("-m", "perception.cli", "map", str(scene.resolve()), "-o", str(path.resolve()), "--json", "--resume"),
        *("--preset", variant.preset, *settings),
        threads=variant.threads or os.cpu_count() or 1,
    )
    after = os.times()
    facts = json.loads(output)
    train, iterations = facts["seconds"]["train"], max(1, facts["iterations"])
    cpu = after.children_user + after.children_system - before.children_user - before.children_system
    found = {
        "map": str(path),
        "max_side": load_config(None, pairs, variant.preset).photos.max_side,
        "minutes": facts["seconds"]["total"] / 60,
        "cpu_minutes": cpu / 60,
        "seconds_per_1000": 1000 * train / iterations,
        "gaussians": facts["gaussians"],
        "peak_mib": facts["peak_memory_mib"],
        "psnr": facts["quality"].get("psnr"),
        "ssim": facts["quality"].get("ssim"),
        "load": os.getloadavg()[0] if hasattr(os, "getloadavg") else None,
    }
    if (scene / "scene.json").is_file():
        scores = score_map(scene, path)
        found |= scores["ap"]["all, calibrated"] | {"miou": scores["rendered_miou"]}
    return found


def code_digest() -> str:
    """Digest of the source files that can change a row."""
    root = Path(__file__).resolve().parents[1]
    digest = hashlib.sha256()
    for path in sorted(path for pattern in _CODE for path in root.glob(pattern)):
        for file in sorted(path.rglob("*.py")) if path.is_dir() else [path]:
            digest.update(file.name.encode() + file.read_bytes())
    return digest.hexdigest()[:16]
