"""A blank wall gets few Gaussians, a bookshelf many: one plane, half of it plain, half of it full of colour."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from perception.config import load_config
from perception.gaussians.model import from_points
from perception.gaussians.train import Trainer
from perception.gaussians.views import TrainingView

WIDTH, HEIGHT, FOCAL, DEPTH, PATCH = 96, 64, 80.0, 2.0, 0.1


def photographed(x0: float, y0: float) -> TrainingView:
    """The plane z = DEPTH from (x0, y0, 0), 3 × 3 samples a pixel: plain for x < 0, random patches for x >= 0."""
    patches = np.random.default_rng(0).random((40, 40, 3))
    u = (np.arange(3 * WIDTH) + 0.5) / 3 - WIDTH / 2
    v = (np.arange(3 * HEIGHT) + 0.5) / 3 - HEIGHT / 2
    x, y = np.meshgrid(u * DEPTH / FOCAL + x0, v * DEPTH / FOCAL + y0)
    rows, columns = ((a / PATCH).astype(int) % 40 for a in (y + 2.0, np.abs(x)))
    colors = np.where((x < 0)[..., None], 0.6, patches[rows, columns])
    colors = colors.reshape(HEIGHT, 3, WIDTH, 3, 3).mean(axis=(1, 3))
    pose = torch.eye(4)
    pose[:2, 3] = -torch.tensor([x0, y0])
    K = torch.tensor([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
    photo = torch.from_numpy((255 * colors + 0.5).astype(np.uint8))
    return TrainingView(f"{x0} {y0}", photo, None, K, pose)


def trained(views: list[TrainingView], held: list[TrainingView], *more: str) -> Trainer:
    rng = np.random.default_rng(1)
    points = np.stack([rng.uniform(-1.5, 1.5, 300), rng.uniform(-1, 1, 300), np.full(300, DEPTH)], axis=1)
    start = from_points(points, np.full((300, 3), 150, np.uint8), feature_dim=1, seed=0)
    pairs = ["train.iterations=400", "densify.every=20", "train.budget=6000", "train.sh_degree=0", *more]
    trainer = Trainer(start, views, load_config(None, pairs), held)
    trainer.run()
    return trainer


@pytest.mark.slow
def test_the_full_half_gets_most_of_the_gaussians_and_a_plain_wall_ends_growth() -> None:
    places = [(x, y) for x in (-0.3, -0.1, 0.1, 0.3) for y in (-0.15, 0.15)]
    both = trained([photographed(*place) for place in places], [photographed(0.0, 0.0)])
    x = both.gaussians.means[:, 0]
    plain, full = int((x < -0.05).sum()), int((x > 0.05).sum())
    assert full > 4 * plain

    # The same cameras in front of the plain part alone: as few for its area, which is twice that of a half, and an end
    # before the course is over. The step at which growth ends depends on the processor's rounding.
    wall = trained([photographed(x - 3.0, y) for x, y in places], [photographed(-3.0, 0.0)])
    assert full > 4 * len(wall.gaussians) / 2
    assert wall.iteration < 400 and any(text.startswith("stop: 10 %") for text in wall.record.decisions)
