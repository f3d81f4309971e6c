"""Trains the head of borders on the maps of a frozen ImageNet network.

python tools training.heads WORK

Worlds are those of `training.masks` and three of `training.crowds` in each set. The packaged weights are those of one
set. WORK keeps the worlds and the state, so that a run that was stopped goes on. Equal seeds give equal weights.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
import torch
import torch.nn.functional as F

from perception.masks.boundaries import inputs_of, scaled
from perception.masks.head import (
    DIRECT,
    OFFSETS,
    OUTPUTS,
    PROJECTED,
    THING,
    WEIGHTS,
    backbone,
    enlarged,
    forward,
    shapes,
)
from training import crowds, masks
from training.boundaries import CHANNELS
from worlds import scene as scenes

if TYPE_CHECKING:
    from perception.masks.boundaries import Layers
    from perception.masks.stereo import StereoView

scenes.SCENES |= {"crowds": crowds}
SCENES = (*masks.SCENES, ("crowds", 5000, 3), ("crowds", 5001, 3), ("crowds", 5002, 3))  # first seed, step
VIEWS = 6  # of a reading; others in the two readings of a world
STEPS, BATCH, RATE = 425, 6, 3e-3
CYCLE, FALL = 600, 100  # steps: of the schedule of the rate, and the last ones, in which it falls to 0
CROP, GRID = (160, 224), 32  # of a photo, in pixels; its place, which the maps of all strides share
COPIES = 3  # of each photo, in other light
STUFF = 1 << 14  # added to the ids of floors, walls and tables
BLIND = 0.25  # share of samples without geometry
SAVED = 25  # steps


@dataclass
class Photos:
    """N augmented photos of one size. inputs: [N, 11, h, w] uint8; ids: [N, h, w] int16, 0 = unknown, of floors, walls
    and tables STUFF more; maps: of the frozen network, [N, C, h / s, w / s] float16 each."""

    inputs: np.ndarray
    ids: np.ndarray
    maps: list[np.ndarray]

    @classmethod
    def joined(cls, parts: list[Photos]) -> Photos:
        maps = [np.concatenate(level) for level in zip(*(part.maps for part in parts), strict=True)]
        return cls(*(np.concatenate([getattr(part, name) for part in parts]) for name in ("inputs", "ids")), maps)


def photos_of(views: list[StereoView], ids: list[np.ndarray], stuff: list[int], seed: int) -> Photos:
    """COPIES of each of the views, in other light and colours, with noise, blurred, mirrored."""
    rng, inputs, images, truths = np.random.default_rng(seed), [], [], []
    for view, truth in zip(views, ids, strict=True):
        seen = inputs_of(*view.cues())
        for _ in range(COPIES):
            rgb, x = in_other_light(view.photo, rng), seen.copy()
            told = (truth + STUFF * np.isin(truth, stuff)).astype(np.int16)
            if rng.random() < 0.5:
                rgb, x, told = np.ascontiguousarray(rgb[:, ::-1]), x[:, :, ::-1].copy(), told[:, ::-1]
                x[CHANNELS["normal x"]] = 255 - x[CHANNELS["normal x"]]
            x[CHANNELS["lab"]] = cv2.cvtColor(rgb, cv2.COLOR_RGB2LAB).transpose(2, 0, 1)
            for column, value in zip((inputs, images, truths), (x, rgb, told), strict=True):
                column.append(value)
    with torch.inference_mode():
        maps = [[m[0].half().numpy() for m in backbone().maps(torch.from_numpy(rgb)[None])] for rgb in images]
    return Photos(np.stack(inputs), np.stack(truths), [np.stack(level) for level in zip(*maps, strict=True)])


def in_other_light(rgb: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Another exposure, contrast, tint and saturation, noise, sometimes a blur. [h, w, 3] uint8."""
    light, red, blue = np.moveaxis(cv2.cvtColor(rgb, cv2.COLOR_RGB2LAB).astype(np.float32) / 127.5 - 1, 2, 0)
    light = light * (1 + 0.25 * rng.normal()) + 0.2 * rng.normal()
    turn, size = 0.5 * rng.normal(), np.exp(0.3 * rng.normal()) * (rng.random() > 0.05)
    red, blue = np.cos(turn) * red - np.sin(turn) * blue, np.sin(turn) * red + np.cos(turn) * blue
    lab = np.stack([light, *(size * color + 0.05 * rng.normal() for color in (red, blue))], axis=-1)
    if rng.random() < 0.4:
        lab = cv2.GaussianBlur(lab.astype(np.float32), (0, 0), rng.uniform(0.5, 1.5))
    lab = lab + 0.06 * rng.random() * rng.normal(size=lab.shape)
    return np.asarray(cv2.cvtColor(((lab + 1) * 127.5).clip(0, 255).astype(np.uint8), cv2.COLOR_LAB2RGB))


