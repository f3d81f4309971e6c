"""2D mask metrics: IoU, boundary IoU, and the results of LERF-mask and LERF-OVS, whose folders are read here.

LERF-mask (Gaussian Grouping): <scene>/test_mask/<view>/<prompt>.png|jpg; predictions alike. LERF-OVS:
label/<scene>/frame_*.json with polygons.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from perception.errors import InputError
from perception.evaluate.images import pictures

Masks = Mapping[tuple[str, str], np.ndarray]  # (view, prompt) -> mask [H, W]


def mask_iou(prediction: np.ndarray, truth: np.ndarray) -> float:
    """|intersection| / |union| of two bool masks [H, W]; 1 when both are empty."""
    union = np.count_nonzero(prediction | truth)
    return np.count_nonzero(prediction & truth) / union if union else 1.0


def mask_boundary(mask: np.ndarray, dilation_ratio: float = 0.02) -> np.ndarray:
    """The mask's pixels within round(ratio · image diagonal) (at least 1) of its border or of the image border.

    Boundary IoU (Cheng et al. 2021): 3x3 erosions with zero padding.
    """
    height, width = mask.shape
    iterations = max(round(dilation_ratio * float(np.hypot(height, width))), 1)
    padded = cv2.copyMakeBorder(mask.astype(np.uint8), 1, 1, 1, 1, cv2.BORDER_CONSTANT, value=0)
    # n erosions by 3x3 equal one erosion by a square of side 2n + 1. The zero padding erodes from the image border too.
    eroded = cv2.erode(padded, np.ones((3, 3), np.uint8), iterations=iterations)
    return mask & ~eroded[1:-1, 1:-1].astype(bool)


def boundary_iou(prediction: np.ndarray, truth: np.ndarray, dilation_ratio: float = 0.02) -> float:
    """IoU of the two masks' boundaries."""
    return mask_iou(mask_boundary(prediction, dilation_ratio), mask_boundary(truth, dilation_ratio))


def evaluate_lerf_mask(predictions: Masks, truths: Masks, **switches: Any) -> dict[str, Any]:
    """LERF-mask (Gaussian Grouping): mIoU and mean boundary IoU; mean per prompt over views, then over prompts.

    truths: {(view, prompt): 8-bit mask, object > 128}. predictions: the same, or bool; resized to the truth by nearest
    neighbour. A missing one scores 0 (the original script leaves it out). switches: how instances are selected and
    rendered; printed with the result.
    """
    scores: dict[str, list[tuple[float, float]]] = {}
    for _, prompt, found, true in _paired("LERF-mask", predictions, truths, 128, 128):
        score = (0.0, 0.0) if found is None else (mask_iou(found, true), boundary_iou(found, true))
        scores.setdefault(prompt, []).append(score)
    prompts = {
        prompt: {"miou": float(np.mean([s[0] for s in rows])), "mbiou": float(np.mean([s[1] for s in rows]))}
        for prompt, rows in scores.items()
    }
    return {
        "miou": float(np.mean([row["miou"] for row in prompts.values()])),
        "mbiou": float(np.mean([row["mbiou"] for row in prompts.values()])),
        "prompts": prompts,
        "missing": [list(key) for key in sorted(truths.keys() - predictions.keys())],
        "protocol": {
            "name": "lerf-mask",
            "truth": "> 128",
            "prediction": "> 128 or bool, resized nearest",
            "boundary": "3x3 erosion, round(.02 diagonal) times, zero padding",
            "mean": "per prompt over views, then over prompts",
            "missing_prediction": "scores 0",
            "empty_union": "scores 1",
            **switches,
        },
    }


