"""The node's face: every topic and service, by its short name. Standard message types only."""

from __future__ import annotations

from dataclasses import dataclass

from perception.io.ros_messages import DETECTIONS, DIAGNOSTICS, MARKERS, POINT_CLOUD, STRING


@dataclass(frozen=True)
class Topic:
    """kind: ROS type. latched: late joiners get the last one. absolute: outside the node's namespace."""

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
"""In: a prompt as plain text, or as a JSON object with "text" and, if wanted, "id", "top_k", "min_score", …"""
ANSWER = Topic("answer", STRING)
"""Out: JSON; the last message of an answer. Its "stamp" is that of the three below, and no other answer has it."""
POINTS = Topic("answer/points", POINT_CLOUD)
BOXES = Topic("answer/detections", DETECTIONS)
MARKS = Topic("answer/markers", MARKERS)
MAP_CLOUD = Topic("map/points", POINT_CLOUD, latched=True)
HEALTH = Topic("diagnostics", DIAGNOSTICS, absolute=True)
"""Where ROS tools look for health (REP 107)."""

QUERY = Service("query", "rcl_interfaces/srv/GetParameters")
"""The one standard service that carries texts in and typed values out: each name is a prompt, each value its answer."""
RELOAD = Service("reload", "std_srvs/srv/Trigger")

OUTPUTS = (ANSWER, POINTS, BOXES, MARKS, MAP_CLOUD, HEALTH)
SERVICES = (QUERY, RELOAD)

DEPTH = 64
"""Messages kept for a reader that is behind; older ones are dropped, never the process's memory filled."""
