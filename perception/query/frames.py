"""Coordinate frames other than the map's, such as a robot's base frame or a metric frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from perception.geometry import check_similarity


@dataclass(frozen=True)
class Frame:
    """A named frame. from_map [4, 4]: the transform frame_from_map, rigid or a similarity.

    A scale other than 1 converts units, for example those of a reconstruction into metres.
    """

    name: str
    from_map: np.ndarray

    def __post_init__(self) -> None:
        object.__setattr__(self, "from_map", check_similarity(self.from_map, f"frame '{self.name}'"))

    @property
    def to_map(self) -> np.ndarray:
        """map_from_frame [4, 4]."""
        return np.linalg.inv(self.from_map)