def evaluate_lerf_ovs(predictions: Masks, truths: Masks, **switches: Any) -> dict[str, Any]:
    """LERF-OVS in 3D (OpenGaussian), one scene: mean of IoU over all (view, object), and mAcc@.25 (strict).

    truths: {(view, prompt): 8-bit mask, object > 10}. predictions: silhouettes in [0, 1] of the selected Gaussians
    (object > .7), or bool. A missing prediction scores 0. switches: selection rule, occlusion, held-out views; printed
    with the result.
    """
    rows = []
    for view, prompt, found, true in _paired("LERF-OVS", predictions, truths, 10, 0.7):
        iou = 0.0 if found is None else mask_iou(found, true)
        rows.append({"view": view, "prompt": prompt, "iou": iou, "missing": found is None})
    ious = np.array([row["iou"] for row in rows])
    return {
        "miou": float(ious.mean()),
        "macc25": float((ious > 0.25).mean()),
        "objects": rows,
        "protocol": {
            "name": "lerf-ovs-3d",
            "truth": "> 10",
            "prediction": "silhouette > .7 or bool",
            "mean": "flat over (view, object)",
            "accuracy": "IoU > .25, strict",
            "missing_prediction": "scores 0",
            **switches,
        },
    }


def _paired(
    name: str, predictions: Masks, truths: Masks, truth_above: float, predicted_above: float
) -> Iterator[tuple[str, str, np.ndarray | None, np.ndarray]]:
    """(view, prompt, predicted mask, true mask) by view and prompt, both bool [H, W] of the truth's size (nearest
    neighbour); masks that are not bool are cut above the thresholds; None for a missing prediction."""
    if not truths:
        raise InputError(f"{name}: there are no truth masks")
    for (view, prompt), truth in sorted(truths.items()):
        true = truth if truth.dtype == bool else truth > truth_above
        found = predictions.get((view, prompt))
        if found is not None and found.dtype != bool:
            found = found > predicted_above
        if found is not None and found.shape != true.shape:
            size = (true.shape[1], true.shape[0])
            found = cv2.resize(found.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST).astype(bool)
        yield view, prompt, found, true


def read_mask_folder(folder: str | Path) -> dict[tuple[str, str], np.ndarray]:
    """{(view, prompt): grey mask [H, W] uint8} of <folder>/<view>/<prompt>.png|jpg."""
    masks = {}
    for stem, path in pictures(folder).items():
        view, _, prompt = stem.rpartition("/")
        image = cv2.imdecode(np.frombuffer(path.read_bytes() or b"\0", np.uint8), cv2.IMREAD_GRAYSCALE)
        if image is None:
            raise InputError(f"{path}: is not a readable picture")
        masks[view, prompt.replace("_", " ")] = image
    return masks


def read_lerf_polygons(folder: str | Path) -> dict[tuple[str, str], np.ndarray]:
    """{(view, category): mask [H, W] bool} of LERF-OVS label files frame_*.json. Polygons are united."""
    masks: dict[tuple[str, str], np.ndarray] = {}
    files = sorted(Path(folder).glob("*.json"))
    if not files:
        raise InputError(f"{folder}: holds no label files frame_*.json")
    for path in files:
        try:
            data = json.loads(path.read_text(encoding="utf-8"))
            size = (int(data["info"]["height"]), int(data["info"]["width"]))
            for thing in data["objects"]:
                mask = masks.setdefault((path.stem, thing["category"]), np.zeros(size, bool))
                polygon = np.asarray(thing["segmentation"], np.float64).reshape(-1, 2).round().astype(np.int32)
                mask |= cv2.fillPoly(np.zeros(size, np.uint8), [polygon], (1,)).astype(bool)
        except (ValueError, KeyError, TypeError) as error:
            raise InputError(f"{path}: is no LERF-OVS label file ({error!r})") from error
    return masks


def scenes_result(scenes: dict[str, dict[str, Any]], keys: Sequence[str]) -> tuple[dict[str, Any], str]:
    """(result, table) of the results of a LERF evaluation by scene: the figures `keys` by scene, and their means."""
    mean = {key: float(np.mean([scene[key] for scene in scenes.values()])) for key in sorted(keys)}
    width = max(len(name) for name in [*scenes, "mean"]) + 2
    lines = [" " * width + "".join(f"{key:>10}" for key in keys)]
    lines += [f"{name:<{width}}" + "".join(f"{s[key]:>10.4f}" for key in keys) for name, s in scenes.items()]
    lines.append(f"{'mean':<{width}}" + "".join(f"{mean[key]:>10.4f}" for key in keys))
    protocol = next(iter(scenes.values()))["protocol"]
    lines.append("protocol " + "; ".join(f"{key}: {value}" for key, value in protocol.items()))
    return {"mean": mean, "scenes": scenes, "protocol": protocol}, "\n".join(lines)
