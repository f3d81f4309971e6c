"""Open3D, an optional package: the only file that imports it."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from perception.errors import InputError, missing_extra
from perception.io.atomic import atomic_file
from perception.machine import require_memory

Shot = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
"""camera_from_world [4, 4], K [3, 3], depth [H, W] (0 = none) and colors [H, W, 3] in [0, 1], float32."""
_BLOCK_BYTES = 8**3 * (1 + 1 + 3) * 4  # of a block of voxels: distance, weight and colour of each


def load_open3d() -> Any:
    """The module `open3d`; InputError when it, or a system library that it links to, is not installed."""
    try:
        import open3d
    except ModuleNotFoundError as error:
        raise missing_extra("open3d", "open3d") from error
    except (ImportError, OSError) as error:  # such as "libusb-1.0.so.0: cannot open shared object file"
        raise InputError(
            f"the package 'open3d' does not load ({error}); install its system libraries, "
            "on Debian and Ubuntu: apt-get install libusb-1.0-0 libgl1 libx11-6 libgomp1; "
            "'pip install \"open3d<0.20\"' (Python below 3.13) needs no libusb"
        ) from error
    return open3d


def tensor_cloud(points: np.ndarray, colors: np.ndarray | None, instance_ids: np.ndarray) -> Any:
    """An `open3d.t.geometry.PointCloud`: positions [P, 3] float32, colors [P, 3] float32 in [0, 1] of uint8 ones,
    instance_id [P, 1] int32."""
    o3d = load_open3d()
    cloud = o3d.t.geometry.PointCloud(o3d.core.Tensor(np.array(points, np.float32)))
    if colors is not None:
        cloud.point.colors = o3d.core.Tensor(colors.astype(np.float32) / 255)
    cloud.point.instance_id = o3d.core.Tensor(np.array(instance_ids, np.int32).reshape(-1, 1))
    return cloud


def fuse_depth(shots: Iterable[Shot], voxel: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(vertices [V, 3] float32, colors [V, 3] uint8, faces [F, 3] int32) of the zero level of a truncated signed
    distance field (Curless & Levoy 1996) with voxels of this size and a truncation of four, where two views saw it.
    Vertices and faces are sorted, as Open3D's order depends on its threads."""
    o3d = load_open3d()
    tensor, single = o3d.core.Tensor, o3d.core.float32
    names, kinds, widths = ("tsdf", "weight", "color"), (single,) * 3, ((1), (1), (3))
    grid = o3d.t.geometry.VoxelBlockGrid(names, kinds, widths, voxel, 8, 20_000, o3d.core.Device("CPU:0"))
    for camera_from_world, K, depth, colors in shots:
        if not (depth > 0).any():
            continue
        own = K - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]  # pixel centres at whole numbers
        camera = (tensor(own), tensor(np.ascontiguousarray(camera_from_world, np.float64)))
        image = o3d.t.geometry.Image(tensor(np.ascontiguousarray(depth)))
        picture = o3d.t.geometry.Image(tensor(np.ascontiguousarray(colors)))
        far = (1.0, 2.0 * float(depth.max()), 4.0)  # unit, farthest depth, truncation
        blocks = grid.compute_unique_block_coordinates(image, *camera, *far)
        held = _BLOCK_BYTES * (grid.hashmap().size() + len(blocks))  # copied where the table grows
        require_memory(held, f"a surface with voxels of {voxel:g}", "choose a larger --voxel-size")
        grid.integrate(blocks, image, picture, camera[0], *camera, *far)
    mesh = grid.extract_triangle_mesh(1.5)
    if len(mesh.vertex.positions) == 0:
        raise InputError(f"no surface is found with voxels of {voxel:g}; choose another --voxel-size")
    colors = (mesh.vertex.colors.numpy().clip(0, 1) * 255 + 0.5).astype(np.uint8)
    return _sorted(mesh.vertex.positions.numpy(), colors, mesh.triangle.indices.numpy())


def write_glb(path: Path, points: np.ndarray, colors: np.ndarray, faces: np.ndarray) -> None:
    """Binary glTF of points [V, 3], colors [V, 3] uint8 sRGB and faces [F, 3]; colours become linear, as glTF's are."""
    o3d = load_open3d()
    mesh = o3d.geometry.TriangleMesh(o3d.utility.Vector3dVector(points), o3d.utility.Vector3iVector(faces))
    mesh.vertex_colors = o3d.utility.Vector3dVector((colors / 255) ** 2.2)
    with TemporaryDirectory() as folder, atomic_file(path) as new:
        o3d.io.write_triangle_mesh(f"{folder}/mesh.glb", mesh)
        new.write_bytes(Path(folder, "mesh.glb").read_bytes())


def _sorted(points: np.ndarray, colors: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    order = np.lexsort((*colors.T, *points.T))
    rank = np.empty(len(order), np.int32)
    rank[order] = np.arange(len(order), dtype=np.int32)
    faces = rank[faces]
    first = faces.argmin(axis=1)[:, None]  # turned, not flipped, so that the smallest is first
    faces = np.take_along_axis(faces, (first + np.arange(3)) % 3, axis=1)
    return points[order], colors[order], faces[np.lexsort(faces.T[::-1])]
