"""Smoothing on scenes of exact truth: labels with known errors get better, and true labels are left whole."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from perception.evaluate.instances import evaluate
from perception.export.export_map import ExportOptions, export_labels
from perception.export.smooth import segment_cloud, vote
from perception.io.cloud import read_cloud
from perception.types import PointCloud

DATA = os.environ.get("PERCEPTION_DATA")
pytestmark = pytest.mark.skipif(not DATA, reason="PERCEPTION_DATA is not set")


@pytest.fixture(scope="module", params=["room_a", "tabletop_a"])
def cloud(request) -> PointCloud:
    return read_cloud(Path(str(DATA)) / request.param / "gt_points.ply")


def noisy_map(cloud: PointCloud) -> tuple[np.ndarray, np.ndarray]:
    """60 000 means 1 cm off the surface, 15 % of them with another's instance."""
    rng = np.random.default_rng(0)
    truth = cloud.labels["instance_id"]
    chosen = rng.choice(len(truth), 60000, replace=False)
    means = cloud.points[chosen] + rng.normal(0, 0.01, (60000, 3))
    ids = truth[chosen].copy()
    wrong = rng.random(60000) < 0.15
    ids[wrong] = rng.choice(ids, wrong.sum())
    return means, ids


@pytest.mark.slow
def test_smoothing_raises_the_figure_of_noisy_labels(cloud):
    means, ids = noisy_map(cloud)
    truth = cloud.labels["instance_id"]
    raw = evaluate(export_labels(means, ids, cloud, ExportOptions(smooth=False)), None, truth)
    smooth = evaluate(export_labels(means, ids, cloud), None, truth)
    assert raw["ap"] < 0.6 and smooth["ap"] > 0.97 and smooth["ap50"] == 1.0


@pytest.mark.slow
def test_smoothing_leaves_true_labels_nearly_whole(cloud):
    truth = cloud.labels["instance_id"]
    smoothed = vote(truth, segment_cloud(cloud))
    assert (smoothed == truth).mean() > 0.99
    assert evaluate(smoothed, None, truth)["ap"] > 0.99


def test_smoothing_works_without_normals(cloud):
    truth = cloud.labels["instance_id"]
    bare = PointCloud(cloud.points, cloud.colors)
    assert evaluate(vote(truth, segment_cloud(bare)), None, truth)["ap"] > 0.95
