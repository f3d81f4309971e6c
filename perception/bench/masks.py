"""Class-agnostic quality of masks on scenes with truth: `python -m perception.bench.masks SCENE…`.

A scene is a folder with `images/` and `masks_gt/` of equal stems. For every truth instance in every photo the
best IoU over the photo's masks is taken; all (photo, instance) pairs weigh the same. Instances under 100 px
are left out.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from perception.errors import InputError
from perception.masks import make_source
from perception.types import View

SMALLEST = 100  # pixels


@dataclass(frozen=True)
class PhotoScore:
    """best_iou: [G] per truth instance; fragments: [G] masks lying mostly on it; masks: how many in all."""

    best_iou: np.ndarray
    fragments: np.ndarray
    masks: int


def score_photo(labels: np.ndarray, truth: np.ndarray, smallest: int = SMALLEST) -> PhotoScore:
    """labels, truth: [h, w] integers ≥ 0, 0 = nothing (never matched)."""
    ids, truth_index = np.unique(truth, return_inverse=True)
    masks, mask_index = np.unique(labels, return_inverse=True)
    shared = np.zeros((len(ids), len(masks)))
    np.add.at(shared, (truth_index.ravel(), mask_index.ravel()), 1.0)
    truth_area, mask_area = shared.sum(1, keepdims=True), shared.sum(0, keepdims=True)
    iou = shared / (truth_area + mask_area - shared)
    rows = (ids != 0) & (truth_area[:, 0] >= smallest)
    columns = masks != 0
    inside = shared / mask_area > 0.5
    best = iou[rows][:, columns].max(axis=1, initial=0.0)
    return PhotoScore(best, inside[rows][:, columns].sum(axis=1), int(columns.sum()))


def score_scene(scene: Path, spec: str, every: int = 1) -> dict[str, Any]:
    """Runs the source `spec` over every `every`-th photo of a truth scene and sums up."""
    source = make_source(spec)
    views = list(views_with_truth(scene))[::every]
    if not views:
        raise InputError(f"{scene}: expected images/ and masks_gt/ with equal stems, found none")
    warnings = source.check([view for view, _ in views])
    scores, seconds = [], 0.0
    for view, truth in views:
        photo = read_image(view.photo)
        start = perf_counter()
        labels = source.label_image(view, photo)
        seconds += perf_counter() - start
        scores.append(score_photo(labels, truth))
    best = np.concatenate([score.best_iou for score in scores])
    fragments = np.concatenate([score.fragments for score in scores])
    return {
        "scene": scene.name,
        "source": source.identity,
        "photos": len(views),
        "pairs": len(best),
        "mean_best_iou": float(best.mean()),
        "recall_50": float((best > 0.5).mean()),
        "fragments_per_instance": float(fragments.mean()),
        "masks_per_photo": float(np.mean([score.masks for score in scores])),
        "seconds_per_photo": seconds / len(views),
        "warnings": warnings,
    }


def views_with_truth(scene: Path) -> Iterator[tuple[View, np.ndarray]]:
    """Every photo with its truth [h, w]; the camera is left out, since masks of one photo need none."""
    for photo in sorted((scene / "images").glob("*")):
        truth = scene / "masks_gt" / f"{photo.stem}.png"
        if truth.is_file():
            ids = read_image(truth)
            yield View(photo.name, photo, np.eye(3), ids.shape[1], ids.shape[0], np.eye(4)), ids


def read_image(file: Path) -> np.ndarray:
    """The pixels as stored."""
    from PIL import Image

    with Image.open(file) as image:
        return np.asarray(image)


def main(arguments: list[str] | None = None) -> int:
    """Prints one JSON object per scene."""
    parser = argparse.ArgumentParser(
        prog="python -m perception.bench.masks", description=(__doc__ or "").split("\n")[0]
    )
    parser.add_argument("scenes", nargs="+", type=Path, metavar="SCENE")
    parser.add_argument("--masks", default="builtin", help="a mask source as of `perception map` (default: builtin)")
    parser.add_argument("--every", type=int, default=1, help="take every n-th photo")
    options = parser.parse_args(arguments)
    try:
        for scene in options.scenes:
            print(json.dumps(score_scene(scene, options.masks, options.every)), flush=True)
    except InputError as error:
        print(error, file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
