"""What moved between photos is found by comparing photos with each other, and left out of training."""

from __future__ import annotations

import numpy as np
import torch

from perception.gaussians.model import from_points
from perception.gaussians.transients import transient_masks, without_transients
from perception.gaussians.views import TrainingView

WIDTH, HEIGHT, FOCAL, DEPTH, PERSON = 96, 64, 80.0, 2.0, np.s_[20:60, 40:60]


def photographed(shift: float) -> TrainingView:
    """A wall of soft colours at DEPTH, seen from x = shift; with a depth image."""
    x = ((np.arange(WIDTH) + 0.5 - WIDTH / 2) * DEPTH / FOCAL + shift)[None].repeat(HEIGHT, axis=0)
    y = ((np.arange(HEIGHT) + 0.5 - HEIGHT / 2) * DEPTH / FOCAL)[:, None].repeat(WIDTH, axis=1)
    colors = 0.5 + 0.3 * np.stack([np.sin(5 * x), np.sin(4 * y + x), np.sin(9 * x * y)], axis=-1)
    colors += np.random.default_rng(int(100 * shift) + 99).uniform(-0.1, 0.1, colors.shape)  # detail of each photo
    pose = torch.eye(4)
    pose[0, 3] = -shift
    K = torch.tensor([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
    photo = torch.from_numpy((255 * colors.clip(0, 1)).astype(np.uint8))
    return TrainingView(str(shift), photo, None, K, pose, depth=torch.full((HEIGHT, WIDTH), DEPTH))


def wall():  # type: ignore[no-untyped-def]
    """The wall as a grey map: the right place, none of the colours."""
    x, y = np.meshgrid(np.arange(-2, 2, 0.05), np.arange(-1.2, 1.2, 0.05))
    points = np.stack([x.ravel(), y.ravel(), np.full(x.size, DEPTH)], axis=1)
    return from_points(points, np.full((x.size, 3), 128, np.uint8), feature_dim=1, seed=0, opacity=0.9)


def test_a_person_is_found_and_detail_that_is_not_trained_is_kept() -> None:
    views = [photographed(shift) for shift in (-0.3, -0.15, 0.0, 0.15, 0.3, 0.45)]
    assert not any(mask.any() for mask in transient_masks(wall(), views))
    views[2].photo[PERSON] = torch.tensor([250, 20, 230], dtype=torch.uint8)
    masks = transient_masks(wall(), views)
    assert masks[2][PERSON].all() and not any(masks[other].any() for other in (0, 1, 3, 4, 5))
    outside = masks[2].copy()
    outside[14:66, 34:66] = False  # three blocks of two pixels around the person
    assert not outside.any()


def test_what_moved_is_left_out_of_the_losses_on_color_and_depth() -> None:
    moved = np.zeros((HEIGHT, WIDTH), bool)
    moved[PERSON] = True
    view = photographed(0.0)
    assert without_transients(view, ~moved & moved) is view
    found = without_transients(view, moved)
    assert found.weight is not None and found.depth is not None
    np.testing.assert_array_equal(found.weight.numpy(), ~moved)
    np.testing.assert_array_equal(found.depth.numpy(), DEPTH * ~moved)
