"""The free floor of a metric map, and lines of sight above it."""

from __future__ import annotations

import cv2
import numpy as np
from scipy import ndimage

from perception.geometry import move_points
from perception.map.map import Map
from perception.query.floor_grid import FREE, HEIGHT, STEP, UNKNOWN, level_surface
from perception.types import OrientedBox

CELL = 0.05  # side of a cell of the floor and of a voxel, metres
CLEARANCE = 0.1  # end of a ray in which nothing blocks it, metres: what touches the instance does not hide it
TALL = 200  # voxels above the floor in which something can block a ray: 10 m
_CORNER = np.sqrt(0.5) * CELL  # from the centre of a cell to its corner, metres


class FreeSpace:
    """The free floor of a map, and what blocks rays above it. InputError as `floor_grid`. Thread-safe.

    Free are the cells of `floor_grid`, and unknown ones in gaps one cell wide, outside the boxes of instances that
    reach between the robot's lowest and highest point. A box with mostly free floor in it encloses space, such as that
    of all walls in one instance, and is not counted. map_from_grid [4, 4]: of the grid, origin on the floor.
    """

    def __init__(self, gmap: Map) -> None:
        surface = level_surface(gmap)
        cells, self.map_from_grid = surface.grid(CELL)
        free = cells == FREE
        self._free = free | (ndimage.binary_closing(free) & (cells == UNKNOWN))
        for entry in gmap.instances:
            mask = self._footprint(entry["obb"])
            if mask.any() and free[mask].mean() <= 0.5:
                self._free &= ~mask
        corner = (np.linalg.inv(surface.map_from_level) @ self.map_from_grid)[:2, 3]
        keys, within = self._keys(surface.points - [*corner, 0])
        ids, owner = np.unique(gmap.instance_ids, return_inverse=True)
        taken = np.unique(keys[within] * len(ids) + owner[surface.rows[within]])
        self._taken, self._owners = taken // len(ids), ids[taken % len(ids)]

    def reachable(self, radius: float) -> np.ndarray:
        """bool [H, W]: cells at whose centre a disc of `radius` metres is free, the largest connected part."""
        clear = ndimage.distance_transform_edt(np.pad(self._free, 1))[1:-1, 1:-1] * CELL >= radius + _CORNER
        parts, count = ndimage.label(clear)
        return clear if count < 2 else parts == 1 + np.bincount(parts[clear])[1:].argmax()

    def seen(self, instance_id: int, eyes: np.ndarray, targets: np.ndarray) -> np.ndarray:
        """bool [E, T]: whether the ray from each of eyes [E, 3] to each of targets [T, 3], in the grid's frame, meets
        no voxel with a point of something other than the instance, but for its last 10 cm."""
        taken = np.append(self._taken[self._owners != instance_id], np.iinfo(np.int64).max)  # which no key is
        rays = targets[None] - eyes[:, None]
        lengths = np.linalg.norm(rays, axis=2)
        steps = int(np.ceil(2 * lengths.max() / CELL)) + 1
        shares = np.linspace(0, 1, steps)[:, None, None] * np.maximum(1 - CLEARANCE / np.maximum(lengths, CLEARANCE), 0)
        keys, within = self._keys(eyes[:, None] + shares[..., None] * rays)
        return ~(within & (taken[np.searchsorted(taken, keys)] == keys)).any(axis=0)

    def _keys(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Numbers of the voxels of points [..., 3] in the grid's frame, int64, and whether each lies above the grid."""
        size = np.array([*self._free.shape[::-1], TALL])
        voxels = np.floor(points / CELL)
        within = np.asarray(((voxels >= 0) & (voxels < size)).all(axis=-1))
        x, y, z = np.moveaxis(np.where(within[..., None], voxels, 0).astype(np.int64), -1, 0)
        return (x * size[1] + y) * TALL + z, within

    def _footprint(self, box: dict[str, list[float]]) -> np.ndarray:
        """bool [H, W]: cells below the box, of instances.json, if a robot under it would be in it."""
        corners = move_points(np.linalg.inv(self.map_from_grid), OrientedBox.from_json(box).corners)
        mask = np.zeros(self._free.shape, np.uint8)
        if corners[:, 2].min() < HEIGHT and corners[:, 2].max() > STEP:
            cells = np.floor(corners[:, :2] / CELL).astype(np.int32)
            cv2.fillConvexPoly(mask, cv2.convexHull(cells), 1)
        return mask.astype(bool)
