"""The node's topics and services, by short name. Only standard message types are used."""

from __future__ import annotations

from dataclasses import dataclass

from perception.node.answers import DETECTIONS, DIAGNOSTICS, MARKERS, POINT_CLOUD, STRING


@dataclass(frozen=True)
class Topic:
    """kind: ROS type. latched: late subscribers receive the last message. absolute: outside the node's namespace."""

    name: str
    kind: str
    latched: bool = False
    absolute: bool = False

    def path(self, namespace: str) -> str:
        """The topic's ROS name, without the leading slash."""
        return self.name if self.absolute else f"{namespace}/{self.name}"


@dataclass(frozen=True)
class Service:
    """kind: ROS type of the service; its messages add _Request and _Response."""

    name: str
    kind: str

    def path(self, namespace: str) -> str:
        return f"{namespace}/{self.name}"


PROMPT = Topic("prompt", STRING)
"""Input: a prompt as plain text, or a JSON object with "text" and optionally "id", "top_k", "min_score", …"""
ANSWER = Topic("answer", STRING)
"""Output: JSON, the last message of an answer. Its "stamp", unique to the answer, is also that of the three below."""
POINTS = Topic("answer/points", POINT_CLOUD)
BOXES = Topic("answer/detections", DETECTIONS)
MARKS = Topic("answer/markers", MARKERS)
MAP_CLOUD = Topic("map/points", POINT_CLOUD, latched=True)
HEALTH = Topic("diagnostics", DIAGNOSTICS, absolute=True)
"""The topic on which ROS tools expect health (REP 107)."""

QUERY = Service("query", "rcl_interfaces/srv/GetParameters")
"""The standard service type that takes texts and returns typed values: each name is a prompt, each value its answer."""
RELOAD = Service("reload", "std_srvs/srv/Trigger")

OUTPUTS = (ANSWER, POINTS, BOXES, MARKS, MAP_CLOUD, HEALTH)
SERVICES = (QUERY, RELOAD)

DEPTH = 64
"""Largest number of messages queued for a slow reader; older ones are dropped, which bounds the memory."""
