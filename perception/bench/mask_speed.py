"""Speed and memory of mask sources: photos a second and peak memory at two numbers of photos, each in a process of its
own. Label images are written as `map` writes them.

SCENE is a scene with truth. `builtin` is its second round, all photos together, from the depth there spoilt as that of
a half-trained map is; `builtin:photos` every photo alone. Photos are repeated when there are fewer than asked for.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from perception.bench.children import child_options
from perception.bench.fit_masks import posed_views, spoilt_depth
from perception.bench.masks import read_image
from perception.bench.sweep_cli import Column, finish, table
from perception.errors import InputError
from perception.masks import MaskSource, make_source
from perception.masks.store import compute_masks
from perception.types import View

COLUMNS: tuple[Column, ...] = (
    ("photos", "photos", "d"),
    ("photos/s", "photos_per_second", ".2f"),
    ("CPU s/photo", "cpu_seconds_per_photo", ".3f"),
    ("masks/photo", "masks", ".1f"),
    ("MiB loaded", "loaded_mib", ".0f"),
    ("MiB peak", "peak_mib", ".0f"),
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Prints a table and keeps it as JSON."""
    parser = argparse.ArgumentParser(prog="perception bench mask-speed", description=__doc__)
    parser.add_argument("scene", type=Path, metavar="SCENE")
    parser.add_argument("sources", nargs="*", metavar="SOURCE", help="as of --masks; labels: the scene's own")
    parser.add_argument("-o", "--output", type=Path, default=Path("bench-mask-speed"))
    parser.add_argument("--counts", type=int, nargs="+", default=[50, 200], help="numbers of photos (default: 50 200)")
    parser.add_argument("--points", type=int, default=32, help="points a side of a SAM's prompt grid (default: 32)")
    parser.add_argument("--child", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    if min(options.counts) < 1:
        raise InputError(f"--counts {min(options.counts)}: expected at least one photo")
    if options.child:
        print(json.dumps(measure(options.scene, options.sources[0], options.counts[0], options.points)))
        return 0
    if not (options.scene / "transforms.json").is_file():
        raise InputError(f"{options.scene}: no transforms.json there; expected the folder of a scene with truth")
    sources = options.sources or ["labels", "builtin:photos", "builtin"]
    rows = [_in_a_process(options, source, count) for source in sources for count in sorted(options.counts)]
    finish("mask-speed", options, {"rows": rows}, table(rows, COLUMNS, ("source",)))
    return 0


def measure(scene: Path, spec: str, count: int, points: int = 32) -> dict[str, Any]:
    """One source over `count` photos in this very process: seconds, CPU seconds and MiB, masks a photo."""
    from perception.pipeline.record import PeakMemory, peak_memory_mib

    with tempfile.TemporaryDirectory() as aside:
        work = Path(aside)
        views = repeated_views(scene, count, work)
        source = _source(f"labels:{work / 'labels'}" if spec == "labels" else spec, points)
        depth = (lambda view: _depth(scene, view)) if spec == "builtin" else None
        peak, loaded = PeakMemory(), peak_memory_mib()
        wall, cpu = time.perf_counter(), time.process_time()
        report = compute_masks(views, source, lambda view: read_image(view.photo), work / "masks", load_depth=depth)
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    return {
        "source": spec,
        "identity": source.identity,
        "photos": count,
        "pixels": [views[0].width, views[0].height],
        "photos_per_second": count / wall,
        "cpu_seconds_per_photo": cpu / count,
        "masks": report["masks"],
        "loaded_mib": loaded,
        "peak_mib": peak.mib(),
    }


def repeated_views(scene: Path, count: int, work: Path) -> list[View]:
    """`count` views of the scene, taken in turns, under names of their own; `work` gets links to photos and labels."""
    posed = [posed for _, posed in sorted(posed_views(scene).items())]
    for kind in ("photos", "labels"):
        (work / kind).mkdir()
    views = []
    for n in range(count):
        view = posed[n % len(posed)]
        photo = work / "photos" / f"{n:05d}{view.photo.suffix}"
        photo.symlink_to(view.photo.resolve())
        label = scene / "labels" / f"{view.photo.stem}.png"
        (work / "labels" / f"{n:05d}.png").symlink_to(label.resolve())
        views.append(replace(view, name=photo.name, photo=photo))
    return views


def _source(spec: str, points: int) -> MaskSource:
    if spec.startswith("sam:"):
        from perception.masks.sam import SamSettings, SamSource

        return SamSource(spec.removeprefix("sam:"), SamSettings(points_per_side=points))
    return make_source(spec)


def _depth(scene: Path, view: View) -> np.ndarray:
    return spoilt_depth(scene, view.photo.resolve().stem, int(Path(view.name).stem))


def _in_a_process(options: argparse.Namespace, source: str, count: int) -> dict[str, Any]:
    kind, _, path = source.partition(":")
    if kind in ("sam", "labels") and path:  # the process starts elsewhere
        source = f"{kind}:" + ",".join(str(Path(part).resolve()) for part in path.split(","))
    command = [sys.executable, "-m", "perception.bench.mask_speed", str(options.scene.resolve()), source, "--child"]
    command += ["--counts", str(count), "--points", str(options.points)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, **child_options())
    if done.returncode:
        why = done.stderr.strip().splitlines()[-1:] or [f"exit status {done.returncode}"]
        raise InputError(f"--masks {source}, {count} photos: {why[0].removeprefix('perception.errors.InputError: ')}")
    print(f"{source}: {count} photos measured", file=sys.stderr, flush=True)
    return dict(json.loads(done.stdout.splitlines()[-1]))


if __name__ == "__main__":
    raise SystemExit(main())
