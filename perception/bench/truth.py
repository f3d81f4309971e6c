"""Ground truth of a scene in the layout of `perception demo --photos-only`. Used only for scoring."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from perception.errors import InputError
from perception.types import PointCloud


def read_scene(scene: Path) -> dict[str, Any]:
    """The content of scene.json. Raises InputError when the file is missing."""
    file = scene / "scene.json"
    if not file.is_file():
        raise InputError(f"{scene}: no scene.json there; expected the folder of a scene with truth")
    about: dict[str, Any] = json.loads(file.read_text(encoding="utf-8"))
    return about


def read_truth_cloud(scene: Path, means: np.ndarray) -> PointCloud:
    """gt_points.ply. Raises InputError without the label `instance_id`, or with most points off `means` [N, 3]."""
    from perception.export.transfer import check_overlap
    from perception.io.cloud import read_cloud

    cloud = read_cloud(scene / "gt_points.ply")
    if "instance_id" not in cloud.labels:
        raise InputError(f"{scene / 'gt_points.ply'}: expected a property instance_id, found none")
    if check_overlap(means, cloud.points) < 0.5:
        raise InputError(f"{scene}: most of its points lie outside the map; map the scene with its transforms.json")
    return cloud
