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
    "AnswerTimeout": "engine",
    "Description": "hit",
    "EngineBusy": "engine",
    "EngineClosed": "engine",
    "Frame": "frames",
    "Hit": "hit",
    "Neighbor": "hit",
    "PartsMap": "parts",
    "QueryEngine": "engine",
    "QueryMap": "query_map",
    "Reply": "requests",
    "Request": "requests",
    "Where": "where",
    "axis_box": "regions",
    "load_map": "query_map",
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
    if name in _HOMES:
        import importlib

        return getattr(importlib.import_module(f"perception.query.{_HOMES[name]}"), name)
    raise AttributeError(f"module 'perception.query' has no attribute '{name}'")
