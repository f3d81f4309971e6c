"""Synthetic maps with known answers: instance k is a ball of Gaussians in cell k of a grid, with the name names[k]."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from perception.boxes import oriented_box
from perception.language.base import Encoder
from perception.language.description import InstanceDescription, to_arrays
from perception.map.write import Map, write_map

CELL = 1.0
"""Distance in metres between the centres of neighbouring instances."""
SIGMA = 0.08
"""Standard deviation in metres of an instance's points per axis. Cut at three sigmas, so that balls do not touch."""
_NOISE = 0.1
"""Share of Gaussians without an instance."""


def write_synthetic_map(
    path: Path,
    names: Sequence[str],
    encoder: Encoder | None,
    *,
    gaussians: int,
    sh_degree: int = 3,
    feature_dim: int = 8,
    seed: int = 0,
    encoder_spec: str = "conse",
    first_id: int = 0,
) -> None:
    """Writes a map of `gaussians` Gaussians in random order, with one instance per name; ids start at `first_id`.

    Embeddings are those that `encoder` computes for the names (none without an encoder), stored as `encoder_spec`. The
    best answer to names[k] is therefore instance first_id + k.
    """
    rng = np.random.default_rng(seed)
    owner = rng.integers(0, len(names), gaussians)
    owner[rng.random(gaussians) < _NOISE] = -1
    centers = grid(len(names))
    means = centers[owner] + np.clip(rng.normal(0, SIGMA, (gaussians, 3)), -3 * SIGMA, 3 * SIGMA)
    above = np.array([0, 0, 3 * CELL])  # noise far from every instance
    means[owner < 0] = above + rng.uniform(-CELL, centers.max() + CELL, (int((owner < 0).sum()), 3))
    means = means.astype(np.float32)
    ids = np.where(owner < 0, -1, owner + first_id).astype(np.int32)
    quats = rng.normal(size=(gaussians, 4)).astype(np.float32)
    gmap = Map(
        means=means,
        quats=quats / np.linalg.norm(quats, axis=1, keepdims=True),
        log_scales=rng.normal(-4, 0.3, (gaussians, 3)).astype(np.float32),
        opacity_logits=rng.normal(1, 1, gaussians).astype(np.float32),
        sh=rng.normal(0, 0.1, (gaussians, (sh_degree + 1) ** 2, 3)).astype(np.float32),
        features=rng.normal(size=(gaussians, feature_dim)).astype(np.float32),
        instance_ids=ids,
        membership=np.ones(gaussians, np.float32),
        instances=[_entry(means[owner == k], k + first_id) for k in range(len(names))],
        info=_info(encoder_spec, seed),
        language={} if encoder is None else _language(names, encoder),
    )
    write_map(path, gmap)


def grid(count: int) -> np.ndarray:
    """Centres [count, 3] on a square grid in the plane z = 0."""
    side = int(np.ceil(np.sqrt(count)))
    cells = np.arange(count)
    return np.stack([cells % side, cells // side, np.zeros(count)], axis=1) * CELL


def _entry(points: np.ndarray, number: int) -> dict[str, Any]:
    box = oriented_box(points)
    return {
        "id": number,
        "label": None,
        "score": 0.9,
        "num_gaussians": len(points),
        "views": 1,
        "centroid": points.astype(np.float64).mean(axis=0).tolist(),
        "obb": box.to_json(),
        "aabb": {"min": points.min(axis=0).tolist(), "max": points.max(axis=0).tolist()},
    }


def _language(names: Sequence[str], encoder: Encoder) -> dict[str, np.ndarray]:
    rows = encoder.encode_texts([encoder.templates[0].replace("{}", name) for name in names])
    palette = np.zeros((24, 4), np.float32)
    palette[0] = [50, 0, 0, 1]
    seen = [InstanceDescription(row, row[None], palette, [f"{k:05}.jpg"], [(0, 0, 8, 8)]) for k, row in enumerate(rows)]
    return to_arrays(seen, encoder.identity)


def _info(spec: str, seed: int) -> dict[str, Any]:
    return {
        "frame": "map",
        "metric": True,
        "source": "synthetic",
        "seed": seed,
        "config": {"language": {"encoder": spec}, "photos": {"max_side": 800}},
        "quality": {},
    }
