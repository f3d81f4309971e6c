"""Instance average precision as ScanNet defines it, on contingency tables pooled over scenes.

Rules (ScanNet benchmark, 3D semantic instance evaluation): IoU must be strictly above the threshold. True instances are
visited in order, predictions in input order. The first match uses the prediction. Each further match is a false
positive at the lower of the two scores. An unmatched prediction is a false positive unless its share of void and of too
small true instances exceeds the threshold.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from perception.evaluate.overlap import Overlap


@dataclass
class Matches:
    """Result for one class at one threshold: scores of true and false positives, number of misses."""

    scores: list[float] = field(default_factory=list)
    positive: list[bool] = field(default_factory=list)
    misses: int = 0
    has_truth: bool = False
    has_prediction: bool = False


def match(scenes: Sequence[Overlap], label: int, threshold: float, min_region: int) -> Matches:
    """Greedy matching of predictions and true instances of one class at one IoU threshold, over all scenes."""
    result = Matches()
    for scene in scenes:
        preds = np.flatnonzero((scene.pred_classes == label) & (scene.pred_sizes >= max(min_region, 1)))
        truths = np.flatnonzero(scene.gt_classes == label)
        big = truths[scene.gt_sizes[truths] >= min_region]
        result.has_truth |= len(big) > 0
        result.has_prediction |= len(preds) > 0
        hit = scene.iou > threshold
        _match_truth(scene, preds, big, hit, result)
        _unmatched(scene, preds, truths, hit, threshold, min_region, result)
    return result


def _match_truth(scene: Overlap, preds: np.ndarray, truths: np.ndarray, hit: np.ndarray, result: Matches) -> None:
    used: set[int] = set()
    for g in truths.tolist():
        candidates = [p for p in preds[hit[preds, g]].tolist() if p not in used]
        if not candidates:
            result.misses += 1
            continue
        used.add(candidates[0])  # only the first is used: a duplicate may still match another true instance
        best = float(scene.pred_scores[candidates[0]])
        for p in candidates[1:]:
            score = float(scene.pred_scores[p])
            result.scores.append(min(best, score))
            result.positive.append(False)
            best = max(best, score)
        result.scores.append(best)
        result.positive.append(True)


def _unmatched(
    scene: Overlap,
    preds: np.ndarray,
    truths: np.ndarray,
    hit: np.ndarray,
    threshold: float,
    min_region: int,
    result: Matches,
) -> None:
    """Adds a false positive for each prediction that matches no true instance of its class, unless it is ignored."""
    small = truths[scene.gt_sizes[truths] < min_region]
    for p in preds[~hit[np.ix_(preds, truths)].any(axis=1)].tolist():
        ignored = scene.pred_void[p] + scene.intersections[p, small].sum()
        if ignored / scene.pred_sizes[p] <= threshold:
            result.scores.append(float(scene.pred_scores[p]))
            result.positive.append(False)


def average_precision(matches: Matches) -> float:
    """Area under the precision-recall curve: one point per distinct score, plus the point (recall 0, precision 1).

    NaN without true instances; 0 without predictions or when all predictions are ignored.
    """
    if not matches.has_truth:
        return float("nan")
    if not matches.has_prediction or not matches.scores:
        return 0.0
    scores = np.array(matches.scores)
    order = np.argsort(scores, kind="stable")
    positive = np.array(matches.positive, float)[order]
    first = np.unique(scores[order], return_index=True)[1]  # first index of each distinct score, ascending
    true_above = positive.sum() - np.concatenate(([0.0], np.cumsum(positive)))[first]
    precision = np.append(true_above / (len(scores) - first), 1.0)
    recall = np.append(true_above / (positive.sum() + matches.misses), 0.0)
    padded = np.concatenate((recall[:1], recall, [0.0]))
    widths = np.convolve(padded, [-0.5, 0.0, 0.5], "valid")
    return float(precision @ widths)
