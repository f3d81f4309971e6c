"""A room of boxes in closed form: exact depth pictures by ray casting, and points on its surfaces."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from perception.boxes import oriented_box
from perception.export.depth_views import DepthView
from perception.frame.gravity import Gravity
from perception.query import QueryMap
from perception.types import View
from support.aimed import look_at

Boxes = list[tuple[list[float], list[float]]]
"""Lowest and highest corner of each; the first is the room, seen from inside."""

FURNISHED: Boxes = [
    ([-2.5, -2, 0], [2.5, 2, 2.4]),
    ([-2.5, 0.5, 0], [-1.7, 2, 1.8]),
    ([0.3, -2, 0], [1.9, -1.3, 0.75]),
    ([-0.9, -0.6, 0], [0.1, 0.3, 0.45]),
    ([1.8, 1.0, 0], [2.5, 2, 1.1]),
    ([-2.5, -2.0, 0], [-2.0, -1.0, 2.1]),
]


def views(boxes: Boxes, count: int = 12, size: tuple[int, int] = (120, 90), textured: bool = False) -> list[DepthView]:
    """Cameras at 1.4 m on a small circle that look outwards and down, a quarter of them inwards."""
    found = []
    width, height = size
    K = np.array([[0.55 * width, 0, width / 2], [0, 0.55 * width, height / 2], [0, 0, 1]])
    for n in range(count):
        angle = 2 * np.pi * n / count
        out = np.array([np.cos(angle), np.sin(angle), 0])
        eye = (1.3 if n % 4 == 0 else 0.4) * out * [1, 0.8, 1] + [0, 0, 1.4]
        target = (-1 if n % 4 == 0 else 2) * out + [0, 0, 0.5]
        pose = look_at(eye, target, np.array([0, 0, 1.0]))
        v, u = np.mgrid[:height, :width] + 0.5
        rays = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones_like(u)], axis=-1)
        directions = rays @ pose[:3, :3]
        depth = cast(boxes, eye, directions.reshape(-1, 3)).reshape(height, width)
        places = eye + directions * depth[..., None]
        gray = texture(places.reshape(-1, 3)).reshape(height, width) if textured else np.full((height, width), 0.5)
        colors = np.repeat(gray[..., None], 3, axis=2).astype(np.float32)
        found.append(DepthView(pose, K, depth.astype(np.float32), colors))
    return found


def cast(boxes: Boxes, eye: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Ray parameter [R] of the first hit by the slab method; the room is left, the others are entered."""
    first = np.full(len(directions), np.inf)
    with np.errstate(divide="ignore", invalid="ignore"):
        for n, corners in enumerate(boxes):
            t = (np.array(corners)[:, None] - eye) / directions
            enter, leave = t.min(axis=0).max(axis=1), t.max(axis=0).min(axis=1)
            hit = leave if n == 0 else np.where((enter <= leave) & (enter > 0), enter, np.inf)
            first = np.minimum(first, hit)
    return first


def points(boxes: Boxes, spacing: float = 0.04) -> np.ndarray:
    """[P, 3] on the faces of all boxes, parts inside other boxes or under them left out."""
    found = []
    room_low, room_high = np.array(boxes[0])
    for n, (low, high) in enumerate(np.array(boxes)):
        for axis in range(3):
            a, b = (axis + 1) % 3, (axis + 2) % 3
            ranges = [np.arange(low[i] + spacing / 2, high[i], spacing) for i in (a, b)]
            grid = np.stack(np.meshgrid(*ranges), axis=-1).reshape(-1, 2)
            for value in (low[axis], high[axis]):
                face = np.empty((len(grid), 3))
                face[:, [a, b]], face[:, axis] = grid, value
                hidden = np.zeros(len(face), bool)
                for m, (lo, hi) in enumerate(np.array(boxes)):
                    if m not in (0, n):
                        hidden |= ((face >= lo) & (face <= hi)).all(axis=1)
                if n > 0:
                    hidden |= ((face <= room_low) | (face >= room_high)).any(axis=1)
                found.append(face[~hidden])
    return np.concatenate(found)


def map_of(
    boxes: Boxes, map_from_room: np.ndarray | None = None, merged: dict[int, int] | None = None, **info: Any
) -> QueryMap:
    """A map of the boxes' surfaces. Instances: the number of the box, or what `merged` says of it; the room's shell has
    none, unless merged[0] gives it one."""
    move = np.eye(4) if map_from_room is None else map_from_room
    surface, owner = points(boxes), np.full(len(points(boxes)), -1, np.int32)
    for number, (low, high) in enumerate(np.array(boxes)):
        if number > 0 or (merged and 0 in merged):
            there = (surface >= low - 1e-9).all(axis=1) & (surface <= high + 1e-9).all(axis=1)
            owner[there] = (merged or {}).get(number, number)
    means, count = surface @ move[:3, :3].T + move[:3, 3], len(surface)
    instances = [
        {
            "id": i,
            "label": None,
            "score": 1.0,
            "num_gaussians": len(own),
            "centroid": own.mean(axis=0).tolist(),
            "obb": oriented_box(own).to_json(),
        }
        for i, own in ((int(i), means[owner == i]) for i in np.unique(owner[owner >= 0]))
    ]
    eye = move[:3, :3] @ [0.0, -1.2, 1.4] + move[:3, 3]
    return QueryMap(
        means=means.astype(np.float32),
        quats=np.tile(np.array([1, 0, 0, 0], np.float32), (count, 1)),
        log_scales=np.full((count, 3), np.log(1e-3), np.float32),
        opacity_logits=np.full(count, 3, np.float32),
        sh=np.zeros((count, 1, 3), np.float32),
        features=np.zeros((count, 1), np.float32),
        instance_ids=owner,
        membership=np.ones(count, np.float32),
        instances=instances,
        info={
            "metric": True,
            "frame": "home",
            "gravity": Gravity(-move[:3, 2], 1.0, "truth").to_json(),
            **info,
        },
        views=[View("a.jpg", Path("a.jpg"), np.eye(3), 64, 48, look_at(eye, eye + move[:3, 0], move[:3, 2]))],
        path=Path("room.gsmap"),
    )


def texture(places: np.ndarray) -> np.ndarray:
    """Brightness [P] in [0, 1] of points: a smooth pattern without symmetry or period."""
    x, y, z = places.T
    return (
        0.5 + 0.16 * np.sin(5 * x + 2 * y) + 0.16 * np.sin(3.7 * y - 4 * z + 1) + 0.16 * np.sin(2.3 * z + 6.1 * x + 2)
    )
