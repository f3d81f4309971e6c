"""Gaussians for masks that have too few: a disc on a plane of large Gaussians, whose true place is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from perception.gaussians.model import Gaussians, isotropic
from perception.gaussians.starved import LEAST_PIXELS, MOST, OWN, WANTED, for_starved_masks
from perception.gaussians.views import TrainingView

SIDE, FOCAL, HIGH, RADIUS = 120, 120.0, 1.0, 0.06
RED = (200, 30, 30)


def plane(spacing: float = 0.08, count: int = 13) -> Gaussians:
    """Grey Gaussians on z = 0, larger than the disc of RADIUS."""
    x, y = np.meshgrid(*[spacing * (np.arange(count) - count // 2)] * 2)
    points = np.stack([x.ravel(), y.ravel(), np.zeros(count**2)], axis=1)
    grey, generator = torch.full((count**2, 3), 0.5), torch.Generator().manual_seed(0)
    return isotropic(points, torch.full((count**2,), np.log(0.6 * spacing)), grey, 0.95, 4, generator)


def view(name: str, dx: float, radius: float | None = RADIUS) -> TrainingView:
    """From HIGH above (dx, 0), looking down; label 2 and red in the disc about (.02, 0), label 1 around it."""
    pose = np.diag([1.0, -1.0, -1.0, 1.0])
    pose[:3, 3] = -pose[:3, :3] @ [dx, 0, HIGH]
    column, row = np.meshgrid(*[np.arange(SIDE) + 0.5] * 2)
    x, y = (column - SIDE / 2) / FOCAL * HIGH + dx, -(row - SIDE / 2) / FOCAL * HIGH
    disc = np.hypot(x - 0.02, y) < (radius or 0)
    photo = np.where(disc[..., None], np.array(RED, np.uint8), np.uint8(127))
    K = torch.tensor([[FOCAL, 0, SIDE / 2], [0, FOCAL, SIDE / 2], [0, 0, 1.0]])
    labels, camera = torch.from_numpy(1 + disc.astype(np.int32)), torch.from_numpy(pose).float()
    return TrainingView(name, torch.from_numpy(photo), labels, K, camera)


def large(gaussians: Gaussians) -> Gaussians:
    """With as many faint Gaussians far away that WANTED are less than MOST of all."""
    far = np.tile([0.0, 0.0, -50.0], (int(2 * WANTED / MOST), 1))
    grey, generator = torch.full((len(far), 3), 0.5), torch.Generator().manual_seed(1)
    return Gaussians.concatenate([gaussians, isotropic(far, torch.full((len(far),), -9.0), grey, 0.01, 4, generator)])


def test_a_mask_that_two_photos_show_gets_gaussians_on_its_surface() -> None:
    born = for_starved_masks(large(plane()), [view("a", 0.1), view("b", -0.1)], 0)
    assert OWN <= len(born) <= 2 * WANTED
    means = born.means.numpy()
    assert (np.hypot(means[:, 0] - 0.02, means[:, 1]) < RADIUS).all()
    assert np.abs(means[:, 2]).max() < 0.04  # the balls' front lies before their middle
    assert (born.scales < RADIUS / 2).all()
    rgb = born.sh[:, 0] * 0.28209479 + 0.5
    np.testing.assert_allclose(rgb, np.tile(RED, (len(born), 1)) / np.float32(255), atol=1e-3)


def test_units_do_not_matter() -> None:
    gaussians, views, unit = large(plane()), [view("a", 0.1), view("b", -0.1)], 1e6  # beyond half precision
    born = for_starved_masks(gaussians, views, 0)
    for one in views:
        one.camera_from_world[:3, 3] *= unit
    scaled = replace(gaussians, means=gaussians.means * unit, log_scales=gaussians.log_scales + float(np.log(unit)))
    again = for_starved_masks(scaled, views, 0)
    np.testing.assert_allclose(again.means.numpy() / unit, born.means.numpy(), atol=1e-4)
    np.testing.assert_allclose(again.log_scales - np.log(unit), born.log_scales, atol=1e-3)


def test_a_mask_of_one_photo_or_too_few_pixels_gets_none() -> None:
    few = np.sqrt(0.7 * LEAST_PIXELS / np.pi) / FOCAL * HIGH
    for radius in (None, few):
        views = [view("a", 0.1, radius or RADIUS), view("b", -0.1, radius)]
        assert len(for_starved_masks(large(plane()), views, 0)) == 0


def test_a_mask_with_gaussians_of_its_own_gets_none() -> None:
    views = [view("a", 0.1), view("b", -0.1)]
    first = large(plane())
    served = Gaussians.concatenate([first, for_starved_masks(first, views, 0)])
    assert len(for_starved_masks(served, views, 0)) == 0


def test_few_of_all_are_placed() -> None:
    assert len(for_starved_masks(plane(), [view("a", 0.1), view("b", -0.1)], 0)) == 0  # 169 Gaussians, MOST are 8
