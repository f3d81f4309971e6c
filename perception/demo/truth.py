"""What is true about the demo's photos: for scoring what the map found, never for making it."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from perception.demo.render import Camera
from perception.errors import InputError

FLIP = np.diag([1.0, -1.0, -1.0, 1.0])  # OpenCV camera axes <-> the OpenGL axes of transforms.json


@dataclass(frozen=True)
class Truth:
    """One instance as it is: id > 0, name, prompts that name it, whether it is background (table, wall,
    floor...)."""

    id: int
    name: str
    prompts: list[str]
    is_stuff: bool


@dataclass
class DemoTruth:
    """Truth of a set of demo photos, metres, z up.

    instances: by id. queries: (text, ids that answer it); no ids = not in the scene. names: photo file names.
    cameras: one per photo. points [N, 3] float32, normals [N, 3] float32, colors [N, 3] uint8, instance_ids
    [N] int32:
    surface points seen in at least two photos. folder: where the label images lie.
    """

    instances: list[Truth]
    queries: list[tuple[str, list[int]]]
    names: list[str]
    cameras: list[Camera]
    points: np.ndarray
    normals: np.ndarray
    colors: np.ndarray
    instance_ids: np.ndarray
    folder: Path

    @property
    def things(self) -> list[Truth]:
        """The instances that are no background."""
        return [instance for instance in self.instances if not instance.is_stuff]

    def labels(self, name: str) -> np.ndarray:
        """Instance ids [H, W] uint16 of a photo, 0 = nothing; the same id in every photo."""
        path = self.folder / "labels" / f"{Path(name).stem}.png"
        image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        if image is None:
            raise InputError(f"{path}: no readable label image; make the demo's photos again")
        return image

    def save(self) -> None:
        """Writes scene.json, transforms.json and gt_points.ply into the folder."""
        scene = {
            "units": "metres",
            "up": "+Z",
            "instances": [vars(instance) for instance in self.instances],
            "queries": [{"text": text, "instance_ids": ids} for text, ids in self.queries],
        }
        (self.folder / "scene.json").write_text(json.dumps(scene, indent=1))
        (self.folder / "transforms.json").write_text(json.dumps(_transforms(self.names, self.cameras), indent=1))
        _write_points(self.folder / "gt_points.ply", self)


def load_truth(folder: Path | str) -> DemoTruth:
    """Reads what `DemoTruth.save` wrote."""
    folder = Path(folder)
    if not (folder / "scene.json").is_file():
        raise InputError(f"{folder}: holds no scene.json; expected the truth folder of `perception demo`")
    scene = json.loads((folder / "scene.json").read_text())
    views = json.loads((folder / "transforms.json").read_text())
    K = np.array([[views["fl_x"], 0, views["cx"]], [0, views["fl_y"], views["cy"]], [0, 0, 1.0]])
    cameras = [
        Camera(K, np.linalg.inv(np.array(frame["transform_matrix"]) @ FLIP), views["w"], views["h"])
        for frame in views["frames"]
    ]
    raw = (folder / "gt_points.ply").read_bytes()
    data = np.frombuffer(raw[raw.index(b"end_header\n") + 11 :], _VERTEX)
    points, normals, colors = (np.stack([data[name] for name in group], -1) for group in _GROUPS)
    return DemoTruth(
        [Truth(**instance) for instance in scene["instances"]],
        [(query["text"], query["instance_ids"]) for query in scene["queries"]],
        [Path(frame["file_path"]).name for frame in views["frames"]],
        cameras,
        points,
        normals,
        colors,
        data["instance_id"].astype(np.int32),
        folder,
    )


def _transforms(names: list[str], cameras: list[Camera]) -> dict[str, Any]:
    first = cameras[0]
    frames = [
        {
            "file_path": f"images/{name}",
            "transform_matrix": (np.linalg.inv(camera.camera_from_world) @ FLIP).tolist(),
        }
        for name, camera in zip(names, cameras, strict=True)
    ]
    K = first.K
    intrinsics = {
        "fl_x": K[0, 0],
        "fl_y": K[1, 1],
        "cx": K[0, 2],
        "cy": K[1, 2],
        "w": first.width,
        "h": first.height,
    }
    return {"camera_model": "OPENCV", **intrinsics, "frames": frames}


_GROUPS = (("x", "y", "z"), ("nx", "ny", "nz"), ("red", "green", "blue"))
_VERTEX = np.dtype(
    [(name, "<f4") for group in _GROUPS[:2] for name in group]
    + [(name, "u1") for name in _GROUPS[2]]
    + [("instance_id", "<i4")]
)


def _write_points(path: Path, truth: DemoTruth) -> None:
    data = np.empty(len(truth.points), _VERTEX)
    for group, array in zip(_GROUPS, (truth.points, truth.normals, truth.colors), strict=True):
        for k, name in enumerate(group):
            data[name] = array[:, k]
    data["instance_id"] = truth.instance_ids
    types = {"<f4": "float", "|u1": "uchar", "<i4": "int"}
    lines = [f"property {types[_VERTEX[name].str]} {name}" for name in _VERTEX.names or ()]
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {len(data)}",
        *lines,
        "end_header",
        "",
    ]
    path.write_bytes("\n".join(header).encode() + data.tobytes())
