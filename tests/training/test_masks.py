"""Worlds that the built-in masks are trained on, and what is learned from them."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from perception.demo.scene import make_photos
from training.masks import fit, learn, make_world, pairs_of, plain_rule


@pytest.fixture(scope="module")
def photographed(tmp_path_factory):
    home = tmp_path_factory.mktemp("worlds") / "clutter_5"
    return home, make_photos(home / "images", scene="clutter", views=8, width=160, height=120, seed=5, light_samples=2,
                             truth_folder=home)  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("stereo", [False, True])
def test_truth_of_a_worlds_voxels_against_the_true_points(photographed, stereo):
    home, made = photographed
    world = make_world(home, stereo)
    distance, near = cKDTree(made.points).query(world.graph.surface.points)
    close = (distance < world.graph.surface.size) & (world.truth > 0)
    assert close.mean() > 0.2  # the cloud of true points is thin on walls
    assert (world.truth[close] == made.instance_ids[near[close]]).mean() > 0.85
    features, one, weights = pairs_of(world, plain_rule, 0)
    assert len(features) == len(one) == len(weights) > 50 and 0.1 < one.mean() < 0.95
    again = make_world(home, stereo)  # from its file
    np.testing.assert_array_equal(again.graph.sums, world.graph.sums)
    home.with_suffix(".stereo" if stereo else ".sensor").unlink()
    np.testing.assert_array_equal(make_world(home, stereo).truth, world.truth)  # from its photos, with the same noise


@pytest.mark.slow
def test_equal_seeds_make_equal_weights(photographed):
    world = make_world(photographed[0], False)
    first, second = (learn([world, world], seed=0) for _ in range(2))
    for one, two in zip(first.pair.parts + first.whole.parts, second.pair.parts + second.whole.parts, strict=True):
        np.testing.assert_array_equal(one, two)


def test_networks_learn_a_rule_that_is_not_linear():
    rng = np.random.default_rng(2)
    x = rng.normal(3, 2, (6000, 4))
    y = (np.abs(x[:, :1] - 3) > 1.5) != (x[:, 1:2] > 3)
    network = fit([(x[:5000], y[:5000], np.ones(5000))], {}, 60, 0)
    assert ((network(x[5000:]) > 0) == y[5000:]).mean() > 0.9
