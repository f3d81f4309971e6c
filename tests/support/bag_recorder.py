"""Writes bags of made messages: images, depth, camera_info, transforms, odometry and IMU."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy.spatial.transform import Rotation


@cache
def typestore(ros1: bool):
    """The messages of one ROS generation. It compiles how each is written once."""
    store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
    if ros1:  # which its store leaves out
        entries = "geometry_msgs/TransformStamped[] transforms\n"
        store.register(get_types_from_msg(entries, "tf2_msgs/msg/TFMessage"))
    return store


class Recorder:
    """Writes messages of one ROS generation; kind: "ros1", "sqlite" or "mcap"."""

    def __init__(self, path: Path, kind: str) -> None:
        self.ros1 = kind == "ros1"
        self.store = typestore(self.ros1)
        plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
        self.writer = Writer1(path) if self.ros1 else Writer2(path, version=9, storage_plugin=plugin)
        self.writer.open()
        self.topics: dict = {}
        self.sequence = 0

    def close(self) -> None:
        self.writer.close()

    def type(self, name: str):
        return self.store.types[name]

    def header(self, time: int, frame: str):
        stamp = self.type("builtin_interfaces/msg/Time")(time // 10**9, time % 10**9)
        extra = {"seq": 0} if self.ros1 else {}
        return self.type("std_msgs/msg/Header")(stamp=stamp, frame_id=frame, **extra)

    def write(self, topic: str, kind: str, time: int, message) -> None:
        if topic not in self.topics:
            self.topics[topic] = self.writer.add_connection(topic, kind, typestore=self.store)
        serialize = self.store.serialize_ros1 if self.ros1 else self.store.serialize_cdr
        self.writer.write(self.topics[topic], time, serialize(message, kind))

    def image(self, topic: str, time: int, picture: np.ndarray, frame: str = "cam", encoding: str = "bgr8") -> None:
        kind = "sensor_msgs/msg/Image"
        height, width = picture.shape[:2]
        data = np.frombuffer(picture.tobytes(), np.uint8)
        step = data.size // height
        image = self.type(kind)(self.header(time, frame), height, width, encoding, 0, step, data)
        self.write(topic, kind, time, image)

    def jpeg(self, topic: str, time: int, data: bytes, frame: str = "cam", name: str = "jpeg") -> None:
        kind = "sensor_msgs/msg/CompressedImage"
        message = self.type(kind)(self.header(time, frame), name, np.frombuffer(data, np.uint8))
        self.write(topic, kind, time, message)

    def info(
        self, topic: str, time: int, size: tuple[int, int], K: np.ndarray, D: list, model: str = "plumb_bob"
    ) -> None:
        kind = "sensor_msgs/msg/CameraInfo"
        roi = self.type("sensor_msgs/msg/RegionOfInterest")(0, 0, 0, 0, False)
        names = ("D", "K", "R", "P") if self.ros1 else ("d", "k", "r", "p")
        P = np.hstack([K * 0.9, np.zeros((3, 1))])
        values = [np.array(v, np.float64).ravel() for v in (D, K, np.eye(3), P)]
        fields = dict(zip(names, values, strict=True))
        header = self.header(time, "cam")
        common = {"height": size[1], "width": size[0], "distortion_model": model, "binning_x": 0, "binning_y": 0}
        self.write(topic, kind, time, self.type(kind)(header=header, roi=roi, **common, **fields))

    def transform(self, topic: str, time: int, parent: str, child: str, matrix: np.ndarray) -> None:
        x, y, z, w = Rotation.from_matrix(matrix[:3, :3]).as_quat()
        vector = self.type("geometry_msgs/msg/Vector3")(*map(float, matrix[:3, 3]))
        quaternion = self.type("geometry_msgs/msg/Quaternion")(x, y, z, w)
        transform = self.type("geometry_msgs/msg/Transform")(vector, quaternion)
        entry = self.type("geometry_msgs/msg/TransformStamped")(self.header(time, parent), child, transform)
        self.write(topic, "tf2_msgs/msg/TFMessage", time, self.type("tf2_msgs/msg/TFMessage")([entry]))

    def odometry(self, topic: str, time: int, matrix: np.ndarray) -> None:
        x, y, z, w = Rotation.from_matrix(matrix[:3, :3]).as_quat()
        g = {
            name: self.type(f"geometry_msgs/msg/{name}") for name in ("Point", "Quaternion", "Pose", "Twist", "Vector3")
        }
        pose = g["Pose"](g["Point"](*map(float, matrix[:3, 3])), g["Quaternion"](x, y, z, w))
        none = g["Vector3"](0.0, 0.0, 0.0)
        with_pose = self.type("geometry_msgs/msg/PoseWithCovariance")(pose, np.zeros(36))
        with_twist = self.type("geometry_msgs/msg/TwistWithCovariance")(g["Twist"](none, none), np.zeros(36))
        kind = "nav_msgs/msg/Odometry"
        self.write(topic, kind, time, self.type(kind)(self.header(time, "odom"), "base", with_pose, with_twist))

    def imu(self, topic: str, time: int, acceleration: np.ndarray, turn: np.ndarray, frame: str = "imu") -> None:
        vector, none = self.type("geometry_msgs/msg/Vector3"), np.zeros(9)
        unknown = self.type("geometry_msgs/msg/Quaternion")(0.0, 0.0, 0.0, 1.0)
        fields = (unknown, none, vector(*map(float, turn)), none, vector(*map(float, acceleration)), none)
        kind = "sensor_msgs/msg/Imu"
        self.write(topic, kind, time, self.type(kind)(self.header(time, frame), *fields))
