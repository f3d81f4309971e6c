"""The engine's replies, the map and the health figures as standard ROS 2 messages, independent of the transport; the
topics and services, by short name, of standard types only.

A message is a dict of its fields; omitted fields have the ROS default. Arrays are numpy, times are
(seconds, nanoseconds). Layouts: the interface definitions of ROS 2 (common_interfaces, vision_msgs 4).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from perception.colors import instance_palette, rgb8_from_sh
from perception.query import Hit, QueryMap
from perception.serve.requests import Reply
from perception.types import OrientedBox


@dataclass(frozen=True)
class Channel:
    """A topic or service. name: in the node's namespace, unless it begins with a slash. kind: ROS type. latched: late
    subscribers receive the last message."""

    name: str
    kind: str
    latched: bool = False


PROMPT = Channel("prompt", "std_msgs/msg/String")
"""Input: a prompt as plain text, or a JSON object with "text" and optionally "id", "top_k", "min_score", …"""
ANSWER = Channel("answer", "std_msgs/msg/String")
"""Output: JSON, the last message of an answer. Its "stamp", unique to the answer, is also that of the three below."""
POINTS = Channel("answer/points", "sensor_msgs/msg/PointCloud2")
BOXES = Channel("answer/detections", "vision_msgs/msg/Detection3DArray")
MARKS = Channel("answer/markers", "visualization_msgs/msg/MarkerArray")
MAP_CLOUD = Channel("map/points", "sensor_msgs/msg/PointCloud2", latched=True)
CHANGES = Channel("changes", "std_msgs/msg/String", latched=True)
"""Output: JSON of `QueryMap.changes_json`, since the visit before the newest, with map_id and stamp."""
HEALTH = Channel("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray")
"""The topic on which ROS tools expect health (REP 107)."""

QUERY = Channel("query", "rcl_interfaces/srv/GetParameters")
"""The standard service type that takes texts and returns typed values: each name is a prompt, each value its answer."""
RELOAD = Channel("reload", "std_srvs/srv/Trigger")

LOCALISE_IMAGE = Channel("localise/image", "sensor_msgs/msg/Image")
LOCALISE_COMPRESSED = Channel("localise/image/compressed", "sensor_msgs/msg/CompressedImage")
LOCALISE_CAMERA = Channel("localise/camera_info", "sensor_msgs/msg/CameraInfo")
"""Input: images to be localised, and their intrinsics if known."""
LOCALISE_POSE = Channel("localise/pose", "geometry_msgs/msg/PoseWithCovarianceStamped")
LOCALISE_ANSWER = Channel("localise/answer", "std_msgs/msg/String")
"""Output, with the image's stamp: the camera's pose in the map's frame; JSON, also of an image that has no pose."""

OUTPUTS = (ANSWER, POINTS, BOXES, MARKS, MAP_CLOUD, CHANGES, HEALTH, LOCALISE_POSE, LOCALISE_ANSWER)

DEPTH = 64  # largest number of messages queued for a slow reader; older ones are dropped, which bounds the memory

Stamp = tuple[int, int]
_FIELD_KINDS = {"<i4": 5, "<u4": 6, "<f4": 7}  # sensor_msgs/PointField
_CUBE, _TEXT, _DELETE_ALL = 1, 9, 3  # visualization_msgs/Marker
_STRING, _DOUBLE_ARRAY = 4, 8  # rcl_interfaces/ParameterType
LEAST_SIDE = 1e-3
_OK, _WARN, _ERROR = 0, 1, 2  # diagnostic_msgs/DiagnosticStatus


def answer_json(reply: Reply, identity: str | None) -> dict[str, Any]:
    """An entry of `results` with the prompt's id and the map's frame, unit and id."""
    of_map = {"frame": reply.frame, "metric": reply.metric, "map_id": reply.map_id}
    return {"id": identity, **reply.to_json(), **of_map}


def stamp_json(stamp: Stamp) -> dict[str, int]:
    """builtin_interfaces/Time, as a message and as JSON."""
    return {"sec": stamp[0], "nanosec": stamp[1]}


def hits_cloud(reply: Reply, stamp: Stamp) -> dict[str, Any]:
    """PointCloud2 of all hits, best first: x y z float32, instance_id int32, score float32."""
    return point_cloud2(_hit_columns(reply.hits), reply.frame, stamp)


def _hit_columns(hits: Sequence[Hit]) -> dict[str, np.ndarray]:
    sizes = [len(hit.points) for hit in hits]
    points = np.concatenate([hit.points for hit in hits]) if hits else np.empty((0, 3), np.float32)
    return {
        **{axis: points[:, i].astype(np.float32) for i, axis in enumerate("xyz")},
        "instance_id": np.repeat(np.array([hit.instance_id for hit in hits], np.int32), sizes),
        "score": np.repeat(np.array([hit.score for hit in hits], np.float32), sizes),
    }


def hits_detections(reply: Reply, stamp: Stamp) -> dict[str, Any]:
    """Detection3DArray: id is the instance's, class_id the prompt's text, the score that of the hit."""
    head, text = header(reply.frame, stamp), reply.request.text
    made = [detection(hit.obb, text, hit.score, str(hit.instance_id), head, hit.covariance) for hit in reply.hits]
    return {"header": head, "detections": made}


