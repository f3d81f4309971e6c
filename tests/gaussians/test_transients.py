"""What moved between photos is found by comparing photos with each other, and left out of training."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch

from perception.gaussians.transients import train_without_transients, transient_masks, without_transients
from perception.progress import Progress
from support.wall_photos import DEPTH, HEIGHT, PERSON, WIDTH, photographed, wall


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


def test_a_resumed_run_leaves_the_same_pixels_out(tmp_path: Path) -> None:
    views = [photographed(shift) for shift in (-0.3, -0.15, 0.0, 0.15, 0.3)]
    views[2].photo[PERSON] = torch.tensor([250, 20, 230], dtype=torch.uint8)
    shown: list[Any] = []
    trainer: Any = SimpleNamespace(progress=0.5, gaussians=wall(), show=shown.append)
    for _ in range(2):
        train_without_transients(trainer, views, None, tmp_path / "transients.npz", Progress(quiet=True))  # type: ignore[arg-type]
        trainer.gaussians = None  # nothing to compare with: the file must do
    first, second = shown
    assert [view.weight is None for view in first] == [True, True, False, True, True]
    assert not first[2].weight[PERSON].any() and torch.equal(first[2].weight, second[2].weight)
