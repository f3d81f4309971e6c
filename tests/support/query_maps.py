"""Small synthetic maps for the tests of queries, and an encoder that needs no weights."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from perception.language.colors import without_color_words
from support.synthetic_map import write_synthetic_map

NAMES = ["mug", "banana", "laptop", "teapot", "kettle", "lamp", "violin", "anchor", "drum"]


class HashEncoder:
    """Every text its own random direction: exact names fit, everything else is unrelated."""

    identity, dim, templates = "hash-test", 256, ("{}",)

    def encode_texts(self, texts: Sequence[str]) -> np.ndarray:
        rows = []
        for text in texts:
            words = without_color_words(text)  # which the ranking takes off a prompt
            seed = int.from_bytes(hashlib.sha256(words.encode()).digest()[:8], "little")
            rows.append(np.random.default_rng(seed).normal(size=self.dim))
        out = np.array(rows).reshape(-1, self.dim)
        return (out / np.linalg.norm(out, axis=1, keepdims=True)).astype(np.float32)

    def encode_images(self, images: Sequence[np.ndarray]) -> np.ndarray:
        raise NotImplementedError("tests write embeddings of names")


def encoders(spec: str) -> HashEncoder:
    assert spec == "hash"
    return HashEncoder()


def write_map_of(path: Path, names: Sequence[str] = NAMES, *, gaussians: int = 3000, **options: int) -> Path:
    """A map of the given names that `encoders` can ask."""
    settings = {"sh_degree": 1, **options}
    write_synthetic_map(path, names, HashEncoder(), gaussians=gaussians, encoder_spec="hash", **settings)
    return path
