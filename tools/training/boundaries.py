"""Trains the network of object borders of `perception.masks.boundaries`; `python tools training.masks` calls it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch
import torch.nn.functional as F

from perception.masks.boundaries import OUTPUTS, REACH, forward, scaled, shapes

if TYPE_CHECKING:
    from perception.masks.boundaries import Layers

STEPS, BATCH = 5000, 8
RATE = 3e-3
THING = 0.3  # weight of the third output
CHANNELS = {"lab": slice(0, 3), "normal x": 3, "geometry": slice(3, 11), "depth": 10}


def targets_of(ids: np.ndarray, stuff: list[int]) -> np.ndarray:
    """[3, h, w] uint8, what `boundaries` should tell: 0 or 1; 2 where it is unknown. ids: [h, w] true ids, 0 = unknown;
    stuff: those of floors, walls and tables."""
    targets = np.full((OUTPUTS, *ids.shape), 2, np.uint8)
    for target, image in ((targets[0], ids), (targets[1].T, ids.T)):
        before, after = image[:, : -2 * REACH], image[:, 2 * REACH :]
        target[:, REACH:-REACH] = np.where((before > 0) & (after > 0), before != after, 2)
    targets[2] = np.where(ids > 0, ~np.isin(ids, stuff), 2)
    return targets


def train(inputs: np.ndarray, targets: np.ndarray, seed: int, steps: int = STEPS) -> Layers:
    """The layers after `steps` of AdamW on the cross entropy. inputs: [N, 11, h, w] uint8 of `inputs_of`; targets:
    [N, 3, h, w] uint8."""
    torch.manual_seed(seed)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # sums of one order
    layers = [
        ((torch.randn(o, i, k, k) * (2 / (i * k * k)) ** 0.5).requires_grad_(), torch.zeros(o, requires_grad=True))
        for o, i, k in shapes()
    ]
    parts = [part for layer in layers for part in layer]
    optimiser = torch.optim.AdamW(parts, weight_decay=1e-3)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, RATE, total_steps=steps)
    for _ in range(steps):
        some = torch.randint(len(inputs), (BATCH,)).numpy()
        x, y = augmented(scaled(torch.from_numpy(inputs[some])), torch.from_numpy(targets[some]))
        known = (y < 2).float()
        loss = F.binary_cross_entropy_with_logits(forward(layers, x), y.clamp(max=1).float(), known, reduction="none")
        means = loss.sum(dim=(0, 2, 3)) / known.sum(dim=(0, 2, 3)).clamp(min=1)
        optimiser.zero_grad()
        (means @ torch.tensor([1.0, 1.0, THING])).backward()
        torch.nn.utils.clip_grad_norm_(parts, 1.0)
        optimiser.step()
        schedule.step()
    torch.set_num_threads(threads)
    return [(weight.detach(), offset.detach()) for weight, offset in layers]


def augmented(x: torch.Tensor, y: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Inputs [B, 11, h, w] and targets in other light and colours, with noise, blurred, mirrored, and some without
    colour or without geometry."""
    count = len(x)

    def normal(spread: float) -> torch.Tensor:
        return spread * torch.randn(count, 1, 1)

    x = x.clone()
    if torch.rand(()) < 0.5:
        x, y = x.flip(-1), y.flip(-1)
        x[:, CHANNELS["normal x"]] *= -1
    light, red, blue = x[:, CHANNELS["lab"]].unbind(dim=1)
    light = light * (1 + normal(0.25)) + normal(0.15)
    turn, size = normal(0.5), torch.exp(normal(0.3)) * (torch.rand(count, 1, 1) > 0.05)
    colours = (turn.cos() * red - turn.sin() * blue, turn.sin() * red + turn.cos() * blue)
    lab = torch.stack([light, *(size * colour + normal(0.05) for colour in colours)], dim=1)
    lab = lab + 0.06 * torch.rand(count, 1, 1, 1) * torch.randn_like(lab)
    if torch.rand(()) < 0.3:
        lab = F.avg_pool2d(lab, 3, 1, 1)
    x[:, CHANNELS["depth"]] += normal(0.2)
    geometry = x[:, CHANNELS["geometry"]]
    geometry = geometry + 0.04 * torch.randn(count, 1, 1, 1) * torch.randn_like(geometry)
    return torch.cat([lab, geometry * (torch.rand(count, 1, 1, 1) > 0.1)], dim=1), y
