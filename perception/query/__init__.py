"""Queries on a finished map: ranked 3D instances for a text prompt, with filters on position, size and label.

gmap = load_map("kitchen.gsmap")             a map in one process; thread-safe
with QueryEngine("kitchen.gsmap") as engine  for servers: bounded request queue, time-outs, reload of a changed map
"""

from perception.query.hit import Description, Hit, Neighbor
from perception.query.map_store import load_map
from perception.query.query_map import QueryMap
from perception.query.where import Frame, Where, axis_box

__all__ = ["Description", "Frame", "Hit", "Neighbor", "QueryMap", "Where", "axis_box", "load_map"]
