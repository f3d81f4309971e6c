"""Maps inputs with another commit and this one in turns: CPU and wall seconds, PSNR, SSIM, AP, peak memory.

python tools speed.turns OTHER INPUT ... [--seeds 0 1 2] [--threads N] [--masks NAME] [--set KEY=VALUE] [-o OUTPUT]

OTHER: a checkout of the other commit, whose core csrc/build_inplace.sh built. INPUT: what `perception map` takes, or
the word demo, which runs `perception demo`. Where a folder NAME (labels_sam) lies beside the photos, masks are of it;
where a scene.json lies there, AP is of this commit's `score.instances`. PSNR and SSIM compare with the held-out photos
as this commit undistorts them. A row kept in OUTPUT is not run again.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

import perception
from perception.bench.output import Column, bench_parser, finish, table
from perception.errors import InputError
from perception.export.render import as_gaussians
from perception.gaussians.photos import training_view
from perception.io.atomic import write_file
from perception.map.write import read_map
from perception.pipeline.record import score_views
from score.instances import score_map

FIGURES = ("cpu_seconds", "seconds", "psnr", "ssim", "ap", "peak_mib")
COLUMNS: tuple[Column, ...] = (
    ("CPU s", "cpu_seconds", ".0f"),
    ("wall s", "seconds", ".0f"),
    ("PSNR", "psnr", ".2f"),
    ("SSIM", "ssim", ".3f"),
    ("AP", "ap", ".3f"),
    ("MiB", "peak_mib", ".0f"),
    ("CPU ratio", "cpu_ratio", ".2f"),
    ("wall ratio", "wall_ratio", ".2f"),
)


def run(tree: Path, words: Sequence[str], threads: int | None) -> tuple[dict[str, Any], dict[str, float]]:
    """What `perception WORDS --json` of a checkout prints, and what it used: seconds, cpu_seconds, peak_mib."""
    limits = {"OMP_NUM_THREADS": str(threads)} if threads else {}
    env = {**os.environ, "PYTHONPATH": str(tree), **limits}
    begun = time.monotonic()
    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err:
        command = [sys.executable, "-m", "perception.cli", *words, "--json"]
        process = subprocess.Popen(command, stdout=out, stderr=err, cwd=tempfile.gettempdir(), env=env)
        _, status, used = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        for file in (out, err):
            file.seek(0)
        if process.returncode:
            raise RuntimeError(f"{tree}: {' '.join(words)}: {err.read().decode(errors='replace').strip()[-2000:]}")
        facts = json.loads(out.read())
    spent = {"seconds": time.monotonic() - begun, "cpu_seconds": used.ru_utime + used.ru_stime}
    return facts, {**spent, "peak_mib": used.ru_maxrss / 1024}


def row_of(tree: Path, given: str, seed: int, options: argparse.Namespace, work: Path) -> dict[str, Any]:
    """One run of a checkout on one input, scored."""
    if given == "demo":
        env = {**os.environ, "PYTHONPATH": str(tree)}
        about = [sys.executable, "-m", "perception.cli", "demo", "--help"]
        taken = b"--seed" in subprocess.check_output(about, cwd=tempfile.gettempdir(), env=env)
        facts, used = run(tree, ["demo", "-o", str(work), *(["--seed", str(seed)] if taken else [])], options.threads)
        return {**used, **{key: facts["quality"].get(key) for key in ("psnr", "ssim")}, "ap": facts["ap"]["ap"]}
    path = Path(given).resolve()
    folder = path if path.is_dir() else path.parent
    masks = [f"masks=labels:{folder / options.masks}"] if (folder / options.masks).is_dir() else []
    pairs = [f"seed={seed}", *masks, *options.pairs]
    words = ["map", str(path), "-o", str(work), *(word for pair in pairs for word in ("--set", pair))]
    _, used = run(tree, words, options.threads)
    scores = scores_of(work)
    if (folder / "scene.json").is_file() and (folder / "gt_points.ply").is_file():
        scores["ap"] = score_map(folder, work)["ap"]["all, calibrated"]["ap"]
    return {**used, **scores}


def scores_of(path: Path) -> dict[str, Any]:
    """PSNR and SSIM of a map in its held-out photos, which this commit reads."""
    gmap = read_map(path)
    side = gmap.info["config"]["photos"]["max_side"]
    held = [training_view(view, side) for view in gmap.views if view.held_out]
    quality = score_views(as_gaussians(gmap), held)
    return {key: quality.get(key) for key in ("psnr", "ssim")}


def main(arguments: Sequence[str] | None = None) -> None:
    """Prints the table, a row for each input and commit; JSON goes to the output folder."""
    parser = bench_parser("turns", __doc__)
    parser.add_argument("other", type=Path, metavar="OTHER")
    parser.add_argument("inputs", nargs="+", metavar="INPUT")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--threads", type=int, help="OMP_NUM_THREADS (default: as it is set)")
    parser.add_argument("--masks", default="labels_sam", metavar="NAME")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", dest="pairs")
    options = parser.parse_args(arguments)
    trees = {"other": options.other.resolve(), "this": Path(perception.__file__).resolve().parents[1]}
    if not any((trees["other"] / "perception").glob("_core*.so")):
        raise InputError(f"{options.other}: no built core there; run csrc/build_inplace.sh in that checkout")
    rows = []
    for given in options.inputs:
        found: dict[str, list[dict[str, Any]]] = {name: [] for name in trees}
        for seed in options.seeds:
            for name, tree in trees.items():
                kept = options.output / f"{given.strip('/').replace('/', '_')}-{name}-{seed}.json"
                if not kept.is_file():
                    row = row_of(tree, given, seed, options, kept.with_suffix(".gsmap").absolute())
                    write_file(kept, json.dumps(row), parents=True)
                found[name].append(json.loads(kept.read_text(encoding="utf-8")))
                print(f"{given} {name} {seed}: {found[name][-1]}", file=sys.stderr, flush=True)
        rows += compared(given, found)
    finish("turns", options, {"rows": rows}, table(rows, COLUMNS, ("input", "commit")))


def compared(given: str, found: dict[str, list[dict[str, Any]]]) -> list[dict[str, Any]]:
    """Means over the seeds of both commits, this one's also as shares of the other's seconds."""
    rows: list[dict[str, Any]] = []
    for name, runs in found.items():
        known = {key: [run[key] for run in runs if run.get(key) is not None] for key in FIGURES}
        rows.append({"input": given, "commit": name, **{k: float(np.mean(v)) for k, v in known.items() if v}})
    other, this = rows
    this["cpu_ratio"] = this["cpu_seconds"] / other["cpu_seconds"]
    this["wall_ratio"] = this["seconds"] / other["seconds"]
    return rows


if __name__ == "__main__":
    main()
