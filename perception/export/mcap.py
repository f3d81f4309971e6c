"""Writes a map and its photos as an MCAP recording of ROS 2 messages, for Foxglove, RViz and `ros2 bag`.

Requires the optional package `rosbags`.
"""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from perception.colors import instance_palette
from perception.errors import InputError, missing_extra
from perception.io.atomic import replacing
from perception.io.cdr import serialize, typestore
from perception.io.photos import load_photo, scaled_K
from perception.io.ros_messages import (
    DETECTIONS,
    MARKERS,
    POINT_CLOUD,
    Stamp,
    box_markers,
    detection,
    header,
    packed_rgb,
    point_cloud2,
)
from perception.types import OrientedBox, PointCloud, View

IMAGE = "sensor_msgs/msg/CompressedImage"
CAMERA = "sensor_msgs/msg/CameraInfo"
TRANSFORM = "tf2_msgs/msg/TFMessage"
PHOTO_SIDE = 640
"""Long side of the recorded photos in pixels."""
START, STEP = 1_000_000_000, 500_000_000
"""Time of the map, and time between photos, in nanoseconds. ROS interprets time 0 as "no time"."""
CAMERA_FRAME = "camera"

Timed = tuple[str, str, int, dict[str, Any]]
"""A message: topic, type, time in nanoseconds, fields."""


def write_recording(
    path: Path,
    cloud: PointCloud,
    labels: np.ndarray,
    instances: Sequence[dict[str, Any]],
    views: Sequence[View],
    frame: str = "map",
) -> None:
    """Writes a labelled cloud, the map's instances and its photos, all in the map's frame.

    labels [P] int32, −1 = none. instances: entries of instances.json; hidden ones are left out. At the start:
    /map/points (PointCloud2: x y z and, when known, rgb), /map/instances (PointCloud2: the labelled points in their
    instance's colour, with instance_id), /map/boxes (MarkerArray), /map/detections (Detection3DArray). Then photo by
    photo: /tf (map → camera), /camera/camera_info, /camera/image/compressed. A missing photo is left out, its
    camera is still written.
    """
    messages = _map_messages(cloud, labels, [entry for entry in instances if not entry.get("hidden")], frame)
    for i, view in enumerate(views):
        messages += _photo_messages(view, START + i * STEP, frame)
    _write_bag(path, messages)


def _map_messages(
    cloud: PointCloud, labels: np.ndarray, instances: Sequence[dict[str, Any]], frame: str
) -> list[Timed]:
    stamp = _stamp(START)
    head = header(frame, stamp)
    own = labels >= 0
    boxes = [(int(e["id"]), OrientedBox.from_json(e["obb"]), e.get("label") or str(e["id"])) for e in instances]
    scores = [float(entry.get("score", 1.0)) for entry in instances]
    found = [detection(box, name, s, str(i), head) for (i, box, name), s in zip(boxes, scores, strict=True)]
    ids = {"instance_id": labels[own].astype(np.int32)}
    told = {
        "/map/points": (POINT_CLOUD, _cloud(cloud.points, cloud.colors, {}, frame, stamp)),
        "/map/instances": (POINT_CLOUD, _cloud(cloud.points[own], instance_palette(labels[own]), ids, frame, stamp)),
        "/map/boxes": (MARKERS, box_markers(boxes, "instances", head)),
        "/map/detections": (DETECTIONS, {"header": head, "detections": found}),
    }
    return [(topic, kind, START, message) for topic, (kind, message) in told.items()]


def _cloud(
    points: np.ndarray, colors: np.ndarray | None, more: dict[str, np.ndarray], frame: str, stamp: Stamp
) -> dict[str, Any]:
    columns = {axis: points[:, i].astype(np.float32) for i, axis in enumerate("xyz")}
    if colors is not None:
        columns["rgb"] = packed_rgb(colors)
    return point_cloud2(columns | more, frame, stamp)


def _photo_messages(view: View, time: int, frame: str) -> list[Timed]:
    head = header(CAMERA_FRAME, _stamp(time))
    rotation = view.camera_from_world[:3, :3].T
    place = -rotation @ view.camera_from_world[:3, 3]
    turn = Rotation.from_matrix(rotation).as_quat()
    transform = {
        "header": header(frame, _stamp(time)),
        "child_frame_id": CAMERA_FRAME,
        "transform": {
            "translation": dict(zip("xyz", map(float, place), strict=True)),
            "rotation": dict(zip("xyzw", map(float, turn), strict=True)),
        },
    }
    messages: list[Timed] = [("/tf", TRANSFORM, time, {"transforms": [transform]})]
    with contextlib.suppress(InputError):  # a missing photo
        photo = load_photo(view, PHOTO_SIDE)
        height, width = photo.shape[:2]
        K = scaled_K(view, width, height)
        info = {
            "header": head,
            "height": height,
            "width": width,
            "distortion_model": "plumb_bob",
            "d": np.zeros(5),
            "k": K.reshape(-1),
            "r": np.eye(3).reshape(-1),
            "p": np.hstack([K, np.zeros((3, 1))]).reshape(-1),
        }
        encoded = cv2.imencode(".jpg", photo[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 85])[1]
        image = {"header": head, "format": "jpeg", "data": np.asarray(encoded, np.uint8).reshape(-1)}
        messages += [("/camera/camera_info", CAMERA, time, info), ("/camera/image/compressed", IMAGE, time, image)]
    return messages


def _stamp(time: int) -> Stamp:
    return time // 1_000_000_000, time % 1_000_000_000


def _write_bag(path: Path, messages: Iterable[Timed]) -> None:
    """Writes an MCAP file of messages atomically."""
    try:
        from rosbags.rosbag2 import StoragePlugin, Writer
    except ImportError as error:
        raise missing_extra("rosbags", "ros") from error
    with tempfile.TemporaryDirectory() as folder:
        bag = Path(folder) / "bag"
        with Writer(bag, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
            topics: dict[str, Any] = {}
            for topic, kind, time, message in messages:
                if topic not in topics:
                    topics[topic] = writer.add_connection(topic, kind, typestore=typestore())
                writer.write(topics[topic], time, serialize(kind, message))
        written = list(bag.glob("*.mcap"))
        if len(written) != 1:
            raise InputError(f"{path}: rosbags wrote {len(written)} MCAP files, expected one; update rosbags")
        with replacing(path) as file, written[0].open("rb") as source:
            while block := source.read(1 << 24):
                file.write(block)
