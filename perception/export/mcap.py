"""A labelled cloud and its instances as ROS 2 messages in an MCAP file, through the optional package `rosbags`."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from perception.boxes import instance_boxes
from perception.errors import InputError, missing_extra
from perception.io.atomic import replacing
from perception.io.cdr import serialize, typestore
from perception.io.ros_messages import DETECTIONS, POINT_CLOUD, Stamp, detection, header, packed_rgb, point_cloud2
from perception.types import OrientedBox, PointCloud


def write_mcap(
    path: str | Path,
    cloud: PointCloud,
    labels: np.ndarray,
    instances: Mapping[int, Mapping[str, Any]],
    *,
    frame: str = "map",
    stamp_ns: int = 0,
) -> None:
    """One PointCloud2 on /perception/points (x y z rgb instance_id) and one Detection3DArray on
    /perception/instances.

    Points keep their order; not a number stays so. stamp_ns: time of both messages in nanoseconds.
    """
    try:
        from rosbags.rosbag2 import StoragePlugin, Writer
    except ImportError as error:
        raise missing_extra("rosbags", "ros") from error
    path = Path(path)
    stamp = (stamp_ns // 1_000_000_000, stamp_ns % 1_000_000_000)
    messages = {
        "/perception/points": (POINT_CLOUD, labelled_cloud(cloud, labels, frame, stamp)),
        "/perception/instances": (DETECTIONS, detections(cloud.points, labels, instances, frame, stamp)),
    }
    with tempfile.TemporaryDirectory() as folder:
        bag = Path(folder) / "bag"
        with Writer(bag, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
            for topic, (kind, message) in messages.items():
                connection = writer.add_connection(topic, kind, typestore=typestore())
                writer.write(connection, stamp_ns, serialize(kind, message))
        written = list(bag.glob("*.mcap"))
        if len(written) != 1:
            raise InputError(f"{path}: rosbags wrote {len(written)} MCAP files, expected one; update rosbags")
        with replacing(path) as file, written[0].open("rb") as source:
            while block := source.read(1 << 24):
                file.write(block)


def labelled_cloud(cloud: PointCloud, labels: np.ndarray, frame: str, stamp: Stamp) -> dict[str, Any]:
    """sensor_msgs/PointCloud2 with x y z (float32), rgb packed as in PCL when known, instance_id (int32)."""
    columns = {axis: cloud.points[:, i].astype(np.float32) for i, axis in enumerate("xyz")}
    if cloud.colors is not None:
        columns["rgb"] = packed_rgb(cloud.colors)
    columns["instance_id"] = labels.astype(np.int32)
    return point_cloud2(columns, frame, stamp)


def detections(
    points: np.ndarray, labels: np.ndarray, instances: Mapping[int, Mapping[str, Any]], frame: str, stamp: Stamp
) -> dict[str, Any]:
    """vision_msgs/Detection3DArray: one detection for each instance, its oriented box, label (or id) and score."""
    head = header(frame, stamp)
    found = []
    for i, facts in instance_boxes(points, labels).items():
        known, obb = instances.get(i, {}), facts["obb"]
        box = OrientedBox(np.array(obb["center"]), np.array(obb["rotation"]), np.array(obb["extent"]))
        found.append(detection(box, known.get("label") or str(i), known.get("score", 1.0), str(i), head))
    return {"header": head, "detections": found}
