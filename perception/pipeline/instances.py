"""From trained Gaussians to described instances: cluster, render silhouettes, score, embed."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from perception.boxes import oriented_box
from perception.config import MapConfig
from perception.errors import InputError
from perception.gaussians.model import Gaussians
from perception.gaussians.train import TrainingView
from perception.instances.group import Grouping, group
from perception.instances.silhouettes import Silhouettes, render_silhouettes
from perception.instances.votes import mask_votes
from perception.language.base import Encoder
from perception.progress import Progress
from perception.types import Scene


@dataclass
class FoundInstances:
    """ids [N] int32 (−1 = none), membership [N] float32, instances.json's list, language arrays, facts, and the
    arrays of parts.npz (see io.store)."""

    ids: np.ndarray
    membership: np.ndarray
    instances: list[dict[str, Any]]
    language: dict[str, np.ndarray] = field(default_factory=dict)
    report: dict[str, Any] = field(default_factory=dict)
    parts: dict[str, np.ndarray] = field(default_factory=dict)


def find_instances(
    gaussians: Gaussians, views: list[TrainingView], scene: Scene, config: MapConfig, progress: Progress
) -> FoundInstances:
    """Clusters the Gaussians and says of every instance where, how sure, and what it looks like."""
    means = gaussians.means.detach().numpy()
    opacities = gaussians.opacities.detach().numpy()
    has_labels = any(view.labels is not None and bool((view.labels > 0).any()) for view in views)
    if not has_labels:
        empty = np.full(len(means), -1, np.int32)
        return FoundInstances(empty, np.zeros(len(means), np.float32), [], {}, {"warnings": ["no photo has masks"]})

    progress.log(f"grouping {len(means)} Gaussians")
    grouped = group_gaussians(gaussians, views, config, progress)
    seen = _silhouettes(gaussians, grouped.ids, views, "silhouettes", progress) if grouped.count else []
    instances = _entries(grouped, means, opacities, seen)
    words, encoder = config.language, _encoder(config, progress) if grouped.count else None
    language = {}
    if encoder is not None:
        language = _embed(encoder, grouped.ids, seen, views, words.views, words.zooms, progress)
    report = {
        "count": grouped.count,
        "parts": len(grouped.parents),
        "noise_share": float(np.mean(grouped.ids < 0)),
        "encoder": str(language["encoder"]) if language else None,
    }
    parts = _parts(encoder, gaussians, grouped, views, config, progress) if grouped.parents else {}
    return FoundInstances(grouped.ids, grouped.membership, instances, language, report, parts)


def group_gaussians(gaussians: Gaussians, views: list[TrainingView], config: MapConfig, progress: Progress) -> Grouping:
    """The votes of all masks, and the instances they and the features make."""
    votes = mask_votes(
        gaussians,
        views,
        half_resolution=config.losses.half_resolution,
        progress=lambda done, of: progress.update("mask votes", done, of),
    )
    return group(
        gaussians.means.detach().numpy(),
        gaussians.scales.detach().numpy(),
        gaussians.opacities.detach().numpy(),
        gaussians.features.detach().numpy(),
        votes,
        config.instances,
        margin=config.losses.margin,
        seed=config.seed,
    )


def _silhouettes(
    gaussians: Gaussians, ids: np.ndarray, views: list[TrainingView], what: str, progress: Progress
) -> list[Silhouettes]:
    seen = []
    for done, view in enumerate(views, start=1):
        height, width = view.photo.shape[:2]
        seen.append(render_silhouettes(gaussians, ids, view.camera_from_world, view.K, width, height))
        progress.update(what, done, len(views))
    return seen


def _entries(
    grouped: Grouping, means: np.ndarray, opacities: np.ndarray, seen: list[Silhouettes]
) -> list[dict[str, Any]]:
    """instances.json's list, the parts of each instance inside its entry."""
    views = np.sum([view.pixels > 0 for view in seen], axis=0) if seen else np.zeros(grouped.count)
    entries = [
        _describe(i, means, opacities, grouped.ids, float(grouped.scores[i]), int(views[i]))
        for i in range(grouped.count)
    ]
    for number, parent in enumerate(grouped.parents):
        score, shown = grouped.part_scores[number], grouped.part_views[number]
        part = _describe(grouped.count + number, means, opacities, grouped.part_ids, score, shown)
        entries[parent].setdefault("parts", []).append({**part, "parent": parent})
    return entries


def _parts(
    encoder: Encoder | None,
    gaussians: Gaussians,
    grouped: Grouping,
    views: list[TrainingView],
    config: MapConfig,
    progress: Progress,
) -> dict[str, np.ndarray]:
    """The arrays of parts.npz: whose part each Gaussian is and, with an encoder, what the parts look like."""
    local = np.where(grouped.part_ids >= 0, grouped.part_ids - grouped.count, -1).astype(np.int32)
    language: dict[str, np.ndarray] = {}
    if encoder is not None:
        seen = _silhouettes(gaussians, local, views, "silhouettes of parts", progress)
        language = _embed(encoder, local, seen, views, min(2, config.language.views), 1, progress)
    return {"ids": grouped.part_ids, **{f"language_{name}": array for name, array in language.items()}}


BOX_TRIM = 0.01
"""Share of an instance's Gaussians left out of its oriented box at either end of each axis: strays stretch boxes."""


def _describe(
    instance: int, means: np.ndarray, opacities: np.ndarray, ids: np.ndarray, score: float, views: int
) -> dict[str, Any]:
    rows = ids == instance
    points = means[rows].astype(np.float64)
    weights = opacities[rows].astype(np.float64)
    box = oriented_box(points, BOX_TRIM)
    return {
        "id": instance,
        "label": None,
        "score": score,
        "num_gaussians": int(rows.sum()),
        "views": views,
        "centroid": (weights @ points / weights.sum()).tolist(),
        "obb": box.to_json(),
        "aabb": {"min": points.min(axis=0).tolist(), "max": points.max(axis=0).tolist()},
    }


def _encoder(config: MapConfig, progress: Progress) -> Encoder | None:
    """What turns pictures into words' vectors; None where none is wanted, or "auto" finds none."""
    from perception.language.encoders import make_encoder

    spec = config.language.encoder
    try:
        return make_encoder("conse" if spec == "auto" else spec)
    except InputError as error:
        if spec != "auto":
            raise
        progress.log(f"warning: no language: {error}")
        return None


def _embed(
    encoder: Encoder,
    ids: np.ndarray,
    seen: list[Silhouettes],
    views: list[TrainingView],
    best: int,
    zooms: int,
    progress: Progress,
) -> dict[str, np.ndarray]:
    """Language arrays of all instances from their `best` views (eq. 11), `zooms` crops of each (0: as suits)."""
    from perception.instances.crops import choose_views, view_scores
    from perception.instances.describe import describe_instances
    from perception.language.base import reading_of
    from perception.language.description import to_arrays

    pixels = np.stack([view.pixels for view in seen], axis=1)
    total = np.maximum(np.bincount(ids[ids >= 0], minlength=len(pixels)), 1)
    visible = np.stack([view.visible for view in seen], axis=1) / total[:, None]
    sizes = np.array([view.photo.shape[0] * view.photo.shape[1] for view in views])
    chosen = choose_views(view_scores(pixels, sizes, visible), best)
    descriptions = describe_instances(
        encoder,
        chosen,
        lambda index: (views[index].photo.numpy(), seen[index].ids),
        [view.name for view in views],
        levels=zooms or reading_of(encoder).zooms,
        progress=lambda done, of: progress.update("language", done, of),
    )
    return to_arrays(descriptions, encoder.identity)
