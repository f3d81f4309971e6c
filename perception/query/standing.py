"""Where a robot can stand to face and see an instance of a metric map."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from perception.errors import InputError
from perception.geometry import move_points, scale_of
from perception.query.floor_grid import FREE, HEIGHT, STEP, UNKNOWN, level_surface
from perception.query.query_map import QueryMap
from perception.query.spatial_index import CORNERS
from perception.query.where import Frame

CELL = 0.05  # side of a cell of the floor and of a voxel, metres
RAYS, MOST_PLACES, BATCH = 32, 640, 64  # points of an instance that are looked at; places tried, so many at a time
LEAST_SEEN = 0.5  # share of the rays that make a line of sight
NEAR = 0.1  # end of a ray in which nothing blocks it, metres: what touches the instance does not hide it
SIDEWAYS = 0.25  # metres off the wanted distance that weigh as much as one metre off the instance's centre
TALL = 200  # voxels above the floor in which something can block a ray: 10 m
_CORNER = np.sqrt(0.5) * CELL  # from the centre of a cell to its corner


@dataclass(frozen=True)
class Stand:
    """A place on the floor beside an instance. position [3] and map_from_robot [4, 4], rigid, in `frame`; the robot's
    frame is that of REP 103: origin on the floor below its centre, x forward to the instance, z up.

    distance: level, to the nearest point of the instance, metres.
    seen: share of the rays to the instance that nothing blocks.

    >>> Stand(4, np.eye(4), distance=0.6, seen=1.0, frame="map").yaw
    0.0
    """

    instance_id: int
    map_from_robot: np.ndarray
    distance: float
    seen: float
    frame: str

    @property
    def position(self) -> np.ndarray:
        """[3] of the robot, on the floor."""
        return self.map_from_robot[:3, 3]

    @property
    def yaw(self) -> float:
        """Of the robot's x about the z axis of `frame`, radians."""
        return float(np.arctan2(self.map_from_robot[1, 0], self.map_from_robot[0, 0]))


