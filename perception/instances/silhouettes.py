"""Instance images and silhouettes of each photo, rendered with occlusion (paper §3.2.2)."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from perception.gaussians.model import Gaussians, Nearby
from perception.gaussians.views import TrainingView, half_camera
from perception.rasterizer.rasterize import rasterizer_for
from perception.rasterizer.types import Settings

MOST_LABELS = 1 << 24  # the rasterizer takes smaller ids only; larger ones are numbered anew
HALVED_FROM = 480  # pixels of the long side from which half the resolution is rendered, in a third of the time


@dataclass(frozen=True)
class Silhouettes:
    """One view of shape (H, W). packed: `ids`, compressed; shown [S]: ids of the instances with pixels; pixels [S]:
    their number; visible [S]: number of their Gaussians that contribute to any pixel."""

    packed: bytes
    shape: tuple[int, ...]
    shown: np.ndarray
    pixels: np.ndarray
    visible: np.ndarray

    @property
    def ids(self) -> np.ndarray:
        """[H, W] int32: the instance with the largest weight in a pixel, −1 if it is below `threshold`."""
        return np.frombuffer(zlib.decompress(self.packed), np.int32).reshape(self.shape)


def view_silhouettes(nearby: Nearby, levels: Sequence[np.ndarray], view: TrainingView) -> list[Silhouettes]:
    """`render_silhouettes` of a photo, from HALVED_FROM on at half its resolution. levels: ids [N] int32 of all
    Gaussians."""
    K, (height, width), eps2d = view.K, view.photo.shape[:2], view.eps2d
    if max(height, width) >= HALVED_FROM:
        K, (height, width), eps2d = half_camera(K, (height, width), eps2d)
    gaussians, rows = nearby.of(view.name)
    owners = [ids[rows] for ids in levels]
    return render_silhouettes(gaussians, owners, view.camera_from_world, K, width, height, eps2d=eps2d)


@torch.no_grad()
def render_silhouettes(
    gaussians: Gaussians,
    levels: Sequence[np.ndarray],
    camera_from_world: torch.Tensor,
    K: torch.Tensor,
    width: int,
    height: int,
    threshold: float = 0.2,
    eps2d: float = 0.3,
) -> list[Silhouettes]:
    """The silhouettes of each of up to 8 levels, such as instances and parts, in one pass over the Gaussians.

    levels: ids [N] int32, −1 = none. An instance's weight in a pixel is the sum of the weights of its
    Gaussians; all other Gaussians occlude it. camera_from_world [4, 4], K [3, 3] float32. eps2d: see `rasterize`.
    """
    inputs = gaussians.inputs(camera_from_world, K)
    owners, known = np.stack([np.asarray(ids, np.int32) for ids in levels]), None
    if owners.max(initial=-1) >= MOST_LABELS:
        known = np.unique(owners[owners >= 0])
        owners = np.where(owners < 0, -1, np.searchsorted(known, owners)).astype(np.int32)
    label_images = rasterizer_for(gaussians.means.device).label_images
    images, visible = label_images(inputs, owners, threshold, Settings(width, height, depth=False, eps2d=eps2d))
    silhouettes = []
    for ids, image in zip(owners, images, strict=True):
        shown, pixels = np.unique(image[image >= 0], return_counts=True)
        seen = np.bincount(ids[visible & (ids >= 0)])[shown]
        if known is not None:
            shown, image = known[shown], np.where(image < 0, -1, known[image])
        packed = zlib.compress(image.astype(np.int32).tobytes(), 1)
        silhouettes.append(Silhouettes(packed, image.shape, shown, pixels, seen))
    return silhouettes
