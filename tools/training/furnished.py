"""Exact truth of the path-traced worlds of `blender_worlds`, and a camera's noise; `training.masks` calls it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np


def finish(folder: Path) -> None:
    """Adds what `masks.read_scene` reads: photos, depth, true ids of pixels (rays through their centres), poses.
    Raises ValueError where `blender_worlds` has not been."""
    import cv2
    import open3d as o3d

    if not (folder / "cameras.json").is_file():
        raise ValueError(f"{folder}: not there; run tools/training/blender_worlds.py on {folder.parent} first")
    about = json.loads((folder / "cameras.json").read_text(encoding="utf-8"))
    surface = np.load(folder / "surface.npz")
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(o3d.core.Tensor(surface["points"]), o3d.core.Tensor(surface["faces"].astype(np.uint32)))
    (width, height), focal = about["size"], about["focal"]
    columns, rows = np.meshgrid(np.arange(width) + 0.5 - width / 2, np.arange(height) + 0.5 - height / 2)
    rays = np.stack([columns / focal, -rows / focal, -np.ones_like(columns)], axis=-1)
    for kind in ("depth", "masks_gt"):
        (folder / kind).mkdir(exist_ok=True)
    frames = []
    for k, pose in enumerate(np.array(about["poses"])):
        directions = rays @ pose[:3, :3].T
        origins = np.broadcast_to(pose[:3, 3], directions.shape)
        hit = scene.cast_rays(o3d.core.Tensor(np.concatenate([origins, directions], axis=-1).astype(np.float32)))
        depth, face = hit["t_hit"].numpy(), hit["primitive_ids"].numpy()
        seen = np.isfinite(depth)
        ids = np.where(seen, surface["ids"][np.where(seen, face, 0)], 0).astype(np.uint16)
        millimetres = np.where(seen, 1000 * depth, 0).clip(0, 65535).round().astype(np.uint16)
        cv2.imwrite(str(folder / "depth" / f"{k:04d}.png"), millimetres)
        cv2.imwrite(str(folder / "masks_gt" / f"{k:04d}.png"), ids)
        render = cv2.imread(str(folder / "images" / f"{k:04d}.png")).astype(np.float64)
        noise = np.random.default_rng([k, *folder.name.encode()]).normal(0, 1, render.shape)
        photo = (render + np.sqrt(0.35 + 0.009 * render) * noise).clip(0, 255).round().astype(np.uint8)
        cv2.imwrite(str(folder / "images" / f"{k:04d}.jpg"), photo, [cv2.IMWRITE_JPEG_QUALITY, 92])
        frames.append({"file_path": f"images/{k:04d}.jpg", "transform_matrix": pose.tolist()})
    camera = {"fl_x": focal, "fl_y": focal, "cx": width / 2, "cy": height / 2, "w": width, "h": height}
    (folder / "transforms.json").write_text(json.dumps({**camera, "frames": frames}), encoding="utf-8")
    named = {"instances": about["instances"]}
    (folder / "scene.json").write_text(
        json.dumps(named), encoding="utf-8"
    )  # the last, so that it says that all is there
