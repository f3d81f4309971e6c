"""A labelled cloud and its instances as ROS 2 messages in an MCAP file, through the optional package
`rosbags`.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from perception.boxes import instance_boxes
from perception.errors import InputError, missing_extra
from perception.io.atomic import replacing
from perception.types import PointCloud

# vision_msgs 4 (ROS 2 Humble and later), which rosbags does not carry itself.
_VISION = {
    "vision_msgs/msg/ObjectHypothesis": "string class_id\nfloat64 score\n",
    "vision_msgs/msg/ObjectHypothesisWithPose": (
        "vision_msgs/ObjectHypothesis hypothesis\ngeometry_msgs/PoseWithCovariance pose\n"
    ),
    "vision_msgs/msg/BoundingBox3D": "geometry_msgs/Pose center\ngeometry_msgs/Vector3 size\n",
    "vision_msgs/msg/Detection3D": (
        "std_msgs/Header header\nvision_msgs/ObjectHypothesisWithPose[] results\n"
        "vision_msgs/BoundingBox3D bbox\nstring id\n"
    ),
    "vision_msgs/msg/Detection3DArray": "std_msgs/Header header\nvision_msgs/Detection3D[] detections\n",
}
_FLOAT32, _INT32, _UINT32 = 7, 5, 6  # sensor_msgs/PointField datatypes


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
    store = typestore()
    stamp = (stamp_ns // 1_000_000_000, stamp_ns % 1_000_000_000)
    messages = {
        "/perception/points": point_cloud2(store, cloud, labels, frame, stamp),
        "/perception/instances": detections(store, cloud.points, labels, instances, frame, stamp),
    }
    with tempfile.TemporaryDirectory() as folder:
        bag = Path(folder) / "bag"
        with Writer(bag, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
            for topic, message in messages.items():
                connection = writer.add_connection(topic, message.__msgtype__, typestore=store)
                writer.write(connection, stamp_ns, store.serialize_cdr(message, message.__msgtype__))
        written = list(bag.glob("*.mcap"))
        if len(written) != 1:
            raise InputError(f"{path}: rosbags wrote {len(written)} MCAP files, expected one; update rosbags")
        with replacing(path) as file, written[0].open("rb") as source:
            while block := source.read(1 << 24):
                file.write(block)


def typestore() -> Any:
    """rosbags' types of ROS 2 Jazzy with vision_msgs added."""
    try:
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore
    except ImportError as error:
        raise missing_extra("rosbags", "ros") from error
    store = get_typestore(Stores.ROS2_JAZZY)
    types: dict[str, Any] = {}
    for name, definition in _VISION.items():
        types |= get_types_from_msg(definition, name)
    store.register(types)
    return store


def point_cloud2(store: Any, cloud: PointCloud, labels: np.ndarray, frame: str, stamp: tuple[int, int]) -> Any:
    """sensor_msgs/PointCloud2 with x y z (float32), rgb packed as in PCL when known, instance_id (int32)."""
    columns = {axis: (cloud.points[:, i].astype("<f4"), _FLOAT32) for i, axis in enumerate("xyz")}
    if cloud.colors is not None:
        r, g, b = cloud.colors.astype(np.uint32).T
        columns["rgb"] = (((r << 16) | (g << 8) | b).astype("<u4"), _UINT32)
    columns["instance_id"] = (labels.astype("<i4"), _INT32)
    rows = np.empty(len(cloud.points), [(name, values.dtype.str) for name, (values, _) in columns.items()])
    for name, (values, _) in columns.items():
        rows[name] = values
    field = store.types["sensor_msgs/msg/PointField"]
    fields = [field(name, 4 * i, kind, 1) for i, (name, (_, kind)) in enumerate(columns.items())]
    return store.types["sensor_msgs/msg/PointCloud2"](
        header=_header(store, frame, stamp),
        height=1,
        width=len(rows),
        fields=fields,
        is_bigendian=False,
        point_step=rows.itemsize,
        row_step=rows.nbytes,
        data=rows.view(np.uint8).reshape(-1),
        is_dense=bool(np.isfinite(cloud.points).all()),
    )


def detections(
    store: Any,
    points: np.ndarray,
    labels: np.ndarray,
    instances: Mapping[int, Mapping[str, Any]],
    frame: str,
    stamp: tuple[int, int],
) -> Any:
    """vision_msgs/Detection3DArray: one detection for each instance, its oriented box, label (or id) and
    score.
    """
    t = store.types
    header = _header(store, frame, stamp)
    found = []
    for i, box in instance_boxes(points, labels).items():
        known = instances.get(i, {})
        pose = _pose(store, box["obb"])
        hypothesis = t["vision_msgs/msg/ObjectHypothesis"](
            class_id=known.get("label") or str(i), score=float(known.get("score", 1.0))
        )
        with_pose = t["geometry_msgs/msg/PoseWithCovariance"](pose=pose, covariance=np.zeros(36))
        size = t["geometry_msgs/msg/Vector3"](*(float(s) for s in box["obb"]["extent"]))
        found.append(
            t["vision_msgs/msg/Detection3D"](
                header=header,
                results=[t["vision_msgs/msg/ObjectHypothesisWithPose"](hypothesis=hypothesis, pose=with_pose)],
                bbox=t["vision_msgs/msg/BoundingBox3D"](center=pose, size=size),
                id=str(i),
            )
        )
    return t["vision_msgs/msg/Detection3DArray"](header=header, detections=found)


def _header(store: Any, frame: str, stamp: tuple[int, int]) -> Any:
    time = store.types["builtin_interfaces/msg/Time"](sec=stamp[0], nanosec=stamp[1])
    return store.types["std_msgs/msg/Header"](stamp=time, frame_id=frame)


def _pose(store: Any, obb: dict[str, Any]) -> Any:
    """geometry_msgs/Pose of a box: its rotation takes box axes to the frame (rows of `rotation` are those
    axes).
    """
    from scipy.spatial.transform import Rotation

    x, y, z, w = Rotation.from_matrix(np.array(obb["rotation"]).T).as_quat().tolist()
    return store.types["geometry_msgs/msg/Pose"](
        position=store.types["geometry_msgs/msg/Point"](*obb["center"]),
        orientation=store.types["geometry_msgs/msg/Quaternion"](x, y, z, w),
    )
