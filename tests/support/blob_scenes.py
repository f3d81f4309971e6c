"""Small maps whose instances are known exactly: balls of Gaussians, cameras around them, masks as a segmenter errs.

No training: features are given, so that what is measured is the grouping alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np


def rand_index(a: np.ndarray, b: np.ndarray) -> float:
    """Scikit-learn's adjusted Rand index; only the process that asks for it loads the library."""
    from sklearn.metrics import adjusted_rand_score

    return float(adjusted_rand_score(a, b))


@dataclass(frozen=True)
class BlobScene:
    """gaussians: a Gaussians of N; views: TrainingViews with labels; truth [N] int32: the ball of each Gaussian."""

    gaussians: Any
    views: list[Any]
    truth: np.ndarray


def make_scene(
    centres: np.ndarray,
    features: np.ndarray,
    cameras: Sequence[tuple[np.ndarray, np.ndarray]],
    *,
    each: int | Sequence[int] = 150,
    radius: float = 0.3,
    feature_noise: float = 0.05,
    size: tuple[int, int] = (96, 72),
    focal: float = 80.0,
    seed: int = 0,
) -> BlobScene:
    """Balls about centres [K, 3] with features [K, D]; cameras: (eye [3], target [3]) each, z up.

    each: Gaussians a ball. Labels are the balls' own silhouettes with ids shuffled per photo, 0 where nothing is.
    """
    import torch

    from perception.gaussians.model import from_points
    from perception.gaussians.views import TrainingView
    from perception.instances.silhouettes import render_silhouettes

    rng = np.random.default_rng(seed)
    counts = np.broadcast_to(np.asarray(each), len(centres))
    truth = np.repeat(np.arange(len(centres), dtype=np.int32), counts)
    offsets = rng.normal(size=(len(truth), 3))
    offsets *= radius * rng.random((len(truth), 1)) ** (1 / 3) / np.linalg.norm(offsets, axis=1, keepdims=True)
    points = centres[truth] + offsets
    gaussians = from_points(
        points, rng.integers(0, 256, (len(truth), 3), np.uint8), feature_dim=features.shape[1], seed=seed, opacity=0.9
    )
    widest = np.log(0.5 * radius)
    noisy = features[truth] + rng.normal(0, feature_noise, (len(truth), features.shape[1]))
    gaussians = replace(
        gaussians,
        features=torch.from_numpy(noisy.astype(np.float32)),
        log_scales=gaussians.log_scales.clamp(max=float(widest)),
    )
    width, height = size
    K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]], dtype=torch.float32)
    views = []
    for number, (eye, target) in enumerate(cameras):
        pose = torch.from_numpy(look_at(np.asarray(eye, float), np.asarray(target, float)).astype(np.float32))
        seen = render_silhouettes(gaussians, [truth], pose, K, width, height, threshold=0.5)[0].ids
        names = np.concatenate([[0], 1 + rng.permutation(len(centres))]).astype(np.int32)
        photo = torch.zeros((height, width, 3), dtype=torch.uint8)
        views.append(TrainingView(f"{number:03d}.jpg", photo, torch.from_numpy(names[seen + 1]), K, pose))
    return BlobScene(gaussians, views, truth)


def look_at(eye: np.ndarray, target: np.ndarray) -> np.ndarray:
    """camera_from_world [4, 4] of a camera at `eye` that looks at `target`, z up, OpenCV axes."""
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, -rotation @ eye
    return pose


def orbit(count: int, distance: float, height: float, target: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Cameras on a circle about `target`."""
    angles = 2 * np.pi * np.arange(count) / count
    ring = np.stack([distance * np.cos(angles), distance * np.sin(angles), np.full(count, height)], axis=1)
    return [(target + eye, target) for eye in ring]


def random_scene(
    seed: int, count: int = 25, dim: int = 8, views: int = 24, crowding: float = 1.0, feature_noise: float = 0.12
) -> BlobScene:
    """`count` balls strewn over a square (crowding > 1: into one another), features a margin apart on average."""
    rng = np.random.default_rng(seed)
    side = 0.5 * np.sqrt(count) / crowding
    centres = np.stack([*rng.uniform(-side, side, (2, count)), rng.uniform(0, 0.6, count)], axis=1)
    features = rng.normal(0, 0.35, (count, dim))
    sizes = rng.integers(30, 400, count).tolist()
    cameras = orbit(views, 2.2 * side, 1.5 * side, np.zeros(3))
    return make_scene(centres, features, cameras, each=sizes, feature_noise=feature_noise, seed=seed)


def with_errors(scene: BlobScene, rng: np.random.Generator, rate: float = 0.3) -> BlobScene:
    """The scene with masks as a segmenter errs: cut in two by a line (`rate`), dropped (`rate` / 3), merged with a mask
    that it touches (`rate` / 2), each mask of each photo by itself."""
    import torch

    views = []
    for view in scene.views:
        labels = view.labels.numpy().copy()
        for name in np.unique(labels[labels > 0]):
            _err(labels, int(name), rng, rate)
        views.append(replace(view, labels=torch.from_numpy(labels)))
    return replace(scene, views=views)


def _err(labels: np.ndarray, name: int, rng: np.random.Generator, rate: float) -> None:
    rows, columns = np.nonzero(labels == name)
    if len(rows) == 0:
        return
    draw = rng.random()
    if draw < rate:
        angle, at = rng.uniform(0, np.pi), rng.integers(len(rows))
        side = np.cos(angle) * (rows - rows[at]) + np.sin(angle) * (columns - columns[at]) > 0
        labels[rows[side], columns[side]] = labels.max() + 1
    elif draw < rate * 4 / 3:
        labels[rows, columns] = 0
    elif draw < rate * 11 / 6:
        right = np.minimum(columns + 1, labels.shape[1] - 1)
        touched = labels[rows, right]
        touched = touched[(touched != name) & (touched > 0)]
        if len(touched):
            labels[rows, columns] = touched[0]
