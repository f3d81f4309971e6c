"""`perception export --mesh` and `--voxels`: surfaces and space of a map, from depth rendered from its own views."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from perception.colors import instance_palette, rgb8_from_sh
from perception.errors import InputError
from perception.export.depth_views import DepthView
from perception.export.export_map import rendered_depth
from perception.export.neighbors import nearest_gaussian
from perception.export.transfer import ExportOptions, export_labels
from perception.export.volume import FREE, OCCUPIED, closed_body, grid_shape, occupancy, signed_distance
from perception.frame.recentre import map_from_input
from perception.io.atomic import atomic_file
from perception.io.cloud import write_cloud
from perception.io.open3d import fuse_depth, write_glb
from perception.map.write import Map
from perception.types import PointCloud

MOST_VIEWS, LONG_SIDE = 300, 640
MESHES = (".ply", ".glb")


def check_outputs(mesh: Path | None, voxels: Path | None, voxel_size: float | None) -> None:
    """InputError for kinds of files that are not written, and for a size that is not positive."""
    if mesh is not None and mesh.suffix.lower() not in MESHES:
        raise InputError(f"{mesh}: unknown kind of mesh '{mesh.suffix}', expected .ply or .glb")
    if voxels is not None and voxels.suffix.lower() != ".npz":
        raise InputError(f"{voxels}: voxels are written as .npz")
    if voxel_size is not None and not (np.isfinite(voxel_size) and voxel_size > 0):
        raise InputError(f"--voxel-size is {voxel_size:g}; expected a length above 0 in map units")


def export_mesh(
    gmap: Map, output: Path, instance: int | None, voxel: float | None, color: str
) -> tuple[dict[str, Any], str]:
    """Writes the map's surface, or the closed body of one instance, with colours by vertex.

    A .ply has `instance_id` by vertex, too, and the input's coordinates, a .glb those of the map.

    The surface: rendered depth fused in a truncated signed distance field (`io.open3d.fuse_depth`), labelled as a scan
    is. One instance: `volume.closed_body`. voxel: None = two pixels at the median depth; of an instance
    at least a 64th of its longest side. color: "original" or "instance".
    """
    views = rendered_depth(gmap, MOST_VIEWS, LONG_SIDE)
    if instance is None:
        size = voxel or 2 * _footprint(views)
        shots = ((view.camera_from_world, view.K, view.depth, view.colors) for view in views)
        points, colors, faces = fuse_depth(shots, size)
        labels = export_labels(gmap.means, gmap.instance_ids, PointCloud(points, colors, None, faces), ExportOptions())
        method = "TSDF of rendered depth"
    else:
        own = gmap.instance_ids == instance
        if not own.any():
            raise InputError(f"--instance {instance}: the map has no such instance; `perception query` lists their ids")
        bounds = np.percentile(
            gmap.means[own & (gmap.opacities >= min(0.5, gmap.opacities[own].max()))], [1, 99], axis=0
        )
        size = voxel or max(_footprint(views), float((bounds[1] - bounds[0]).max()) / 64)
        low, high = bounds[0] - size, bounds[1] + size
        points, faces = closed_body(low, high, size, views, gmap.means, own)
        colors = rgb8_from_sh(gmap.sh[own, 0])[nearest_gaussian(points, gmap.means[own])]
        labels = np.full(len(points), instance, np.int32)
        method = "space carving by rendered depth"
    colors = instance_palette(labels) if color == "instance" else colors
    if output.suffix.lower() == ".glb":
        write_glb(output, points, colors, faces)
    else:
        origin = _origin(gmap)
        placed = points + origin if origin.any() else points
        write_cloud(output, PointCloud(placed, colors, None, faces, {"instance_id": labels}))
    facts = {"vertices": len(points), "faces": len(faces), "voxel_size": size, "method": method, "unit": _unit(gmap)}
    return facts, f"{output}: {len(faces)} triangles, {method}, voxels of {size:.4g} {facts['unit']}"


def export_voxels(gmap: Map, output: Path, voxel: float | None) -> tuple[dict[str, Any], str]:
    """Writes occupancy [X, Y, Z] uint8 (0 unknown, 1 free, 2 occupied), esdf [X, Y, Z] float32 (`signed_distance`),
    origin [3] (the corner of voxel 0, 0, 0), voxel_size, frame and unit ("m" or "unknown") as .npz.

    voxel: None = 5 cm in a metric map, else a 128th of the extent. The grid lies along the map's axes.
    """
    views = rendered_depth(gmap, MOST_VIEWS, LONG_SIDE // 2)
    eyes = np.array([-view.camera_from_world[:3, :3].T @ view.camera_from_world[:3, 3] for view in views])
    solid = gmap.means[gmap.opacities >= 0.5] if (gmap.opacities >= 0.5).any() else gmap.means
    bounds = np.percentile(solid, [1, 99], axis=0)
    low, high = np.minimum(bounds[0], eyes.min(axis=0)), np.maximum(bounds[1], eyes.max(axis=0))
    size = voxel or (0.05 if gmap.metric else float(np.linalg.norm(high - low)) / 128)
    low, high = low - 2 * size, high + 2 * size
    state = occupancy(low, grid_shape(low, high, size), size, views)
    arrays: dict[str, Any] = {
        "occupancy": state,
        "esdf": signed_distance(state, size),
        "origin": low + _origin(gmap),
        "voxel_size": np.float64(size),
        "frame": np.array(gmap.frame),
        "unit": np.array(_unit(gmap)),
    }
    with atomic_file(output) as new, new.open("wb") as file:
        np.savez(file, **arrays)
    shares = {name: float((state == value).mean()) for name, value in (("free", FREE), ("occupied", OCCUPIED))}
    facts = {"shape": list(state.shape), "voxel_size": size, "unit": _unit(gmap), **shares}
    text = f"{output}: {' x '.join(map(str, state.shape))} voxels of {size:.4g} {_unit(gmap)}, "
    return facts, text + f"{shares['free']:.0%} free, {shares['occupied']:.1%} occupied, the rest unknown"


def _footprint(views: list[DepthView]) -> float:
    """Width of a pixel at the median depth; InputError where the views show nothing."""
    depths = np.concatenate([view.depth[::4, ::4][view.depth[::4, ::4] > 0] for view in views])
    if len(depths) == 0:
        raise InputError("the map's views show no surface; there is nothing to export")
    return float(np.median(depths) / np.median([view.K[0, 0] for view in views]))


def _origin(gmap: Map) -> np.ndarray:
    """Offset [3] from map to input coordinates; 0 where axes or units differ, as in `export`."""
    placed = map_from_input(gmap.path or Path(), gmap.info)
    return -placed[:3, 3] if np.array_equal(placed[:3, :3], np.eye(3)) else np.zeros(3)


def _unit(gmap: Map) -> str:
    return "m" if gmap.metric else "unknown"
