"""Meshes, voxels and bodies against spheres and box rooms in closed form; glTF against trimesh."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from perception.errors import InputError
from perception.export.depth_views import DepthView, depth_views
from perception.export.mesh import (
    FREE,
    OCCUPIED,
    centres,
    check_outputs,
    closed_body,
    export_mesh,
    export_voxels,
    grid_shape,
    occupancy,
    signed_distance,
)
from perception.gaussians.model import as_gaussians
from perception.io.open3d import fuse_depth, write_glb
from support import box_rooms
from support.aimed import look_at
from support.box_rooms import FURNISHED

RADIUS = 0.5


def ball_views(count: int = 14, side: int = 120) -> list[DepthView]:
    """Exact depth of a ball at the origin before a sphere of 4 m, from 2 m away; red where it faces +x."""
    found = []
    K = np.array([[1.2 * side, 0, side / 2], [0, 1.2 * side, side / 2], [0, 0, 1.0]])
    for n in range(count):
        z = 1 - (2 * n + 1) / count
        eye = 2 * np.array([np.sqrt(1 - z * z) * np.cos(2.4 * n), np.sqrt(1 - z * z) * np.sin(2.4 * n), z])
        pose = look_at(eye, np.zeros(3), np.array([0, 0.1, 1.0]))
        v, u = np.mgrid[:side, :side] + 0.5
        rays = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones_like(u)], axis=-1) @ pose[:3, :3]
        a, b = (rays**2).sum(-1), rays @ eye
        inside = b * b - a * (eye @ eye - RADIUS**2)
        near = (-b - np.sqrt(np.maximum(inside, 0))) / a
        far = (-b + np.sqrt(b * b - a * (eye @ eye - 16))) / a
        hit = inside > 0
        red = hit & ((eye + rays * near[..., None])[..., 0] > 0)
        colors = np.stack([red, ~red, ~red], axis=-1).astype(np.float32)
        found.append(DepthView(pose, K, np.where(hit, near, far).astype(np.float32), colors))
    return found


def signed_volume(points: np.ndarray, faces: np.ndarray) -> float:
    a, b, c = np.moveaxis(points[faces].astype(float), 1, 0)
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6)


def closed(faces: np.ndarray) -> bool:
    """Every edge has two triangles, which run through it in opposite directions."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).astype(np.int64)
    keys = np.sort(edges[:, 0] * (1 << 32) + edges[:, 1])
    return len(np.unique(keys)) == len(keys) and bool((np.sort(edges[:, 1] * (1 << 32) + edges[:, 0]) == keys).all())


def test_the_body_of_a_ball_is_closed_and_has_its_volume() -> None:
    views, voxel = ball_views(), 0.04
    rng = np.random.default_rng(0)
    means = rng.normal(size=(3000, 3))
    means /= np.linalg.norm(means, axis=1, keepdims=True)
    means[:2000] *= RADIUS
    means[2000:] *= 4
    own = np.arange(3000) < 2000
    points, faces = closed_body(np.full(3, -0.6), np.full(3, 0.6), voxel, views, means, own)
    assert closed(faces)
    assert np.abs(np.linalg.norm(points, axis=1) - RADIUS).max() < voxel
    assert abs(signed_volume(points, faces)) == pytest.approx(4 / 3 * np.pi * RADIUS**3, rel=0.05)
    with pytest.raises(InputError, match="holds no voxel"):
        closed_body(np.full(3, -0.6), np.full(3, 0.6), voxel, views, means, np.zeros(3000, bool))


def test_fused_depth_lies_on_the_ball_with_its_colours_and_repeats() -> None:
    pytest.importorskip("open3d")
    shots = [(view.camera_from_world, view.K, view.depth, view.colors) for view in ball_views()]
    points, colors, faces = fuse_depth(shots, 0.04)
    radius = np.linalg.norm(points, axis=1)
    ball = radius < 2
    assert ball.sum() > 1000 and np.abs(radius[ball] - RADIUS).max() < 0.04
    assert np.median(radius[ball]) == pytest.approx(RADIUS, abs=0.005)
    red = colors[:, 0] > 128
    sure = ball & (np.abs(points[:, 0]) > 0.1)
    assert (red == (points[:, 0] > 0))[sure].mean() > 0.98
    for one, again in zip((points, colors, faces), fuse_depth(shots, 0.04), strict=True):
        np.testing.assert_array_equal(one, again)


