"""Camera poses from a bag's transforms (tf, tf_static) and odometry."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from perception.bags.read import ODOMETRY, TRANSFORMS, Bag
from perception.geometry import interpolated_pose, inverse_se3

FIXED_FRAMES = ("map", "odom", "world")
MAX_GAP = 0.5
"""Maximum time in seconds between two samples of a moving frame for a pose to be interpolated."""


class Poses:
    """A tree of frames over time: parent_from_child samples of every child frame."""

    def __init__(self) -> None:
        self._samples: dict[str, list[tuple[int, np.ndarray]]] = {}
        self._static: set[str] = set()
        self.parents: dict[str, str] = {}
        self._arrays: dict[str, tuple[np.ndarray, np.ndarray]] = {}

    def add(self, parent: str, child: str, time: int, parent_from_child: np.ndarray, static: bool = False) -> None:
        """Adds one sample [4, 4] at a time in ns. A frame keeps its first parent."""
        parent, child = parent.lstrip("/"), child.lstrip("/")
        if self.parents.setdefault(child, parent) != parent:
            return
        self._samples.setdefault(child, []).append((time, parent_from_child))
        if static:
            self._static.add(child)

    def root(self, frame: str) -> str:
        """The topmost ancestor of a frame."""
        return [frame.lstrip("/"), *self._ancestors(frame)][-1]

    def chain(self, fixed: str, frame: str) -> list[str] | None:
        """Frames from `frame` up to just below `fixed`; None if `fixed` is not an ancestor of `frame`."""
        fixed, frames = fixed.lstrip("/"), [frame.lstrip("/")]
        while frames[-1] != fixed:
            parent = self.parents.get(frames[-1])
            if parent is None or parent in frames:
                return None
            frames.append(parent)
        return frames[:-1]

    def camera_from_world(self, fixed: str, frame: str, time: int) -> np.ndarray | None:
        """[4, 4] at a time in ns, interpolated; None if the frames are not connected or there is no sample nearby."""
        chain = self.chain(fixed, frame)
        if not chain:
            return None
        fixed_from_frame = np.eye(4)
        for child in chain:
            step = self._at(child, time)
            if step is None:
                return None
            fixed_from_frame = step @ fixed_from_frame
        return inverse_se3(fixed_from_frame)

    def between(self, a: str, b: str, time: int) -> np.ndarray | None:
        """a_from_b [4, 4] at a time in ns, by their nearest common ancestor; None as in `camera_from_world`."""
        above = [[frame.lstrip("/"), *self._ancestors(frame)] for frame in (a, b)]
        common = next((frame for frame in above[0] if frame in above[1]), None)
        if common is None:
            return None
        ends = [
            np.eye(4) if frames[0] == common else self.camera_from_world(common, frames[0], time) for frames in above
        ]
        return None if ends[0] is None or ends[1] is None else ends[0] @ inverse_se3(ends[1])

    def _ancestors(self, frame: str) -> list[str]:
        found: list[str] = []
        while (parent := self.parents.get(found[-1] if found else frame.lstrip("/"))) and parent not in found:
            found.append(parent)
        return found

    def _at(self, child: str, time: int) -> np.ndarray | None:
        if child not in self._arrays:
            samples = sorted(self._samples[child], key=lambda sample: sample[0])
            self._arrays[child] = np.array([t for t, _ in samples]), np.stack([m for _, m in samples])
        times, matrices = self._arrays[child]
        if child in self._static:
            return np.asarray(matrices[-1])
        return interpolated_pose(times, matrices, time, MAX_GAP * 1e9)


def read_poses(bag: Bag, odometry: str | None = None) -> Poses:
    """All transforms of a bag. odometry [topic] (default: all odometry) adds frames that tf does not define."""
    poses = Poses()
    for topic, _, message in bag.messages(bag.of_type(*TRANSFORMS)):
        for entry in message.transforms:
            t, q = entry.transform.translation, entry.transform.rotation
            static = topic.rstrip("/").endswith("static")
            poses.add(entry.header.frame_id, entry.child_frame_id, _time(entry), _matrix(t, q), static)
    topics = [odometry] if odometry else bag.of_type(ODOMETRY)
    for _, _, message in bag.messages(topics):
        pose = message.pose.pose
        child = message.child_frame_id or "base_link"
        poses.add(message.header.frame_id, child, _time(message), _matrix(pose.position, pose.orientation))
    return poses


def _time(message: Any) -> int:
    return int(message.header.stamp.sec) * 1_000_000_000 + int(message.header.stamp.nanosec)


def _matrix(position: Any, quaternion: Any) -> np.ndarray:
    matrix = np.eye(4)
    xyzw = np.array([quaternion.x, quaternion.y, quaternion.z, quaternion.w])
    matrix[:3, :3] = Rotation.from_quat(xyzw if np.linalg.norm(xyzw) > 0 else [0, 0, 0, 1]).as_matrix()
    matrix[:3, 3] = position.x, position.y, position.z
    return matrix
