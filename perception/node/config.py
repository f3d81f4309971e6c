"""The node's settings; every one has a default."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import Field

from perception.config import settings_from
from perception.errors import InputError
from perception.serve.requests import EngineSettings


class NodeConfig(EngineSettings):
    """How one process serves one map."""

    namespace: str = Field(
        "perception",
        pattern=r"^[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*$",
        title="names of letters, digits and _, joined by /",
        description="stands before every topic and service",
    )
    domain: int | None = Field(None, ge=0, le=232, description="ROS domain; none: ROS_DOMAIN_ID or 0")
    map_points: int = Field(
        1_000_000, ge=0, description="most points of the latched cloud, evenly thinned; 0: no cloud of the map"
    )
    photos: Path | None = Field(None, description="folder where the map's photos may be read beside its own")
    health_seconds: float = Field(1.0, ge=0.05, le=3600, description="seconds between two health messages")
    discovery_seconds: float = Field(
        1.0, ge=0, le=60, description="seconds in which another node of this name is looked for"
    )

    @property
    def domain_id(self) -> int:
        """The ROS domain; InputError when ROS_DOMAIN_ID is no number."""
        if self.domain is not None:
            return self.domain
        text = os.environ.get("ROS_DOMAIN_ID", "") or "0"
        if not text.isdecimal() or int(text) > 232:
            raise InputError(f"ROS_DOMAIN_ID: found '{text}', expected 0 to 232")
        return int(text)


def node_config(values: Mapping[str, Any], where: str = "--set") -> NodeConfig:
    """NodeConfig from named values (texts or YAML's own types); InputError names `where` and the setting."""
    return settings_from(NodeConfig, {key: (value, where) for key, value in values.items()})
