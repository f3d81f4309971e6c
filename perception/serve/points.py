"""Encoding of an instance's points as NPZ or PLY bytes."""

from __future__ import annotations

import io

import numpy as np

from perception.io.ply import ply_bytes
from perception.query.query_map import QueryMap

FORMATS = {"npz": "application/x-npz", "ply": "application/octet-stream"}
"""Name → media type."""


def encode(gmap: QueryMap, instance_id: int, kind: str) -> bytes:
    """The instance's points in the map's frame, in map order.

    npz: points [P, 3] float32, centroid [3], covariance [3, 3], obb_center, obb_rotation, obb_extent, instance_id,
    frame, metric, map_id. ply: binary, x y z float and instance_id int, as `perception export` writes.
    """
    hit = gmap.get(instance_id)
    if kind == "ply":
        columns = {axis: np.ascontiguousarray(hit.points[:, n]) for n, axis in enumerate("xyz")}
        ids = np.full(len(hit.points), instance_id, np.int32)
        return ply_bytes({"vertex": {**columns, "instance_id": ids}})
    buffer = io.BytesIO()
    np.savez(
        buffer,
        points=hit.points,
        centroid=hit.centroid,
        covariance=hit.covariance,
        obb_center=hit.obb.center,
        obb_rotation=hit.obb.rotation,
        obb_extent=hit.obb.extent,
        instance_id=np.int64(instance_id),
        frame=np.array(gmap.frame),
        metric=np.array(gmap.metric),
        map_id=np.array(gmap.map_id),
    )
    return buffer.getvalue()
