"""Wrote v1.gsmap and its photos with the code of commit df9cc88, format version 1: run there, in this folder."""

from pathlib import Path

import cv2
import numpy as np

from perception.boxes import oriented_box
from perception.io.scene_cache import view_json
from perception.language.colors import PALETTE
from perception.language.description import InstanceDescription, to_arrays
from perception.map.write import GaussianMap, write_map
from perception.types import Lens, View

COLORS = np.array([[220, 40, 30], [40, 180, 60], [40, 60, 210]])
CENTRES = np.array([[-0.6, 0, 3], [0, 0, 3], [0.6, 0, 3]])
rng = np.random.default_rng(0)
count = 180
ids = np.repeat([0, 1, 2], 60).astype(np.int32)
ids[::20] = -1
means = (CENTRES[np.repeat([0, 1, 2], 60)] + rng.uniform(-0.15, 0.15, (count, 3))).astype(np.float32)
parts = np.where(ids == 1, np.where(means[:, 1] < 0, 3, 4), -1).astype(np.int32)


def entry(number: int, own: np.ndarray, label: str | None) -> dict:
    points = means[own]
    return {
        "id": number,
        "label": label,
        "score": 0.9,
        "num_gaussians": int(own.sum()),
        "views": 2,
        "centroid": points.mean(0).tolist(),
        "obb": oriented_box(points).to_json(),
        "aabb": {"min": points.min(0).tolist(), "max": points.max(0).tolist()},
    }


K = np.array([[60.0, 0, 32], [0, 60, 24], [0, 0, 1]])
Path("photos").mkdir(exist_ok=True)
views = []
for n in range(3):
    pose = np.eye(4)
    pose[0, 3] = 0.1 * (n - 1)
    picture = np.full((48, 64, 3), 200, np.uint8)
    for k in range(3):
        x = round(float((CENTRES[k, 0] + pose[0, 3]) / 3 * 60 + 32))
        picture[21:28, x - 3 : x + 4] = COLORS[k]
    cv2.imwrite(f"photos/{n}.png", picture[..., ::-1])
    lens = Lens("OPENCV", (60.0, 60.0, 32.0, 24.0, 0.0, 0.0, 0.0, 0.0), 64, 48) if n == 2 else None
    views.append(View(f"{n}.png", Path(f"photos/{n}.png"), K, 64, 48, pose, lens))

instances = [entry(0, ids == 0, None), entry(1, ids == 1, "grandma's cup"), entry(2, ids == 2, None)]
instances[1]["parts"] = [{**entry(k, parts == k, None), "parent": 1} for k in (3, 4)]


def described(total: int) -> dict:
    rows = rng.normal(size=(total, 8)).astype(np.float32)
    rows /= np.linalg.norm(rows, axis=1, keepdims=True)
    palette = np.zeros((PALETTE, 4), np.float32)
    boxes = [[(x - 3, 21, x + 4, 28) for x in (20 + 12 * (k % 3), 22 + 12 * (k % 3))] for k in range(total)]
    found = [
        InstanceDescription(row, np.stack([row, row]), palette, ["1.png", "2.png"], own)
        for row, own in zip(rows, boxes, strict=True)
    ]
    return to_arrays(found, "encoder of that time")


write_map(
    Path("v1.gsmap"),
    GaussianMap(
        means=means,
        quats=np.tile(np.array([1, 0, 0, 0], np.float32), (count, 1)),
        log_scales=np.full((count, 3), -4, np.float32),
        opacity_logits=np.full(count, 2, np.float32),
        sh=rng.normal(size=(count, 4, 3)).astype(np.float32) * 0.3,
        features=rng.normal(size=(count, 4)).astype(np.float32),
        instance_ids=ids,
        membership=np.where(ids >= 0, 1, 0).astype(np.float32),
        instances=instances,
        info={
            "frame": "kitchen",
            "metric": True,
            "source": "photos",
            "seed": 0,
            "config": {"language": {"encoder": "auto", "zooms": 1}, "photos": {"max_side": 64}},
            "scene": {"origin": [10.0, 0.0, 0.0]},
            "views": [view_json(view) for view in views],
            "quality": {"psnr": 20.0, "ssim": 0.9, "views": {"0.png": {"psnr": 20.0, "ssim": 0.9}}},
        },
        cameras={
            "names": np.array([view.name for view in views]),
            "photos": np.array([str(view.photo) for view in views]),
            "K": np.stack([view.K for view in views]),
            "sizes": np.array([[64, 48]] * 3),
            "camera_from_world": np.stack([view.camera_from_world for view in views]),
            "held_out": np.array([True, False, False]),
        },
        language=described(3),
        parts={"ids": parts, **{f"language_{name}": array for name, array in described(2).items()}},
    ),
)