def hits_markers(reply: Reply, identity: str | None, stamp: Stamp) -> dict[str, Any]:
    """MarkerArray: a box and a text for each hit; ns is the prompt's id, else its text."""
    text = reply.request.text
    boxes = [(hit.instance_id, hit.obb, f"{text} #{hit.instance_id} {hit.score:.2f}") for hit in reply.hits]
    return box_markers(boxes, identity or text, header(reply.frame, stamp))


def text_value(text: str) -> dict[str, Any]:
    """rcl_interfaces/ParameterValue of an answer's or an error's JSON."""
    return {"type": _STRING, "string_value": text}


def points_value(reply: Reply) -> dict[str, Any]:
    """rcl_interfaces/ParameterValue: rows (instance id, x, y, z), one a point, flat; float64 holds float32 exactly."""
    columns = _hit_columns(reply.hits)
    rows = np.stack([columns[name].astype(np.float64) for name in ("instance_id", "x", "y", "z")], axis=1)
    return {"type": _DOUBLE_ARRAY, "double_array_value": rows.reshape(-1)}


def map_cloud(gmap: QueryMap, most: int, stamp: Stamp) -> dict[str, Any]:
    """PointCloud2 of the map, every k-th Gaussian, at most `most`: x y z, rgb, instance_id (−1 = none)."""
    rows = slice(None, None, max(1, -(-len(gmap) // most)))
    r, g, b = rgb8_from_sh(gmap.sh[rows, 0]).astype(np.uint32).T
    columns = {axis: np.asarray(gmap.means[rows, i], np.float32) for i, axis in enumerate("xyz")}
    columns["rgb"] = (r << 16) | (g << 8) | b  # as PCL packs colours
    columns["instance_id"] = np.asarray(gmap.instance_ids[rows], np.int32)
    return point_cloud2(columns, gmap.frame, stamp)


def diagnostics(name: str, facts: Mapping[str, Any], warnings: Sequence[str], stamp: Stamp) -> dict[str, Any]:
    """DiagnosticArray of the engine's health and the transport's warnings."""
    problem = facts.get("problem")
    level, message = _OK, "serving"
    if facts.get("status") == "closed":
        level, message = _ERROR, "closed"
    elif problem or warnings:
        level, message = _WARN, "; ".join([*([str(problem)] if problem else []), *warnings])
    status = {
        "level": level,
        "name": f"{name}: instance map",
        "message": message,
        "hardware_id": str(facts.get("map", "")),
        "values": [{"key": key, "value": "" if value is None else str(value)} for key, value in facts.items()],
    }
    return {"header": header("", stamp), "status": [status]}


def header(frame: str, stamp: Stamp) -> dict[str, Any]:
    """std_msgs/Header."""
    return {"stamp": stamp_json(stamp), "frame_id": frame}


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
    return {"position": xyz(box.center), "orientation": xyzw(box.rotation.T)}


def detection(
    box: OrientedBox, class_id: str, score: float, identity: str, head: dict[str, Any], spread: np.ndarray
) -> dict[str, Any]:
    """vision_msgs/Detection3D. spread [3, 3]: covariance of the points, used as that of the position."""
    covariance = np.zeros((6, 6))
    covariance[:3, :3] = spread
    at = pose(box)
    hypothesis = {"class_id": class_id, "score": float(score)}
    return {
        "header": head,
        "results": [{"hypothesis": hypothesis, "pose": {"pose": at, "covariance": covariance.reshape(-1)}}],
        "bbox": {"center": at, "size": xyz(box.extent)},
        "id": identity,
    }


def box_markers(boxes: Iterable[tuple[int, OrientedBox, str]], namespace: str, head: dict[str, Any]) -> dict[str, Any]:
    """visualization_msgs/MarkerArray: one marker that deletes the markers before it, then for each of `boxes`
    (instance id, box, text) a transparent box in the instance's colour and its text. Viewers reject sides
    of length 0, so sides are at least LEAST_SIDE."""
    markers: list[dict[str, Any]] = [{"header": head, "action": _DELETE_ALL}]
    for i, (instance, box, label) in enumerate(boxes):
        at, common = pose(box), {"header": head, "ns": namespace}
        size = {axis: max(side, LEAST_SIDE) for axis, side in xyz(box.extent).items()}
        tint = dict(zip("rgb", (instance_palette([instance])[0] / 255).tolist(), strict=True)) | {"a": 0.4}
        markers.append({**common, "id": 2 * i, "type": _CUBE, "pose": at, "scale": size, "color": tint})
        upright = {"position": at["position"], "orientation": {"w": 1.0}}
        letters = {"z": max(0.25 * min(size.values()), 0.1 * max(size.values()))}
        white = dict.fromkeys("rgba", 1.0)
        text = {"type": _TEXT, "pose": upright, "scale": letters, "color": white, "text": label}
        markers.append({**common, "id": 2 * i + 1, **text})
    return {"markers": markers}


def xyz(vector: Sequence[float] | np.ndarray) -> dict[str, float]:
    """geometry_msgs/Vector3 or Point of a vector [3]."""
    return dict(zip("xyz", map(float, vector), strict=True))


def xyzw(rotation: np.ndarray) -> dict[str, float]:
    """geometry_msgs/Quaternion of a rotation [3, 3]."""
    return dict(zip("xyzw", map(float, Rotation.from_matrix(rotation).as_quat(canonical=True)), strict=True))
