"""Sends the map's Gaussians to every browser: a coarse picture at once, then all of them."""

from __future__ import annotations

import threading
from typing import Any

import numpy as np

from perception.io.store import Map
from perception.viewer.picking import covariances

FIRST = 25_000
"""Number of Gaussians sent first (0.8 MB): drawn in seconds on a slow connection or a computer without a GPU."""


class Splats:
    """Sends the Gaussians to each browser separately, because each has its own camera and connects on its own."""

    def __init__(self, gmap: Map, scale: float):
        self.centers = (gmap.means * np.float32(scale)).astype(np.float32)
        self.covariances = covariances(gmap) * np.float32(scale**2)
        self.first = most_visible(gmap, FIRST)
        self._handles: dict[int, Any] = {}
        self._lock = threading.Lock()

    def show(self, client: Any, colors: np.ndarray, opacities: np.ndarray) -> None:
        """Draws in one browser; the first call sends the coarse picture only. colors [N, 3] uint8, opacities [N]."""
        with self._lock:
            handle = self._handles.get(client.client_id)
            if handle is None:
                rows = self.first
                self._handles[client.client_id] = client.scene.add_gaussian_splats(
                    "/map/splats", self.centers[rows], self.covariances[rows], colors[rows], opacities[rows, None]
                )
            else:
                handle.set_gaussians(self.centers, self.covariances, colors, opacities[:, None])

    @property
    def coarse(self) -> bool:
        """Whether the coarse picture lacks Gaussians, so that a second one must follow."""
        return len(self.first) < len(self.centers)

    def forget(self, client: Any) -> None:
        """To be called when a browser has disconnected."""
        with self._lock:
            self._handles.pop(client.client_id, None)


def most_visible(gmap: Map, count: int) -> np.ndarray:
    """Rows of the `count` Gaussians that cover most (opacity times the area of the widest section), ascending."""
    if len(gmap) <= count:
        return np.arange(len(gmap))
    widest = np.sort(gmap.log_scales, axis=1)[:, 1:].sum(axis=1)
    cover = np.log(np.maximum(gmap.opacities, 1e-9)) + widest
    return np.sort(np.argpartition(-cover, count)[:count])
