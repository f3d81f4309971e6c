"""Trains the instance features of a finished Gaussian scene, with geometry and colours held."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, replace
from typing import Any, Protocol

import numpy as np
import torch

from perception.config import MapConfig
from perception.gaussians.losses import assign_labels, instance_loss, variance_loss
from perception.gaussians.model import Gaussians
from perception.gaussians.optimiser import SparseAdam
from perception.gaussians.schedule import FEATURES, cooling
from perception.gaussians.state import TrainRecord, sized
from perception.gaussians.train import INSTANCE_WEIGHT
from perception.gaussians.views import TrainingView
from perception.interrupts import uninterrupted
from perception.machine import torch_on_one_thread
from perception.progress import Progress
from perception.rasterizer.rasterize import rasterizer_for
from perception.rasterizer.types import Cotangents, Gradients, Settings


def new_features(count: int, config: MapConfig) -> torch.Tensor:
    """[count, D] random features to start from."""
    generator = torch.Generator().manual_seed(config.seed)
    return torch.rand(count, config.losses.feature_dim, generator=generator) - 0.5


def feature_steps(config: MapConfig, views: int) -> int:
    """As many steps as train features in a map of as many photos."""
    losses = config.losses
    return max(1, round(sized(config, views).train.iterations * (1 - losses.start) / losses.every))


class Checkpoints(Protocol):
    """Where the state of a training is kept, so that one that was stopped goes on."""

    def load(self) -> dict[str, Any] | None:
        """The state that was saved last, if any."""

    def save(self, state: dict[str, Any], at_once: bool = False) -> None:
        """Called after every step, and `at_once` when the training ends or is interrupted. The tensors in `state` are
        those of now until the next step."""


@torch_on_one_thread()
def train_features(
    gaussians: Gaussians,
    views: Sequence[TrainingView],
    config: MapConfig,
    progress: Progress,
    checkpoints: Checkpoints | None = None,
) -> TrainRecord:
    """Changes `gaussians.features` by λ_inst2d L_inst2d + λ_var L_var (eq. 14) over `feature_steps`, one view a step,
    in a new random order each epoch. Views without labels are left out."""
    losses, device = config.losses, gaussians.means.device
    shown = [view.halved() if losses.half_resolution else view for view in views]
    shown = [view for view in shown if view.labelled]
    steps = feature_steps(config, len(views)) if shown else 0
    record, optimiser = TrainRecord(), SparseAdam({"features": gaussians.features})
    if checkpoints is not None and (state := checkpoints.load()) is not None:
        record = TrainRecord(**state["record"])
        gaussians.features.copy_(state["optimiser"]["params"]["features"])
        optimiser.load_state_dict(state["optimiser"] | {"params": {}})
    gradients = Gradients(features=torch.zeros_like(gaussians.features))
    labels = [assign_labels(view.labels, view.keep).to(device) for view in shown if view.labels is not None]
    fixed = [gaussians.inputs(view.camera_from_world, view.K, gaussians.features) for view in shown[:1]]

    def save(at_once: bool = False) -> None:
        if checkpoints is not None:
            checkpoints.save({"optimiser": optimiser.state_dict(copy=False), "record": asdict(record)}, at_once)

    def step(n: int) -> None:
        view = shown[n]
        viewmats, Ks = view.camera_from_world[None].contiguous().to(device), view.K[None].contiguous().to(device)
        inputs = replace(fixed[0], viewmats=viewmats, Ks=Ks)
        settings = Settings(view.photo.shape[1], view.photo.shape[0], eps2d=view.eps2d, variance=True, depth=False)
        with record.timed("rasterizer"):
            out = rasterizer_for(device).rasterize_forward(inputs, settings)
        assert out.features is not None and out.feature_variance is not None  # for the type checker
        weight = (torch.ones(1) if view.weight is None else view.weight[..., None]).to(device)
        _, spread = variance_loss(out.feature_variance[0] * weight, losses.variance_weight)  # λ_var L_var, eq. 13
        w = INSTANCE_WEIGHT
        inst = instance_loss(out.features[0], labels[n], margin=losses.margin, w_pos=w, w_neg=w)  # eqs. 6 to 9
        by_image = Cotangents(features=inst.gradient[None], feature_variance=(spread * weight)[None].contiguous())
        with record.timed("rasterizer"):
            rasterizer_for(device).rasterize_backward(inputs, settings, out, by_image, gradients, stored=True)
        rate = FEATURES * cooling(record.iterations / steps)
        optimiser.step({"features": rate}, {"features": gradients.features}, out.visible[0])
        record.pairs += out.frames.contributing
        record.iterations += 1

    try:
        while record.iterations < steps:
            epoch, turn = divmod(record.iterations, len(shown))
            with uninterrupted():
                step(int(np.random.default_rng([config.seed, epoch]).permutation(len(shown))[turn]))
            save()
            progress.update("features", record.iterations, steps)
    finally:
        save(at_once=True)
    record.seconds = sum(record.profile.values())
    record.decisions.append("features alone were trained: geometry and colours are the input's")
    return record
