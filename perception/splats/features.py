"""Trains the instance features of a finished Gaussian scene, with geometry and colours held."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

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


@torch_on_one_thread()
def train_features(
    gaussians: Gaussians, views: Sequence[TrainingView], config: MapConfig, progress: Progress
) -> TrainRecord:
    """Changes `gaussians.features` by λ_inst2d L_inst2d + λ_var L_var (eq. 14) over `feature_steps`, one view a step,
    in a new random order each epoch. Views without labels are left out."""
    losses, device = config.losses, gaussians.means.device
    shown = [view.halved() if losses.half_resolution else view for view in views]
    shown = [view for view in shown if view.labels is not None and bool((view.labels > 0).any())]
    record = TrainRecord(iterations=feature_steps(config, len(views)) if shown else 0)
    optimiser = SparseAdam({"features": gaussians.features})
    gradients = Gradients(features=torch.zeros_like(gaussians.features))
    labels = [assign_labels(view.labels, view.keep).to(device) for view in shown if view.labels is not None]
    for step in range(record.iterations):
        epoch, turn = divmod(step, len(shown))
        n = int(np.random.default_rng([config.seed, epoch]).permutation(len(shown))[turn])
        view = shown[n]
        if step == 0:
            fixed = gaussians.inputs(view.camera_from_world, view.K, gaussians.features)
        viewmats, Ks = view.camera_from_world[None].contiguous().to(device), view.K[None].contiguous().to(device)
        inputs = replace(fixed, viewmats=viewmats, Ks=Ks)
        settings = Settings(view.photo.shape[1], view.photo.shape[0], eps2d=view.eps2d, variance=True, depth=False)
        with record.timed("rasterizer"):
            out = rasterizer_for(device).rasterize_forward(inputs, settings)
        assert out.features is not None and out.feature_variance is not None  # for the type checker
        weight = torch.ones(1) if view.weight is None else view.weight[..., None]
        weight = weight.to(device)
        _, spread = variance_loss(out.feature_variance[0] * weight, losses.variance_weight)  # λ_var L_var, eq. 13
        w = INSTANCE_WEIGHT
        inst = instance_loss(out.features[0], labels[n], margin=losses.margin, w_pos=w, w_neg=w)  # eqs. 6 to 9
        by_image = Cotangents(features=inst.gradient[None], feature_variance=(spread * weight)[None].contiguous())
        with record.timed("rasterizer"):
            rasterizer_for(device).rasterize_backward(inputs, settings, out, by_image, gradients, stored=True)
        rate = FEATURES * cooling(step / record.iterations)
        optimiser.step({"features": rate}, {"features": gradients.features}, out.visible[0])
        record.pairs += out.frames.contributing
        progress.update("features", step + 1, record.iterations)
    record.seconds = sum(record.profile.values())
    record.decisions.append("features alone were trained: geometry and colours are the input's")
    return record
