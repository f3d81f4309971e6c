"""Writes labelled clouds: cloud and sidecar, and the submission format of ScanNet."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from perception.errors import InputError
from perception.io.atomic import replacing
from perception.io.cloud import write_cloud
from perception.types import PointCloud

Instances = Mapping[int, Mapping[str, Any]]


def write_export(
    path: str | Path,
    cloud: PointCloud,
    labels: np.ndarray,
    instances: Instances,
    facts: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Writes the cloud with `instance_id` and its sidecar JSON (same stem); returns the sidecar.

    labels [P] int32, −1 = none; points and order are the cloud's own. instances: {id: {"score", "label"}} of the map.
    facts: further keys of the sidecar.
    """
    path = Path(path)
    sidecar = {**(facts or {}), **sidecar_of(labels, instances)}
    with replacing(path.with_suffix(".json")) as file:
        file.write(json.dumps(sidecar, indent=1).encode())
    labelled = {"instance_id": labels.astype(np.int32)}
    write_cloud(path, PointCloud(cloud.points, cloud.colors, cloud.normals, cloud.faces, labelled))
    return sidecar


def sidecar_of(labels: np.ndarray, instances: Instances) -> dict[str, Any]:
    """{"instances": {"<id>": {"score", "label", "num_points"}}} of the instances that labels [P] name; parts also have
    their `parent`, groups the `instances` in them."""
    ids, counts = np.unique(labels[labels >= 0], return_counts=True)
    rows = {}
    for i, n in zip(ids.tolist(), counts.tolist(), strict=True):
        known = instances.get(i, {})
        score = float(known.get("score", 1.0))
        more = {key: known[key] for key in ("parent", "instances") if key in known}
        rows[str(i)] = {"score": score, "label": known.get("label"), "num_points": n, **more}
    return {"instances": rows}


def write_scannet(
    folder: str | Path, scene: str, labels: np.ndarray, instances: Instances, classes: Mapping[int, int] | None = None
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
        with replacing(masks / name) as file:
            file.write(np.stack([digits, np.full_like(digits, ord("\n"))], axis=1).tobytes())
        rows.append(f"predicted_masks/{name} {1 if classes is None else classes.get(i, 0)} {score[i]:.6f}\n")
    with replacing(folder / f"{scene}.txt") as file:
        file.write("".join(rows).encode())
    return folder / f"{scene}.txt"
