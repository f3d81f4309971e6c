"""Directory layouts of public datasets, as downloaded, and functions that evaluate predictions in them.

LERF-mask (Gaussian Grouping): <scene>/test_mask/<view>/<prompt>.png|jpg; predictions alike. LERF-OVS:
label/<scene>/frame_*.json with polygons. ScanNet and ScanNet++: <scene>.txt with true ids (1000 · class + instance, one
per vertex); predictions are submission files <scene>.txt that name mask files.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from perception.errors import InputError
from perception.evaluate.images import pictures
from perception.evaluate.instances import Protocol, evaluate_overlaps, get_protocol, mask_overlap
from perception.evaluate.masks import mean_over_scenes


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
    mean = mean_over_scenes(scenes)
    width = max(len(name) for name in [*scenes, "mean"]) + 2
    lines = [" " * width + "".join(f"{key:>10}" for key in keys)]
    lines += [f"{name:<{width}}" + "".join(f"{s[key]:>10.4f}" for key in keys) for name, s in scenes.items()]
    lines.append(f"{'mean':<{width}}" + "".join(f"{mean[key]:>10.4f}" for key in keys))
    protocol = next(iter(scenes.values()))["protocol"]
    lines.append("protocol " + "; ".join(f"{key}: {value}" for key, value in protocol.items()))
    return {"mean": mean, "scenes": scenes, "protocol": protocol}, "\n".join(lines)


def run_scannet(
    prediction: str | Path, truth: str | Path, protocol: str | Protocol = "scannet", **changes: Any
) -> tuple[dict[str, Any], str]:
    """Instance AP over all scenes of a ScanNet or ScanNet++ layout: (result, table).

    truth: <scene>.txt, one id per vertex (1000 · class + instance, 0 = void); prediction: <scene>.txt naming mask
    files. For a scene without prediction all true instances count as missed.
    """
    from perception.evaluate.labelled_clouds import instances_table

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
        overlaps.append(mask_overlap(rules, masks, scores, ids, classes, ids // 1000, None))
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