def targets_of(ids: np.ndarray) -> np.ndarray:
    """[11, h, w] uint8, what the head should tell: 0 or 1; 2 where it is unknown. ids: see `Photos`."""
    h, w = ids.shape
    targets = np.full((OUTPUTS, h, w), 2, np.uint8)

    def differ(k: int, a: np.ndarray, b: np.ndarray, where: tuple[slice, slice]) -> None:
        targets[k][where] = np.where((a > 0) & (b > 0), a != b, 2)

    differ(DIRECT.start, ids[:, :-1], ids[:, 1:], np.s_[:, :-1])
    differ(DIRECT.start + 1, ids[:-1], ids[1:], np.s_[:-1, :])
    for k, (x, y) in OFFSETS.items():
        up = abs(y)
        before, after = ids[up - y : h - up - y, : w - 2 * x], ids[up + y : h - up + y, 2 * x :]
        differ(k, before, after, np.s_[up : h - up, x : w - x])
    targets[THING] = np.where(ids > 0, ids < STUFF, 2)
    return targets


def train(photos: Photos, seed: int, aside: Path, steps: int = STEPS) -> Layers:
    """The layers after `steps` of AdamW on the cross entropy. aside: a file that keeps the state, so that a run that
    was stopped goes on. The maps are normalised for training; the layers returned take them as they are."""
    torch.manual_seed(seed)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # sums of one order
    means, scales = zip(*(_statistics(level) for level in photos.maps), strict=True)
    layers = [
        ((torch.randn(o, i, k, k) * (2 / (i * k * k)) ** 0.5).requires_grad_(), torch.zeros(o, requires_grad=True))
        for o, i, k in shapes()
    ]
    parts = [part for layer in layers for part in layer]
    optimiser = torch.optim.AdamW(parts, weight_decay=1e-3)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, RATE, total_steps=max(CYCLE, steps))
    first = _restored(aside, parts, optimiser, schedule)
    weights = torch.tensor([0.25] * OUTPUTS)
    weights = torch.cat([weights, torch.ones(2)])  # borders between neighbours also at the photos' resolution
    weights[THING], weights[DIRECT] = 0.3, 0.0
    for step in range(first, steps):
        rng = np.random.default_rng((seed, step))
        x, maps, ids = _drawn(photos, rng)
        x = without_geometry(x, rng).contiguous(memory_format=torch.channels_last)
        maps = [(level - mean) / scale for level, mean, scale in zip(maps, means, scales, strict=True)]
        y = torch.from_numpy(np.stack([targets_of(image) for image in ids]))
        odds, (i, j) = forward(layers, x, maps), rng.integers(2, size=2)
        losses = torch.cat([_losses(odds, y[:, :, i::2, j::2]), _losses(enlarged(odds[:, DIRECT], x), y[:, DIRECT])])
        optimiser.zero_grad()
        (losses @ weights).backward()
        torch.nn.utils.clip_grad_norm_(parts, 1.0)
        for group in optimiser.param_groups:  # set anew by the schedule
            group["lr"] *= min(1.0, (steps - step) / FALL)
        optimiser.step()
        schedule.step()
        if step % SAVED == SAVED - 1:
            print(f"head: step {step + 1} of {steps}, losses {[round(v, 3) for v in losses.tolist()]}", flush=True)
            state = (step + 1, [part.detach() for part in parts], optimiser.state_dict(), schedule.state_dict())
            torch.save(state, aside.with_suffix(".part"))
            aside.with_suffix(".part").replace(aside)
    torch.set_num_threads(threads)
    return _folded([(weight.detach(), offset.detach()) for weight, offset in layers], means, scales)


