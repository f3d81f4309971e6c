"""A labelled cloud and its instances as ROS 2 messages in an MCAP file, through the optional package `rosbags`."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from perception.boxes import instance_boxes
from perception.errors import InputError, missing_extra
from perception.io.atomic import replacing
from perception.io.cdr import serialize, typestore
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
from perception.types import OrientedBox, PointCloud

Timed = tuple[str, str, int, dict[str, Any]]
"""A message: topic, type, time in nanoseconds, fields."""


def write_mcap(
    path: str | Path,
    cloud: PointCloud,
    labels: np.ndarray,
    instances: Mapping[int, Mapping[str, Any]],
    *,
    frame: str = "map",
    stamp_ns: int = 0,
) -> None:
    """One PointCloud2 on /perception/points (x y z rgb instance_id), one Detection3DArray on /perception/instances, and
    the same boxes with their words as a MarkerArray, which viewers draw, on /perception/boxes.

    Points keep their order; not a number stays so. stamp_ns: time of the messages in nanoseconds.
    """
    stamp = (stamp_ns // 1_000_000_000, stamp_ns % 1_000_000_000)
    found = detections(cloud.points, labels, instances, frame, stamp)
    boxes = {int(i): OrientedBox.from_json(facts["obb"]) for i, facts in instance_boxes(cloud.points, labels).items()}
    words = [(box, instances.get(i, {}).get("label") or str(i)) for i, box in boxes.items()]
    write_bag(
        Path(path),
        [
            ("/perception/points", POINT_CLOUD, stamp_ns, labelled_cloud(cloud, labels, frame, stamp)),
            ("/perception/instances", DETECTIONS, stamp_ns, found),
            ("/perception/boxes", MARKERS, stamp_ns, box_markers(words, "instances", header(frame, stamp))),
        ],
    )


def write_bag(path: Path, messages: Iterable[Timed]) -> None:
    """An MCAP file of ROS 2 messages (topic, type, nanoseconds, fields); written aside, then put in place."""
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
