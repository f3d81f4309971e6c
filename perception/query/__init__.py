"""Queries on a finished map: ranked 3D instances for a text prompt, with filters on position, size and label.

gmap = load_map("kitchen.gsmap")             a map in one process; thread-safe
with QueryEngine("kitchen.gsmap") as engine  for servers: bounded request queue, time-outs, reload of a changed map
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from perception.query.engine import AnswerTimeout, EngineBusy, EngineClosed, QueryEngine
    from perception.query.frames import Frame
    from perception.query.hit import Description, Hit, Neighbor
    from perception.query.parts import PartsMap
    from perception.query.query_map import QueryMap, load_map
    from perception.query.regions import axis_box
    from perception.query.requests import Reply, Request
    from perception.query.where import Where

_HOMES = {
    "engine": ("AnswerTimeout", "EngineBusy", "EngineClosed", "QueryEngine"),
    "frames": ("Frame",),
    "hit": ("Description", "Hit", "Neighbor"),
    "parts": ("PartsMap",),
    "query_map": ("QueryMap", "load_map"),
    "regions": ("axis_box",),
    "requests": ("Reply", "Request"),
    "where": ("Where",),
}
__all__ = [
    "AnswerTimeout",
    "Description",
    "EngineBusy",
    "EngineClosed",
    "Frame",
    "Hit",
    "Neighbor",
    "PartsMap",
    "QueryEngine",
    "QueryMap",
    "Reply",
    "Request",
    "Where",
    "axis_box",
    "load_map",
]


def __getattr__(name: str) -> Any:
    import importlib

    for home, names in _HOMES.items():
        if name in names:
            return getattr(importlib.import_module(f"perception.query.{home}"), name)
    raise AttributeError(f"module 'perception.query' has no attribute '{name}'")
