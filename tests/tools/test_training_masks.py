"""Worlds that the built-in masks are trained on, and what is learned from them."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from perception.masks.boundaries import REACH, forward, scaled
from training import boundaries, patchwork
from training.masks import border_samples, fit, learn, make_world, pairs_of, plain_rule
from worlds.scene import make_photos


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
    assert close.sum() > 2000  # the cloud of true points is thin on walls, and voxels are of several sizes
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
    for one, two in zip(first.pair.parts + first.region.parts, second.pair.parts + second.region.parts, strict=True):
        np.testing.assert_array_equal(one, two)


def test_networks_learn_a_rule_that_is_not_linear():
    rng = np.random.default_rng(2)
    x = rng.normal(3, 2, (6000, 4))
    y = (np.abs(x[:, :1] - 3) > 1.5) != (x[:, 1:2] > 3)
    network = fit([(x[:5000], y[:5000], np.ones(5000))], np.zeros(4, int), 60, 0)
    assert ((network(x[5000:]) > 0) == y[5000:]).mean() > 0.9


@pytest.mark.slow
def test_things_of_a_group_in_patchwork_touch_and_do_not_share_space():
    """Boxes of one orientation along the row: their extents may meet, not overlap."""
    for seed in range(20):
        bodies = [body for body, _ in patchwork.books(np.random.default_rng(seed))]
        middle, thick = (
            np.array([getattr(body.parts[0].shape, name)[0] for body in bodies]) for name in ("origin", "extent")
        )
        gaps = (middle[1:] - thick[1:] / 2) - (middle[:-1] + thick[:-1] / 2)
        assert len(bodies) >= 4 and (gaps > -1e-9).all() and (gaps < 0.0025).all()


def test_a_patchwork_animal_is_one_body_of_at_least_three_paints():
    for seed in range(5):
        body, _ = patchwork.animal(np.random.default_rng(seed))
        means = np.array([part.paint.mean(axis=(0, 1)) for part in body.parts])
        assert len(np.unique(means.round(6), axis=0)) >= 3
        low = min(float(part.shape.origin[2] - part.shape.radii[2]) for part in body.parts)
        assert abs(low) < 0.03  # it stands on the ground


def test_targets_of_borders_against_loops():
    rng = np.random.default_rng(3)
    ids = np.kron(rng.integers(0, 4, (5, 6)), np.ones((5, 5), int))
    targets, (height, width) = boundaries.targets_of(ids, [2]), ids.shape
    for y in range(height):
        for x in range(width):
            for axis, step in ((0, (0, REACH)), (1, (REACH, 0))):
                ends = [(y - step[0], x - step[1]), (y + step[0], x + step[1])]
                inside = all(0 <= v < height and 0 <= u < width for v, u in ends)
                a, b = (ids[end] for end in ends) if inside else (0, 0)
                assert targets[axis, y, x] == (a != b if a and b else 2)
            assert targets[2, y, x] == (ids[y, x] != 2 if ids[y, x] else 2)


@pytest.mark.slow
def test_borders_are_learned_and_equal_seeds_give_equal_layers(photographed):
    inputs, targets = border_samples(photographed[0], False)
    layers, again = (boundaries.train(inputs, targets, seed=0, steps=60) for _ in range(2))
    for one, two in zip(layers, again, strict=True):
        assert all(torch.equal(*pair) for pair in zip(one, two, strict=True))
    with torch.no_grad():
        odds = forward(layers, scaled(torch.from_numpy(inputs))).numpy()
    for k in range(3):
        yes, no = odds[:, k][targets[:, k] == 1], odds[:, k][targets[:, k] == 0]
        assert np.median(yes) > np.quantile(no, 0.7)
