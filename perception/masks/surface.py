"""Fuses all depth images into one surface: voxels with mean point, normal and colour."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from perception.geometry import move_points, sums_by
from perception.masks.cues import DepthCues, PhotoCues

FOOTPRINTS = 4.0  # voxel side in pixel footprints at the median depth; above the noise of the depth
_MOST = 400_000  # voxels; larger scenes use larger voxels
_LEAST_PIXELS = 3  # over all photos, minimum for a voxel to be kept
_COUNT, _POINT, _NORMAL, _LAB, _BORDER = 0, slice(1, 4), slice(4, 7), slice(7, 10), 10
_OFFSET = 1 << 20  # makes voxel indices positive; 2^21 values per axis


@dataclass(frozen=True)
class Surface:
    """V voxels of side `size`, a corner of one at `origin` along each axis.

    keys [V] int64 ascending; pixels [V]: number of pixels in each, over all photos; points, normals, lab [V, 3] float32
    means in the world frame (Lab in 8-bit scale); border [V]: mean probability that pixels to both sides are of
    different things.
    """

    size: float
    origin: float
    keys: np.ndarray
    pixels: np.ndarray
    points: np.ndarray
    normals: np.ndarray
    lab: np.ndarray
    border: np.ndarray

    def __len__(self) -> int:
        return len(self.keys)

    def voxel_of(self, points: np.ndarray) -> np.ndarray:
        """[...] int32 index of the voxel that contains each of points [..., 3]; −1 where there is none."""
        voxel = position_in(self.keys, voxel_keys(points.reshape(-1, 3) - self.origin, self.size))
        return voxel.astype(np.int32).reshape(points.shape[:-1])


class SurfaceBuilder:
    """Accumulates photos one by one. Memory grows with the surface, not with the number of photos.

    size: side of the voxels; shift: of their grid along each axis, in sides. Each voxel has sums over its pixels,
    columns _COUNT to _BORDER. Too many voxels are made eight times as large: `halvings` of their indices so far.
    """

    def __init__(self, size: float, shift: float = 0.0) -> None:
        self.size, self.origin, self.halvings = size, shift * size, 0
        self._first_size = size
        self._keys, self._sums = np.zeros(0, np.int64), np.zeros((0, _BORDER + 1))

    def voxels_of(self, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Keys [N] of the voxels, of the first size, that the `pixels_of` a photo are in, and their sums."""
        return _summed(voxel_keys(pixels[:, _POINT] - self.origin, self._first_size), pixels)

    def add(self, keys: np.ndarray, sums: np.ndarray) -> None:
        """Adds the `voxels_of` a photo."""
        for _ in range(self.halvings):
            keys, sums = _halved(keys, sums)
        every, index = np.unique(np.concatenate([self._keys, keys]), return_inverse=True)
        old, new = np.split(index, [len(self._keys)])
        total = np.zeros((len(every), sums.shape[1]))
        total[new] = sums
        total[old] += self._sums
        self._keys, self._sums = every, total
        while len(self._keys) > 2 * _MOST:
            self.size, self.halvings = 2 * self.size, self.halvings + 1
            self._keys, self._sums = _halved(self._keys, self._sums)

    def build(self) -> Surface:
        """The voxels with at least _LEAST_PIXELS pixels."""
        rows = self._sums[:, _COUNT] >= _LEAST_PIXELS
        sums = self._sums[rows]
        normals = sums[:, _NORMAL] / np.maximum(np.linalg.norm(sums[:, _NORMAL], axis=1, keepdims=True), 1e-9)
        means = (sums / sums[:, :1]).astype(np.float32)
        points, lab, border = (np.ascontiguousarray(means[:, column]) for column in (_POINT, _LAB, _BORDER))
        return Surface(
            self.size, self.origin, self._keys[rows], sums[:, _COUNT], points, normals.astype(np.float32), lab, border
        )


def _summed(keys: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The distinct of keys [P], ascending, and the sums of `values` [P, C] by them."""
    every, index = np.unique(keys, return_inverse=True)
    return every, sums_by(index, values, len(every))


def _halved(keys: np.ndarray, sums: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Keys and sums of voxels of twice the side."""
    return _summed(pack_voxels(unpack_voxels(keys) // 2), sums)


def pixels_of(
    photo: PhotoCues, depth: DepthCues, border: np.ndarray, known: np.ndarray, world_from_camera: np.ndarray
) -> np.ndarray:
    """[P, _BORDER + 1] what each pixel of a photo adds to its voxel. border: [h, w] probability; known: [h, w] bool,
    pixels with reliable depth; world_from_camera: [4, 4]."""
    points = move_points(world_from_camera, depth.points[known].astype(np.float64))
    normals = depth.normals[known] @ world_from_camera[:3, :3].T
    columns = [np.ones((len(points), 1)), points, normals, photo.lab[known], border[known][:, None]]
    return np.concatenate(columns, axis=1)


def position_in(ascending: np.ndarray, keys: np.ndarray) -> np.ndarray:
    """[P] position of each of keys [P] ≥ 0 in `ascending` [V]; −1 where it is not one of them."""
    position = np.searchsorted(ascending, keys)
    return np.where(np.append(ascending, -1)[position] == keys, position, -1)


def voxel_keys(points: np.ndarray, size: float) -> np.ndarray:
    """[P] int64 key of the voxel that contains each of points [P, 3]."""
    return pack_voxels(np.floor(points / size).astype(np.int64))


def pack_voxels(index: np.ndarray) -> np.ndarray:
    """Packs three voxel indices [P, 3] into one int64 [P]."""
    i = np.clip(index + _OFFSET, 0, 2 * _OFFSET - 1)
    return (i[:, 0] << 42) | (i[:, 1] << 21) | i[:, 2]


def unpack_voxels(keys: np.ndarray) -> np.ndarray:
    """The three voxel indices [P, 3] of each key; inverse of `pack_voxels`."""
    mask = (1 << 21) - 1
    return np.stack([(keys >> 42) & mask, (keys >> 21) & mask, keys & mask], axis=1) - _OFFSET
