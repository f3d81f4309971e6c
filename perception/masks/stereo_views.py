"""Photos at stereo resolution, with their cameras and depth."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from perception.io.disk_arrays import Keep
from perception.masks.cues import DepthCues, PhotoCues, depth_cues, filled_depth, photo_cues
from perception.types import View

SIDE = 320  # pixels of the long side at stereo resolution
_LEAST_DEPTH = 0.05  # share of a photo's pixels that must have depth; other photos are not used


@dataclass
class StereoView:
    """One photo. photo: [h, w, 3] uint8 RGB; grey: [h, w] uint8; K: [3, 3]; camera_from_world: [4, 4] float64.

    prior: [h, w] depth known before stereo, 0 = none. depth: [h, w] current best depth. confirmed: [h, w] bool, pixels
    whose depth other photos agree with. measured: the prior comes from a sensor. voxel: [h, w] int32, the voxel of the
    surface that each pixel shows, −1 = none, set by `surface_graph`. keep: where images that are made later are kept.
    """

    name: str
    photo: np.ndarray
    grey: np.ndarray
    K: np.ndarray
    camera_from_world: np.ndarray
    prior: np.ndarray
    depth: np.ndarray
    confirmed: np.ndarray
    measured: bool = False
    voxel: np.ndarray = field(default_factory=lambda: np.zeros((0, 0), np.int32))
    keep: Keep = np.asarray

    def store(self, keep: Keep) -> None:
        """Puts the images but `voxel` where `keep` puts them."""
        for name in ("photo", "grey", "prior", "depth", "confirmed"):
            setattr(self, name, keep(getattr(self, name)))

    @property
    def center(self) -> np.ndarray:
        """[3] camera centre in the world frame."""
        return -self.camera_from_world[:3, :3].T @ self.camera_from_world[:3, 3]

    @property
    def world_from_camera(self) -> np.ndarray:
        """[4, 4]."""
        return np.asarray(np.linalg.inv(self.camera_from_world))

    def cues(self) -> tuple[PhotoCues, DepthCues]:
        """Cues of photo and depth. They are recomputed at every call, because they take 20 times the photo's memory."""
        return photo_cues(self.photo), depth_cues(self.depth, self.K)


def make_stereo_view(view: View, photo: np.ndarray, depth: np.ndarray, keep: Keep = np.asarray) -> StereoView | None:
    """photo: [H, W, 3] uint8 RGB; depth: [H, W] prior, 0 = none. Returns None if too few pixels have depth."""
    import cv2

    height, width = photo.shape[:2]
    ratio = SIDE / max(height, width)
    size = (max(1, round(width * ratio)), max(1, round(height * ratio)))
    known = np.isfinite(depth) & (depth > 0)
    if known.mean() < _LEAST_DEPTH:
        return None
    small = cv2.resize(photo, size, interpolation=cv2.INTER_AREA if ratio < 1 else cv2.INTER_LINEAR)
    prior = cv2.resize(np.where(known, depth, 0).astype(np.float32), size, interpolation=cv2.INTER_NEAREST)
    K = np.diag([size[0] / view.width, size[1] / view.height, 1.0]) @ view.K
    grey = cv2.cvtColor(small, cv2.COLOR_RGB2GRAY)
    pose = np.asarray(view.camera_from_world, np.float64)
    measured = view.depth is not None
    made = StereoView(view.name, small, grey, K, pose, prior, filled_depth(prior), prior > 0, measured, keep=keep)
    made.store(keep)
    return made
