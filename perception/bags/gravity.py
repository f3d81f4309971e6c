"""The direction of gravity in the world of a bag's poses, from accelerometers."""

from __future__ import annotations

import numpy as np

from perception.bags.poses import Poses
from perception.bags.read import Bag, stamp_of

IMU = "sensor_msgs/msg/Imu"
G = 9.81
STILL_TURN, STILL_PUSH = 0.5, 0.5
"""Largest rate of turn in rad/s and largest difference of the measured acceleration from G in m/s² of used samples."""
LEAST_SAMPLES, MOST_SAMPLES, BLOCKS = 20, 400, 8
BIAS_DEG = 0.6
"""Standard error in degrees that averaging does not reduce: a bias of 0.1 m/s² of the accelerometer."""


def gravity(bag: Bag, poses: Poses, fixed: str) -> tuple[np.ndarray, float] | None:
    """Unit vector [3] that points down in frame `fixed`, and its standard error in degrees; None without an IMU.

    An accelerometer at rest measures the acceleration that holds it up. Samples taken while moving slowly are rotated
    into the world by tf and averaged; the error is the spread of the means of BLOCKS stretches of time, and BIAS_DEG.
    """
    samples = []
    for _, recorded, message in bag.messages(bag.of_type(IMU)):
        push, turn = (
            np.array([v.x, v.y, v.z], np.float64) for v in (message.linear_acceleration, message.angular_velocity)
        )
        size = float(np.linalg.norm(push))
        if abs(size - G) < STILL_PUSH and not np.linalg.norm(turn) > STILL_TURN:  # a gyroscope may be absent: NaN
            samples.append((str(message.header.frame_id), stamp_of(message) or recorded, push / size))
    kept = np.unique(np.linspace(0, len(samples) - 1, min(len(samples), MOST_SAMPLES)).round().astype(int))
    ups = []
    for frame, time, push in (samples[index] for index in kept):
        imu_from_world = poses.camera_from_world(fixed, frame, time)
        if imu_from_world is not None:
            ups.append(imu_from_world[:3, :3].T @ push)
    if len(ups) < LEAST_SAMPLES:
        return None
    means = np.array([np.mean(block, axis=0) for block in np.array_split(np.array(ups), BLOCKS)])
    down = -means.mean(axis=0) / np.linalg.norm(means.mean(axis=0))
    spread = np.degrees(np.linalg.norm(means - means.mean(axis=0), axis=1))
    error = float(np.sqrt((spread**2).sum() / (BLOCKS * (BLOCKS - 1)) + BIAS_DEG**2))
    return down, error
