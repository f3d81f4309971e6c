"""Weak coverage against geometry worked out by hand."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from perception.gaussians.model import Gaussians
from perception.geometry import look_at
from perception.pipeline.view_coverage import views_of_each, weak_coverage
from perception.types import View

K = np.array([[200.0, 0, 100], [0, 200.0, 75], [0, 0, 1]])
UP = np.array([0, 0, 1.0])


def balls(count: int) -> Gaussians:
    """`count` Gaussians about (0, 0, 0), then as many about (10, 0, 0)."""
    rng = np.random.default_rng(0)
    means = rng.normal(0, 0.2, (2 * count, 3))
    means[count:, 0] += 10
    return Gaussians(
        means=torch.from_numpy(means.astype(np.float32)),
        quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(2 * count, 1),
        log_scales=torch.full((2 * count, 3), -4.0),
        opacity_logits=torch.full((2 * count,), 2.0),
        sh=torch.zeros(2 * count, 1, 3),
        features=torch.zeros(2 * count, 1),
    )


def view(name: str, eye: list[float], target: list[float]) -> View:
    return View(name, Path(name), K, 200, 150, look_at(np.array(eye), np.array(target), UP))


def test_each_ball_is_seen_by_the_cameras_that_face_it() -> None:
    first = [view(f"a{i}.jpg", [4 * np.cos(i), 4 * np.sin(i), 1], [0, 0, 0]) for i in (1.3, 1.6, 1.9)]
    second = [view("b.jpg", [10, 4, 1], [10, 0, 0])]
    counts = views_of_each(balls(50), first + second)
    assert np.median(counts[:50]) == 3 and counts[50:].max() == 1
    told = weak_coverage(balls(50), first + second)
    assert told is not None and "b.jpg" in told and "50%" in told.replace("49%", "50%").replace("51%", "50%")


def test_enough_photos_everywhere_is_no_warning() -> None:
    views = [view(f"{x}{i}.jpg", [x + 4 * np.cos(i), 4 * np.sin(i), 1], [x, 0, 0]) for x in (0, 10) for i in range(6)]
    assert weak_coverage(balls(50), views) is None
    assert weak_coverage(balls(50), []) is None
