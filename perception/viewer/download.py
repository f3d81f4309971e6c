"""Export of the selection as a PLY file for download."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np

from perception.errors import InputError
from perception.io.ply import write_ply
from perception.io.store import Map
from perception.viewer.paint import base_colors


def selection_ply(gmap: Map, chosen: list[int]) -> bytes:
    """A binary PLY of the chosen instances' means: x y z, red green blue, instance_id. InputError for no instance."""
    if not chosen:
        raise InputError("nothing is selected; click a thing first")
    rows = np.isin(gmap.instance_ids, chosen)
    points, colors = gmap.means[rows].astype(np.float32), base_colors(gmap)[rows]
    table = {axis: np.ascontiguousarray(points[:, i]) for i, axis in enumerate("xyz")}
    table |= {name: np.ascontiguousarray(colors[:, i]) for i, name in enumerate(("red", "green", "blue"))}
    table["instance_id"] = gmap.instance_ids[rows].astype(np.int32)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "selection.ply"
        write_ply(path, {"vertex": table})
        return path.read_bytes()
