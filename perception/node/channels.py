"""The node's topics and services, by short name. Only standard message types are used."""

from __future__ import annotations

from dataclasses import dataclass

from perception.node.answers import DETECTIONS, DIAGNOSTICS, MARKERS, POINT_CLOUD, STRING


@dataclass(frozen=True)
class Channel:
    """A topic or service. name: in the node's namespace, unless it begins with a slash. kind: ROS type. latched: late
    subscribers receive the last message."""

    name: str
    kind: str
    latched: bool = False


PROMPT = Channel("prompt", STRING)
"""Input: a prompt as plain text, or a JSON object with "text" and optionally "id", "top_k", "min_score", …"""
ANSWER = Channel("answer", STRING)
"""Output: JSON, the last message of an answer. Its "stamp", unique to the answer, is also that of the three below."""
POINTS = Channel("answer/points", POINT_CLOUD)
BOXES = Channel("answer/detections", DETECTIONS)
MARKS = Channel("answer/markers", MARKERS)
MAP_CLOUD = Channel("map/points", POINT_CLOUD, latched=True)
HEALTH = Channel("/diagnostics", DIAGNOSTICS)
"""The topic on which ROS tools expect health (REP 107)."""

QUERY = Channel("query", "rcl_interfaces/srv/GetParameters")
"""The standard service type that takes texts and returns typed values: each name is a prompt, each value its answer."""
RELOAD = Channel("reload", "std_srvs/srv/Trigger")

OUTPUTS = (ANSWER, POINTS, BOXES, MARKS, MAP_CLOUD, HEALTH)

DEPTH = 64
"""Largest number of messages queued for a slow reader; older ones are dropped, which bounds the memory."""
