"""`perception export`: a map's instances onto a cloud, or onto the map's own surface points."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from perception.errors import InputError
from perception.export import ExportOptions, Outputs, run_export
from perception.gaussians.model import SH_C0
from perception.io.recentre import map_origin
from perception.io.store import GaussianMap, read_map
from perception.types import PointCloud

SURFACE_OPACITY = 0.5
"""Gaussians at least this opaque stand for the map's own surface."""


def export_map(
    map_path: Path, output: Path, points: Path | None, options: ExportOptions, outputs: Outputs
) -> tuple[dict[str, Any], str]:
    """Writes the labelled cloud, its sidecar JSON and what `outputs` asks for; returns facts and a table.

    Without `points` the map's opaque Gaussians are the cloud and keep their own instance ids, and coordinates are
    those of the input that the map was made from. An output of .mcap is the whole map for viewers: points,
    instances, boxes, cameras and photos.
    """
    if output.suffix.lower() == ".mcap":
        return _for_viewers(map_path, output, points)
    if output.suffix.lower() not in (".ply", ".pcd", ".npz"):
        raise InputError(
            f"{output}: unknown kind of cloud '{output.suffix}', expected .ply, .pcd, .npz, or for viewers .mcap"
        )
    gmap = read_map(map_path)
    origin = map_origin(map_path, gmap.info)
    means = gmap.means + origin if origin.any() else gmap.means
    cloud: PointCloud | Path = points if points is not None else surface_points(gmap, means)
    if points is None:  # every point is a Gaussian: nearest is itself
        options = ExportOptions(drop_noise=False, smooth=False)
    return run_export(
        output,
        cloud,
        means,
        gmap.instance_ids,
        {entry["id"]: entry for entry in gmap.instances},
        opacities=gmap.opacities,
        quats=gmap.quats,
        scales=gmap.scales,
        options=options,
        outputs=outputs,
    )


def _for_viewers(map_path: Path, output: Path, points: Path | None) -> tuple[dict[str, Any], str]:
    from perception.pipeline.replay import write_replay
    from perception.pipeline.reporting import saved_views

    if points is not None:
        raise InputError(
            f"{output}: such a file holds the map itself; leave --points out, or write the cloud with -o OUT.ply "
            "and --mcap OUT.mcap beside it"
        )
    gmap = read_map(map_path)
    views = saved_views(gmap)
    write_replay(output, gmap, views)
    facts = {"output": str(output), "views": len(views), "instances": len(gmap.instances)}
    return facts, f"{output}: the map with {len(gmap.instances)} instances and {len(views)} cameras"


def surface_points(gmap: GaussianMap, means: np.ndarray | None = None) -> PointCloud:
    """The means of opaque Gaussians with their colours; `means` [N, 3] instead of the map's own."""
    rows = np.flatnonzero(gmap.opacities >= SURFACE_OPACITY)
    colors = np.clip((gmap.sh[rows, 0] * SH_C0 + 0.5) * 255 + 0.5, 0, 255).astype(np.uint8)
    return PointCloud((gmap.means if means is None else means)[rows], colors)
