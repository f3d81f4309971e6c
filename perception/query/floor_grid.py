"""The floor plan of a metric map, for robots that drive: cells that are free, occupied or unknown."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np

from perception.errors import InputError
from perception.frame.gravity import floor_height
from perception.geometry import camera_centres, rotations, transform
from perception.map.map import Map
from perception.query.where import check_size

FREE, OCCUPIED, UNKNOWN = 0, 100, -1  # nav_msgs/OccupancyGrid
OPAQUE, MOST_CELLS = 0.5, 16_000_000  # least opacity of a Gaussian that counts; largest grid
STEP, HEIGHT = 0.1, 1.8  # what lies between these heights above the floor is in a robot's way, metres
DISC = [(u, v) for u, v in product(np.linspace(-1, 1, 5), repeat=2) if np.hypot(u, v) <= 1]


@dataclass(frozen=True)
class Surface:
    """Points on the surfaces of a metric map: the disc of each opaque Gaussian, of one standard deviation along its two
    longest axes, sampled at 13 points.

    points [P, 3] float64: x, y, height above the floor, metres. rows [P]: their Gaussians. map_from_level [4, 4],
    rigid: its origin is on the floor, z is up, x as near to the map's x as a level axis can be. path: of the map.
    """

    points: np.ndarray
    rows: np.ndarray
    map_from_level: np.ndarray
    path: Path | None

    def grid(self, resolution: float, step: float = STEP) -> tuple[np.ndarray, np.ndarray]:
        """`floor_grid` of these points."""
        points = self.points
        points = points[(np.abs(points[:, 2]) <= step) | ((points[:, 2] > 0) & (points[:, 2] <= HEIGHT))]
        cells, occupied = np.floor(points[:, :2] / resolution).astype(np.int64), points[:, 2] > step
        if occupied.all():
            raise InputError(f"{self.path}: has no floor below its cameras")
        low, size = cells.min(axis=0), np.ptp(cells, axis=0) + 1
        if size.astype(float).prod() > MOST_CELLS:
            raise InputError(f"{self.path}: has more than {MOST_CELLS} cells of {resolution} m; choose larger ones")
        grid = np.full(size[::-1], UNKNOWN, np.int8)
        for rows, value in ((~occupied, FREE), (occupied, OCCUPIED)):
            grid[tuple((cells[rows] - low).T[::-1])] = value
        return grid, self.map_from_level @ transform(np.eye(3), [*low * resolution, 0.0])


def level_surface(gmap: Map) -> Surface:
    """The surfaces of a map above its floor, one level plane (`floor_height`). InputError for a map without metric
    scale, gravity or cameras."""
    down = (gmap.info.get("gravity") or {}).get("direction")
    for lacking, what in ((not gmap.metric, "metric scale"), (down is None, "gravity"), (not gmap.views, "cameras")):
        if lacking:
            raise InputError(f"{gmap.path}: has no {what}, expected a map in metres with gravity and cameras")
    up = -np.asarray(down, np.float64) / np.linalg.norm(np.asarray(down, np.float64))
    x = np.cross(np.cross(up, np.eye(3)[int(abs(up[0]) > 0.9)]), up)
    axes = np.stack([x, np.cross(up, x), up], axis=1) / [np.linalg.norm(x), np.linalg.norm(x), 1]  # map_from_level
    solid = gmap.opacities >= OPAQUE
    sides = rotations(gmap.quats[solid]) * gmap.scales[solid][:, None]
    longest = np.argsort(gmap.scales[solid], axis=1)[:, None, :0:-1]
    first, second = np.moveaxis(np.take_along_axis(sides, longest, axis=2), 2, 0) @ axes
    means = gmap.means[solid] @ axes
    floor = floor_height(np.eye(3)[2], means, np.median(camera_centres(gmap.poses) @ axes, axis=0))
    points = np.concatenate([means + u * first + v * second for u, v in DISC]) - [0, 0, floor]
    rows = np.tile(np.flatnonzero(solid), len(DISC))
    return Surface(points, rows, transform(axes, axes @ [0, 0, floor]), gmap.path)


def floor_grid(gmap: Map, resolution: float, step: float = STEP) -> tuple[np.ndarray, np.ndarray]:
    """cells [H, W] int8, row y, column x, of `resolution` metres; map_from_grid [4, 4], rigid: its origin is the outer
    corner of cell (0, 0) on the floor, z is up, x as near to the map's x as a level axis can be.

    Occupied: cells with something between `step` and 1.8 metres above the floor; else free: with something
    within `step` of it; else unknown. What lies deeper is not drawn: a stair down is unknown.

    "Something" is a point of `level_surface`; discs with a radius above two cells leave gaps. InputError for a map
    without metric scale, gravity, cameras or floor, of more than 16 million cells, or of cells without a size.

    >>> cells, map_from_grid = floor_grid(perception.load_map("room.gsmap"), 0.1)
    >>> sorted({int(value) for value in cells.ravel()}), map_from_grid.shape  # unknown, free, occupied
    ([-1, 0, 100], (4, 4))
    """
    check_size("floor_grid: resolution", resolution)
    return level_surface(gmap).grid(resolution, step)
