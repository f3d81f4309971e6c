"""Conversion of the engine's replies, the map and the health figures into ROS messages."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from perception.colors import rgb8_from_sh
from perception.io.ros_messages import Stamp, box_markers, detection, header, packed_rgb, point_cloud2
from perception.query import Hit, QueryMap, Reply

_STRING, _DOUBLE_ARRAY = 4, 8  # rcl_interfaces/ParameterType
_OK, _WARN, _ERROR = 0, 1, 2  # diagnostic_msgs/DiagnosticStatus


def answer_json(reply: Reply, identity: str | None) -> dict[str, Any]:
    """An entry of `results` with the prompt's id and the map's frame, unit and id."""
    facts = {"frame": reply.frame, "metric": reply.metric, "map_id": reply.map_id}
    return {"id": identity, **reply.to_json(), **facts}


def stamp_json(stamp: Stamp) -> dict[str, int]:
    return {"sec": stamp[0], "nanosec": stamp[1]}


def hits_cloud(reply: Reply, stamp: Stamp) -> dict[str, Any]:
    """PointCloud2 of all hits, best first: x y z float32, instance_id int32, score float32."""
    columns = _hit_columns(reply.hits)
    return point_cloud2(columns, reply.frame, stamp)


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
    head = header(reply.frame, stamp)
    found = [
        detection(hit.obb, reply.request.text, hit.score, str(hit.instance_id), head, hit.covariance)
        for hit in reply.hits
    ]
    return {"header": head, "detections": found}


def hits_markers(reply: Reply, identity: str | None, stamp: Stamp) -> dict[str, Any]:
    """MarkerArray: a box and a text for each hit; ns is the prompt's id, else its text."""
    boxes = [
        (hit.instance_id, hit.obb, f"{reply.request.text} #{hit.instance_id} {hit.score:.2f}") for hit in reply.hits
    ]
    return box_markers(boxes, identity or reply.request.text, header(reply.frame, stamp))


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
    colors = rgb8_from_sh(gmap.sh[rows, 0])
    columns = {axis: np.asarray(gmap.means[rows, i], np.float32) for i, axis in enumerate("xyz")}
    columns["rgb"] = packed_rgb(colors)
    columns["instance_id"] = np.asarray(gmap.instance_ids[rows], np.int32)
    return point_cloud2(columns, gmap.frame, stamp)


def diagnostics(name: str, facts: Mapping[str, Any], warnings: Sequence[str], stamp: Stamp) -> dict[str, Any]:
    """DiagnosticArray of the engine's health and the transport's warnings."""
    problem = facts.get("problem")
    if facts.get("status") == "closed":
        level, message = _ERROR, "closed"
    elif problem or warnings:
        level, message = _WARN, "; ".join([*([str(problem)] if problem else []), *warnings])
    else:
        level, message = _OK, "serving"
    status = {
        "level": level,
        "name": f"{name}: instance map",
        "message": message,
        "hardware_id": str(facts.get("map", "")),
        "values": [{"key": key, "value": "" if value is None else str(value)} for key, value in facts.items()],
    }
    return {"header": header("", stamp), "status": [status]}