def test_space_of_a_room_is_free_occupied_or_unknown_as_it_truly_is() -> None:
    voxel, low = 0.1, np.array([-2.7, -2.2, -0.2])
    shape = grid_shape(low, np.array([2.7, 2.2, 2.6]), voxel)
    state = occupancy(low, shape, voxel, box_rooms.views(FURNISHED, count=16))
    places = centres(low, shape, voxel)
    boxes = np.array(FURNISHED)
    beyond = np.maximum(boxes[:, :1] - places, places - boxes[:, 1:]).max(axis=2)  # signed, Chebyshev; > 0 outside
    solid = (beyond[0] > 0) | (beyond[1:] < 0).any(axis=0)
    near = np.abs(beyond).min(axis=0)  # at most the distance to the nearest face's plane
    clear, flat = near > voxel, state.reshape(-1)
    assert not (flat[solid & clear] == FREE).any()
    assert (flat[~solid & clear] != OCCUPIED).mean() > 0.999
    assert (flat[~solid & clear] == FREE).mean() > 0.75  # the cameras do not see all of it
    surface = box_rooms.points(FURNISHED)
    distance = signed_distance(state, voxel).reshape(-1)
    probes = np.flatnonzero((flat == FREE) & clear)[::197]
    true = np.sqrt(((places[probes, None] - surface[None, ::3]) ** 2).sum(axis=2)).min(axis=1)
    held = places[flat == OCCUPIED]
    brute = np.sqrt(((places[probes, None] - held[None]) ** 2).sum(axis=2)).min(axis=1)
    np.testing.assert_allclose(distance[probes], brute, rtol=1e-5)
    assert np.median(np.abs(distance[probes] - true)) < voxel


@pytest.mark.parametrize(("metric", "unit"), [(True, "m"), (False, "map units")])
def test_the_size_of_voxels_is_told_with_its_unit(tmp_path: Path, metric: bool, unit: str) -> None:
    facts, line = export_voxels(box_rooms.map_of(FURNISHED, metric=metric), tmp_path / "space.npz", 0.5)
    assert f"voxels of 0.5 {unit}, " in line
    assert facts["unit"] == str(np.load(tmp_path / "space.npz")["unit"]) == ("m" if metric else "unknown")


@pytest.mark.parametrize("voxel", [0.0, -1.0, np.nan, np.inf])
def test_sizes_that_no_grid_has_are_refused(voxel: float) -> None:
    with pytest.raises(InputError, match="voxel-size"):
        check_outputs(None, None, voxel)


def test_more_voxels_than_are_held_are_refused() -> None:
    with pytest.raises(InputError, match="voxel-size"):
        grid_shape(np.zeros(3), np.ones(3), 1e-5)


def test_views_that_do_not_fit_into_the_memory_are_refused_before_they_are_rendered(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The oracle is the size of one view's arrays."""
    gmap = box_rooms.map_of(FURNISHED)
    (view,) = depth_views(as_gaussians(gmap), gmap.views[:1], 640)
    needed = len(gmap.views) * sum(a.nbytes for a in (view.depth, view.colors, view.brightness))
    free = needed / 0.9
    monkeypatch.setattr("perception.machine.available_memory", lambda: 0.99 * free)
    monkeypatch.setattr("perception.export.depth_views.render", lambda *_: pytest.fail("rendered"))
    with pytest.raises(InputError, match=rf"depth rendered from {len(gmap.views)} views: needs about .* are free"):
        export_mesh(gmap, tmp_path / "room.ply", None, None, "original")
    monkeypatch.setattr("perception.machine.available_memory", lambda: 1.01 * free)
    with pytest.raises(pytest.fail.Exception, match="rendered"):
        export_mesh(gmap, tmp_path / "room.ply", None, None, "original")


def test_glb_holds_the_mesh(tmp_path: Path) -> None:
    trimesh = pytest.importorskip("trimesh")
    pytest.importorskip("open3d")
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], np.float32)
    faces = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]], np.int32)
    colors = np.array([[0, 0, 0], [255, 0, 0], [0, 255, 0], [128, 128, 128]], np.uint8)
    write_glb(tmp_path / "m.glb", points, colors, faces)
    (mesh,) = trimesh.load(tmp_path / "m.glb", process=False).geometry.values()
    np.testing.assert_array_equal(mesh.vertices, points)
    np.testing.assert_array_equal(mesh.faces, faces)
    assert mesh.is_watertight
    linear = mesh.visual.vertex_colors[:, 0].astype(int)  # 255 (128 / 255)^2.2 = 56
    np.testing.assert_allclose(linear, [0, 255, 0, 56], atol=1)
    assert [file.name for file in tmp_path.iterdir()] == ["m.glb"]


def test_a_surface_that_memory_does_not_hold_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("open3d")
    shots = [(view.camera_from_world, view.K, view.depth, view.colors) for view in ball_views(1, 40)]
    monkeypatch.setattr("perception.machine.available_memory", lambda: 2.0**20)
    with pytest.raises(InputError, match=r"surface with voxels of 0\.01: needs about .* choose a larger --voxel-size"):
        fuse_depth(shots, 0.01)


def test_bodies_and_voxels_that_memory_does_not_hold_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("perception.machine.available_memory", lambda: 2.0**28)
    with pytest.raises(InputError, match="choose larger voxels"):
        grid_shape(np.zeros(3), np.ones(3), 0.005)  # 8 million voxels of 0.5 GiB together
    with pytest.raises(InputError, match="choose larger voxels"):
        closed_body(np.full(3, -0.6), np.full(3, 0.6), 0.008, ball_views(2), np.zeros((1, 3)), np.ones(1, bool))
