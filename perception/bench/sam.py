"""Speed and memory of a SAM export on photos: `perception bench sam MODEL PHOTOS`.

Label images are made one after another and thrown away; peak memory is read after 1, 10, 50, 100 and 200 photos, which
must not grow. CPU seconds are the steadier figure on a shared machine. Photos are repeated when there are fewer.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from perception.errors import InputError

MARKS = (1, 10, 50, 100, 200)


def main(arguments: Sequence[str] | None = None) -> None:
    """Prints a table, or one JSON object with --json."""
    parser = argparse.ArgumentParser(prog="perception bench sam", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("model", metavar="MODEL", help="as of --masks sam:MODEL")
    parser.add_argument("photos", type=Path, metavar="PHOTOS", help="a folder of photos")
    parser.add_argument("--count", type=int, default=10, help="how many label images are made (default: 10)")
    parser.add_argument("--points", type=int, default=32, help="points a side of the prompt grid (default: 32)")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args(arguments)
    report = measure(options.model, options.photos, options.count, options.points)
    print(json.dumps(report) if options.json else "\n".join(f"{k:>22}: {v}" for k, v in report.items()))


def measure(model: str, photos: Path, count: int, points: int) -> dict[str, Any]:
    """Seconds a photo (wall and CPU), masks a photo, and peak memory in MiB at the marks."""
    from PIL import Image

    from perception.masks.sam import SamSettings, SamSource
    from perception.pipeline.record import peak_memory_mib, versions
    from perception.types import View

    files = sorted(p for p in photos.glob("*") if p.suffix.lower() in (".jpg", ".jpeg", ".png"))
    if not files or count < 1:
        raise InputError(f"{photos}: expected a folder of photos and --count of at least 1, found {len(files)} photos")
    source = SamSource(model, SamSettings(points_per_side=points))
    masks, memory = [], {"loaded": peak_memory_mib()}
    wall, cpu = time.perf_counter(), time.process_time()
    for n in range(count):
        with Image.open(files[n % len(files)]) as image:
            photo = np.asarray(image.convert("RGB"))
        height, width = photo.shape[:2]
        view = View(files[n % len(files)].name, files[n % len(files)], np.eye(3), width, height, np.eye(4))
        masks.append(len(np.unique(source.label_image(view, photo))) - 1)
        if n + 1 in MARKS or n + 1 == count:
            memory[str(n + 1)] = peak_memory_mib()
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    return {
        "model": source.identity,
        "provider": source.model.provider,
        "photos": count,
        "pixels": f"{width} x {height}",
        "seconds_per_photo": round(wall / count, 3),
        "cpu_seconds_per_photo": round(cpu / count, 3),
        "masks_per_photo": round(float(np.mean(masks)), 1),
        "peak_memory_mib": memory,
        "versions": versions(),
    }
