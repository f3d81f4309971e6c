"""Masks of what moved are made once: a resumed run reads them instead of comparing photos with another map."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import torch

from perception.pipeline.transients import train_without_transients
from perception.progress import Progress
from support.wall_photos import PERSON, photographed, wall


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
