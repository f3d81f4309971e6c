"""A rendered scene with exact truth, read for scoring only: photos, consistent instance ids, view scores,
queries.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from perception.errors import InputError


@dataclass(frozen=True)
class TruthScene:
    """ids [I] of the instances seen in some photo, frames of transforms.json, and `scene.json` as read."""

    folder: Path
    ids: np.ndarray
    frames: list[dict[str, Any]]
    cameras: dict[str, float]
    about: dict[str, Any]

    def load(self, view: int) -> tuple[np.ndarray, np.ndarray]:
        """Photo [H, W, 3] uint8 and instance image [H, W] int32 holding positions in `ids`, −1 = none."""
        from PIL import Image

        frame = self.frames[view]
        photo = np.asarray(Image.open(self.folder / frame["file_path"]).convert("RGB"))
        truth = np.asarray(Image.open(self.folder / frame["instance_file_path"])).astype(np.int32)
        position = np.full(max(int(truth.max()), int(self.ids.max())) + 1, -1, np.int32)
        position[self.ids] = np.arange(len(self.ids), dtype=np.int32)
        return photo, position[truth]

    def queries(self) -> list[tuple[str, set[int]]]:
        """Prompts that some visible instance answers, with the positions in `ids` of all that do."""
        position = {int(i): n for n, i in enumerate(self.ids)}
        found = [(q["text"], {position[i] for i in q["instance_ids"] if i in position}) for q in self.about["queries"]]
        return [(text, answers) for text, answers in found if answers]


def read_truth(folder: str | Path) -> TruthScene:
    """Open a truth scene (`scene.json`, `transforms.json`, `masks_gt/`, `gt_points.ply`)."""
    folder = Path(folder)
    for name in ("scene.json", "transforms.json", "masks_gt"):
        if not (folder / name).exists():
            raise InputError(f"{folder}: no {name} there; expected the folder of a scene with truth")
    about = json.loads((folder / "scene.json").read_text())
    transforms = json.loads((folder / "transforms.json").read_text())
    ids = np.array(sorted(i["id"] for i in about["instances"] if i.get("views_visible", 1)), np.int32)
    cameras = {k: float(transforms[k]) for k in ("fl_x", "fl_y", "cx", "cy", "w", "h")}
    return TruthScene(folder, ids, transforms["frames"], cameras, about)


def truth_view_scores(scene: TruthScene) -> np.ndarray:
    """OpenSplat3D's view score [I, V] from the true silhouettes, surface points standing in for Gaussians."""
    from perception.instances.crops import view_scores

    points, owner = _surface_points(scene)
    count, views = len(scene.ids), len(scene.frames)
    pixels = np.zeros((count, views))
    visible = np.zeros((count, views))
    total = np.maximum(np.bincount(owner, minlength=count), 1)
    for v in range(views):
        _, image = scene.load(v)
        pixels[:, v] = np.bincount(image[image >= 0], minlength=count)
        seen = _look_up(scene, v, points, image) == owner
        visible[:, v] = np.bincount(owner[seen], minlength=count) / total
    size = np.full(views, scene.cameras["w"] * scene.cameras["h"])
    return view_scores(pixels, size, visible)


def truth_directions(scene: TruthScene) -> np.ndarray:
    """[I, V, 3] unit vectors from the middle of each instance's surface to each camera."""
    points, owner = _surface_points(scene)
    count = len(scene.ids)
    number = np.maximum(np.bincount(owner, minlength=count), 1)
    middle = np.stack([np.bincount(owner, weights=points[:, axis], minlength=count) / number for axis in range(3)], 1)
    cameras = np.array([frame["transform_matrix"] for frame in scene.frames], np.float64)[:, :3, 3]
    rays = cameras[None] - middle[:, None]
    return np.asarray(rays / np.maximum(np.linalg.norm(rays, axis=2, keepdims=True), 1e-12))


def _surface_points(scene: TruthScene) -> tuple[np.ndarray, np.ndarray]:
    vertices = _read_vertices(scene.folder / "gt_points.ply")
    points = np.stack([vertices[axis] for axis in "xyz"], axis=1).astype(np.float64)
    ids = vertices["instance_id"].astype(np.int64)
    position = np.full(int(max(ids.max(), scene.ids.max())) + 1, -1, np.int64)
    position[scene.ids] = np.arange(len(scene.ids))
    owner = position[ids]
    return points[owner >= 0], owner[owner >= 0]


def _look_up(scene: TruthScene, view: int, points: np.ndarray, image: np.ndarray) -> np.ndarray:
    """Instance seen in a view at each point's projection [P], −2 outside the photo."""
    world_from_gl = np.array(scene.frames[view]["transform_matrix"], np.float64)
    camera_from_world = np.linalg.inv(world_from_gl @ np.diag([1.0, -1.0, -1.0, 1.0]))
    p = points @ camera_from_world[:3, :3].T + camera_from_world[:3, 3]
    c = scene.cameras
    z = np.where(p[:, 2] > 1e-6, p[:, 2], np.inf)
    u = np.floor(c["fl_x"] * p[:, 0] / z + c["cx"]).astype(np.int64)
    w = np.floor(c["fl_y"] * p[:, 1] / z + c["cy"]).astype(np.int64)
    height, width = image.shape
    inside = (p[:, 2] > 1e-6) & (u >= 0) & (w >= 0) & (u < width) & (w < height)
    found = np.full(len(points), -2, np.int64)
    found[inside] = image[w[inside], u[inside]]
    return found


_PLY_TYPES = {"float": "<f4", "double": "<f8", "uchar": "u1", "ushort": "<u2", "int": "<i4", "uint": "<u4"}


def _read_vertices(path: Path) -> np.ndarray:
    """Vertices of a binary little-endian PLY without list properties, as a structured array."""
    raw = path.read_bytes()
    end = raw.find(b"end_header\n")
    lines = raw[: max(end, 0)].decode("ascii", "replace").splitlines()
    if end < 0 or "format binary_little_endian 1.0" not in lines:
        raise InputError(f"{path}: expected a binary little-endian PLY")
    count = next(int(line.split()[2]) for line in lines if line.startswith("element vertex"))
    fields = [line.split()[1:] for line in lines if line.startswith("property")]
    dtype = np.dtype([(name, _PLY_TYPES[kind]) for kind, name in fields])
    return np.frombuffer(raw, dtype, count, end + len(b"end_header\n"))
