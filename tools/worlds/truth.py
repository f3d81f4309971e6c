"""Ground truth of a synthetic scene. It is used to score a map, never to build one."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from perception.geometry import OPENCV_FROM_OPENGL
from perception.io.cloud import write_cloud
from perception.types import PointCloud
from worlds.cameras import Camera


@dataclass(frozen=True)
class Truth:
    """One instance: id > 0, name, category and its id, prompts that name it, whether it is background (wall, floor...),
    number of its points in gt_points.ply, number of photos that show it, ids of the instances that it stands on and
    that it is attached to."""

    id: int
    name: str
    category: str
    semantic_id: int
    prompts: list[str]
    is_stuff: bool
    gt_points: int
    views_visible: int
    on: int | None = None
    attached_to: int | None = None


@dataclass
class DemoTruth:
    """Ground truth of a set of photos. Metres, z up.

    instances: by id. asked: prompts of `perception demo`. names: photo file names. cameras: one per photo.
    points [N, 3] float32, normals [N, 3] float32, colors [N, 3] uint8, instance_ids [N] int32: surface points that at
    least two photos see. folder: folder of the ground truth. photos: path of the photos relative to that folder.
    """

    instances: list[Truth]
    asked: list[str]
    names: list[str]
    cameras: list[Camera]
    points: np.ndarray
    normals: np.ndarray
    colors: np.ndarray
    instance_ids: np.ndarray
    folder: Path
    photos: str = "images"

    @property
    def queries(self) -> list[tuple[str, list[int]]]:
        """Every prompt with the ids of the visible instances that it names."""
        found: dict[str, list[int]] = {}
        for instance in self.instances:
            for text in dict.fromkeys([instance.name, instance.category, *instance.prompts]):
                if instance.gt_points:
                    found.setdefault(text, []).append(instance.id)
        return sorted(found.items())

    def save(self) -> None:
        """Writes scene.json, transforms.json and gt_points.ply into the folder."""
        stuff = {instance.id for instance in self.instances if instance.is_stuff}
        queries = [{"text": text, "instance_ids": ids, "is_stuff": set(ids) <= stuff} for text, ids in self.queries]
        scene = {
            "units": "metres",
            "up": "+Z",
            "image_size": [self.cameras[0].width, self.cameras[0].height],
            "views": len(self.names),
            "instances": [asdict(instance) for instance in self.instances],
            "semantics": {str(instance.semantic_id): instance.category for instance in self.instances},
            "queries": queries,
            "asked": self.asked,
        }
        (self.folder / "scene.json").write_text(json.dumps(scene, indent=1), encoding="utf-8")
        transforms = _transforms(self.photos, self.names, self.cameras)
        (self.folder / "transforms.json").write_text(json.dumps(transforms, indent=1), encoding="utf-8")
        semantic = np.zeros(len(self.instances) + 1, np.int32)
        semantic[[instance.id for instance in self.instances]] = [i.semantic_id for i in self.instances]
        labels = {"instance_id": self.instance_ids, "semantic_id": semantic[self.instance_ids]}
        cloud = PointCloud(self.points, self.colors, self.normals, labels=labels)
        write_cloud(self.folder / "gt_points.ply", cloud)


def _transforms(photos: str, names: list[str], cameras: list[Camera]) -> dict[str, Any]:
    frames = [
        {
            "file_path": f"{photos}/{name}",
            "transform_matrix": (np.linalg.inv(camera.camera_from_world) @ OPENCV_FROM_OPENGL).tolist(),
            "instance_file_path": f"masks_gt/{Path(name).stem}.png",
        }
        for name, camera in zip(names, cameras, strict=True)
    ]
    K, width, height = cameras[0].K, cameras[0].width, cameras[0].height
    lens = {"fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2], "cy": K[1, 2], "w": width, "h": height}
    return {"camera_model": "OPENCV", **lens, "depth_unit_scale_factor": 0.001, "frames": frames}
