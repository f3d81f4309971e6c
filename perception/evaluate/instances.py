"""`perception eval instances`: AP of point labels by ScanNet's rules and common variants, pooled over scenes.

Rules (ScanNet benchmark, 3D semantic instance evaluation): IoU must be strictly above the threshold. True instances are
visited in order, predictions in input order. The first match uses the prediction. Each further match is a false
positive at the lower of the two scores. An unmatched prediction is a false positive unless its share of void and of too
small true instances exceeds the threshold.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from perception.errors import InputError
from perception.geometry import align_similarity
from perception.io.cloud import read_cloud, to_int32
from perception.io.documents import refusing
from perception.types import PointCloud

SAME_POINTS = 0.02  # median distance of points, as a share of the cloud's diagonal, up to which clouds are the same
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


@dataclass
class Matches:
    """Result for one class at one threshold: scores of true and false positives, number of misses."""

    scores: list[float] = field(default_factory=list)
    positive: list[bool] = field(default_factory=list)
    misses: int = 0

    def add(self, score: float, positive: bool) -> None:
        self.scores.append(score)
        self.positive.append(positive)


def match(scenes: Sequence[Overlap], label: int, threshold: float, min_region: int) -> Matches:
    """Greedy matching of predictions and true instances of one class at one IoU threshold, over all scenes."""
    result = Matches()
    for scene in scenes:
        preds = np.flatnonzero((scene.pred_classes == label) & (scene.pred_sizes >= max(min_region, 1)))
        truths = np.flatnonzero(scene.gt_classes == label)
        big = truths[scene.gt_sizes[truths] >= min_region]
        hit = scene.iou > threshold
        _match_truth(scene, preds, big, hit, result)
        small = truths[scene.gt_sizes[truths] < min_region]
        for p in preds[~hit[np.ix_(preds, truths)].any(axis=1)].tolist():
            ignored = scene.pred_void[p] + scene.intersections[p, small].sum()
            if ignored / scene.pred_sizes[p] <= threshold:
                result.add(float(scene.pred_scores[p]), positive=False)
    return result


def _match_truth(scene: Overlap, preds: np.ndarray, truths: np.ndarray, hit: np.ndarray, result: Matches) -> None:
    used: set[int] = set()
    for g in truths.tolist():
        candidates = [p for p in preds[hit[preds, g]].tolist() if p not in used]
        if not candidates:
            result.misses += 1
            continue
        used.add(candidates[0])  # only the first is used: a duplicate may still match another true instance
        best, *others = scene.pred_scores[candidates].tolist()
        for score in others:
            result.add(min(best, score), positive=False)
            best = max(best, score)
        result.add(best, positive=True)


def average_precision(matches: Matches) -> float:
    """Area under the precision-recall curve: one point per distinct score, plus the point (recall 0, precision 1).

    NaN without true instances, each of which is matched or missed; 0 without predictions that count.
    """
    if not any(matches.positive) and not matches.misses:
        return float("nan")
    if not matches.scores:
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


@dataclass(frozen=True)
class Protocol:
    """All options that change a result, with which they are printed.

    thresholds: IoU thresholds averaged into AP; extra_thresholds are reported apart (AP25).
    constant_score: all confidences are 1.0 (Segment3D). remove_ignored: ignored points (truth ids below −1, or a mask)
    are removed from truth and prediction before counting (ScanNet++); without it they are void. by_class,
    valid_classes: for callers that set the classes of an `Overlap`.
    """

    name: str
    thresholds: tuple[float, ...] = tuple(np.arange(0.5, 0.95, 0.05).tolist())
    extra_thresholds: tuple[float, ...] = (0.25,)
    min_region: int = 100
    void_ids: tuple[int, ...] = (0,)
    constant_score: bool = False
    remove_ignored: bool = False
    by_class: bool = False
    valid_classes: tuple[int, ...] | None = None

    def describe(self) -> dict[str, Any]:
        """JSON-serialisable; includes the fixed rules that have no option."""
        rules = {
            "matching": "greedy in truth order, strict IoU > threshold, duplicates are false positives",
            "unmatched": "false positive unless the share of void and too-small truth exceeds the threshold",
            "void": "truth ids < 0, void_ids, classes outside valid_classes",
            "all_predictions_ignored": "AP 0 (ScanNet's original script stops with an error)",
            "classes_without_truth": "left out of the mean",
        }
        return asdict(self) | {"rules": rules}


PROTOCOLS = {
    "scannet": Protocol("scannet"),
    "mask3d": Protocol("mask3d"),
    "segment3d": Protocol("segment3d", constant_score=True),
    "scannetpp": Protocol("scannetpp", remove_ignored=True),
}


def get_protocol(protocol: str | Protocol, **changes: Any) -> Protocol:
    """A protocol by name ("scannet", "mask3d", "segment3d", "scannetpp"), with the given fields changed."""
    if isinstance(protocol, str):
        if protocol not in PROTOCOLS:
            raise InputError(f"protocol '{protocol}' is unknown; expected one of {', '.join(PROTOCOLS)}")
        protocol = PROTOCOLS[protocol]
    return replace(protocol, **changes)


def evaluate(
    pred_ids: np.ndarray,
    pred_scores: Mapping[int, float] | None,
    gt_ids: np.ndarray,
    protocol: str | Protocol = "scannet",
    ignore: np.ndarray | None = None,
) -> dict[str, Any]:
    """AP of predicted labels against true labels, both [N] int over the same points; negative prediction = none.

    pred_scores: confidence by id (None: all 1). ignore: [N] bool.
    """
    rules = get_protocol(protocol)
    pred_ids, gt_ids = np.asarray(pred_ids), np.asarray(gt_ids)
    if len(pred_ids) != len(gt_ids):
        found = f"prediction has {len(pred_ids)} points, truth has {len(gt_ids)}"
        raise InputError(f"{found}; they must be the same points")
    keep, truth = evaluated_truth(rules, gt_ids, ignore)
    scores = None if rules.constant_score or pred_scores is None else {int(k): v for k, v in pred_scores.items()}
    return evaluate_overlaps([overlap_of_ids(pred_ids[keep], scores, truth)], rules)


def evaluated_truth(
    rules: Protocol, gt_ids: np.ndarray, ignore: np.ndarray | None = None
) -> tuple[np.ndarray | slice, Truth]:
    """Selection of the evaluated points, and the ground truth of these points."""
    gt_ids = gt_ids.astype(np.int64) if gt_ids.dtype.kind == "u" else gt_ids  # −1 is given to what is ignored
    ignored = np.zeros(len(gt_ids), bool) if ignore is None else np.asarray(ignore, bool)
    if rules.remove_ignored:
        keep = (gt_ids >= -1) & ~ignored
        return keep, read_truth(gt_ids[keep], rules.void_ids)
    return slice(None), read_truth(np.where(ignored, -1, gt_ids), rules.void_ids)


def evaluate_overlaps(scenes: Sequence[Overlap], rules: Protocol) -> dict[str, Any]:
    """AP over scenes, pooled as in the benchmarks. NaN (class without true instances) becomes null in the result."""
    thresholds = [*rules.thresholds, *rules.extra_thresholds]
    labels = sorted({int(c) for scene in scenes for c in scene.gt_classes})
    table = np.full((len(labels), len(thresholds)), np.nan)
    for i, label in enumerate(labels):
        for j, threshold in enumerate(thresholds):
            table[i, j] = average_precision(match(scenes, label, threshold, rules.min_region))
    mean = _known_mean(table)
    result: dict[str, Any] = dict(_summary(mean, thresholds, len(rules.thresholds)))
    result["per_threshold"] = [{"iou": round(t, 10), "ap": _number(a)} for t, a in zip(thresholds, mean, strict=True)]
    if rules.by_class:
        rows = {str(c): _summary(row, thresholds, len(rules.thresholds)) for c, row in zip(labels, table, strict=True)}
        result["classes"] = rows
    result["num_truth"] = sum(int((s.gt_sizes >= rules.min_region).sum()) for s in scenes)
    result["num_predictions"] = sum(int((s.pred_sizes >= max(rules.min_region, 1)).sum()) for s in scenes)
    result["protocol"] = rules.describe()
    return result


def _summary(ap: np.ndarray, thresholds: Sequence[float], averaged: int) -> dict[str, float | None]:
    """AP over the first `averaged` thresholds, and at IoU 0.5 and 0.25; None where that is not computed."""
    summary = {"ap": _number(_known_mean(ap[:averaged, None])[0])}
    for name, iou in (("ap50", 0.5), ("ap25", 0.25)):
        summary[name] = next((_number(a) for a, t in zip(ap, thresholds, strict=True) if np.isclose(t, iou)), None)
    return summary


def _known_mean(table: np.ndarray) -> np.ndarray:
    """Means [T] of the columns of a table [C, T] over the entries that are not NaN; NaN where there are none."""
    return np.asarray(np.ma.masked_invalid(table).mean(axis=0).filled(np.nan))


def _number(value: Any) -> float | None:
    return None if np.isnan(value) else float(value)


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
    confidence = np.array([1.0 if pred_scores is None else pred_scores[i] for i in ids.tolist()], np.float64)
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


_ID_NAMES = ("instance_id", "instance", "inst_id", "label")


def run_instances(prediction: str | Path, truth: str | Path, protocol: str = "scannet") -> tuple[dict[str, Any], str]:
    """Instance AP of a labelled cloud against ground truth: (result, table).

    Confidences come from the sidecar JSON next to the prediction. Without it they are all 1, and the result says so.
    Points with a non-zero property `ignore` in the ground truth are ignored.
    """
    pred, gt = read_cloud(prediction), read_cloud(truth)
    pred_ids, gt_ids = _ids(pred, prediction), _ids(gt, truth)
    if len(pred_ids) != len(gt_ids):
        counts = f"{prediction}: has {len(pred_ids)} points, the truth {truth} has {len(gt_ids)}"
        raise InputError(f"{counts}; both must be the same points in the same order")
    if (off := _apart(pred.points, gt.points)) > SAME_POINTS:
        found = f"half of its points lie over {off:.0%} of the cloud's size from those of the truth {truth}"
        raise InputError(f"{prediction}: {found}; label the truth's own points, in their order")
    rules, source = get_protocol(protocol), Path(prediction).with_suffix(".json")
    confidence = read_scores(source) if source.is_file() else None
    if confidence is not None and (lacking := set(pred_ids[pred_ids >= 0].tolist()) - confidence.keys()):
        found = f"has no score for instance {min(lacking)} ({len(lacking)} such)"
        raise InputError(f"{source}: {found}; give the one that was written with {prediction}")
    ignore = gt.labels.get("ignore")
    result = evaluate(pred_ids, confidence, gt_ids, rules, None if ignore is None else ignore != 0)
    result["void_points"] = {"negative": int((gt_ids < 0).sum())}
    result["void_points"] |= {str(i): n for i in rules.void_ids if (n := int((gt_ids == i).sum()))}
    constant = rules.constant_score or confidence is None
    result["protocol"]["confidence"] = "constant 1.0" if constant else str(source)
    return result, instances_table(result)


def _apart(a: np.ndarray, b: np.ndarray) -> float:
    """Median distance of the points [N, 3] of two clouds by their order, as a share of the cloud's diagonal, in the
    best common frame, as one may have been moved; 0 for clouds that have none."""
    known = np.isfinite(a).all(axis=1) & np.isfinite(b).all(axis=1)
    a, b = a[known].astype(np.float64), b[known].astype(np.float64)
    if len(a) < 4 or not (np.ptp(a, axis=0).any() and np.ptp(b, axis=0).any()):
        return 0.0
    scale, rotation, shift = align_similarity(a, b)
    off = np.linalg.norm(a - scale * b @ rotation.T - shift, axis=1)
    return float(np.median(off) / np.linalg.norm(np.ptp(a, axis=0)))


def read_scores(path: str | Path) -> dict[int, float]:
    """Confidence by instance id from an export's sidecar, {"instances": {"<id>": {"score": s}}}."""
    path = Path(path)
    with refusing(f'{path}: expected {{"instances": {{"<id>": {{"score": number}}}}}} ({{why}})'):
        rows = json.loads(path.read_text(encoding="utf-8"))["instances"]
        return {int(key): float(row["score"]) for key, row in rows.items()}


