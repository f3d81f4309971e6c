"""`perception export` onto a scan with a known place, meshes and voxels of a map, and what is refused."""

from __future__ import annotations

import builtins
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from perception.cli import main
from perception.errors import InputError
from perception.export.export_map import read_transform
from perception.frame.recentre import moved
from perception.io.cloud import read_cloud, write_cloud
from perception.io.open3d import load_open3d
from perception.map.map import Map
from perception.map.write import write_map
from perception.query import load_map
from perception.types import PointCloud
from support.viewer_maps import small_map

SCAN_FROM_MAP = np.eye(4)
SCAN_FROM_MAP[:3, :3] = 1000 * Rotation.from_euler("xyz", [20, -50, 110], degrees=True).as_matrix()
SCAN_FROM_MAP[:3, 3] = 5e5, -3e3, 20


@pytest.fixture
def path(tmp_path: Path) -> Path:
    write_map(tmp_path / "m.gsmap", small_map())
    return tmp_path / "m.gsmap"


@pytest.mark.parametrize("form", ["text", "json", "sidecar"])
def test_a_known_transform_places_the_scan_which_keeps_its_frame(path: Path, tmp_path: Path, form: str) -> None:
    gmap = small_map()
    points = gmap.means.astype(np.float64) @ SCAN_FROM_MAP[:3, :3].T + SCAN_FROM_MAP[:3, 3]
    write_cloud(tmp_path / "scan.ply", PointCloud(points))
    rows = np.linalg.inv(SCAN_FROM_MAP)
    text = {
        "text": "\n".join(" ".join(repr(float(x)) for x in row) for row in rows),
        "json": json.dumps(rows.tolist()),
        "sidecar": json.dumps({"map_from_scan": rows.tolist(), "instances": {}}),
    }[form]
    (tmp_path / "place").write_text(text)
    words = [
        "export",
        str(path),
        "--points",
        str(tmp_path / "scan.ply"),
        "-o",
        str(tmp_path / "out.ply"),
        "--no-smooth",
    ]
    assert main([*words, "--transform", str(tmp_path / "place")]) == 0
    out = read_cloud(tmp_path / "out.ply")
    np.testing.assert_array_equal(out.points, points)
    held = gmap.instance_ids >= 0
    assert (out.labels["instance_id"] == gmap.instance_ids)[held].all()
    np.testing.assert_allclose(json.loads((tmp_path / "out.json").read_text())["map_from_scan"], rows)


def test_a_place_in_another_map_or_before_it_was_scaled_is_refused(path: Path, tmp_path: Path, capsys: Any) -> None:
    write_cloud(tmp_path / "scan.ply", PointCloud(small_map().means.astype(np.float64)))
    np.savetxt(tmp_path / "place.txt", np.eye(4))
    words = ["export", str(path), "--points", str(tmp_path / "scan.ply"), "--no-smooth", "-o"]
    assert main([*words, str(tmp_path / "out.ply"), "--transform", str(tmp_path / "place.txt")]) == 0
    again = [*words, str(tmp_path / "again.ply"), "--transform", str(tmp_path / "out.json")]
    assert main(again) == 0
    other = small_map()
    other.views = [moved(view, np.linalg.inv(SCAN_FROM_MAP)) for view in other.views]
    write_map(tmp_path / "other.gsmap", other)
    assert main([again[0], str(tmp_path / "other.gsmap"), *again[2:]]) == 2
    assert "out.json: is in the frame of another map; align the scan again" in capsys.readouterr().err
    assert main(["scale", str(path), "--known-length", "1.1: 0,0,0 0,0,1"]) == 0
    assert main(again) == 2
    assert "out.json: is in another unit than the map has now; align the scan again" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("1 0 0 0\n0 1 0 0\n0 0 -1 0\n0 0 0 1", "mirror"),
        ("1 0.2 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1", "shear"),
        ("1 0 0 nan\n0 1 0 0\n0 0 1 0\n0 0 0 1", "finite"),
        ("1 0 0\n0 1 0\n0 0 1", "4"),
        ("1 0 0 0\n0 1 0\n", "4"),
        ("[[1, 2], 3]", "4"),
        ('{"a": 1}', "4 × 4"),
        ("not numbers", "4 × 4"),
    ],
)
def test_other_transforms_are_refused(text: str, told: str, tmp_path: Path) -> None:
    (tmp_path / "t.txt").write_text(text)
    with pytest.raises(InputError, match=told) as caught:
        read_transform(tmp_path / "t.txt", Map())
    assert "t.txt" in str(caught.value)


