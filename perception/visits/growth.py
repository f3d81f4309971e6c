"""Adds Gaussians where a visit shows something else than the map, and trains them with the rest held."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch

from perception.changes.carving import carved_surface
from perception.changes.evidence import AGREE, mask_odds
from perception.changes.look import DIFFERENT, Look
from perception.config import MapConfig
from perception.gaussians.depth_start import start_on_surface
from perception.gaussians.model import Gaussians, from_points
from perception.gaussians.state import USUAL_PHOTOS, TrainRecord, sized
from perception.gaussians.train import Trainer
from perception.gaussians.views import TrainingView
from perception.instances.assign import LEAST_AGREEMENT, affinities, mask_shares
from perception.instances.group import Grouping, group
from perception.masks.votes import MaskVotes
from perception.pipeline.checkpoint import TrainingObserver
from perception.visits.visit import Visit

GROWING, SETTLING = 0.16, 0.1
"""Iterations of the two legs of an update, relative to those of a new map."""
LEAST_ITERATIONS = 100
SHIFTED = 0.01
"""Relative difference of depth from which a pixel of a mask that the map does not explain shows a new surface."""
APART = 2.0
"""Spacings of carved points from which one is not of a measured surface."""
UNSURE = 0.2
"""Their first opacity: at .1 a mug of 15 pixels stays thin in the few iterations, from .5 on wrong ones hide others."""
SPARE = 3
"""Gaussians that may grow in an update, relative to those that it starts from."""


def changed_pixels(shown: Look) -> np.ndarray:
    """[h, w] bool: pixels that are not ignored whose surface the map lacks: where it shows none, and where the masks
    that it does not explain have another depth or colour than it."""
    changed = shown.mapped == 0
    foreign = mask_odds(shown)[0] < 0
    apart = np.abs(shown.measured / np.maximum(shown.mapped, 1e-6) - 1)
    local = shown.product < 0.3 * np.sqrt(np.maximum(shown.rendered * shown.shown, 0))
    other = shown.colour > DIFFERENT
    changed |= (foreign[shown.labels] & ((apart > SHIFTED) | other)) | (other & local & (apart > AGREE))
    return changed & shown.counts


def new_surface(looks: Sequence[Look], like: Gaussians, budget: int, seed: int) -> Gaussians:
    """Gaussians on the surface of all changed pixels, measured or else carved; none where nothing changed. like: of the
    map."""
    from scipy.spatial import cKDTree

    views, changed = [], [changed_pixels(shown) for shown in looks]
    for shown, pixels in zip(looks, changed, strict=True):
        depth = np.where(pixels, shown.measured, 0).astype(np.float32)
        views.append(replace(shown.view, depth=torch.from_numpy(depth)))
    none, size = np.zeros((0, 3)), like.features.shape[1]
    measured = start_on_surface(views, none, none.astype(np.uint8), budget, size, seed)
    parts = [] if measured is None else [measured]
    known = none if measured is None else measured.means.double().numpy()
    carved = carved_surface(looks, changed, known)
    away = cKDTree(known).query(carved.points)[0] > APART * carved.side
    if away.any():
        parts.append(from_points(carved.points[away], carved.colors[away], feature_dim=size, seed=seed, opacity=UNSURE))
    if not parts:
        return like.rows(torch.zeros(0, dtype=torch.long))
    return Gaussians.concatenate(parts).with_coefficients(like.sh.shape[1])


def update_config(config: MapConfig, photos: int, share: float, start: int, alone: bool = False) -> MapConfig:
    """The settings of one leg of training: `share` of the iterations of a new map, fewer for a few photos, as these see
    little; at most `start` Gaussians, and its part of a time limit, which is all where it is the only leg."""
    part = 1.0 if alone else share / (GROWING + SETTLING)
    share *= min(1.0, photos / USUAL_PHOTOS)
    iterations = max(LEAST_ITERATIONS, round(share * sized(config, photos).train.iterations))
    train = config.part(part).train.model_copy(update={"iterations": iterations, "budget": max(1, start)})
    return config.model_copy(update={"train": train})


def trained(
    visit: Visit,
    leg: str,
    share: float,
    gaussians: Gaussians,
    held: int,
    rehearsed: Sequence[TrainingView],
    alone: bool = False,
    fixed: np.ndarray | None = None,
) -> tuple[Gaussians, TrainRecord]:
    """Trains one leg on the photos and on what is `rehearsed`: all of the Gaussians beyond the first `held` rows, and
    the colours of those but for the ones that are `fixed` [held] bool. From its checkpoint on, if there is one that
    began with these Gaussians: other settings of instances, or more time for the leg before, give others. On the CPU.
    share, alone: see `update_config`."""
    run, photos = visit.run, visit.photos
    config = update_config(run.config, len(photos.views), share, held + SPARE * (len(gaussians) - held), alone)
    start = hashlib.sha256()
    for tensor in gaussians.named().values():
        start.update(tensor.contiguous().numpy().data)
    work = run.work / f"leg-{leg}-{start.hexdigest()[:16]}"
    work.mkdir(exist_ok=True)
    trainer = Trainer(gaussians, [*photos.views, *rehearsed], config, photos.held, run.device, held=held, fixed=fixed)
    trainer.stopping.degree_decided = True  # the map's
    observer = TrainingObserver(work, visit.mark, "", 0.0, run.progress)  # the mark is also of the masks
    observer.take_up(trainer)
    with run.stage("train"):
        record = trainer.run(observer)
    return trainer.gaussians.to("cpu"), record


def joined_instances(votes: MaskVotes, ids: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """[R] int32: of the new Gaussians `rows` [R], the instance whose masks they lie in, −1 = none. ids [N]: instances
    of all Gaussians, −1 = none (the new ones among them)."""
    known, number = np.unique(ids[ids >= 0], return_inverse=True)
    if len(known) == 0 or len(rows) == 0:
        return np.full(len(rows), -1, np.int32)
    dense = np.full(len(ids), -1, np.int32)
    dense[ids >= 0] = number
    affinity = affinities(votes, mask_shares(votes.of_groups(dense, len(known))), rows)[0].toarray()
    best = affinity.argmax(axis=1)
    return np.where(affinity[np.arange(len(rows)), best] >= LEAST_AGREEMENT, known[best], -1).astype(np.int32)


def grouped(gaussians: Gaussians, votes: MaskVotes, rows: np.ndarray, config: MapConfig) -> Grouping:
    """Instances of the Gaussians `rows`, from where they lie and the masks, whatever `instances.method` made the map:
    their features were trained too shortly to tell things apart, and join a speaker with a chair a metre beside it."""
    part = gaussians.rows(torch.from_numpy(rows))
    own = MaskVotes(votes.pixels[rows], votes.void[rows], votes.view, votes.area, votes.label)
    means, scales, opacities = (tensor.numpy() for tensor in (part.means, part.scales, part.opacities))
    none = np.zeros((len(rows), 1), np.float32)
    options = config.instances.model_copy(update={"method": "consensus"})
    return group(means, scales, opacities, none, own, options, seed=config.seed, whole=False)
