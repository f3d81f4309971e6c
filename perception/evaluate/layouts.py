"""Directory layouts of public datasets, as downloaded, and functions that evaluate predictions in them.

LERF-mask (Gaussian Grouping): <scene>/test_mask/<view>/<prompt>.png|jpg; predictions alike. LERF-OVS:
label/<scene>/frame_*.json with polygons. ScanNet and ScanNet++: <scene>.txt with true ids (1000 · class + instance, one
per vertex); predictions are submission files <scene>.txt that name mask files, or <scene>.json with run-length masks.
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
from perception.evaluate.masks import evaluate_lerf_mask, evaluate_lerf_ovs, mean_over_scenes


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


def run_lerf_mask(
    prediction: str | Path, dataset: str | Path, *, missing: str = "zero", **switches: Any
) -> tuple[dict[str, Any], str]:
    """LERF-mask over the scenes of a dataset folder (or one scene): (result, table).

    dataset: <scene>/test_mask/<view>/<prompt>.*; prediction: <scene>/<view>/<prompt>.*, or with test_mask between.
    """
    scenes = {
        name: evaluate_lerf_mask(
            _predicted(prediction, name, "test_mask"), read_mask_folder(folder), missing=missing, **switches
        )
        for name, folder in _scenes(dataset, "test_mask").items()
    }
    return _scene_result(scenes, ("miou", "mbiou"))


def run_lerf_ovs(prediction: str | Path, dataset: str | Path, **switches: Any) -> tuple[dict[str, Any], str]:
    """LERF-OVS 3D selection over the scenes of a dataset folder: (result, table).

    dataset: label/<scene>/frame_*.json; prediction: <scene>/<view>/<prompt>.*, silhouettes as images (255 = 1).
    """
    root = Path(dataset) / "label" if (Path(dataset) / "label").is_dir() else Path(dataset)
    folders = {p.name: p for p in sorted(root.iterdir()) if p.is_dir()} if root.is_dir() else {}
    if not folders:
        raise InputError(f"{dataset}: holds no scenes; expected label/<scene>/frame_*.json")
    scenes = {}
    for name, folder in folders.items():
        silhouettes = {key: mask / 255.0 for key, mask in _predicted(prediction, name, "").items()}
        scenes[name] = evaluate_lerf_ovs(silhouettes, read_lerf_polygons(folder), **switches)
    return _scene_result(scenes, ("miou", "macc25"))


def _scenes(dataset: str | Path, inner: str) -> dict[str, Path]:
    dataset = Path(dataset)
    if (dataset / inner).is_dir():
        return {dataset.name: dataset / inner}
    found = {p.parent.name: p for p in sorted(dataset.glob(f"*/{inner}")) if p.is_dir()}
    if not found:
        raise InputError(f"{dataset}: holds no scenes; expected <scene>/{inner}/<view>/<prompt>.png")
    return found


def _predicted(prediction: str | Path, scene: str, inner: str) -> dict[tuple[str, str], np.ndarray]:
    """Predicted masks of a scene. A missing scene has none and therefore scores 0."""
    prediction = Path(prediction)
    if not prediction.is_dir():
        raise InputError(f"{prediction}: is no folder; expected predictions as <scene>/<view>/<prompt>.png")
    for folder in (prediction / scene / inner, prediction / scene):
        if folder.is_dir():
            return read_mask_folder(folder)
    return {}


def _scene_result(scenes: dict[str, dict[str, Any]], keys: Sequence[str]) -> tuple[dict[str, Any], str]:
    mean = mean_over_scenes(scenes)
    width = max(len(name) for name in [*scenes, "mean"]) + 2
    lines = [" " * width + "".join(f"{key:>10}" for key in keys)]
    lines += [f"{name:<{width}}" + "".join(f"{s[key]:>10.4f}" for key in keys) for name, s in scenes.items()]
    lines.append(f"{'mean':<{width}}" + "".join(f"{mean[key]:>10.4f}" for key in keys))
    protocol = next(iter(scenes.values()))["protocol"]
    lines.append("protocol " + "; ".join(f"{key}: {value}" for key, value in protocol.items()))
    return {"mean": mean, "scenes": scenes, "protocol": protocol}, "\n".join(lines)


def run_scannet(
    prediction: str | Path,
    truth: str | Path,
    protocol: str | Protocol = "scannet",
    **changes: Any,
) -> tuple[dict[str, Any], str]:
    """Instance AP over all scenes of a ScanNet or ScanNet++ layout: (result, table).

    truth: <scene>.txt, one id per vertex (1000 · class + instance, 0 = void); prediction: <scene>.txt naming mask
    files, or <scene>.json with run-length masks. For a scene without prediction all true instances count as missed.
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
    text, rle = folder / f"{scene}.txt", folder / f"{scene}.json"
    if rle.is_file():
        return _read_rle(rle, points)
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


def _read_rle(path: Path, points: int) -> _Prediction:
    """ScanNet++ predictions: a list of {"label_id", "confidence", "segmentation": {"length", "counts"}}.

    counts: pairs of start (1-based) and length of runs, as a list or as a string of numbers.
    """
    masks, classes, scores = [], [], []
    try:
        for row in json.loads(path.read_text(encoding="utf-8")):
            coded = row["segmentation"]
            counts = coded["counts"]
            runs = np.array(counts.split() if isinstance(counts, str) else counts, np.int64).reshape(-1, 2)
            if int(coded["length"]) != points or (
                len(runs) and (runs.min() < 1 or runs.sum(axis=1).max() > points + 1)
            ):
                raise InputError(f"{path}: a mask is coded for {coded['length']} points, the truth has {points}")
            mask = np.zeros(points, bool)
            for start, length in runs.tolist():
                mask[start - 1 : start - 1 + length] = True
            masks.append(mask)
            classes.append(int(row["label_id"]))
            scores.append(float(row["confidence"]))
    except InputError:
        raise
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path}: is no run-length prediction file ({error!r})") from error
    return masks, classes, scores