def test_a_scan_without_a_place_is_refused_and_nothing_is_written(path: Path, tmp_path: Path, capsys: Any) -> None:
    write_cloud(tmp_path / "scan.ply", PointCloud(np.random.default_rng(0).normal(size=(3000, 3)).astype(np.float32)))
    before = sorted(tmp_path.iterdir())
    words = ["export", str(path), "-o", str(tmp_path / "out.ply")]
    assert main([*words, "--align"]) == 2
    assert main([*words, "--align", "--points", str(tmp_path / "scan.ply")]) == 2
    assert main(["export", str(path)]) == 2
    assert main(["export", str(path), "--mesh", str(tmp_path / "m.stl")]) == 2
    assert main(["export", str(path), "--voxels", str(tmp_path / "v.npz"), "--voxel-size", "0"]) == 2
    for number in ("77", "-1"):  # -1: Gaussians of no instance
        assert main(["export", str(path), "--mesh", str(tmp_path / "m.ply"), "--instance", number]) == 2
    assert sorted(tmp_path.iterdir()) == before
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 7 and all("\n" not in line for line in lines)


def test_voxels_and_one_body_need_no_open3d(path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    without(monkeypatch, ModuleNotFoundError("No module named 'open3d'"))
    words = ["export", str(path), "--voxels", str(tmp_path / "v.npz"), "--voxel-size", "0.25"]
    assert main([*words, "--mesh", str(tmp_path / "ball.ply"), "--instance", "1"]) == 0
    assert set(read_cloud(tmp_path / "ball.ply").labels["instance_id"]) == {1}
    with np.load(tmp_path / "v.npz") as held:
        state, origin, size = held["occupancy"], held["origin"], float(held["voxel_size"])
        assert str(held["unit"]) == "m" and held["esdf"].shape == state.shape
    held = (np.argwhere(state == 2) + 0.5) * size + origin
    gaps = np.linalg.norm(held[:, None] - small_map().means[None], axis=2).min(axis=1)
    assert len(held) > 20 and gaps.max() < 2 * size
    free = (np.argwhere(state == 1) + 0.5) * size + origin
    assert len(free) > 100 and (free[:, 2] > 0).all() and free[:, 2].max() < 7  # between the camera and the wall


def test_an_instance_and_a_map_become_open3d_clouds(path: Path) -> None:
    pytest.importorskip("open3d")
    gmap, made = load_map(path), small_map()
    whole = gmap.to_open3d()
    np.testing.assert_array_equal(whole.point.positions.numpy(), made.means)
    np.testing.assert_array_equal(whole.point.instance_id.numpy()[:, 0], made.instance_ids)
    moved = gmap.get(2).transformed(SCAN_FROM_MAP, "scan")
    cloud = moved.to_open3d()
    np.testing.assert_array_equal(cloud.point.positions.numpy(), moved.points)
    np.testing.assert_allclose(
        cloud.point.colors.numpy(), np.tile([0.15, 0.2, 0.9], (len(moved.points), 1)), atol=0.003
    )
    assert (cloud.point.instance_id.numpy() == 2).all()


@pytest.mark.parametrize(
    ("error", "told"),
    [
        (ModuleNotFoundError("No module named 'open3d'"), r'pip install ".\[open3d\]"'),
        (OSError("libusb-1.0.so.0: cannot open shared object file"), "libusb.*apt-get install libusb-1.0-0"),
        (ImportError("libGL.so.1: cannot open shared object file"), "libGL.*libgl1"),
    ],
)
def test_a_missing_package_or_system_library_is_named(
    error: Exception, told: str, monkeypatch: pytest.MonkeyPatch, path: Path
) -> None:
    without(monkeypatch, error)
    with pytest.raises(InputError, match=told):
        load_open3d()
    with pytest.raises(InputError, match=told):
        load_map(path).get(0).to_open3d()


def without(monkeypatch: pytest.MonkeyPatch, error: Exception) -> None:
    real = builtins.__import__

    def fails(name: str, *rest: Any, **more: Any) -> Any:
        if name == "open3d":
            raise error
        return real(name, *rest, **more)

    monkeypatch.setattr(builtins, "__import__", fails)
