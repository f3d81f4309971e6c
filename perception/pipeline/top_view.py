"""Top view of the instances of a map, like a floor plan."""

from __future__ import annotations

import cv2
import numpy as np
import torch

from perception.colors import instance_palette
from perception.gaussians.rasterize import rasterize
from perception.geometry import camera_centres
from perception.io.store import Map

SOLID = 0.3
"""Least opacity of Gaussians that are drawn."""
FAR = 60.0
"""Height of the camera above the map in units of the map's width; nearly an orthographic projection."""
INK = (70, 70, 70)


@torch.no_grad()
def instances_top_view(gmap: Map, side: int = 480) -> np.ndarray:
    """[side, side, 3] uint8: the instances in their colours, cameras as dots, a scale bar.

    "Down" is the mean of the cameras' downward axes. Gaussians above all cameras, such as ceilings, are left out.
    """
    poses = gmap.poses
    axes = _axes(poses)
    turned = gmap.means @ axes.T
    eyes = camera_centres(poses) @ axes.T
    solid = (gmap.opacities > SOLID) & (gmap.instance_ids >= 0)
    below = solid & (turned[:, 2] >= eyes[:, 2].min())
    rows = np.flatnonzero(below if below.any() else solid)
    if len(rows) == 0:
        return np.full((side, side, 3), 255, np.uint8)
    low, high = np.percentile(turned[rows], [2, 98], axis=0)
    width = 1.08 * max(float((high - low)[:2].max()), 1e-9)
    middle = (low + high) / 2
    pose = np.eye(4)
    pose[:3, :3] = axes
    pose[:3, 3] = -middle + [0, 0, FAR * width]
    focal = FAR * side
    K = np.array([[focal, 0, side / 2], [0, focal, side / 2], [0, 0, 1]])
    arrays = (gmap.means, gmap.quats, gmap.scales, gmap.opacities, instance_palette(gmap.instance_ids) / 255)
    centres, quats, scales, opacities, colors = (
        torch.from_numpy(np.ascontiguousarray(array[rows], np.float32)) for array in arrays
    )
    viewmats, Ks = (torch.from_numpy(array[None].astype(np.float32)) for array in (pose, K))
    white = torch.ones(1, 3)
    out = rasterize(centres, quats, scales, opacities, colors, viewmats, Ks, side, side, background=white)
    picture = np.ascontiguousarray((out.colors[0].clamp(0, 1) * 255 + 0.5).to(torch.uint8).numpy())
    for eye in (eyes - middle)[:, :2] / width * side + side / 2:
        if (np.abs(eye) < 10 * side).all():
            cv2.circle(picture, (round(eye[0]), round(eye[1])), 2, INK, -1, cv2.LINE_AA)
    _scale_bar(picture, width, " m" if gmap.info.get("metric") else "")
    return picture


def _axes(poses: np.ndarray) -> np.ndarray:
    """Rows [3, 3]: image right, towards the reader, down in the scene; right is that of a camera, made horizontal."""
    down = poses[:, 1, :3].mean(axis=0)
    down /= max(float(np.linalg.norm(down)), 1e-9)
    right = poses[len(poses) // 2, 0, :3]  # of one camera: the mean over a closed path can be 0
    right = right - (right @ down) * down
    if np.linalg.norm(right) < 1e-3:
        right = np.cross(down, [1.0, 0.2, 0.1])
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(down, right), down])


def _scale_bar(picture: np.ndarray, width: float, unit: str) -> None:
    """A bar of a round length, between an eighth and a third of the picture, with its length beside it."""
    side = picture.shape[1]
    base = 10.0 ** np.floor(np.log10(width / 3))
    length = max(m * base for m in (1, 2, 5) if m * base <= width / 3)
    x0, y0, x1 = 14, side - 16, 14 + round(length / width * side)
    cv2.rectangle(picture, (x0 - 6, y0 - 22), (x1 + 6, y0 + 8), (255, 255, 255), -1)
    cv2.line(picture, (x0, y0), (x1, y0), INK, 2, cv2.LINE_AA)
    text = f"{length:g}{unit}"
    cv2.putText(picture, text, (x0, y0 - 7), cv2.FONT_HERSHEY_SIMPLEX, 0.45, INK, 1, cv2.LINE_AA)
