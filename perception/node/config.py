"""The node's settings: typed, defaults need no file."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from perception.config import set_value
from perception.errors import InputError

_NAME = re.compile(r"[A-Za-z_]\w*(/[A-Za-z_]\w*)*", re.ASCII)


@dataclass(frozen=True)
class NodeConfig:
    """How one process serves one map.

    namespace: before every topic and service. transport: dds (CycloneDDS), rclpy (ROS 2 of this machine) or auto:
    rclpy where it can be imported, else dds. domain: DDS domain, None = ROS_DOMAIN_ID or 0. network (dds only):
    "localhost", an interface's name, None = as ROS_AUTOMATIC_DISCOVERY_RANGE says. workers, queue_size, timeout: of
    the query engine; seconds. map_points: the latched cloud has at most so many points, evenly thinned.
    health_seconds: period of the health message. watch: seconds between looks for a new map.
    discovery_seconds: how long another node of this name is looked for before this one serves.
    """

    namespace: str = "perception"
    transport: str = "auto"
    domain: int | None = None
    network: str | None = None
    workers: int = 2
    queue_size: int = 64
    timeout: float = 10.0
    map_points: int = 1_000_000
    health_seconds: float = 1.0
    watch: float = 1.0
    discovery_seconds: float = 1.0

    def __post_init__(self) -> None:
        rules: list[tuple[str, bool, str]] = [
            ("namespace", bool(_NAME.fullmatch(self.namespace)), "names of letters, digits and _, joined by /"),
            ("transport", self.transport in ("auto", "dds", "rclpy"), "auto, dds or rclpy"),
            ("domain", self.domain is None or 0 <= self.domain <= 232, "0 to 232, or none"),
            ("workers", 1 <= self.workers <= 64, "1 to 64"),
            ("queue_size", 1 <= self.queue_size <= 10_000, "1 to 10000"),
            ("timeout", 0 < self.timeout <= 3600, "seconds above 0, at most 3600"),
            ("map_points", self.map_points >= 0, "0 (no cloud of the map) or more"),
            ("health_seconds", 0.05 <= self.health_seconds <= 3600, "seconds from 0.05 to 3600"),
            ("watch", 0.01 <= self.watch <= 3600, "seconds from 0.01 to 3600"),
            ("discovery_seconds", 0 <= self.discovery_seconds <= 60, "seconds from 0 to 60"),
        ]
        for name, fine, expected in rules:
            if not fine:
                raise InputError(f"node.{name}: found {getattr(self, name)!r}, expected {expected}")

    @property
    def domain_id(self) -> int:
        """The DDS domain; InputError when ROS_DOMAIN_ID is no number."""
        if self.domain is not None:
            return self.domain
        text = os.environ.get("ROS_DOMAIN_ID", "") or "0"
        if not text.isdecimal() or int(text) > 232:
            raise InputError(f"ROS_DOMAIN_ID: found '{text}', expected 0 to 232")
        return int(text)


def node_config(values: Mapping[str, Any], where: str = "--set") -> NodeConfig:
    """NodeConfig from named values (texts or YAML's own types); InputError names `where` and the setting."""
    config = NodeConfig()
    for key, value in values.items():
        config = set_value(config, key, value, where)
    return config
