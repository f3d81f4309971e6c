"""Reads the truth that `make_photos` writes."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np

from perception.geometry import OPENCV_FROM_OPENGL
from perception.io.cloud import read_cloud
from worlds.cameras import Camera
from worlds.truth import DemoTruth, Truth


def load_truth(folder: Path) -> DemoTruth:
    """What `DemoTruth.save` wrote."""
    scene = json.loads((folder / "scene.json").read_text(encoding="utf-8"))
    views = json.loads((folder / "transforms.json").read_text(encoding="utf-8"))
    K = np.array([[views["fl_x"], 0, views["cx"]], [0, views["fl_y"], views["cy"]], [0, 0, 1.0]])
    cameras = [
        Camera(K, np.linalg.inv(np.array(frame["transform_matrix"]) @ OPENCV_FROM_OPENGL), views["w"], views["h"])
        for frame in views["frames"]
    ]
    cloud = read_cloud(folder / "gt_points.ply")
    assert cloud.normals is not None and cloud.colors is not None
    photos = [Path(frame["file_path"]) for frame in views["frames"]]
    columns = (cloud.points, cloud.normals, cloud.colors, cloud.labels["instance_id"])
    instances = [Truth(**instance) for instance in scene["instances"]]
    names = [photo.name for photo in photos]
    return DemoTruth(instances, scene["asked"], names, cameras, *columns, folder, photos[0].parent.as_posix())


def things(truth: DemoTruth) -> list[Truth]:
    """The instances that are not background."""
    return [instance for instance in truth.instances if not instance.is_stuff]


def labels_of(truth: DemoTruth, name: str) -> np.ndarray:
    """Instance ids [H, W] uint16 of a photo, 0 = none, alike in all photos."""
    image = cv2.imread(str(truth.folder / "masks_gt" / f"{Path(name).stem}.png"), cv2.IMREAD_UNCHANGED)
    assert image is not None
    return image
