"""Results as standard ROS 2 messages in the form of plain dicts, independent of the transport.

A message is a dict of its fields; omitted fields have the ROS default. Arrays are numpy, times are
(seconds, nanoseconds). Layouts: the interface definitions of ROS 2 (common_interfaces, vision_msgs 4).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from perception.colors import instance_palette
from perception.types import OrientedBox

POINT_CLOUD = "sensor_msgs/msg/PointCloud2"
DETECTIONS = "vision_msgs/msg/Detection3DArray"
MARKERS = "visualization_msgs/msg/MarkerArray"
STRING = "std_msgs/msg/String"
DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"

Stamp = tuple[int, int]
_FIELD_KINDS = {"<i4": 5, "<u4": 6, "<f4": 7}  # sensor_msgs/PointField
_CUBE, _TEXT, _DELETE_ALL = 1, 9, 3  # visualization_msgs/Marker


def header(frame: str, stamp: Stamp) -> dict[str, Any]:
    """std_msgs/Header."""
    return {"stamp": {"sec": stamp[0], "nanosec": stamp[1]}, "frame_id": frame}


def packed_rgb(colors: np.ndarray) -> np.ndarray:
    """PCL's packing of colors [P, 3] uint8 into [P] uint32."""
    r, g, b = colors.astype(np.uint32).T
    return (r << 16) | (g << 8) | b


def point_cloud2(columns: Mapping[str, np.ndarray], frame: str, stamp: Stamp) -> dict[str, Any]:
    """sensor_msgs/PointCloud2 of one row, with a field for each float32, int32 or uint32 column [P]; order is kept."""
    kinds = {name: values.dtype.newbyteorder("<").str for name, values in columns.items()}
    count = len(next(iter(columns.values())))
    rows = np.empty(count, list(kinds.items()))
    for name, values in columns.items():
        rows[name] = values
    coordinates = [values for name, values in columns.items() if name in "xyz"]
    return {
        "header": header(frame, stamp),
        "height": 1,
        "width": count,
        "fields": [
            {"name": name, "offset": 4 * i, "datatype": _FIELD_KINDS[kind], "count": 1}
            for i, (name, kind) in enumerate(kinds.items())
        ],
        "is_bigendian": False,
        "point_step": rows.itemsize,
        "row_step": rows.nbytes,
        "data": rows.view(np.uint8).reshape(-1),
        "is_dense": all(bool(np.isfinite(values).all()) for values in coordinates),
    }


def pose(box: OrientedBox) -> dict[str, Any]:
    """geometry_msgs/Pose of a box, frame_from_box (box axes are the rows of `rotation`); quaternion xyzw."""
    w, x, y, z = (float(v) for v in _quaternion(box.rotation.T))
    return {"position": _xyz(box.center), "orientation": {"x": x, "y": y, "z": z, "w": w}}


def detection(
    box: OrientedBox, class_id: str, score: float, identity: str, head: dict[str, Any], spread: np.ndarray | None = None
) -> dict[str, Any]:
    """vision_msgs/Detection3D. spread [3, 3]: covariance of the points, used as that of the position."""
    covariance = np.zeros((6, 6))
    if spread is not None:
        covariance[:3, :3] = spread
    at = pose(box)
    hypothesis = {"class_id": class_id, "score": float(score)}
    return {
        "header": head,
        "results": [{"hypothesis": hypothesis, "pose": {"pose": at, "covariance": covariance.reshape(-1)}}],
        "bbox": {"center": at, "size": _xyz(box.extent)},
        "id": identity,
    }


def box_markers(
    boxes: Iterable[tuple[int, OrientedBox, str]], namespace: str, head: dict[str, Any], least: float = 1e-3
) -> dict[str, Any]:
    """visualization_msgs/MarkerArray: one marker that deletes the markers before it, then for each of `boxes`
    (instance id, box, text) a transparent box in the instance's colour and its text. Viewers reject sides
    of length 0, so sides are at least `least`."""
    markers: list[dict[str, Any]] = [{"header": head, "action": _DELETE_ALL}]
    for i, (instance, box, words) in enumerate(boxes):
        at, common = pose(box), {"header": head, "ns": namespace}
        size = {axis: max(side, least) for axis, side in _xyz(box.extent).items()}
        tint = dict(zip("rgb", (instance_palette([instance])[0] / 255).tolist(), strict=True)) | {"a": 0.4}
        markers.append({**common, "id": 2 * i, "type": _CUBE, "pose": at, "scale": size, "color": tint})
        upright = {"position": at["position"], "orientation": {"w": 1.0}}
        letters = {"z": max(0.25 * min(size.values()), 0.1 * max(size.values()))}
        white = dict.fromkeys("rgba", 1.0)
        text = {"type": _TEXT, "pose": upright, "scale": letters, "color": white, "text": words}
        markers.append({**common, "id": 2 * i + 1, **text})
    return {"markers": markers}


def _xyz(vector: np.ndarray) -> dict[str, float]:
    return dict(zip("xyz", (float(v) for v in vector), strict=True))


def _quaternion(rotation: np.ndarray) -> np.ndarray:
    """wxyz with w ≥ 0 of a rotation [3, 3] (Bar-Itzhack 2000: the eigenvector of the largest eigenvalue)."""
    (a, b, c), (d, e, f), (g, h, i) = rotation
    matrix = np.array(
        [
            [a + e + i, h - f, c - g, d - b],
            [h - f, a - e - i, b + d, c + g],
            [c - g, b + d, e - a - i, f + h],
            [d - b, c + g, f + h, i - a - e],
        ]
    )
    wxyz = np.linalg.eigh(matrix)[1][:, -1]
    return -wxyz if wxyz[0] < 0 else wxyz
