"""`perception export`: a map's instances onto a cloud, or onto the map's own surface points."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from perception.errors import InputError
from perception.export import ExportOptions, export_labels, write_export
from perception.export.run import check_overlap
from perception.gaussians.model import SH_C0
from perception.io.cloud import read_cloud
from perception.io.store import GaussianMap, read_map
from perception.types import PointCloud

SURFACE_OPACITY = 0.5
"""Gaussians at least this opaque stand for the map's own surface."""


def export_map(
    map_path: Path,
    output: Path,
    points: Path | None = None,
    *,
    smooth: bool = True,
    max_distance: float | None = None,
    fill: bool = True,
    color: str = "original",
) -> tuple[dict[str, Any], str]:
    """Writes the labelled cloud and its sidecar JSON; returns facts and a line of text.

    Without `points` the map's opaque Gaussians are the cloud and keep their own instance ids.
    """
    if output.suffix.lower() not in (".ply", ".pcd", ".npz"):
        raise InputError(f"{output}: unknown kind of cloud '{output.suffix}', expected .ply, .pcd or .npz")
    gmap = read_map(map_path)
    if points is None:
        cloud, labels = surface_points(gmap)
    else:
        cloud = read_cloud(points)
        check_overlap(gmap.means, cloud.points)
        options = ExportOptions(drop_noise=fill, max_distance=max_distance, smooth=smooth)
        labels = export_labels(gmap.means, gmap.instance_ids, gmap.opacities, cloud, options)
    if color == "instance":
        from perception.pictures import instance_palette

        cloud.colors = instance_palette(labels)
    sidecar = write_export(output, cloud, labels, {entry["id"]: entry for entry in gmap.instances})
    labelled = int((labels >= 0).sum())
    facts = {
        "output": str(output),
        "points": len(labels),
        "labelled": labelled,
        "instances": sidecar["instances"],
    }
    return (
        facts,
        f"{output}: {len(labels)} points, {labelled} labelled, {len(sidecar['instances'])} instances",
    )


def surface_points(gmap: GaussianMap) -> tuple[PointCloud, np.ndarray]:
    """The means of opaque Gaussians with their colours, and their instance ids."""
    rows = np.flatnonzero(gmap.opacities >= SURFACE_OPACITY)
    colors = np.clip((gmap.sh[rows, 0] * SH_C0 + 0.5) * 255 + 0.5, 0, 255).astype(np.uint8)
    return PointCloud(gmap.means[rows], colors), gmap.instance_ids[rows]
