"""Depth by stereo against exact depths of a slanted wall behind a smaller one, cast by rays; where it is not used."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from perception.config import load_config
from perception.gaussians.depth_start import start_on_surface
from perception.gaussians.model import from_points
from perception.gaussians.stereo import FEW, LEAST_POINTS, with_stereo
from perception.gaussians.train import Trainer
from perception.gaussians.views import TrainingView, surface_depth
from perception.pipeline.record import depth_used
from perception.types import DepthImage, View
from support.two_walls import HALF, HEIGHT, NEAR, SLOPE, WIDTH, sparse, taken


@pytest.fixture(scope="module")
def shots() -> list[tuple[View, TrainingView, np.ndarray]]:
    return [taken(x, z) for x in (-0.5, 0.0, 0.5) for z in (-0.25, 0.25)]


def test_depths_are_right_where_photos_agree(shots):
    views, decoded, depths = (list(part) for part in zip(*shots, strict=True))
    weight = torch.ones(HEIGHT, WIDTH)
    weight[:40] = 0
    decoded[0] = replace(decoded[0], weight=weight)
    found = with_stereo(views, decoded, sparse(300))
    assert not found[0].depth[:40].any()  # ignored pixels
    for view, depth in zip(found, depths, strict=True):
        known = view.depth.numpy() > 0
        error = np.abs(view.depth.numpy() / depth - 1)[known]
        assert known.mean() > 0.4
        assert np.median(error) < 0.01
        assert (error < 0.05).mean() > 0.97  # the walls are 35 % apart
    assert all(view.depth is None for view in decoded)  # what training sees
    start = start_on_surface(found, sparse(300), np.zeros((300, 3), np.uint8), 2000, 2, 0)
    x, y, z = start.means.double().numpy().T
    behind = np.abs(y - 4 - SLOPE * x) / 4
    before = np.where((np.abs(x) < 1.2 * HALF) & (np.abs(z) < 1.2 * HALF), np.abs(y - NEAR) / NEAR, 1)
    assert (np.minimum(behind, before) < 0.05).mean() > 0.95


def test_stereo_is_left_out_where_it_is_not_needed(shots):
    views, decoded, _ = (list(part) for part in zip(*shots, strict=True))
    assert with_stereo(views, decoded, sparse(LEAST_POINTS - 1)) is decoded
    measured = [replace(views[0], depth=DepthImage(Path("depth.png"), 0.001)), *views[1:]]
    assert with_stereo(measured, decoded, sparse(300)) is decoded
    halves = [view.halved() for view in decoded]  # too small to be matched
    assert with_stereo(views, halves, sparse(300)) is halves
    many = FEW // len(views) + 1  # so that each point is in more than FEW photos
    assert with_stereo(many * views, many * decoded, sparse(300)) == many * decoded


def test_what_a_sensor_measured_is_a_surface_and_a_loss(shots):
    _, view, depth = shots[0]
    measured = replace(view, depth=torch.from_numpy(depth.astype(np.float32)))
    starts = [from_points(sparse(300), np.full((300, 3), 128, np.uint8), feature_dim=8, seed=0) for _ in range(2)]
    assert np.array_equal(surface_depth(starts[0], measured), measured.depth.numpy())
    assert depth_used([view]) is None
    assert depth_used([view, measured]) == {"views": 1, "measured": 1.0}
    losses = []
    for start, shown in zip(starts, (view, measured), strict=True):
        pairs = ["train.iterations=10", "losses.half_resolution=false", "train.sh_degree=0"]
        losses.append(Trainer(start, [shown], load_config(pairs=pairs), []).step(0.0))
    assert losses[0] < losses[1]
