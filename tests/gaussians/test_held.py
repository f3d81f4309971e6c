"""Training with held rows: nothing but their colours changes, and nothing of those that are fixed or not seen."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from perception.config import load_config
from perception.gaussians import model
from perception.gaussians.model import HeldGaussians, from_points
from perception.gaussians.train import Trainer
from perception.gaussians.views import TrainingView

HELD, BEHIND, FIXED = 40, 10, 25


@pytest.mark.parametrize("fixed", [None, np.arange(HELD) >= FIXED], ids=["none fixed", "some fixed"])
def test_held_rows_keep_all_but_their_colours(fixed: np.ndarray | None) -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform(-1, 1, (80, 3)) + np.array([0, 0, 4])
    points[:BEHIND, 2] *= -1  # behind all cameras
    gaussians = from_points(points, rng.integers(0, 255, (80, 3)).astype(np.uint8), feature_dim=4, seed=0, opacity=0.6)
    gaussians.opacity_logits[5:HELD:3] = -9.0  # nearly transparent: they would be pruned
    before = gaussians.rows(torch.arange(80))
    K = torch.tensor([[40.0, 0, 24], [0, 40, 16], [0, 0, 1]])
    views = []
    for n in range(3):
        pose = torch.eye(4)
        pose[0, 3] = 0.3 * n
        photo = torch.from_numpy(rng.integers(0, 255, (32, 48, 3)).astype(np.uint8))
        views.append(TrainingView(str(n), photo, None, K, pose))
    config = load_config(None, ["train.iterations=200", "train.budget=200", "densify.every=20", "train.sh_degree=0"])
    trainer = Trainer(gaussians, views, config, [], held=HELD, fixed=fixed)
    trainer.run()
    after = trainer.gaussians
    assert len(after) > HELD
    for name, tensor in before.named().items():
        same = (after.named()[name][:HELD] == tensor[:HELD]).flatten(1 if tensor.ndim > 1 else 0)
        assert name == "sh" or bool(same.all()), name
    assert torch.equal(after.sh[:BEHIND], before.sh[:BEHIND])
    assert not torch.equal(after.sh[BEHIND:FIXED], before.sh[BEHIND:FIXED])
    assert torch.equal(after.sh[FIXED:HELD], before.sh[FIXED:HELD]) == (fixed is not None)


def test_those_not_held_lie_along_a_curve_with_all_that_is_theirs() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform(-1, 1, (400, 3)) + np.array([0, 0, 4])
    gaussians = from_points(points, rng.integers(0, 255, (400, 3)).astype(np.uint8), feature_dim=4, seed=0)
    view = TrainingView("", torch.zeros(32, 48, 3, dtype=torch.uint8), None, torch.eye(3), torch.eye(4))
    trainer = Trainer(gaussians, [view], load_config(None, []), [], held=HELD)
    for table in (trainer.optimiser._first, trainer.optimiser._second):
        table["means"].copy_(trainer.gaussians.means)
    means = trainer.gaussians.means.clone()
    trainer.arrange()
    found = trainer.gaussians.means
    assert torch.equal(found[:HELD], means[:HELD])
    assert sorted(found.tolist()) == sorted(means.tolist())
    steps = [float((rows[HELD + 1 :] - rows[HELD:-1]).norm(dim=1).mean()) for rows in (means, found)]
    assert steps[1] < 0.4 * steps[0]  # neighbours in memory are neighbours in space
    for table in (trainer.optimiser._first, trainer.optimiser._second):
        assert torch.equal(table["means"], found)


def test_held_gaussians_are_activated_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Inputs of the second camera are those of Gaussians that may change, bit for bit; features may still change."""
    rng = np.random.default_rng(0)
    free = from_points(rng.random((50, 3)), rng.integers(0, 256, (50, 3), np.uint8), feature_dim=4, seed=0)
    held, calls, activate = HeldGaussians(**free.named()), list[int](), model.sigmoid
    monkeypatch.setattr(model, "sigmoid", lambda logits: calls.append(1) or activate(logits))
    for shift in (0.0, 1.0):
        pose = torch.eye(4) + shift * torch.tensor([[0, 0, 0, 1.0], [0] * 4, [0] * 4, [0] * 4])
        inputs = held.inputs(pose, torch.eye(3), held.features)
    assert len(calls) == 1
    expected = free.inputs(pose, torch.eye(3), free.features)
    for name in ("means", "quats", "scales", "opacities", "colors", "viewmats", "features"):
        assert torch.equal(getattr(inputs, name), getattr(expected, name)), name
    held.features += 1
    assert torch.equal(held.inputs(pose, torch.eye(3), held.features).features, held.features)
