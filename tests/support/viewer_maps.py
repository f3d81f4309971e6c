"""A small map for the viewer's tests, and a port for its page."""

from __future__ import annotations

import socket

import numpy as np

from perception.map.write import Map
from support.views_at import views_at


def small_map(count: int = 600, seed: int = 0) -> Map:
    """Three balls of colour in front of a wall that is no instance; a camera at the origin looks along z."""
    rng = np.random.default_rng(seed)
    ids = rng.integers(-1, 3, count).astype(np.int32)
    centres = np.array([[-1.2, 0, 4], [0, 0.2, 5], [1.2, -0.2, 4.5], [0, 0, 7]])
    spread = np.where(ids[:, None] < 0, [2.0, 1.5, 0.05], 0.25)
    colors = np.array([[0.9, 0.1, 0.1], [0.1, 0.8, 0.2], [0.15, 0.2, 0.9], [0.6, 0.6, 0.6]])
    quats = rng.normal(size=(count, 4))
    pose = np.eye(4)[None].repeat(2, 0).astype(np.float32)
    entries = [
        {"id": i, "label": None, "score": 0.2 + 0.3 * i, "num_gaussians": int((ids == i).sum()), "views": 2}
        | {"centroid": centres[i].tolist(), "aabb": {"min": [0, 0, 0], "max": [1, 1, 1]}}
        | {"obb": {"center": centres[i].tolist(), "rotation": np.eye(3).tolist(), "extent": [1, 1, 1]}}
        for i in range(3)
    ]
    return Map(
        (centres[ids] + rng.normal(size=(count, 3)) * spread).astype(np.float32),
        (quats / np.linalg.norm(quats, axis=1, keepdims=True)).astype(np.float32),
        rng.uniform(np.log(0.05), np.log(0.15), (count, 3)).astype(np.float32),
        np.full(count, 3.0, np.float32),
        ((colors[ids] - 0.5) / 0.28209479177387814)[:, None].astype(np.float32),
        rng.normal(size=(count, 4)).astype(np.float32),
        ids,
        np.where(ids >= 0, 1, 0).astype(np.float32),
        entries,
        {"frame": "map", "metric": True, "config": {"language": {"encoder": "auto"}}},
        views_at(pose),
    )


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
