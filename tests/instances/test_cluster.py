"""Clustering against blobs whose membership is known exactly."""

from __future__ import annotations

import numpy as np
import pytest

from perception.config import InstanceConfig
from perception.instances import cluster
from perception.instances.cluster import by_falling_size, cluster_gaussians, split_disconnected
from support.blob_scenes import rand_index


def blobs(centres: np.ndarray, feature: np.ndarray, each: int, rng: np.random.Generator) -> tuple[np.ndarray, ...]:
    """means, features and truth of `each` points about every centre."""
    truth = np.repeat(np.arange(len(centres)), each)
    means = centres[truth] + rng.normal(0, 0.05, (len(truth), 3))
    return means, feature[truth] + rng.normal(0, 0.02, (len(truth), feature.shape[1])), truth


def run(means: np.ndarray, features: np.ndarray, **changes: int) -> np.ndarray:
    scales, opacities = np.full((len(means), 3), 0.02), np.full(len(means), 0.9)
    return cluster_gaussians(means, scales, opacities, features, InstanceConfig(**changes))


@pytest.mark.parametrize("width", [1, 8, 32])
def test_blobs_are_found(width: int) -> None:
    rng = np.random.default_rng(0)
    feature = rng.normal(0, 1, (5, width)) + 3 * np.arange(5)[:, None]
    means, features, truth = blobs(rng.uniform(-2, 2, (5, 3)), feature, 200, rng)
    ids = run(means, features)
    assert rand_index(truth[ids >= 0], ids[ids >= 0]) == 1
    assert np.mean(ids >= 0) > 0.95


def test_equal_features_far_apart_are_two_instances() -> None:
    """Two objects that share no photo may share a feature; their places tell them apart."""
    rng = np.random.default_rng(1)
    same = np.array([[0.0] * 8, [0.0] * 8, [2.0] * 8])
    means, features, truth = blobs(np.array([[0, 0, 0], [3, 0, 0], [0, 3, 0]], float), same, 150, rng)
    ids = run(means, features)
    assert len(set(ids[ids >= 0])) == 3
    assert rand_index(truth[ids >= 0], ids[ids >= 0]) == 1


def test_all_features_equal_is_one_instance() -> None:
    rng = np.random.default_rng(2)
    means = rng.normal(0, 0.1, (300, 3))
    ids = run(means, np.zeros((300, 8)))
    assert set(ids) <= {0, -1} and np.mean(ids == 0) > 0.9


def test_too_few_gaussians_are_noise() -> None:
    assert (run(np.zeros((5, 3)), np.zeros((5, 8))) == -1).all()
    assert len(run(np.zeros((0, 3)), np.zeros((0, 8)))) == 0


def test_sketch_agrees_with_the_full_run(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(3)
    feature = rng.normal(0, 1, (20, 8)) * 2
    means, features, _ = blobs(rng.uniform(-5, 5, (20, 3)), feature, 300, rng)
    full = run(means, features)
    monkeypatch.setattr(cluster, "MAX_CLUSTERED", 3000)
    sketch = run(means, features)
    both = (full >= 0) & (sketch >= 0)
    assert rand_index(full[both], sketch[both]) >= 0.99 and np.mean(both) > 0.9


def test_order_does_not_matter() -> None:
    rng = np.random.default_rng(4)
    feature = rng.normal(0, 2, (6, 8))
    means, features, _ = blobs(rng.uniform(-2, 2, (6, 3)), feature, 120, rng)
    order = rng.permutation(len(means))
    assert rand_index(run(means, features)[order], run(means[order], features[order])) > 0.99


def test_by_falling_size() -> None:
    assert by_falling_size(np.array([0, 1, 1, -1, 2, 2, 2])).tolist() == [2, 1, 1, -1, 0, 0, 0]
    assert by_falling_size(np.array([-1, -1])).tolist() == [-1, -1]


def test_split_keeps_connected_lines_whole() -> None:
    line = np.stack([np.linspace(0, 1, 60), np.zeros(60), np.zeros(60)], axis=1)
    two = np.concatenate([line, line + np.array([0, 5, 0])])
    ids = split_disconnected(two, np.full((120, 3), 0.001), np.zeros(120, np.int64), 10)
    assert len(set(ids)) == 2 and len(set(ids[:60])) == 1 and len(set(ids[60:])) == 1
