"""A rendered scene with exact truth (`scene.json`, `transforms.json`, `masks_gt/`, `gt_points.ply`)."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from perception.instances.crops import view_scores
from perception.io.cloud import read_cloud


class TruthScene:
    """ids [I] int64: the instances that some photo shows; about: scene.json; frames: of transforms.json."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.about: dict[str, Any] = json.loads((folder / "scene.json").read_text())
        self.transforms: dict[str, Any] = json.loads((folder / "transforms.json").read_text())
        self.frames = self.transforms["frames"]
        self.ids = np.array(sorted(i["id"] for i in self.about["instances"] if i.get("views_visible", 1)))

    def positions(self, ids: np.ndarray) -> np.ndarray:
        """Positions of instance ids in `ids`, -1 = none of them."""
        place = np.full(max(int(ids.max()), int(self.ids.max())) + 1, -1)
        place[self.ids] = np.arange(len(self.ids))
        return place[ids]

    def load(self, view: int) -> tuple[np.ndarray, np.ndarray]:
        """Photo [H, W, 3] uint8 and instance image [H, W]: positions in `ids`, -1 = none."""
        frame = self.frames[view]
        photo = np.asarray(Image.open(self.folder / frame["file_path"]).convert("RGB"))
        truth = np.asarray(Image.open(self.folder / "masks_gt" / f"{Path(frame['file_path']).stem}.png"))
        return photo, self.positions(truth.astype(np.int64)).astype(np.int32)

    def view_scores(self) -> np.ndarray:
        """OpenSplat3D's view score [I, V] from true silhouettes; surface points stand in for Gaussians."""
        cloud = read_cloud(self.folder / "gt_points.ply")
        owner = self.positions(cloud.labels["instance_id"].astype(np.int64))
        points, owner = cloud.points[owner >= 0], owner[owner >= 0]
        count = len(self.ids)
        total = np.maximum(np.bincount(owner, minlength=count), 1)
        pixels, visible = np.zeros((2, count, len(self.frames)))
        for v in range(len(self.frames)):
            image = self.load(v)[1]
            pixels[:, v] = np.bincount(image[image >= 0], minlength=count)
            visible[:, v] = np.bincount(owner[self._seen(v, points, image) == owner], minlength=count) / total
        return view_scores(pixels, np.full(len(self.frames), image.size), visible)

    def _seen(self, view: int, points: np.ndarray, image: np.ndarray) -> np.ndarray:
        """What the instance image holds where each point projects, -2 outside of it."""
        world_from_gl = np.array(self.frames[view]["transform_matrix"])
        camera_from_world = np.linalg.inv(world_from_gl @ np.diag([1.0, -1.0, -1.0, 1.0]))
        p = points @ camera_from_world[:3, :3].T + camera_from_world[:3, 3]
        t, z = self.transforms, np.where(p[:, 2] > 1e-6, p[:, 2], np.inf)
        x = np.floor(t["fl_x"] * p[:, 0] / z + t["cx"]).astype(int)
        y = np.floor(t["fl_y"] * p[:, 1] / z + t["cy"]).astype(int)
        inside = (p[:, 2] > 1e-6) & (x >= 0) & (y >= 0) & (x < image.shape[1]) & (y < image.shape[0])
        found = np.full(len(points), -2)
        found[inside] = image[y[inside], x[inside]]
        return found
