"""`perception export --mesh` and `--voxels`: surfaces and space of a map, from depth rendered from its own views."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy import ndimage

from perception.colors import instance_palette, rgb8_from_sh
from perception.errors import InputError
from perception.export.depth_views import DepthView, centres, observe
from perception.export.export_map import SURFACE_OPACITY, ExportOptions, export_labels, rendered_depth
from perception.export.neighbors import nearest_gaussian
from perception.frame.recentre import map_from_input
from perception.geometry import camera_centres
from perception.io.atomic import write_file
from perception.io.cloud import write_cloud
from perception.io.open3d import fuse_depth, write_glb
from perception.machine import require_memory
from perception.map.write import Map
from perception.types import PointCloud

MOST_VIEWS, LONG_SIDE = 300, 640
MESHES = (".ply", ".glb")
UNKNOWN, FREE, OCCUPIED = 0, 1, 2
MOST_VOXELS = 200_000_000
_SLAB = 1 << 19
BODY_BYTES, SPACE_BYTES = 150, 65
"""Of each voxel, at the peak, while a closed mesh and while a map of distances is made, measured."""


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
    """Writes the map's surface, or the closed body of one instance, with colours by vertex. A .ply has `instance_id` by
    vertex, too, and the input's coordinates, a .glb those of the map.

    The surface: `io.open3d.fuse_depth`, labelled as a scan is. One instance: `closed_body`. voxel: None = two pixels at
    the median depth; of an instance at least a 64th of its longest side. color: "original" or "instance". InputError
    for a map without views, and for an instance that it does not have.

    >>> facts, line = export_mesh(Map.open(Path("room.gsmap")), Path("crate.ply"), 1, 0.05, "original")
    >>> facts["method"], facts["voxel_size"], facts["unit"]
    ('space carving by rendered depth', 0.05, 'm')
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
        if instance < 0 or not own.any():
            raise InputError(f"--instance {instance}: the map has no such instance; `perception query` lists their ids")
        opaque = own & (gmap.opacities >= min(SURFACE_OPACITY, gmap.opacities[own].max()))
        bounds = np.percentile(gmap.means[opaque], [1, 99], axis=0)
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
        origin = _origin(gmap)  # of input coordinates, which need more than float32 there
        vertices = points + origin if origin.any() else points
        write_cloud(output, PointCloud(vertices, colors, None, faces, {"instance_id": labels}))
    facts = {"vertices": len(points), "faces": len(faces), "voxel_size": size, "method": method, "unit": _unit(gmap)}
    return facts, f"{output}: {len(faces)} triangles, {method}, voxels of {size:.4g} {_unit(gmap, 'map units')}"


