"""From trained Gaussians to described instances: group (§3.2.1), then silhouettes, views and embeddings (§3.2.2)."""

from __future__ import annotations

import itertools
from copy import copy
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
from scipy import sparse

from perception import _core
from perception.boxes import instance_entry
from perception.gaussians.model import Gaussians
from perception.gaussians.views import TrainingView
from perception.instances.crops import choose_views, view_scores
from perception.instances.describe import Unread, describe_instances
from perception.instances.group import Grouping, group
from perception.instances.levels import without_faint
from perception.instances.silhouettes import Silhouettes, view_silhouettes
from perception.instances.texts import read_texts, store_texts
from perception.instances.votes import joined_votes, mask_votes
from perception.language.base import Encoder, reading_of
from perception.language.description import to_arrays
from perception.language.ocr import TextReader
from perception.machine import return_free_memory
from perception.map.map import prefixed
from perception.masks.label_files import LARGEST
from perception.masks.merging import Segmentation
from perception.pipeline.optimise import Optimised, Run
from perception.pipeline.photo_tasks import by_tasks, silhouettes_by_tasks, votes_by_tasks
from perception.progress import Progress

NODE_VIEWS = 3  # views of each part and group; by one crop each, some of the many look like what is not there


@dataclass
class DescribedInstances:
    """ids [N] int32 (−1 = none), membership [N] float32, instances.json's list, facts for map.json, and the arrays of
    language.npz, parts.npz and groups.npz (see `map.write`)."""

    ids: np.ndarray
    membership: np.ndarray
    instances: list[dict[str, Any]] = field(default_factory=list)
    report: dict[str, Any] = field(default_factory=dict)
    language: dict[str, np.ndarray] = field(default_factory=dict)
    parts: dict[str, np.ndarray] = field(default_factory=dict)
    groups: dict[str, np.ndarray] = field(default_factory=dict)


def group_gaussians(optimised: Optimised, run: Run, segments: Segmentation | None) -> Grouping | None:
    """Groups Gaussians into instances by features and votes of all masks (§3.2.1); None if no photo has masks.
    segments: of the surface, if the masks come from one."""
    nearby, views, config = optimised.nearby, optimised.photos.views, run.config
    if not any(view.labelled for view in views):
        return None
    run.progress.log(f"grouping {len(nearby.gaussians)} Gaussians")
    return_free_memory()
    half, keep = config.losses.half_resolution, run.new_keep()
    if by_tasks(run, optimised):
        found = votes_by_tasks(run, optimised)
        votes = joined_votes(found, len(nearby.gaussians), len(views), run.progress, keep)
    else:
        votes = mask_votes(nearby, views, half_resolution=half, progress=run.progress, keep=keep)
    gaussians = nearby.gaussians.to("cpu")
    tensors = (gaussians.means, gaussians.scales, gaussians.opacities, gaussians.features)
    means, scales, opacities, features = (tensor.detach().numpy() for tensor in tensors)
    margin = config.losses.margin
    arrays = (means, scales, opacities, features, votes)
    one_surface = segments is not None and len(segments.probability) <= LARGEST + 1
    grouping = group(*arrays, config.instances, margin=margin, seed=config.seed, one_surface=one_surface)
    if segments is None and not config.instances.settle:
        return grouping
    return without_faint(grouping, means, opacities, votes, segments)


def describe(
    optimised: Optimised, grouped: Grouping | None, run: Run, encoder: Encoder | None, reader: TextReader | None
) -> DescribedInstances:
    """Geometry, score and views of each instance; with an encoder its language embeddings (§3.2.2), with a reader its
    printed texts."""
    nearby, views, language, progress = optimised.nearby, optimised.photos.views, run.config.language, run.progress
    count = len(nearby.gaussians)
    if grouped is None:
        report = {"warnings": ["no photo has masks"]}
        return DescribedInstances(np.full(count, -1, np.int32), np.zeros(count, np.float32), report=report)
    part = np.where(grouped.part_ids >= 0, grouped.part_ids - grouped.count, -1).astype(np.int32)
    group_of = np.append(grouped.groups, -1).astype(np.int32)  # the last for Gaussians without an instance
    levels = [grouped.ids, part, group_of[grouped.ids] if len(grouped.group_scores) else np.full_like(part, -1)]
    seen, parts_seen, groups_seen = _silhouettes(optimised, levels, run) if grouped.count else ([], [], [])
    described = DescribedInstances(grouped.ids, grouped.membership, _entries(grouped, nearby.gaussians.to("cpu"), seen))
    if reader is not None and grouped.count:
        choices = _best_views(grouped.ids, seen, language.views)
        # The networks of the copy are freed with it, before the encoder needs as much memory.
        texts = read_texts(copy(reader), choices, lambda n: _shown(views[n], seen[n]), progress)
        store_texts(described.instances, texts)
        return_free_memory()

    zooms = language.zooms or (0 if encoder is None else reading_of(encoder).zooms)
    embedded, node_views = partial(_embedded, views, progress), min(NODE_VIEWS, language.views)
    if grouped.count:
        described.language = embedded(grouped.ids, seen, language.views, zooms, encoder)
    if grouped.parents:
        described.parts = {"ids": grouped.part_ids}
        if encoder is not None and reading_of(encoder).wholes:  # then only `upgrade` needs their views
            arrays = embedded(part, parts_seen, 1, 1, Unread(encoder.dim, encoder.identity))
        else:
            arrays = embedded(part, parts_seen, node_views, zooms, encoder)
        described.parts |= prefixed(arrays)
    if len(grouped.group_scores):
        arrays = embedded(levels[2], groups_seen, node_views, zooms, encoder)
        described.groups = {"of": group_of[:-1], "scores": grouped.group_scores, **prefixed(arrays)}
    described.report = {
        "count": grouped.count,
        "parts": len(grouped.parents),
        "groups": len(grouped.group_scores),
        "noise_share": float(np.mean(grouped.ids < 0)) if count else 0.0,
        "encoder": str(described.language["encoder"]) if described.language else None,
        **({} if reader is None else {"texts": reader.identity}),
    }
    return described


