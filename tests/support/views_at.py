"""Views for maps that tests make by hand: cameras at given poses, without photos."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from perception.types import View


def views_at(poses: Iterable[np.ndarray], names: Sequence[str] | None = None) -> list[View]:
    """A view a pose [4, 4], named 0.jpg, 1.jpg ... or as `names` says; K is that of 64 × 48 pixels."""
    K = np.array([[50.0, 0, 32], [0, 50, 24], [0, 0, 1]])
    poses = list(poses)
    names = names or [f"{k}.jpg" for k in range(len(poses))]
    return [View(name, Path("gone") / name, K, 64, 48, pose) for name, pose in zip(names, poses, strict=True)]
