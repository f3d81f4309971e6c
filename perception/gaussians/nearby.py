"""The Gaussians that a photo may show: all of a model, or in a place made of blocks those of the photo's blocks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch

from perception.gaussians.model import Gaussians


class Nearby:
    """A model on the device that is to render it. The cost of a photo is bounded by what lies around it.

    rows: by photo, those of the Gaussians it may show, int64 arrays to be joined, in one list for all photos that show
    the same ones. A photo that is not listed may show all Gaussians.
    """

    def __init__(self, gaussians: Gaussians, rows: Mapping[str, Sequence[np.ndarray]] | None = None) -> None:
        self.gaussians, self._rows = gaussians, rows or {}
        self._all = [np.arange(len(gaussians))]
        self._last: tuple[Sequence[np.ndarray], Gaussians, np.ndarray] = self._all, gaussians, self._all[0]

    def of(self, photo: str) -> tuple[Gaussians, np.ndarray]:
        """The Gaussians near a photo, and their rows in the model."""
        parts = self._rows.get(photo, self._all)
        if parts is not self._last[0]:
            rows = np.concatenate(parts)
            chosen = torch.from_numpy(rows).to(self.gaussians.means.device)
            self._last = parts, self.gaussians if parts is self._all else self.gaussians.rows(chosen), rows
        return self._last[1:]
