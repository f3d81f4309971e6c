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
from perception.instances.cluster import cluster_gaussians
from perception.instances.confidence import Agreement, scores
from perception.instances.silhouettes import Silhouettes, render_silhouettes
from perception.progress import Progress
from perception.types import Scene


@dataclass
class FoundInstances:
    """ids [N] int32 (−1 = none), membership [N] float32, instances.json's list, language arrays, facts."""

    ids: np.ndarray
    membership: np.ndarray
    instances: list[dict[str, Any]]
    language: dict[str, np.ndarray] = field(default_factory=dict)
    report: dict[str, Any] = field(default_factory=dict)


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

    progress.log(f"clustering {len(means)} Gaussians")
    clusters = cluster_gaussians(
        means,
        gaussians.scales.detach().numpy(),
        opacities,
        gaussians.features.detach().numpy(),
        config.instances,
        config.seed,
    )
    agreement = Agreement(clusters.count)
    seen: list[Silhouettes] = []
    for done, view in enumerate(views, start=1):
        height, width = view.photo.shape[:2]
        found = render_silhouettes(gaussians, clusters.ids, view.camera_from_world, view.K, width, height)
        agreement.add(found, None if view.labels is None else view.labels.numpy())
        seen.append(found)
        progress.update("silhouettes", done, len(views))
    confidence = scores(clusters.ids, clusters.membership, opacities, agreement)
    instances = [
        _describe(i, means, opacities, clusters.ids, float(confidence[i]), int(agreement.views[i]))
        for i in range(clusters.count)
    ]
    language = _embed(clusters.ids, seen, views, config, progress) if clusters.count else {}
    report = {
        "count": clusters.count,
        "noise_share": float(np.mean(clusters.ids < 0)),
        "encoder": str(language["encoder"]) if language else None,
    }
    return FoundInstances(clusters.ids, clusters.membership, instances, language, report)


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


def _embed(
    ids: np.ndarray, seen: list[Silhouettes], views: list[TrainingView], config: MapConfig, progress: Progress
) -> dict[str, np.ndarray]:
    """Language arrays of all instances from their best views (paper eq. 8); {} without an encoder."""
    from perception.instances.crops import choose_views, view_scores
    from perception.instances.describe import describe_instances
    from perception.language import make_encoder
    from perception.language.description import to_arrays

    spec = config.language.encoder
    try:
        encoder = make_encoder("conse" if spec == "auto" else spec)
    except InputError as error:
        if spec != "auto":
            raise
        progress.log(f"warning: no language: {error}")
        return {}
    if encoder is None:
        return {}
    pixels = np.stack([view.pixels for view in seen], axis=1)
    total = np.maximum(np.bincount(ids[ids >= 0], minlength=len(pixels)), 1)
    visible = np.stack([view.visible for view in seen], axis=1) / total[:, None]
    sizes = np.array([view.photo.shape[0] * view.photo.shape[1] for view in views])
    chosen = choose_views(view_scores(pixels, sizes, visible), config.language.views)
    descriptions = describe_instances(
        encoder,
        chosen,
        lambda index: (views[index].photo.numpy(), seen[index].ids),
        [view.name for view in views],
        levels=config.language.zooms,
        expansion=config.language.expansion,
        progress=lambda done, of: progress.update("language", done, of),
    )
    return to_arrays(descriptions, encoder.identity)
