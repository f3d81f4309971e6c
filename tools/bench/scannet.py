"""The layout of ScanNet and ScanNet++ benchmarks: <scene>.txt with true ids (1000 · class + instance, one per vertex);
predictions are submission files <scene>.txt that name mask files.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from perception.errors import InputError
from perception.evaluate.instances import (
    OBJECT,
    Overlap,
    Protocol,
    Truth,
    evaluate_overlaps,
    evaluated_truth,
    get_protocol,
    instances_table,
)
from perception.io.atomic import atomic_file


def write_scannet(
    folder: str | Path,
    scene: str,
    labels: np.ndarray,
    instances: Mapping[int, Mapping[str, Any]],
    classes: Mapping[int, int] | None = None,
) -> Path:
    """ScanNet's 3D instance submission: <scene>.txt with "predicted_masks/<scene>_<nnn>.txt <class> <confidence>" rows.

    Each mask file has one 0 or 1 for each vertex. classes: class by instance id; None writes 1 for all. Best
    score first.
    """
    folder = Path(folder)
    masks = folder / "predicted_masks"
    try:
        masks.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{masks}: cannot be written ({error.strerror}); choose a place you may write to") from error
    ids = np.unique(labels[labels >= 0]).tolist()
    score = {i: float(instances.get(i, {}).get("score", 1.0)) for i in ids}
    rows = []
    for number, i in enumerate(sorted(ids, key=lambda i: (-score[i], i))):
        name = f"{scene}_{number:03d}.txt"
        digits = np.where(labels == i, ord("1"), ord("0")).astype(np.uint8)
        with atomic_file(masks / name) as new, new.open("wb") as file:
            file.write(np.stack([digits, np.full_like(digits, ord("\n"))], axis=1).tobytes())
        rows.append(f"predicted_masks/{name} {1 if classes is None else classes.get(i, 0)} {score[i]:.6f}\n")
    with atomic_file(folder / f"{scene}.txt") as new, new.open("wb") as file:
        file.write("".join(rows).encode())
    return folder / f"{scene}.txt"


def run_scannet(
    prediction: str | Path, truth: str | Path, protocol: str | Protocol = "scannet", **changes: Any
) -> tuple[dict[str, Any], str]:
    """Instance AP over all scenes of a ScanNet or ScanNet++ layout: (result, table).

    truth: <scene>.txt, one id per vertex (1000 · class + instance, 0 = void); prediction: <scene>.txt naming mask
    files. For a scene without prediction all true instances count as missed.
    """
    rules = get_protocol(protocol, **changes)
    files = sorted(Path(truth).glob("*.txt"))
    if not files:
        raise InputError(f"{truth}: holds no truth files <scene>.txt")
    overlaps, missing = [], []
    for path in files:
        ids = _read_ids(path)
        ids = np.where(ids >= 1000, ids, np.minimum(ids, 0))  # class 0 means no class; below -1: ignored
        found = _read_prediction(Path(prediction), path.stem, len(ids))
        if found is None:
            missing.append(path.stem)
            found = ([], [], [])
        masks, classes, scores = found
        overlaps.append(mask_overlap(rules, masks, scores, ids, classes, ids // 1000))
    result = evaluate_overlaps(overlaps, rules)
    result |= {"scenes": [p.stem for p in files], "missing": missing}
    return result, instances_table(result)


def _read_ids(path: Path) -> np.ndarray:
    try:
        values = np.fromstring(path.read_text(encoding="ascii"), dtype=np.float64, sep=" ")
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: expected one whole number a line ({error})") from error
    return values.astype(np.int64)


_Prediction = tuple[list[np.ndarray], list[int], list[float]]


def _read_prediction(folder: Path, scene: str, points: int) -> _Prediction | None:
    text = folder / f"{scene}.txt"
    if not text.is_file():
        return None
    masks, classes, scores = [], [], []
    for number, line in enumerate(text.read_text(encoding="utf-8").splitlines(), 1):
        words = line.split()
        try:
            name, label, score = words
            classes.append(int(label))
            scores.append(float(score))
        except ValueError as error:
            raise InputError(f"{text}: line {number} is '{line}'; expected: mask file, class, confidence") from error
        mask = _read_ids(folder / name)
        if len(mask) != points:
            raise InputError(f"{folder / name}: has {len(mask)} rows, the truth has {points}")
        masks.append(mask != 0)
    return masks, classes, scores


def mode_by_group(group: np.ndarray, values: np.ndarray, count: int) -> np.ndarray:
    """Most frequent value of each group 0..count−1 [count]; ties: the smallest value; group −1 is ignored."""
    inside = group >= 0
    distinct, index = np.unique(values[inside], return_inverse=True)
    if len(distinct) == 0:
        return np.zeros(count, np.int64)
    table = np.zeros((count, len(distinct)), np.int64)
    np.add.at(table, (group[inside], index), 1)
    return distinct[table.argmax(axis=1)].astype(np.int64)


def mask_overlap(
    rules: Protocol,
    masks: Sequence[np.ndarray],
    scores: Sequence[float],
    gt_ids: np.ndarray,
    classes: Sequence[int] | None,
    gt_semantics: np.ndarray | None,
) -> Overlap:
    """Overlap of one scene's masks (each bool [N]; they may overlap) with its true ids [N] under a protocol.

    The order of the masks is the input order of the matching rules.
    """
    gt_ids, kinds = np.asarray(gt_ids), None if gt_semantics is None else np.asarray(gt_semantics)
    if kinds is None and (rules.by_class or rules.valid_classes is not None):
        raise InputError("evaluation by class needs semantic ids in the truth; there are none")
    if kinds is not None and rules.valid_classes is not None:
        gt_ids = np.where(np.isin(kinds, list(rules.valid_classes)), gt_ids, np.minimum(gt_ids, -1))  # void
    keep, truth = evaluated_truth(rules, gt_ids)
    if kinds is not None and rules.by_class:
        truth = replace(truth, classes=mode_by_group(truth.index, kinds[keep], len(truth.ids)))
    kept = [np.asarray(mask, bool)[keep] for mask in masks]
    if rules.by_class and classes is None:
        raise InputError("evaluation by class needs a class for each predicted mask; there are none")
    return overlap_of_masks(
        kept, [1.0] * len(kept) if rules.constant_score else scores, truth, classes if rules.by_class else None
    )


def overlap_of_masks(
    masks: Sequence[np.ndarray], scores: Sequence[float], truth: Truth, classes: Sequence[int] | None = None
) -> Overlap:
    """Overlap of P masks, each bool [N]. Masks may overlap; their order is kept."""
    if len(scores) != len(masks) or (classes is not None and len(classes) != len(masks)):
        raise InputError(
            f"prediction: {len(masks)} masks, {len(scores)} scores; one score (and class) per mask is needed"
        )
    g = len(truth.ids)
    target = np.where(truth.index >= 0, truth.index, g)
    table = np.zeros((len(masks), g + 1), np.int64)
    for row, mask in zip(table, masks, strict=True):
        row += np.bincount(target[mask], minlength=g + 1)
    confidence = np.asarray(scores, np.float64)
    if not np.isfinite(confidence).all():
        raise InputError(
            f"prediction: the score of mask {int(np.isfinite(confidence).argmin())} is not a finite number"
        )
    return Overlap(
        pred_scores=confidence,
        pred_classes=np.asarray([OBJECT] * len(masks) if classes is None else classes, np.int64),
        pred_sizes=table.sum(axis=1),
        pred_void=table[:, -1],
        gt_classes=truth.classes,
        gt_sizes=truth.sizes,
        intersections=table[:, :-1],
    )