def _embedded(
    views: list[TrainingView],
    progress: Progress,
    ids: np.ndarray,
    seen: list[Silhouettes],
    best: int,
    zooms: int,
    encoder: Encoder | Unread | None,
) -> dict[str, np.ndarray]:
    """Language arrays of the instances ids [N] (eq. 11) from their `best` views (eq. 10), `zooms` crops of each; {}
    without an encoder."""
    if encoder is None:
        return {}
    choices, names = _best_views(ids, seen, best), [view.name for view in views]
    shown = describe_instances(encoder, choices, lambda n: _shown(views[n], seen[n]), names, zooms, progress)
    return to_arrays(shown, encoder.identity)


def _silhouettes(optimised: Optimised, levels: list[np.ndarray], run: Run) -> list[list[Silhouettes]]:
    """Of each level, the silhouettes of all views."""
    seen, views = [], optimised.photos.views
    here = partial(view_silhouettes, optimised.nearby, levels)
    tasks = by_tasks(run, optimised)
    for of_view in silhouettes_by_tasks(run, optimised, levels) if tasks else optimised.nearby.each(here, views):
        seen.append(of_view)
        run.progress.update("silhouettes", len(seen), len(views))
    _core.rasterizer_release_memory()  # hundreds of MiB, next to which the encoder's activations would lie
    return_free_memory()
    return [list(level) for level in zip(*seen, strict=True)]


def _shown(view: TrainingView, seen: Silhouettes) -> tuple[np.ndarray, np.ndarray]:
    """photo [H, W, 3] uint8 and instance image [H, W] int32; each pixel of halved silhouettes fills 2 × 2."""
    photo = view.photo.numpy()
    y, x = (np.arange(side) * small // side for side, small in zip(photo.shape[:2], seen.shape, strict=True))
    return photo, seen.ids[y[:, None], x]


def _entries(grouped: Grouping, gaussians: Gaussians, seen: list[Silhouettes]) -> list[dict[str, Any]]:
    """instances.json's list, the parts of each instance inside its entry."""
    views = np.zeros(grouped.count, int)
    for view in seen:
        views[view.shown] += 1
    points, weights = (t.detach().numpy().astype(np.float64) for t in (gaussians.means, gaussians.opacities))

    def entry(number: int, rows: np.ndarray, score: float, shown: int) -> dict[str, Any]:
        return instance_entry(number, points[rows], weights[rows], score, shown)

    parts = range(grouped.count, grouped.count + len(grouped.parents))
    own, below = _members(grouped.ids, range(grouped.count)), _members(grouped.part_ids, parts)
    entries = [entry(i, own[i], float(grouped.scores[i]), int(views[i])) for i in range(grouped.count)]
    for at, (number, parent) in enumerate(zip(parts, grouped.parents, strict=True)):
        part = entry(number, below[at], grouped.part_scores[at], grouped.part_views[at])
        entries[parent].setdefault("parts", []).append({**part, "parent": parent})
    return entries


def _members(ids: np.ndarray, numbers: range) -> list[np.ndarray]:
    """The rows of each of `numbers`, ascending."""
    order = np.argsort(ids, kind="stable")
    ends = np.searchsorted(ids[order], [*numbers, numbers.stop])
    return [order[begin:end] for begin, end in itertools.pairwise(ends)]


def _best_views(ids: np.ndarray, seen: list[Silhouettes], best: int) -> list[np.ndarray]:
    """The `best` views of each instance (eq. 10), see `crops.choose_views`."""
    total = np.bincount(ids[ids >= 0])
    index = np.repeat(np.arange(len(seen)), [len(view.shown) for view in seen])
    shown = np.concatenate([view.shown for view in seen])
    pixels, visible = (np.concatenate([getattr(view, name) for view in seen]) for name in ("pixels", "visible"))
    sizes = np.array([int(np.prod(view.shape)) for view in seen])[index]
    scores = view_scores(pixels, sizes, visible / total[shown])
    return choose_views(sparse.coo_matrix((scores, (shown, index)), shape=(len(total), len(seen))), best)
