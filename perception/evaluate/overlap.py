"""The contingency table between predicted and true instances, from which all overlap metrics are computed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from perception.errors import InputError

OBJECT = 1  # the only class in class-agnostic evaluation


@dataclass(frozen=True)
class Overlap:
    """Sizes and intersections in points, for P predictions in input order and G true instances by ascending id.

    pred_classes, pred_sizes, pred_void [P] int64; pred_scores [P] float64; gt_classes, gt_sizes [G] int64;
    intersections [P, G] int64. pred_void: number of points of a prediction that are void in the ground truth.
    """

    pred_scores: np.ndarray
    pred_classes: np.ndarray
    pred_sizes: np.ndarray
    pred_void: np.ndarray
    gt_classes: np.ndarray
    gt_sizes: np.ndarray
    intersections: np.ndarray

    @property
    def iou(self) -> np.ndarray:
        """[P, G] float64: |intersection| / |union|."""
        union = self.pred_sizes[:, None] + self.gt_sizes[None] - self.intersections
        return self.intersections / np.maximum(union, 1)


@dataclass(frozen=True)
class Truth:
    """Ground truth per point in compact form: index [N] into ids (−1 = void); class and size per instance."""

    index: np.ndarray
    ids: np.ndarray
    classes: np.ndarray
    sizes: np.ndarray


def read_truth(gt_ids: np.ndarray, void_ids: Sequence[int] = (0,)) -> Truth:
    """Compacts the true ids [N] int. Void: negative ids and `void_ids`. The class of every instance is OBJECT."""
    index, ids = compact(gt_ids, void_ids)
    sizes = np.bincount(index[index >= 0], minlength=len(ids))
    return Truth(index, ids, np.full(len(ids), OBJECT, np.int64), sizes)


def compact(ids: np.ndarray, void_ids: Sequence[int] = ()) -> tuple[np.ndarray, np.ndarray]:
    """(index [N] int64 into the ascending ids that occur, those ids); −1 where the id is negative or in `void_ids`."""
    ids = np.asarray(ids)
    if ids.ndim != 1 or ids.dtype.kind not in "iu":
        raise InputError(f"instance ids must be whole numbers [N]; found {ids.dtype} {list(ids.shape)}")
    ids = ids.astype(np.int64)
    values, index = np.unique(ids, return_inverse=True)
    valid = (values >= 0) & ~np.isin(values, list(void_ids))
    return np.where(valid, np.cumsum(valid) - 1, -1)[index], values[valid]


def overlap_of_ids(pred_ids: np.ndarray, pred_scores: dict[int, float] | None, truth: Truth) -> Overlap:
    """Overlap of point labels pred_ids [N] int, negative = none. Predictions are ordered by ascending id.

    pred_scores: by id; None: 1 for every prediction.
    """
    index, ids = compact(pred_ids)
    g = len(truth.ids)
    both = np.where(index >= 0, index * (g + 1) + np.where(truth.index >= 0, truth.index, g), -1)
    table = np.bincount(both[both >= 0], minlength=len(ids) * (g + 1)).reshape(len(ids), g + 1)
    missing = [i for i in ids.tolist() if pred_scores is not None and i not in pred_scores]
    if missing:
        raise InputError(f"prediction: no score for instance {missing[0]} ({len(missing)} such); give one for each")
    scores = [1.0 if pred_scores is None else pred_scores[i] for i in ids.tolist()]
    confidence = np.asarray(scores, np.float64)
    if not np.isfinite(confidence).all():
        raise InputError(f"prediction: score of instance {ids[~np.isfinite(confidence)][0]} is not a finite number")
    return Overlap(
        pred_scores=confidence,
        pred_classes=np.full(len(ids), OBJECT, np.int64),
        pred_sizes=table.sum(axis=1),
        pred_void=table[:, -1],
        gt_classes=truth.classes,
        gt_sizes=truth.sizes,
        intersections=table[:, :-1],
    )
