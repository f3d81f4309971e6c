"""`perception eval instances`: AP of a labelled cloud against a cloud with true ids."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from perception.errors import InputError
from perception.evaluate.instances import evaluate, get_protocol
from perception.io.cloud import read_cloud
from perception.types import PointCloud

_ID_NAMES = ("instance_id", "instance", "inst_id", "label")


def run_instances(prediction: str | Path, truth: str | Path, protocol: str = "scannet") -> tuple[dict[str, Any], str]:
    """Instance AP of a labelled cloud against ground truth: (result, table).

    Confidences come from the sidecar JSON next to the prediction. Without it they are all 1, and the result says so.
    Points with a non-zero property `ignore` in the ground truth are ignored.
    """
    pred, gt = read_cloud(prediction), read_cloud(truth)
    pred_ids, gt_ids = _ids(pred, prediction), _ids(gt, truth)
    if len(pred_ids) != len(gt_ids):
        raise InputError(
            f"{prediction}: has {len(pred_ids)} points, the truth {truth} has {len(gt_ids)}; "
            "both must be the same points in the same order"
        )
    rules, source = get_protocol(protocol), Path(prediction).with_suffix(".json")
    confidence = read_scores(source) if source.is_file() else None
    ignore = gt.labels.get("ignore")
    result = evaluate(pred_ids, confidence, gt_ids, rules, None if ignore is None else ignore != 0)
    result["void_points"] = {"negative": int((gt_ids < 0).sum())}
    result["void_points"] |= {str(i): n for i in rules.void_ids if (n := int((gt_ids == i).sum()))}
    constant = rules.constant_score or confidence is None
    result["protocol"]["confidence"] = "constant 1.0" if constant else str(source)
    return result, instances_table(result)


def read_scores(path: str | Path) -> dict[int, float]:
    """Confidence by instance id from an export's sidecar, {"instances": {"<id>": {"score": s}}}."""
    path = Path(path)
    try:
        rows = json.loads(path.read_text(encoding="utf-8"))["instances"]
        return {int(key): float(row["score"]) for key, row in rows.items()}
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f'{path}: expected {{"instances": {{"<id>": {{"score": number}}}}}} ({error!r})') from error


def _ids(cloud: PointCloud, path: str | Path) -> Any:
    for name in _ID_NAMES:
        if name in cloud.labels:
            return cloud.labels[name]
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
