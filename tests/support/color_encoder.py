"""An encoder that knows three colours: pictures by the channel that stands out, texts by a thing of that colour."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

THINGS = ("strawberry", "lime", "ocean")


class ColorEncoder:
    """Rows of three: the channel in which a picture is brightest against the others; THINGS in that order."""

    identity, dim, templates = "color-test", 3, ("{}",)

    def encode_images(self, images: Sequence[np.ndarray]) -> np.ndarray:
        means = np.array([image.reshape(-1, 3).mean(axis=0) for image in images], np.float64)
        return np.eye(3, dtype=np.float32)[(means - means.mean(axis=1, keepdims=True)).argmax(axis=1)]

    def encode_texts(self, texts: Sequence[str]) -> np.ndarray:
        rows = [np.eye(3)[THINGS.index(text)] if text in THINGS else np.ones(3) / np.sqrt(3) for text in texts]
        return np.array(rows, np.float32).reshape(-1, 3)


def encoders(spec: str) -> ColorEncoder:
    return ColorEncoder()