def export_voxels(gmap: Map, output: Path, voxel: float | None) -> tuple[dict[str, Any], str]:
    """Writes occupancy [X, Y, Z] uint8 (0 unknown, 1 free, 2 occupied), esdf [X, Y, Z] float32 (`signed_distance`),
    origin [3] (the corner of voxel 0, 0, 0), voxel_size, frame and unit ("m" or "unknown") as .npz.

    voxel: None = 5 cm in a metric map, else a 128th of the extent. The grid lies along the map's axes. InputError for a
    map without views.

    >>> facts, line = export_voxels(Map.open(Path("room.gsmap")), Path("space.npz"), 0.1)
    >>> np.load("space.npz")["esdf"].shape == tuple(facts["shape"]), facts["unit"]
    (True, 'm')
    """
    views = rendered_depth(gmap, MOST_VIEWS, LONG_SIDE // 2)
    eyes = camera_centres(np.stack([view.camera_from_world for view in views]))
    solid = gmap.opacities >= SURFACE_OPACITY
    bounds = np.percentile(gmap.means[solid] if solid.any() else gmap.means, [1, 99], axis=0)
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
    write_file(output, lambda file: np.savez(file, **arrays))
    shares = {name: float((state == value).mean()) for name, value in (("free", FREE), ("occupied", OCCUPIED))}
    facts = {"shape": list(state.shape), "voxel_size": size, "unit": _unit(gmap), **shares}
    text = f"{output}: {' x '.join(map(str, state.shape))} voxels of {size:.4g} {_unit(gmap, 'map units')}, "
    return facts, text + f"{shares['free']:.0%} free, {shares['occupied']:.1%} occupied, the rest unknown"


def _footprint(views: list[DepthView]) -> float:
    """Width of a pixel at the median depth; InputError where the views show nothing."""
    depths = np.concatenate([view.depth[::4, ::4][view.depth[::4, ::4] > 0] for view in views])
    if len(depths) == 0:
        raise InputError("the map's views show no surface; there is nothing to export")
    return float(np.median(depths) / np.median([view.K[0, 0] for view in views]))


def _origin(gmap: Map) -> np.ndarray:
    """Offset [3] from map to input coordinates; 0 where axes or units differ, as in `export`."""
    pose = map_from_input(gmap.path or Path(), gmap.info)
    return -pose[:3, 3] if np.array_equal(pose[:3, :3], np.eye(3)) else np.zeros(3)


def _unit(gmap: Map, unknown: str = "unknown") -> str:
    return "m" if gmap.metric else unknown


def grid_shape(low: np.ndarray, high: np.ndarray, voxel: float, each: int = SPACE_BYTES) -> tuple[int, int, int]:
    """Voxels of a side above 0 from corner `low` to beyond `high`; InputError when they are too many, or for the memory
    of `each` bytes a voxel."""
    shape = np.maximum(np.ceil((high - low) / voxel), 1)
    if shape.prod() > MOST_VOXELS:
        raise InputError(f"--voxel-size {voxel:g} gives {shape.prod():.2g} voxels; at most {MOST_VOXELS:.0e} are held")
    require_memory(each * float(shape.prod()), f"--voxel-size {voxel:g}", "choose larger voxels")
    return int(shape[0]), int(shape[1]), int(shape[2])


def occupancy(low: np.ndarray, shape: tuple[int, int, int], voxel: float, views: Sequence[DepthView]) -> np.ndarray:
    """[X, Y, Z] uint8: OCCUPIED where views see a surface in the voxel (depth within half its diagonal of the centre),
    unless more than twice as many see farther, then FREE; UNKNOWN where none looks or all are blocked."""
    state = np.empty(shape, np.uint8).reshape(shape[0], -1)
    slab = max(_SLAB // (shape[1] * shape[2]), 1)
    for x in range(0, shape[0], slab):
        part = (min(slab, shape[0] - x), *shape[1:])
        on, free, _ = observe(centres(low + np.array([x * voxel, 0, 0]), part, voxel), views, voxel * np.sqrt(3) / 2)
        seen = np.where((on > 0) & (2 * on >= free), OCCUPIED, np.where(free > 0, FREE, UNKNOWN))
        state[x : x + part[0]] = seen.reshape(part[0], -1)
    return state.reshape(shape)


def signed_distance(state: np.ndarray, voxel: float) -> np.ndarray:
    """[X, Y, Z] float32: distance of each centre to the nearest occupied one, in map units; in occupied voxels minus
    that to the nearest other. Unknown space is no obstacle here; infinity if nothing is occupied."""
    held = state == OCCUPIED
    if not held.any():
        return np.full(state.shape, np.inf, np.float32)
    outside = ndimage.distance_transform_edt(~held) - ndimage.distance_transform_edt(held)
    return np.asarray(outside * voxel, np.float32)


def closed_body(
    low: np.ndarray, high: np.ndarray, voxel: float, views: Sequence[DepthView], means: np.ndarray, own: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(vertices [V, 3] float32, faces [F, 3] int32) of a watertight mesh between corners `low` and `high`.

    Space carving (Kutulakos & Seitz 2000) with depth: a voxel is outside if views see farther than it, or if the
    nearest of means [N, 3] is not `own` [N]; hidden space is body, so that a side which no photo shows reaches to the
    bounds. Near the surface the mean of depth − z locates it. The largest connected part without its hollows is meshed
    by marching cubes (Lorensen & Cline 1987).
    """
    from skimage.measure import marching_cubes

    shape = grid_shape(low, high, voxel, BODY_BYTES)
    voxels, reach = centres(low, shape, voxel), 3 * voxel
    on, free, gap = observe(voxels, views, reach)
    level = np.where((on > 0) & (2 * on >= free), gap / reach, np.where(free > 0, 1.0, -1.0))
    level = np.where(own[nearest_gaussian(voxels, means)], level, np.maximum(level, 0.5)).reshape(shape)
    parts, count = ndimage.label(level < 0)
    if count == 0:
        raise InputError(f"the instance holds no voxel of {voxel:g}; choose a smaller --voxel-size")
    body = parts == 1 + int(np.argmax(np.bincount(parts.ravel())[1:]))
    filled = ndimage.binary_fill_holes(body)
    level = np.where(filled, np.minimum(np.where(body, level, -1.0), -1e-3), np.maximum(level, 1e-3))
    vertices, faces, _, _ = marching_cubes(np.pad(level, 1, constant_values=1.0), 0.0)
    points = low + (vertices - 0.5) * voxel  # index 1 after padding is the centre of the first voxel
    return points.astype(np.float32), faces.astype(np.int32)