def _drawn(photos: Photos, rng: np.random.Generator) -> tuple[torch.Tensor, list[torch.Tensor], np.ndarray]:
    """BATCH crops: scaled inputs, maps and ids."""
    some = rng.choice(len(photos.ids), BATCH, replace=False)
    places = (np.array(photos.ids.shape[1:]) - CROP) // GRID + 1
    y, x = (GRID * rng.integers(places)).tolist()
    maps = []
    for level, stride in zip(photos.maps, (2, 4, 8, 16, 32), strict=True):
        rows, columns = (slice(at // stride, (at + n) // stride) for at, n in zip((y, x), CROP, strict=True))
        maps.append(torch.from_numpy(level[some, :, rows, columns]).float())
    rows, columns = slice(y, y + CROP[0]), slice(x, x + CROP[1])
    return scaled(torch.from_numpy(photos.inputs[some, :, rows, columns])), maps, photos.ids[some, rows, columns]


def _losses(odds: torch.Tensor, told: torch.Tensor) -> torch.Tensor:
    """[C] mean cross entropy of each output [B, C, h, w], where the targets, uint8, are known."""
    known = (told < 2).float()
    every = F.binary_cross_entropy_with_logits(odds, told.clamp(max=1).float(), known, reduction="none")
    return every.sum(dim=(0, 2, 3)) / known.sum(dim=(0, 2, 3)).clamp(min=1)


def _restored(aside: Path, parts: list[torch.Tensor], optimiser, schedule) -> int:  # type: ignore[no-untyped-def]
    """The number of steps done, whose state is put into the other arguments."""
    if not aside.is_file():
        return 0
    step, values, *states = torch.load(aside, weights_only=True)
    with torch.no_grad():
        for part, value in zip(parts, values, strict=True):
            part.copy_(value)
    optimiser.load_state_dict(states[0])
    schedule.load_state_dict(states[1])
    return int(step)


def without_geometry(x: torch.Tensor, rng: np.random.Generator) -> torch.Tensor:
    """Inputs [B, 11, h, w] with noise in their geometry; a share BLIND without any."""
    count, (lab, geometry) = len(x), x.split([3, 8], dim=1)
    drawn = torch.from_numpy(rng.random((3, count, 1, 1, 1)).astype(np.float32))
    geometry = geometry + 0.08 * drawn[0] * torch.from_numpy(rng.standard_normal(geometry.shape, np.float32))
    geometry[:, -1] += 0.6 * drawn[1, :, 0] - 0.3
    return torch.cat([lab, geometry * (drawn[2] > BLIND)], dim=1)


def _statistics(maps: np.ndarray) -> tuple[torch.Tensor, torch.Tensor]:
    """Mean and standard deviation of each channel, [1, C, 1, 1]."""
    some = maps[:: max(1, len(maps) // 200)].astype(np.float32)
    mean, scale = some.mean(axis=(0, 2, 3)), some.std(axis=(0, 2, 3)) + 1e-3
    return torch.from_numpy(mean)[None, :, None, None], torch.from_numpy(scale)[None, :, None, None]


def _folded(layers: Layers, means: tuple[torch.Tensor, ...], scales: tuple[torch.Tensor, ...]) -> Layers:
    """Layers that normalise the maps themselves: w (x − m) / s + b = (w / s) x + (b − w m / s)."""
    first = next(k for k, (weight, _) in enumerate(layers) if weight.shape[2] == 1)
    for k, mean, scale in zip(range(first, first + len(PROJECTED)), means, scales, strict=True):
        weight, offset = layers[k]
        weight = weight / scale
        layers[k] = weight, offset - (weight * mean).sum(dim=(1, 2, 3))
    return layers


def photos_in(folder: Path, stereo: bool) -> Photos:
    """What is learned from one reading of a world."""
    reading = masks.make_reading(folder, stereo)
    some = np.random.default_rng(1).permutation(len(reading.views))[VIEWS * stereo :][:VIEWS].tolist()
    views, ids = ([column[k] for k in some] for column in (reading.views, reading.ids))
    return photos_of(views, ids, reading.stuff, seed=int(stereo))


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("work", type=Path, metavar="WORK", help="folder of the worlds")
    parser.add_argument("--worlds", type=int, default=1, metavar="N", help="sets of nine to train on (default 1)")
    parser.add_argument("-o", "--output", type=Path, default=WEIGHTS, metavar="FILE", help="default: the package")
    options = parser.parse_args(arguments)
    options.work.mkdir(parents=True, exist_ok=True)
    numbers = [k for k in range(2 * options.worlds) if k % 10 < 8][: options.worlds]
    jobs = masks.jobs_of(options.work, numbers, SCENES)
    with ProcessPoolExecutor(os.cpu_count(), initializer=masks._one_thread) as pool:
        photos = Photos.joined(list(pool.map(photos_in, *zip(*jobs, strict=True))))
    layers = train(photos, 0, options.work / "head_state.pt")
    np.savez_compressed(options.output, *(part.numpy().astype(np.float16) for layer in layers for part in layer))


if __name__ == "__main__":
    main()
