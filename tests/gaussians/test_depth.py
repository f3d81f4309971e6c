"""Depth in training: fused start against a known box, loss against its formula, a wall that photos do not show."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from perception.config import load_config
from perception.gaussians.depth_start import fuse_depth, start_on_surface
from perception.gaussians.losses import depth_loss
from perception.gaussians.model import from_points
from perception.gaussians.train import Trainer
from perception.gaussians.views import TrainingView, depth_image
from support.aimed import look_at

LOW, HIGH = np.array([-0.5, -0.5, 0.0]), np.array([0.5, 0.5, 0.6])
FLOOR = 3.0
"""Half side of the square floor z = 0 on which the box stands."""


def box_view(name: str, eye: list[float], noise: np.ndarray | None = None) -> TrainingView:
    """A view [60, 80] of a red box on a green floor, with exact depth where one of them is hit, by ray casting."""
    pose = look_at(np.array(eye), np.array([0, 0, 0.2]), np.array([0, 0, 1.0]))
    K = np.array([[70.0, 0, 40], [0, 70.0, 30], [0, 0, 1]])
    y, x = np.mgrid[:60, :80] + 0.5
    rays = np.stack([(x - 40) / 70, (y - 30) / 70, np.ones_like(x)], axis=-1) @ pose[:3, :3]
    sides = np.sort(np.stack([(LOW - eye) / rays, (HIGH - eye) / rays]), axis=0)
    enter, leave = sides[0].max(axis=-1), sides[1].min(axis=-1)
    box = np.where(enter < leave, enter, np.inf)
    floor = np.where(rays[..., 2] < 0, -eye[2] / rays[..., 2], np.inf)
    floor[(np.abs(eye + rays * np.where(np.isfinite(floor), floor, 0)[..., None])[..., :2] > FLOOR).any(axis=-1)] = (
        np.inf
    )
    z = np.minimum(box, floor)
    depth = np.where(np.isfinite(z), z, 0) * (1 if noise is None else noise)
    photo = np.where((box < floor)[..., None], [200, 30, 30], [30, 150, 30]).astype(np.uint8)
    tensors = (torch.from_numpy(a.astype(np.float32)) for a in (K, pose))
    return TrainingView(name, torch.from_numpy(photo), None, *tensors, depth=torch.from_numpy(depth.astype(np.float32)))


def ring(count: int = 6, **more: np.ndarray) -> list[TrainingView]:
    angles = 2 * math.pi * np.arange(count) / count
    return [box_view(str(i), [2.5 * math.cos(a), 2.5 * math.sin(a), 1.8], **more) for i, a in enumerate(angles)]


def distance(points: np.ndarray) -> np.ndarray:
    """[P] from the surface of box and floor."""
    outside = np.maximum(np.maximum(LOW - points, points - HIGH), 0)
    inside = np.maximum(np.maximum(LOW - points, points - HIGH).max(axis=1), -np.inf)
    box = np.where((outside > 0).any(axis=1), np.linalg.norm(outside, axis=1), np.abs(inside))
    return np.minimum(box, np.abs(points[:, 2]))


# ------------------------------------------------------------------------ start


def test_the_fused_cloud_lies_on_the_surface_and_covers_it():
    cloud = fuse_depth(ring(), 100_000)
    # A voxel's mean of a flat part lies on it; at edges it is off by less than the side.
    far = distance(cloud.points)
    assert np.median(far) < 1e-3 * cloud.side
    assert far.max() < cloud.side
    # The upper face of the box: every square of two voxels' side has a point.
    top = cloud.points[cloud.points[:, 2] > HIGH[2] - 1e-3]
    cells = np.unique(np.floor((top[:, :2] - LOW[:2]) / (2 * cloud.side)).astype(int), axis=0)
    assert len(cells) >= 0.9 * (1 / (2 * cloud.side)) ** 2
    reds = cloud.colors[(cloud.points[:, 2] > 0.1)][:, 0]
    assert (reds > 150).mean() > 0.95


def test_the_budget_limits_the_cloud():
    fine, coarse = fuse_depth(ring(), 100_000), fuse_depth(ring(), 300)
    assert 200 <= len(coarse.points) <= 300 < len(fine.points)


def test_a_budget_of_less_than_the_voxels_around_the_origin_ends() -> None:
    """Voxels grew without end: those that meet at the origin are eight, whatever their side."""
    raised = torch.eye(4)
    raised[2, 3] = 0.3  # the origin in the middle of the box
    views = [replace(view, camera_from_world=view.camera_from_world @ raised) for view in ring()]
    start = start_on_surface(views, np.zeros((0, 3)), np.zeros((0, 3), np.uint8), 1, 2, 0)
    assert start is not None and 1 < len(start) <= 8


def test_points_that_other_views_look_through_are_dropped():
    views = ring()
    ghost = views[0].depth.clone()
    ghost[26:34, 34:46] = 2.0  # a thing in front of one camera, which the five others look through
    flying = [replace(views[0], depth=ghost), *views[1:]]
    assert distance(fuse_depth([flying[0]], 100_000).points).max() > 0.3
    assert distance(fuse_depth(flying, 100_000).points).max() < 0.1


def test_sparse_points_are_added_only_where_no_depth_was_measured():
    points = np.array([[0, 0, 0.6], [0, 0, 9.0]])
    start = start_on_surface(ring(), points, np.zeros((2, 3), np.uint8), 1000, 2, 0)
    assert (start.means[:, 2] > 5).sum() == 1
    assert len(start) <= 500
    assert start_on_surface([replace(v, depth=None) for v in ring()], points, points, 1000, 2, 0) is None
    assert start_on_surface([replace(v, depth=0 * v.depth) for v in ring()], points, points, 1000, 2, 0) is None


# ------------------------------------------------------------------------- loss


def images() -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(3)
    measured, alphas, ratio = (torch.rand(9, 7, generator=generator, dtype=torch.float64) for _ in range(3))
    measured = torch.where(measured < 0.3, torch.zeros_like(measured), 1 + measured)
    return (0.9 + 0.2 * ratio) * alphas * measured.clamp(min=0.5), alphas, measured


def plain(depths: torch.Tensor, alphas: torch.Tensor, measured: torch.Tensor, still: torch.Tensor) -> torch.Tensor:
    """The formula of `depth_loss`, pixel by pixel; still: the α that is taken as constant."""
    terms = []
    for D, a, d, a0 in zip(depths.flatten(), alphas.flatten(), measured.flatten(), still.flatten(), strict=True):
        if d > 0:
            error = D / (a * d) - 1
            terms.append(a0 * ((error**2 + 1e-4) ** 0.5 - 0.01) + 1 - a)
    return torch.stack(terms).mean()


def test_the_loss_and_its_gradient_are_those_of_the_formula():
    depths, alphas, measured = images()
    value, *gradients = depth_loss(depths, alphas, measured)
    other = [image.clone().requires_grad_() for image in (depths, alphas)]
    expected = plain(*other, measured, alphas)
    expected.backward()
    assert value == pytest.approx(expected.item(), rel=1e-12)
    for ours, theirs in zip(gradients, other, strict=True):
        torch.testing.assert_close(ours, theirs.grad, rtol=1e-9, atol=1e-12)


def test_pixels_without_depth_have_no_gradient_at_all():
    depths, alphas, measured = (image.float() for image in images())
    _, of_depths, of_alphas = depth_loss(depths, alphas, measured)
    none = measured == 0
    assert none.any()
    assert (of_depths[none] == 0).all() and (of_alphas[none] == 0).all()
    assert (of_depths[~none] != 0).all()
    empty = torch.zeros_like(measured)
    assert depth_loss(depths, alphas, empty)[0] == 0


# --------------------------------------------------------------------- training


def grey_wall(depth: bool) -> list[TrainingView]:
    """Views of a wall without texture at z = 2: every depth explains such photos."""
    K = torch.tensor([[40.0, 0, 24], [0, 40.0, 18], [0, 0, 1]])
    photo, views = torch.full((36, 48, 3), 128, dtype=torch.uint8), []
    for i, x in enumerate((-0.2, 0.0, 0.2)):
        pose = torch.eye(4)
        pose[0, 3] = -x
        views.append(TrainingView(str(i), photo, None, K, pose, depth=torch.full((36, 48), 2.0) if depth else None))
    return views


def trained(depth: bool) -> Trainer:
    rng = np.random.default_rng(0)
    points = np.stack([*rng.uniform(-1.2, 1.2, (2, 500)), rng.uniform(1.6, 1.8, 500)], axis=1)
    start = from_points(points, np.full((500, 3), 128, np.uint8), feature_dim=1, seed=0)
    config = load_config(None, ["train.iterations=100", "train.budget=600", "losses.depth_weight=0.5"])
    trainer = Trainer(start, grey_wall(depth), config, [])
    trainer.extent = 80.0  # 0.2 would give the means a rate too small for 100 steps
    trainer.run()
    return trainer


def test_depth_finds_a_wall_that_photos_leave_open():
    errors = []
    for depth in (False, True):
        trainer, view = trained(depth), grey_wall(True)[1]
        rendered = depth_image(trainer.gaussians, view.camera_from_world, view.K, 48, 36)
        errors.append(float((rendered - 2).abs().median()))
    assert errors[0] > 0.1, "the photos alone decide the depth: the test shows nothing"
    assert errors[1] < 0.02  # twice the noise level of the loss's relative error


def test_half_resolution_keeps_depth_where_a_block_has_any():
    depth = torch.zeros(4, 6)
    depth[0, 0], depth[2:, 4:] = 2.0, torch.tensor([[1.0, 1.02], [0.0, 1.01]])
    view = replace(grey_wall(False)[0], photo=torch.zeros(4, 6, 3, dtype=torch.uint8), depth=depth)
    expected = torch.tensor([[2.0, 0, 0], [0, 0, 1.01]])
    torch.testing.assert_close(view.halved().depth, expected)
