"""Camera poses from a bag's transforms (tf, tf_static) and odometry; gravity in their world."""

from __future__ import annotations

from array import array
from dataclasses import dataclass
from itertools import groupby, takewhile
from sys import intern
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from perception.bags.read import IMU, ODOMETRY, TRANSFORMS, Bag, Recorded, stamp_of
from perception.geometry import interpolated_pose, inverse_se3, transform

FIXED_FRAMES = ("map", "odom", "world")
MAX_GAP = 0.5
"""Maximum time in seconds between two samples of a moving frame for a pose to be interpolated."""
SET_BACK = 1_000_000_000
"""Least time in ns by which stamps fall when a clock is set back, or a recording is played again."""
G = 9.81
STILL_TURN, STILL_PUSH = 0.5, 0.5
"""Largest rate of turn in rad/s and largest difference of the measured acceleration from G in m/s² of used samples."""
LEAST_SAMPLES, MOST_SAMPLES, BLOCKS = 20, 400, 8
BIAS_DEG = 0.6
"""Standard error in degrees that averaging does not reduce: a bias of 0.1 m/s² of the accelerometer."""
BASES, CONVENTION_DEG = ("base_link", "base_footprint"), 2.0
"""Frames of a mobile robot, under which its odometry is by REP 105: z up, as level as the floor it drives on."""


class Poses:
    """A tree of frames over time: parent_from_child samples of every child frame. topics: of each child frame, those
    with its poses, of which the first is taken."""

    def __init__(self) -> None:
        self.parents = dict[str, str]()
        self._samples: dict[str, tuple[array[int], array[float]]] = {}  # times and rows of the poses: may be millions
        self._static = set[str]()
        self.topics = dict[str, list[str]]()
        self._arrays = dict[str, tuple[np.ndarray, np.ndarray]]()
        self._twice = dict[str, np.ndarray]()  # of each child, the spans [S, 2] of stamps that came twice

    def add(self, parent: str, child: str, time: int, parent_from_child: np.ndarray, static: bool = False) -> None:
        """Adds one sample [4, 4] at a time in ns. A frame keeps its first parent."""
        parent, child = parent.lstrip("/"), child.lstrip("/")
        if self.parents.setdefault(child, parent) != parent:
            return
        times, rows = self._samples.setdefault(child, (array("q"), array("d")))
        times.append(time)
        rows.extend(parent_from_child[:3].ravel())
        if static:
            self._static.add(child)

    def path(self, frame: str) -> list[str]:
        """The frame and its ancestors up to the root of its tree."""
        found = [frame.lstrip("/")]
        while (parent := self.parents.get(found[-1])) is not None and parent not in found:
            found.append(parent)
        return found

    def told(self, frame: str) -> str | None:
        """Of which topics the poses above `frame` are, where there are several, and whose clock was set back before
        they were asked for; None where there is nothing to tell."""
        several = {child: found for child in self.path(frame) if len(found := self.topics.get(child, [])) > 1}
        lines = [f"'{child}' by {found[0]}, not {', '.join(found[1:])}" for child, found in several.items()]
        back = [child for child in self.path(frame) if len(self._twice.get(child, ()))]
        lines += [f"none at stamps of '{child}' that came twice: its clock was set back" for child in back]
        return "; ".join(lines) or None

    def camera_from_world(self, fixed: str, frame: str, time: int) -> np.ndarray | None:
        """[4, 4] at a time in ns, interpolated; None if `fixed` is no ancestor of `frame`, or no sample is near."""
        frames, fixed_from_frame = self.path(frame), np.eye(4)
        if fixed.lstrip("/") not in frames[1:]:
            return None
        for child in frames[: frames.index(fixed.lstrip("/"))]:
            step = self._at(child, time)
            if step is None:
                return None
            fixed_from_frame = step @ fixed_from_frame
        return inverse_se3(fixed_from_frame)

    def between(self, a: str, b: str, time: int) -> np.ndarray | None:
        """a_from_b [4, 4] at a time in ns, by their nearest common ancestor; None as in `camera_from_world`."""
        paths = [self.path(frame) for frame in (a, b)]
        common = next((frame for frame in paths[0] if frame in paths[1]), None)
        if common is None:
            return None
        ends = [np.eye(4) if path[0] == common else self.camera_from_world(common, path[0], time) for path in paths]
        return None if ends[0] is None or ends[1] is None else ends[0] @ inverse_se3(ends[1])

    def _at(self, child: str, time: int) -> np.ndarray | None:
        if child not in self._arrays:
            stamps, rows = (np.array(column) for column in self._samples.pop(child))
            latest = np.maximum.accumulate(stamps)
            back = (stamps < latest - SET_BACK) & (child not in self._static)
            first = np.flatnonzero(back & ~np.r_[False, back[:-1]])
            self._twice[child] = np.stack([stamps[first], latest[first]], axis=1)
            poses, order = np.tile(np.eye(4), (len(stamps), 1, 1)), np.argsort(stamps, kind="stable")
            poses[:, :3] = rows.reshape(-1, 3, 4)[order]
            self._arrays[child] = stamps[order], poses
        times, matrices = self._arrays[child]
        if child in self._static:
            return np.asarray(matrices[-1])
        if ((self._twice[child][:, 0] <= time) & (time <= self._twice[child][:, 1])).any():
            return None
        return interpolated_pose(times, matrices, time, MAX_GAP * 1e9)


