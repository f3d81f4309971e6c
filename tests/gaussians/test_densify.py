"""Growth and pruning: the budget holds, clones keep the light, splits keep the place, depth is the plane's."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from perception.config import DensifyConfig, load_config
from perception.gaussians.densify import START, STOP, Statistics, densify, rotation_matrices, target_count
from perception.gaussians.model import Gaussians, from_points
from perception.gaussians.train import Trainer
from perception.gaussians.views import TrainingView, depth_image

THRESHOLD = DensifyConfig().grad_threshold


def cloud(count: int = 50, seed: int = 0) -> Gaussians:
    rng = np.random.default_rng(seed)
    points, colors = rng.uniform(-1, 1, (count, 3)), rng.integers(0, 256, (count, 3)).astype(np.uint8)
    return from_points(points, colors, feature_dim=4, seed=seed, opacity=0.5)


def statistics(count: int, gradient: float = 1.0) -> Statistics:
    return Statistics(torch.full((count,), gradient), torch.ones(count))


@pytest.mark.parametrize("allowed", [0, 10, 50, 51, 70, 1000])
@pytest.mark.parametrize("extent", [1e-6, 1e6])  # all are split, all are cloned
def test_the_budget_holds(allowed: int, extent: float) -> None:
    keep, born = densify(cloud(), statistics(50), allowed, extent, THRESHOLD, seed=1)
    assert len(keep) + len(born) == min(100, max(50, allowed))


def test_nothing_grows_below_the_threshold() -> None:
    keep, born = densify(cloud(), statistics(50, THRESHOLD / 2), 1000, 1.0, THRESHOLD, seed=1)
    assert keep.tolist() == list(range(50)) and len(born) == 0


@pytest.mark.parametrize("absolute", [True, False])
def test_a_gaussian_over_stripes_grows_only_by_absolute_gradients(absolute: bool) -> None:
    """A picture of mirror symmetry pulls the Gaussian in its middle to both sides alike."""
    stripes = np.broadcast_to(255 * (np.abs(np.arange(32) - 15.5).astype(int) // 4 % 2)[None, :, None], (32, 32, 3))
    K = torch.tensor([[32.0, 0, 16], [0, 32, 16], [0, 0, 1]])
    view = TrainingView("0", torch.from_numpy(stripes.astype(np.uint8)), None, K, torch.eye(4))
    one = from_points(np.array([[0.0, 0, 2]]), np.full((1, 3), 128, np.uint8), feature_dim=3, seed=0, opacity=0.5)
    one.log_scales[:] = np.log(0.2)
    pairs = [f"densify.absgrad={absolute}", "train.iterations=1000", "losses.half_resolution=false"]
    trainer = Trainer(one, [view], load_config(None, pairs), [])
    trainer._background = lambda: torch.full((1, 3), 0.5)  # type: ignore[method-assign]
    trainer.step(0.2)
    found = float(trainer.statistics.gradient / trainer.statistics.seen)
    assert found > THRESHOLD if absolute else found < THRESHOLD / 1000


def test_a_clone_and_its_original_hide_as_much_as_before() -> None:
    gaussians = cloud()
    before = gaussians.opacities.clone()
    densify(gaussians, statistics(50), 1000, 1e6, THRESHOLD, seed=1)
    torch.testing.assert_close(1 - (1 - gaussians.opacities) ** 2, before)


def test_the_halves_of_a_split_lie_about_its_place() -> None:
    gaussians = cloud(2000, seed=3)
    gaussians.means.zero_()
    gaussians.log_scales.copy_(torch.log(torch.tensor([0.3, 0.2, 0.1])).expand(2000, 3))
    gaussians.quats.copy_(torch.tensor([0.3, -0.5, 0.1, 2.0]).expand(2000, 4))
    _, born = densify(gaussians, statistics(2000), 10**6, 1e-6, THRESHOLD, seed=5)
    turn = Rotation.from_quat([-0.5, 0.1, 2.0, 0.3]).as_matrix()
    expected = turn @ np.diag([0.09, 0.04, 0.01]) @ turn.T
    # 4000 draws: the relative error of a variance is about sqrt(2 / 4000) = 2 %; 4 of those, of the largest.
    assert np.allclose(np.cov(born.means.numpy().T), expected, atol=0.09 * 0.09)
    torch.testing.assert_close(born.scales, torch.tensor([0.3, 0.2, 0.1]).expand(4000, 3) / 1.6)


def test_the_faint_the_unseen_and_the_broken_are_pruned() -> None:
    gaussians, seen = cloud(), statistics(50, 0.0)
    gaussians.opacity_logits[3] = -9.0
    seen.seen[7] = 0
    gaussians.means[11, 1] = float("nan")
    kept, _ = densify(gaussians, seen, 1000, 1.0, THRESHOLD, seed=1)
    assert kept.tolist() == [i for i in range(50) if i not in (3, 7, 11)]


def test_beyond_the_box_of_a_block_growth_needs_a_larger_gradient() -> None:
    gaussians = cloud()
    gaussians.log_scales.fill_(-20.0)  # all are cloned
    box = torch.tensor([[-np.inf, -0.5, 0.0], [0.3, np.inf, np.inf]])
    x, y, z = gaussians.means.numpy().T
    inside = (x < 0.3) & (y >= -0.5) & (z >= 0)
    _, grown = densify(gaussians, statistics(50, 2 * THRESHOLD), 1000, 1.0, THRESHOLD, 1, box)
    np.testing.assert_array_equal(grown.means, gaussians.means[inside])
    _, grown = densify(gaussians, statistics(50, 4 * THRESHOLD), 50 + inside.sum(), 1.0, THRESHOLD, 1, box)
    np.testing.assert_array_equal(grown.means, gaussians.means[inside])  # they are also the first
    _, grown = densify(gaussians, statistics(50, 4 * THRESHOLD), 1000, 1.0, THRESHOLD, 1, box)
    assert len(grown) == 50


def test_growth_is_a_ramp() -> None:
    counts = [target_count(p, 100, 1100) for p in (0.0, START, 0.325, STOP, 1.0)]
    assert counts == [100, 100, 600, 1100, 1100]


def test_rotations_are_those_of_scipy() -> None:
    quats = torch.from_numpy(np.random.default_rng(0).normal(size=(20, 4)))
    expected = Rotation.from_quat(quats.numpy()[:, [1, 2, 3, 0]]).as_matrix()
    np.testing.assert_allclose(rotation_matrices(quats).numpy(), expected, atol=1e-12)
    torch.testing.assert_close(rotation_matrices(torch.zeros(1, 4)), torch.eye(3)[None])


def test_depth_of_a_plane_is_its_distance() -> None:
    x, y = np.meshgrid(np.linspace(-2, 2, 60), np.linspace(-2, 2, 60))
    points = np.stack([x.ravel(), y.ravel(), np.full(x.size, 3.0)], axis=1)
    wall = from_points(points, np.zeros((x.size, 3), np.uint8), feature_dim=1, seed=0, opacity=0.9)
    wall.log_scales[:, 2] = -9.0
    K = torch.tensor([[50.0, 0, 24], [0, 50, 18], [0, 0, 1]])
    depth = depth_image(wall, torch.eye(4), K, 48, 36)
    torch.testing.assert_close(depth, torch.full((36, 48), 3.0), atol=1e-4, rtol=0)
    assert (depth_image(wall, torch.diag(torch.tensor([1.0, 1, -1, 1])), K, 48, 36) == 0).all()


def test_statistics_are_sums_over_the_views_that_see_a_gaussian():
    generator = torch.Generator().manual_seed(0)
    sums, gradient, seen = Statistics.zeros(300), torch.zeros(300), torch.zeros(300)
    for long_side in (640, 320):
        mean2d = torch.randn(300, 2, generator=generator)
        visible = torch.rand(300, generator=generator) > 0.4
        mean2d[~visible] = torch.nan  # may be left from another view
        sums.add(mean2d, visible.to(torch.uint8), long_side)
        gradient += torch.where(visible, mean2d.norm(dim=1) * long_side / 2, 0.0)
        seen += visible
    torch.testing.assert_close(sums.gradient, gradient, rtol=1e-6, atol=0)
    assert torch.equal(sums.seen, seen)
