"""Small labelled maps and an encoder that needs no model, for tests of the node."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from perception.boxes import oriented_box
from perception.language.description import InstanceDescription, to_arrays
from perception.map.write import Map, write_map

DIM = 16


class WordEncoder:
    """Each text is a direction of its own, fixed by its bytes."""

    identity, dim, templates, references, canonical, margin = "words-1", DIM, ("{}",), None, (), 0.0

    def encode_images(self, images: Sequence[np.ndarray]) -> np.ndarray:
        raise AssertionError("the node shows no pictures to an encoder")

    def encode_texts(self, texts: Sequence[str]) -> np.ndarray:
        return np.stack([word(text) for text in texts])


def word(text: str) -> np.ndarray:
    direction = np.random.default_rng(zlib.crc32(text.encode())).normal(size=DIM).astype(np.float32)
    return direction / np.linalg.norm(direction)


def encoders(spec: str) -> WordEncoder:
    return WordEncoder()


def write_small_map(path: Path, labels: Sequence[str], points: int = 50, seed: int = 0, stray: int = 20) -> None:
    """A map whose instance 10 i lies about (i, 0, seed) and is labelled labels[i]; `stray` Gaussians are nobody's."""
    rng = np.random.default_rng(seed)
    count = points * len(labels) + stray
    means = (rng.normal(size=(count, 3)) * [0.2, 0.1, 0.05] + [0, 0, seed]).astype(np.float32)
    ids = np.full(count, -1, np.int32)
    instances = []
    for i, label in enumerate(labels):
        rows = slice(i * points, (i + 1) * points)
        means[rows, 0] += i
        ids[rows] = 10 * i
        own = means[rows]
        instances.append(
            {
                "id": 10 * i,
                "label": label,
                "score": 0.9,
                "num_gaussians": points,
                "centroid": own.mean(axis=0).tolist(),
                "obb": oriented_box(own).to_json(),
                "aabb": {"min": own.min(axis=0).tolist(), "max": own.max(axis=0).tolist()},
            }
        )
    palette = np.zeros((to_palette(), 4), np.float32)
    described = [
        InstanceDescription(word(f"see {x}"), word(f"see {x}")[None], palette, ["a.jpg"], [(0, 0, 9, 9)])
        for x in labels
    ]
    write_map(
        path,
        Map(
            means=means,
            quats=np.tile(np.array([1, 0, 0, 0], np.float32), (count, 1)),
            log_scales=np.full((count, 3), -4, np.float32),
            opacity_logits=np.full(count, 2, np.float32),
            sh=rng.normal(size=(count, 1, 3)).astype(np.float32) * 0.5,
            features=np.zeros((count, 2), np.float32),
            instance_ids=ids,
            membership=np.ones(count, np.float32),
            instances=instances,
            info={"frame": "kitchen", "metric": True},
            language=to_arrays(described, WordEncoder.identity),
        ),
    )


def to_palette() -> int:
    from perception.language.colors import PALETTE

    return PALETTE