def where_to_stand(
    gmap: QueryMap,
    instance_id: int,
    *,
    radius: float = 0.25,
    distance: float = 0.6,
    within: float = 2.0,
    sensor_height: float = 1.2,
    frame: Frame | None = None,
) -> Stand:
    """The place from which a robot faces and sees an instance. All lengths are in metres.

    radius: of the robot's disc on the floor. distance: wanted from its centre to the nearest point of the instance,
    level; within: the largest. sensor_height: of the sensor above the floor, over the centre. frame: of the result.

    The disc lies on free floor (`FreeSpace`), in the largest connected part that such a robot can drive in. Of these
    places the one is taken that is nearest to the wanted distance and before the middle of the instance, and has line
    of sight: at least half of the rays from the sensor to 32 points of the instance meet no voxel of 5 cm with a point
    of another Gaussian before their last 10 cm. The instance does not hide itself.

    Raises UnknownInstance; InputError for a map without metric scale, gravity, cameras or floor, for lengths that are
    not positive, and when no place is free or none of them has line of sight.

    >>> stand = where_to_stand(perception.load_map("room.gsmap"), 1, radius=0.25, distance=0.6)
    >>> stand.map_from_robot.shape, bool(abs(stand.distance - 0.6) < 0.05), stand.seen
    ((4, 4), True, 1.0)
    """
    lengths = {"radius": radius, "distance": distance, "within": within, "sensor_height": sensor_height}
    for name, value in lengths.items():
        if not 0 < value < np.inf:
            raise InputError(f"where_to_stand: {name} is {value}, expected a positive number of metres")
    gmap.position(instance_id)
    space, points = gmap.free_space, gmap.index.of(instance_id)
    points = move_points(np.linalg.inv(space.map_from_grid), points.astype(np.float64))
    places = (np.argwhere(space.reachable(radius))[:, ::-1] + 0.5) * CELL
    gaps = cKDTree(points[:, :2]).query(places, distance_upper_bound=within)[0]
    near = np.isfinite(gaps)
    if not near.any():
        raise InputError(
            f"instance {instance_id}: no free floor within {within} m of it that a robot of radius {radius} m reaches"
        )
    places, gaps, middle = places[near], gaps[near], points.mean(axis=0)[:2]
    order = np.argsort(np.abs(gaps - distance) + SIDEWAYS * np.linalg.norm(places - middle, axis=1), kind="stable")
    order = order[:: -(-len(order) // MOST_PLACES)]
    targets = points[np.linspace(0, len(points) - 1, RAYS).astype(int)]
    for some in np.split(order, range(BATCH, len(order), BATCH)):
        eyes = np.c_[places[some], np.full(len(some), sensor_height)]
        seen = space.seen(instance_id, eyes, targets).mean(axis=1)
        if seen.max() >= LEAST_SEEN:
            best = int((seen >= LEAST_SEEN).argmax())
            chosen = some[best]
            pose = space.map_from_grid @ _facing(places[chosen], middle)
            if frame is not None:
                pose = frame.from_map @ pose
                pose[:3, :3] /= scale_of(pose)
            name = gmap.frame if frame is None else frame.name
            return Stand(instance_id, pose, float(gaps[chosen]), float(seen[best]), name)
    raise InputError(f"instance {instance_id}: is hidden from every free place within {within} m of it")


def _facing(place: np.ndarray, target: np.ndarray) -> np.ndarray:
    """grid_from_robot [4, 4] of a robot at `place` [2] that faces `target` [2]."""
    ahead = target - place if (target != place).any() else np.array([1.0, 0.0])
    x, y = ahead / np.linalg.norm(ahead)
    return np.array([[x, -y, 0, place[0]], [y, x, 0, place[1]], [0, 0, 1, 0], [0, 0, 0, 1]])


class FreeSpace:
    """The free floor of a map, and what blocks rays above it. InputError as `floor_grid`. Thread-safe.

    Free are the cells of `floor_grid`, and unknown ones in gaps one cell wide, outside the boxes of instances that
    reach between the robot's lowest and highest point. A box with mostly free floor in it encloses space, such as that
    of all walls in one instance, and is not counted. map_from_grid [4, 4]: of the grid, origin on the floor.
    """

    def __init__(self, gmap: QueryMap) -> None:
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
        taken = self._taken[self._owners != instance_id]
        rays = targets[None] - eyes[:, None]
        lengths = np.linalg.norm(rays, axis=2)
        steps = int(np.ceil(2 * lengths.max() / CELL)) + 1
        shares = np.linspace(0, 1, steps)[:, None, None] * np.maximum(1 - NEAR / np.maximum(lengths, NEAR), 0)
        keys, within = self._keys(eyes[:, None] + shares[..., None] * rays)
        return ~(within & (taken[np.searchsorted(taken, keys).clip(max=len(taken) - 1)] == keys)).any(axis=0)

    def _keys(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Numbers of the voxels of points [..., 3] in the grid's frame, int64, and whether each lies above the grid."""
        size = np.array([*self._free.shape[::-1], TALL])
        voxels = np.floor(points / CELL)
        within = np.asarray(((voxels >= 0) & (voxels < size)).all(axis=-1))
        x, y, z = np.moveaxis(np.where(within[..., None], voxels, 0).astype(np.int64), -1, 0)
        return (x * size[1] + y) * TALL + z, within

    def _footprint(self, box: dict[str, list[float]]) -> np.ndarray:
        """bool [H, W]: cells below the box, of instances.json, if a robot under it would be in it."""
        corners = np.array(box["center"]) + CORNERS * np.array(box["extent"]) @ np.array(box["rotation"])
        corners, mask = move_points(np.linalg.inv(self.map_from_grid), corners), np.zeros(self._free.shape, np.uint8)
        if corners[:, 2].min() < HEIGHT and corners[:, 2].max() > STEP:
            cells = np.floor(corners[:, :2] / CELL).astype(np.int32)
            cv2.fillConvexPoly(mask, cv2.convexHull(cells), 1)
        return mask.astype(bool)
