"""A robot pose from which an instance of a metric map is seen."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from perception.errors import InputError
from perception.geometry import move_points, scale_of
from perception.query.free_space import CELL
from perception.query.query_map import QueryMap
from perception.query.where import Frame, check_size

RAYS = 32  # points of an instance that are looked at
MOST_CELLS, BATCH = 640, 64  # cells from which the rays are followed, and how many at a time
LEAST_SEEN = 0.5  # share of the rays that make a line of sight
SIDEWAYS = 0.25  # metres off the wanted distance that weigh as much as one metre off the instance's centre


@dataclass(frozen=True, eq=False)
class RobotPose:
    """A pose on the floor beside an instance. position [3] and map_from_robot [4, 4], rigid, in `frame`; the robot's
    frame is that of REP 103: origin on the floor below its centre, x forward to the instance, z up.

    yaw: of x about the z axis of `frame`, radians. distance: level, to the nearest point of the instance, metres.
    seen: share of the rays to the instance that nothing blocks.

    >>> RobotPose(4, np.eye(4), distance=0.6, seen=1.0, frame="map").yaw
    0.0
    """

    instance_id: int
    map_from_robot: np.ndarray
    distance: float
    seen: float
    frame: str

    @property
    def position(self) -> np.ndarray:
        """[3] of the robot's centre on the floor, metres in `frame`."""
        return self.map_from_robot[:3, 3]

    @property
    def yaw(self) -> float:
        """Of x about z, radians."""
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
) -> RobotPose:
    """The pose from which a robot faces and sees an instance. All lengths are in metres.

    radius: of the robot's disc on the floor. distance: wanted from its centre to the nearest point of the instance,
    level; within: the largest. sensor_height: of the sensor above the floor, over the centre. frame: of the result.

    The disc lies on free floor (`FreeSpace`), in the largest connected part that such a robot can drive in. Of its
    cells the one is taken that is nearest to the wanted distance and before the middle of the instance, and has line
    of sight: at least half of the rays from the sensor to 32 points of the instance meet no voxel of 5 cm with a point
    of another Gaussian before their last 10 cm. The instance does not hide itself.

    Raises UnknownInstance; InputError for a map without metric scale, gravity, cameras or floor, for lengths that are
    not positive, and when no cell is free or none of them has line of sight.

    >>> pose = where_to_stand(perception.load_map("room.gsmap"), 1, radius=0.25, distance=0.6)
    >>> pose.map_from_robot.shape, bool(abs(pose.distance - 0.6) < 0.05), pose.seen
    ((4, 4), True, 1.0)
    """
    lengths = {"radius": radius, "distance": distance, "within": within, "sensor_height": sensor_height}
    for name, value in lengths.items():
        check_size(f"where_to_stand: {name}", value)
    gmap.position(instance_id)
    space, points = gmap.free_space, gmap.index.of(instance_id)
    points = move_points(np.linalg.inv(space.map_from_grid), points.astype(np.float64))
    centers = (np.argwhere(space.reachable(radius))[:, ::-1] + 0.5) * CELL
    gaps = cKDTree(points[:, :2]).query(centers, distance_upper_bound=within)[0]
    near = np.isfinite(gaps)
    if not near.any():
        raise InputError(
            f"instance {instance_id}: no free floor within {within} m of it that a robot of radius {radius} m reaches"
        )
    centers, gaps, middle = centers[near], gaps[near], points.mean(axis=0)[:2]
    order = np.argsort(np.abs(gaps - distance) + SIDEWAYS * np.linalg.norm(centers - middle, axis=1), kind="stable")
    order = order[:: -(-len(order) // MOST_CELLS)]
    targets = points[np.linspace(0, len(points) - 1, RAYS).astype(int)]
    for some in np.split(order, range(BATCH, len(order), BATCH)):
        eyes = np.c_[centers[some], np.full(len(some), sensor_height)]
        seen = space.seen(instance_id, eyes, targets).mean(axis=1)
        if seen.max() >= LEAST_SEEN:
            best = int((seen >= LEAST_SEEN).argmax())
            chosen = some[best]
            pose = space.map_from_grid @ _facing(centers[chosen], middle)
            if frame is not None:
                pose = frame.from_map @ pose
                pose[:3, :3] /= scale_of(pose)
            name = gmap.frame if frame is None else frame.name
            return RobotPose(instance_id, pose, float(gaps[chosen]), float(seen[best]), name)
    raise InputError(f"instance {instance_id}: is hidden from every free place within {within} m of it")


def _facing(center: np.ndarray, target: np.ndarray) -> np.ndarray:
    """grid_from_robot [4, 4] of a robot at `center` [2] that faces `target` [2]."""
    ahead = target - center if (target != center).any() else np.array([1.0, 0.0])
    x, y = ahead / np.linalg.norm(ahead)
    return np.array([[x, -y, 0, center[0]], [y, x, 0, center[1]], [0, 0, 1, 0], [0, 0, 0, 1]])
