"""Average precision of masks, for tests."""

from __future__ import annotations

from typing import Any

from bench.scannet import mask_overlap
from perception.evaluate.instances import evaluate_overlaps, get_protocol


def evaluate_masks(
    masks: Any, scores: Any, gt_ids: Any, classes: Any = None, gt_semantics: Any = None, **changes: Any
) -> dict[str, Any]:
    """AP of masks (each bool [N]) of one scene against the truth ids [N]; changes: switches of Protocol."""
    rules = get_protocol("scannet", **changes)
    return evaluate_overlaps([mask_overlap(rules, masks, scores, gt_ids, classes, gt_semantics)], rules)
