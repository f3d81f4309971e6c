"""Adds Gaussians where a visit shows something else than the map, and trains them with the rest held."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch

from perception.config import MapConfig
from perception.gaussians.depth_start import start_on_surface
from perception.gaussians.model import Gaussians
from perception.gaussians.state import USUAL_PHOTOS, TrainRecord, sized
from perception.gaussians.train import Trainer
from perception.instances.assign import LEAST_AGREEMENT, affinities, mask_shares
from perception.instances.group import Grouping, group
from perception.masks.votes import MaskVotes
from perception.pipeline.checkpoint import TrainingObserver
from perception.pipeline.optimise import Photos, Run
from perception.visits.evidence import AGREE, LEAST_PIXELS, WEIGHTS
from perception.visits.look import DIFFERENT, Look, correlation

GROWING, SETTLING = 0.16, 0.1
"""Iterations of the two legs of an update, relative to those of a new map."""
LEAST_ITERATIONS = 100
SHIFTED = 0.01
"""Relative difference of depth from which a pixel of a mask that the map does not explain shows a new surface."""
SPARE = 3
"""Gaussians that may grow in an update, relative to those that it starts from."""


def changed_pixels(shown: Look) -> np.ndarray:
    """[h, w] bool: pixels whose surface the map lacks: where it shows none, and where the masks that it does not
    explain have another depth or colour than it."""
    changed = shown.mapped == 0
    labels, areas = shown.labels, np.bincount(shown.labels.ravel())
    sums = [np.bincount(labels.ravel(), image.ravel().astype(np.float64)) for image in (shown.product, shown.rendered)]
    sums += [np.bincount(labels.ravel(), image.ravel().astype(np.float64)) for image in (shown.shown, shown.colour)]
    (slope, middle), (per_colour, usual) = WEIGHTS["correlation"], WEIGHTS["colour"]
    foreign = np.zeros(len(areas), bool)
    for label in np.flatnonzero(areas >= LEAST_PIXELS):
        product, a, b, colour = (total[label] for total in sums)
        odds = slope * (correlation(product, a, b) - middle) + per_colour * (colour / areas[label] - usual)
        foreign[label] = odds < 0
    foreign[0] = False
    off = np.abs(shown.measured / np.maximum(shown.mapped, 1e-6) - 1) > SHIFTED
    local = shown.product < 0.3 * np.sqrt(np.maximum(shown.rendered * shown.shown, 0))
    unlike = (shown.colour > DIFFERENT) & local & (np.abs(shown.measured / np.maximum(shown.mapped, 1e-6) - 1) > AGREE)
    return np.asarray(changed | (foreign[labels] & (off | (shown.colour > DIFFERENT))) | unlike)


def new_surface(looks: Sequence[Look], like: Gaussians, budget: int, seed: int) -> Gaussians:
    """Gaussians on the measured surface of all changed pixels; none where nothing has changed. like: of the map."""
    views = []
    for shown in looks:
        depth = np.where(changed_pixels(shown), shown.measured, 0).astype(np.float32)
        views.append(replace(shown.view, depth=torch.from_numpy(depth)))
    none = np.zeros((0, 3))
    made = start_on_surface(views, none, none.astype(np.uint8), budget, like.features.shape[1], seed)
    if made is None:
        return like.rows(torch.zeros(0, dtype=torch.long))
    more = made.sh.new_zeros(len(made), like.sh.shape[1] - 1, 3)
    return replace(made, sh=torch.cat([made.sh, more], dim=1))


def update_config(config: MapConfig, photos: int, share: float, start: int) -> MapConfig:
    """The settings of one leg of training: `share` of the iterations of a new map, fewer for a few photos, as these see
    little; at most `start` Gaussians."""
    share *= min(1.0, photos / USUAL_PHOTOS)
    iterations = max(LEAST_ITERATIONS, round(share * sized(config, photos).train.iterations))
    train = config.train.model_copy(update={"iterations": iterations, "budget": max(1, start)})
    return config.model_copy(update={"train": train})


def trained(
    run: Run, leg: str, mark: str, masks: str, gaussians: Gaussians, held: int, photos: Photos, config: MapConfig
) -> tuple[Gaussians, TrainRecord]:
    """Trains one leg, from its checkpoint on if there is one: all of the Gaussians beyond the first `held` rows, and
    the colours of those. On the CPU."""
    work = run.work / f"leg-{leg}"
    work.mkdir(exist_ok=True)
    trainer = Trainer(gaussians, photos.views, config, photos.held, run.device, held=held)
    trainer.stopping.degree_decided = True  # the map's
    observer = TrainingObserver(work, mark, masks, 0.0, run.progress)
    observer.take_up(trainer)
    with run.stage("train"):
        record = trainer.run(observer)
    return trainer.gaussians.to("cpu"), record


def joined_instances(votes: MaskVotes, ids: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """[R] int32: of the new Gaussians `rows` [R], the instance whose masks they lie in, −1 = none. ids [N]: instances
    of all Gaussians, −1 = none (the new ones among them)."""
    count = int(ids.max(initial=-1)) + 1
    joined = np.full(len(rows), -1, np.int32)
    if count == 0 or len(rows) == 0:
        return joined
    affinity = affinities(votes, mask_shares(votes.of_groups(ids, count)), rows)[0].toarray()
    best = affinity.argmax(axis=1)
    good = affinity[np.arange(len(rows)), best] >= LEAST_AGREEMENT
    joined[good] = best[good]
    return joined


def grouped(gaussians: Gaussians, votes: MaskVotes, rows: np.ndarray, config: MapConfig) -> Grouping:
    """Instances of the Gaussians `rows`, from their features and the masks."""
    part = gaussians.rows(torch.from_numpy(rows))
    own = MaskVotes(votes.pixels[rows], votes.void[rows], votes.view, votes.area, votes.label)
    tensors = (part.means, part.scales, part.opacities, part.features)
    means, scales, opacities, features = (tensor.numpy() for tensor in tensors)
    arrays, margin = (means, scales, opacities, features), config.losses.margin
    return group(*arrays, own, config.instances, margin=margin, seed=config.seed, whole=False)
