"""Serialises ROS 2 messages, given as dicts of their fields, to CDR with `rosbags`."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

# Types missing in rosbags: vision_msgs 4 (ROS 2 Humble and later) and the two services the node offers.
_MORE = {
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
    "rcl_interfaces/srv/GetParameters_Request": "string[] names\n",
    "rcl_interfaces/srv/GetParameters_Response": "rcl_interfaces/ParameterValue[] values\n",
    "std_srvs/srv/Trigger_Request": "uint8 structure_needs_at_least_one_member\n",
    "std_srvs/srv/Trigger_Response": "bool success\nstring message\n",
}


@cache
def typestore() -> Any:
    """The ROS 2 Jazzy types of rosbags with those above added."""
    store = get_typestore(Stores.ROS2_JAZZY)
    types: dict[str, Any] = {}
    for name, definition in _MORE.items():
        types[name] = next(iter(get_types_from_msg(definition, name).values()))
    store.register(types)
    return store


def serialize(kind: str, message: dict[str, Any]) -> bytes:
    """A message, given as a dict of its fields, as little-endian CDR with the four-byte header."""
    return bytes(typestore().serialize_cdr(build(kind, message), kind))


def build(kind: str, message: dict[str, Any]) -> Any:
    """The rosbags message of a dict. Omitted fields get the ROS default; unknown fields raise KeyError."""
    store = typestore()
    fields = store.fielddefs[kind][1]
    unknown = message.keys() - {name for name, _ in fields}
    if unknown:
        raise KeyError(f"{kind} has no field {sorted(unknown)}")
    usual = _DEFAULTS.get(kind, {})
    values = {name: _value(definition, message.get(name, usual.get(name))) for name, definition in fields}
    return store.types[kind](**values)


def _value(definition: tuple[Any, Any], value: Any) -> Any:
    kind, detail = definition
    if kind.name == "BASE":
        return _zero(detail[0]) if value is None else value
    if kind.name == "NAME":
        return build(detail, value or {})
    (inner, what), length = detail
    if inner.name == "NAME":
        return [build(what, item) for item in ([{}] * length if value is None else value)]
    if what[0] == "string":
        return [""] * length if value is None else list(value)
    dtype = _DTYPES.get(what[0], what[0])
    return np.zeros(length, dtype) if value is None else np.ascontiguousarray(value, dtype)


_DEFAULTS = {"geometry_msgs/msg/Quaternion": {"w": 1.0}}
"""Non-zero default values in the types used here, which rosbags does not provide."""
_DTYPES = {"byte": "uint8", "octet": "uint8", "char": "uint8"}


def _zero(base: str) -> Any:
    if base == "string":
        return ""
    if base == "bool":
        return False
    return 0.0 if base.startswith("float") else 0
