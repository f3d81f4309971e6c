"""Photos of a wall of soft colours, and the wall as a grey map."""

from __future__ import annotations

import numpy as np
import torch

from perception.gaussians.model import from_points
from perception.gaussians.views import TrainingView

WIDTH, HEIGHT, FOCAL, DEPTH, PERSON = 96, 64, 80.0, 2.0, np.s_[20:60, 40:60]


def photographed(shift: float) -> TrainingView:
    """A wall of soft colours at DEPTH, seen from x = shift; with a depth image."""
    x = ((np.arange(WIDTH) + 0.5 - WIDTH / 2) * DEPTH / FOCAL + shift)[None].repeat(HEIGHT, axis=0)
    y = ((np.arange(HEIGHT) + 0.5 - HEIGHT / 2) * DEPTH / FOCAL)[:, None].repeat(WIDTH, axis=1)
    colors = 0.5 + 0.3 * np.stack([np.sin(5 * x), np.sin(4 * y + x), np.sin(9 * x * y)], axis=-1)
    colors += np.random.default_rng(int(100 * shift) + 99).uniform(-0.1, 0.1, colors.shape)  # detail of each photo
    pose = torch.eye(4)
    pose[0, 3] = -shift
    K = torch.tensor([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
    photo = torch.from_numpy((255 * colors.clip(0, 1)).astype(np.uint8))
    return TrainingView(str(shift), photo, None, K, pose, depth=torch.full((HEIGHT, WIDTH), DEPTH))


def wall():  # type: ignore[no-untyped-def]
    """The wall as a grey map: the right place, none of the colours."""
    x, y = np.meshgrid(np.arange(-2, 2, 0.05), np.arange(-1.2, 1.2, 0.05))
    points = np.stack([x.ravel(), y.ravel(), np.full(x.size, DEPTH)], axis=1)
    return from_points(points, np.full((x.size, 3), 128, np.uint8), feature_dim=1, seed=0, opacity=0.9)