def _ids(cloud: PointCloud, path: str | Path) -> Any:
    for name in _ID_NAMES:
        if name in cloud.labels:
            return to_int32(cloud.labels[name], f"{path}: property '{name}'")
    found = ", ".join(cloud.labels) or "none"
    raise InputError(f"{path}: has no whole-number property 'instance_id' (found: {found})")


def instances_table(result: dict[str, Any]) -> str:
    """Table with AP, AP50, AP25, per-class rows if computed, and the protocol's options."""
    rules = result["protocol"]
    lines = [f"{'':<12}{'AP':>8}{'AP50':>8}{'AP25':>8}"]
    lines += [_row(f"class {name}", row) for name, row in result.get("classes", {}).items()]
    lines.append(_row("all", result))
    lines.append(f"{result['num_predictions']} predictions, {result['num_truth']} true instances")
    lines.append(
        f"protocol {rules['name']}: IoU {rules['thresholds'][0]:.2f}-{rules['thresholds'][-1]:.2f} "
        f"({len(rules['thresholds'])} thresholds), at least {rules['min_region']} points, "
        f"{'by class' if rules['by_class'] else 'class-agnostic'}, "
        f"confidence {rules.get('confidence', 'given')}, "
        f"ignored points {'removed' if rules['remove_ignored'] else 'void'}, "
        f"void ids < 0 and {list(rules['void_ids'])}"
    )
    void = {name: n for name, n in result.get("void_points", {}).items() if n}
    if void:
        lines.append("void truth points: " + ", ".join(f"{n} of id {name}" for name, n in void.items()))
    return "\n".join(lines)


def _row(name: str, row: dict[str, Any]) -> str:
    cells = ["-" if row[key] is None else f"{row[key]:.4f}" for key in ("ap", "ap50", "ap25")]
    return f"{name:<12}" + "".join(f"{cell:>8}" for cell in cells)