def nearest_first(topics: list[str], image: str) -> list[list[str]]:
    """Topics in groups, the first of the namespace of the topic `image`: robots may use the same names of frames.
    /r2/tf comes before /tf, and that before /r1/tf, for /r2/camera/image_raw."""

    def apart(topic: str) -> tuple[int, int]:
        own, other = (name.split("/")[1:-1] for name in (topic, image))
        shared = sum(1 for _ in takewhile(lambda pair: pair[0] == pair[1], zip(own, other, strict=False)))
        return -shared, len(own) - shared

    return [list(group) for _, group in groupby(sorted(topics, key=apart), apart)]


def read_poses(bag: Bag, image: str, odometry: str | None = None) -> Poses:
    """All transforms of a bag; odometry adds frames that tf does not define, that of the topic `odometry` comes before
    tf. Of several topics with poses of one frame the first is taken: a filter on tf and wheel odometry differ, and so
    do two robots (see `nearest_first`; image: the topic of the photos)."""
    poses, topics = Poses(), bag.of_type(ODOMETRY)

    def add(one: Recorded, entry: Any, child: str, position: Any, quaternion: Any, static: bool = False) -> None:
        matrix, used = _matrix(position, quaternion), poses.topics.setdefault(child.lstrip("/"), [])
        if matrix is None:
            bag.leave_out(one.topic, one.number, f"the pose of '{child}' is not finite, or no rotation")
            return
        if one.topic not in used:
            used.append(one.topic)
        if one.topic == used[0]:
            poses.add(entry.header.frame_id, child, stamp_of(entry) or one.time, matrix, static)

    def add_odometry(topics: list[str]) -> None:
        for one in bag.messages(topics):
            pose, child = one.message.pose.pose, one.message.child_frame_id or "base_link"
            add(one, one.message, child, pose.position, pose.orientation)

    if odometry is not None:
        add_odometry([bag.chosen(topics, odometry, "odometry", "--odometry")])
    for group in nearest_first(bag.of_type(*TRANSFORMS), image):
        for one in bag.messages(group):
            for entry in one.message.transforms:
                static = one.topic.rstrip("/").endswith("static")
                add(one, entry, entry.child_frame_id, entry.transform.translation, entry.transform.rotation, static)
    for group in nearest_first([topic for topic in topics if topic != odometry], image):
        add_odometry(group)
    return poses


def _matrix(position: Any, quaternion: Any) -> np.ndarray | None:
    """[4, 4]; None for numbers that are not finite, and a quaternion of zeros, which is no rotation."""
    xyzw, xyz = [quaternion.x, quaternion.y, quaternion.z, quaternion.w], [position.x, position.y, position.z]
    if not np.isfinite([*xyzw, *xyz]).all() or not any(xyzw):
        return None
    return transform(Rotation.from_quat(xyzw).as_matrix(), xyz)


@dataclass(frozen=True)
class Down:
    """direction: unit vector [3] that points down; its standard error in degrees; source: in words."""

    direction: np.ndarray
    standard_error: float
    source: str


def gravity(bag: Bag, poses: Poses, fixed: str, frame: str) -> Down | None:
    """Gravity in the world `fixed` of the camera `frame`: by accelerometers, else by convention if the camera is a
    mobile robot's; None where neither tells."""
    measured = _by_accelerometers(bag, poses, fixed)
    if measured is not None:
        return measured
    path = poses.path(frame)
    robot = any(name.rsplit("/", 1)[-1] in BASES for name in path[: path.index(fixed.lstrip("/"))])
    if fixed.lstrip("/") not in FIXED_FRAMES or not robot:
        return None
    return Down(np.array([0.0, 0.0, -1.0]), CONVENTION_DEG, f"z of '{fixed}' is up (REP 105)")


def _by_accelerometers(bag: Bag, poses: Poses, fixed: str) -> Down | None:
    """As `gravity`; None without an IMU.

    An accelerometer at rest measures the acceleration that holds it up. Samples taken while moving slowly are rotated
    into the world by tf and averaged; the error is the spread of the means of BLOCKS stretches of time, and BIAS_DEG.
    """
    frames, times, pushes = list[str](), array("q"), array("d")  # millions in a long bag
    for one in bag.messages(bag.of_type(IMU)):
        message = one.message
        vectors = (message.linear_acceleration, message.angular_velocity)
        push, turn = (np.array([v.x, v.y, v.z], np.float64) for v in vectors)
        size = float(np.linalg.norm(push))
        if abs(size - G) < STILL_PUSH and not np.linalg.norm(turn) > STILL_TURN:  # a gyroscope may be absent: NaN
            frames.append(intern(str(message.header.frame_id)))
            times.append(stamp_of(message) or one.time)
            pushes.extend(push / size)
    kept = np.unique(np.linspace(0, len(times) - 1, min(len(times), MOST_SAMPLES)).round().astype(int))
    ups = []
    for n in kept.tolist():
        imu_from_world = poses.camera_from_world(fixed, frames[n], times[n])
        if imu_from_world is not None:
            ups.append(imu_from_world[:3, :3].T @ pushes[3 * n : 3 * n + 3])
    if len(ups) < LEAST_SAMPLES:
        return None
    means = np.array([np.mean(block, axis=0) for block in np.array_split(np.array(ups), BLOCKS)])
    up = means.mean(axis=0)
    spread = np.degrees(np.linalg.norm(means - up, axis=1))
    error = float(np.sqrt((spread**2).sum() / (BLOCKS * (BLOCKS - 1)) + BIAS_DEG**2))
    return Down(-up / np.linalg.norm(up), error, "from the IMU")
