"""mIoU of a map's rendered instance masks against true masks, in views that may be held out from training.

The map's ids and the true ids are matched once per scene, one to one (Hungarian method on the IoU of pixels pooled over
all views). An instance whose id changes between views is therefore penalised. The score of an instance is its mean IoU
over the views that show it. A true instance without a match scores 0.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from perception.errors import InputError
from perception.gaussians.model import Gaussians
from perception.instances.silhouettes import render_silhouettes
from perception.masks.label_folder import LabelFolder
from perception.types import View

SMALLEST = 50  # pixels of a true instance in a view; with fewer, the view is not counted for it


def evaluate_rendered(
    gaussians: Gaussians, ids: np.ndarray, views: Sequence[View], truth_dir: str | Path
) -> dict[str, Any]:
    """Renders the instances in each view and scores them against `truth_dir`/STEM.png (see `mask_miou`).

    ids [N] int32, −1 = none. Truth: label images (see `LabelFolder`), ids alike in all views, 0 = void.
    """
    import torch

    def pairs() -> Iterable[tuple[np.ndarray, np.ndarray]]:
        for view in views:
            pose = torch.from_numpy(view.camera_from_world.astype(np.float32))
            K = torch.from_numpy(view.K.astype(np.float32))
            found = render_silhouettes(gaussians, [ids], pose, K, view.width, view.height)[0]
            yield found.ids, truths.label_image(view, found.ids)

    if not views:
        raise InputError("rendered masks: there are no views to score")
    truths = LabelFolder(Path(truth_dir))
    return mask_miou(pairs())


def mask_miou(pairs: Iterable[tuple[np.ndarray, np.ndarray]], smallest: int = SMALLEST) -> dict[str, Any]:
    """mIoU of predicted against true id images, each pair [H, W] int: prediction −1 = none, truth 0 = void.

    Void pixels are ignored. Returns miou (mean over true instances of the mean over the views with at least `smallest`
    of its pixels), pooled_miou (IoU of the pixels of all views together), and both per instance with its match.
    """
    from scipy.optimize import linear_sum_assignment

    tables = [_contingency(pred, truth) for pred, truth in pairs]
    true_ids = sorted({int(i) for _, t, _ in tables for i in t if i > 0})
    pred_ids = sorted({int(i) for p, _, _ in tables for i in p if i >= 0})
    where = {i: n for n, i in enumerate(true_ids)}
    column = {i: n for n, i in enumerate(pred_ids)} | {-1: len(pred_ids)}
    views = np.zeros((len(tables), len(true_ids), len(pred_ids) + 1))
    for table, (preds, truths, counts) in zip(views, tables, strict=True):
        np.add.at(table, ([where[int(i)] for i in truths], [column[int(i)] for i in preds]), counts)
    if not true_ids:
        raise InputError("rendered masks: the truth is void in every view")
    pooled = _iou(views.sum(axis=0))
    rows, columns = linear_sum_assignment(-pooled)
    partner = np.full(len(true_ids), -1)
    partner[rows] = np.where(pooled[rows, columns] > 0, columns, -1)
    instances = []
    each = np.stack([_iou(table) for table in views])
    for row, name in enumerate(true_ids):
        shown = views[:, row].sum(axis=1) >= smallest
        if not shown.any():
            continue
        matched = partner[row] >= 0
        instances.append(
            {
                "gt": name,
                "pred": pred_ids[partner[row]] if matched else None,
                "views": int(shown.sum()),
                "miou": float(each[shown, row, partner[row]].mean()) if matched else 0.0,
                "pooled_iou": float(pooled[row, partner[row]]) if matched else 0.0,
            }
        )
    if not instances:
        raise InputError(f"rendered masks: no true instance covers {smallest} pixels of a view")
    return {
        "miou": float(np.mean([row["miou"] for row in instances])),
        "pooled_miou": float(np.mean([row["pooled_iou"] for row in instances])),
        "instances": instances,
        "views": len(tables),
        "protocol": {
            "matching": "one to one for all views together, Hungarian on pooled IoU",
            "mean": f"over views with at least {smallest} true pixels, then over true instances",
            "missing_prediction": "scores 0",
            "void": "truth id 0, left out",
        },
    }


def _contingency(pred: np.ndarray, truth: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(predicted id, true id, number of pixels) of every pair that occurs outside void."""
    if pred.shape != truth.shape:
        raise InputError(f"rendered masks: prediction is {pred.shape}, truth {truth.shape}; expected one size")
    judged = truth > 0
    pairs, counts = np.unique(np.stack([pred[judged], truth[judged]]), axis=1, return_counts=True)
    return np.maximum(pairs[0], -1), pairs[1], counts


def _iou(table: np.ndarray) -> np.ndarray:
    """[T, P] IoU from counts [T, P + 1]; the last column counts pixels without a prediction."""
    inside = table[:, :-1]
    union = table.sum(axis=1, keepdims=True) + inside.sum(axis=0) - inside
    return inside / np.maximum(union, 1)
