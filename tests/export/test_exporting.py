"""`perception export` of a map's own surface points: what is written, and what is refused."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from perception.colors import instance_palette
from perception.errors import InputError
from perception.export.export_map import ExportOptions, export_map
from perception.export.splat import export_splat
from perception.io.cloud import read_cloud
from perception.io.ply import map_ply, write_ply
from perception.map.map import Map
from perception.map.write import write_map
from perception.splats.read import read_splat
from support.viewer_maps import small_map
from support.visited_map import STATES, number, write_visited_map


def test_all_that_was_asked_for_is_written(tmp_path: Path) -> None:
    gmap, folder, path = small_map(), tmp_path / "out", tmp_path / "m.gsmap"
    gmap.instances[2]["label"] = "blue ball"
    write_map(path, gmap)
    folder.mkdir()
    facts, table = export_map(path, folder / "out.ply", None, ExportOptions(), "instance")
    solid = gmap.opacities >= 0.5
    back = read_cloud(folder / "out.ply")
    np.testing.assert_array_equal(back.labels["instance_id"], gmap.instance_ids[solid])
    np.testing.assert_array_equal(back.colors, instance_palette(gmap.instance_ids[solid]))
    assert facts["points"] == solid.sum() and facts["labelled"] == (solid & (gmap.instance_ids >= 0)).sum()
    assert "blue ball" in table and json.loads(json.dumps(facts))["instances"]["2"]["label"] == "blue ball"
    assert {p.name for p in folder.iterdir()} == {"out.ply", "out.json"}
    with pytest.raises(InputError, match=r"expected one of \.ply"):
        export_map(path, folder / "m.rrd", None, ExportOptions())


@pytest.mark.parametrize("suffix", ["ply", "pcd", "npz"])
@pytest.mark.parametrize("smooth", [True, False])
def test_order_number_and_columns_of_a_scan_are_kept(suffix: str, smooth: bool, tmp_path: Path) -> None:
    """Points that are not finite get no instance; a column that the format cannot hold exactly is named."""
    gmap = small_map(60)
    write_map(tmp_path / "m.gsmap", gmap)
    order = np.random.default_rng(0).permutation(60)
    points = gmap.means[order].astype(np.float32)
    points[7], points[30, 2] = np.nan, np.inf
    whole, halves = np.arange(60, dtype=np.uint32) + 4_000_000_000, np.arange(60, dtype=np.float32) / 2
    halves[::7] = np.nan
    stamps = np.arange(60) + 1_700_000_000_000_000_000
    columns = {"gps_time": whole, "scan_label": halves, "stamp": stamps, "instance_id": np.full(60, 99, np.int32)}
    faces = np.array([[0, 1, 2]], np.int32)
    np.savez(tmp_path / "scan.npz", points=points, faces=faces, **columns)
    output = tmp_path / f"out.{suffix}"
    facts, table = export_map(tmp_path / "m.gsmap", output, tmp_path / "scan.npz", ExportOptions(smooth=smooth))
    back = read_cloud(output)
    np.testing.assert_array_equal(back.points, points)
    np.testing.assert_array_equal(back.labels["gps_time"], whole)
    np.testing.assert_array_equal(back.labels["scan_label"], halves)
    assert facts["points"] == 60 and back.labels["instance_id"][[7, 30]].tolist() == [-1, -1]
    assert (back.labels["instance_id"] >= 0).any() and 99 not in back.labels["instance_id"]
    left = {"ply": ["stamp"], "pcd": ["stamp", "faces"]}.get(suffix, [])
    assert facts.get("left_out", []) == left and all(name in table for name in left)
    assert ("stamp" in back.labels) == ("stamp" not in left) and (back.faces is None) == ("faces" in left)


def test_the_largest_distance_is_in_map_units_whatever_the_unit_of_the_scan(tmp_path: Path) -> None:
    """A scan in millimetres, known by its transform: the same points get an instance as of the scan in metres."""
    gmap = small_map(60)
    gmap.instance_ids[:] = 0
    write_map(tmp_path / "m.gsmap", gmap)
    points = gmap.means + np.linspace(0, 0.2, 60)[:, None] * [0, 0, 1]
    near = np.linalg.norm(points[:, None] - gmap.means[None], axis=2).min(axis=1) <= 0.05
    assert 5 < near.sum() < 55
    np.savez(tmp_path / "scan.npz", points=1000 * points)
    np.savetxt(tmp_path / "pose.txt", np.diag([0.001, 0.001, 0.001, 1]))
    options, output = ExportOptions(max_distance=0.05, smooth=False), tmp_path / "out.npz"
    facts, _ = export_map(tmp_path / "m.gsmap", output, tmp_path / "scan.npz", options, pose=tmp_path / "pose.txt")
    np.testing.assert_array_equal(read_cloud(output).labels["instance_id"] == 0, near)
    assert facts["max_distance"] == 0.05
    with pytest.raises(InputError, match="max_distance is -1"):
        ExportOptions(max_distance=-1)


def test_a_map_without_a_surface_is_told(tmp_path: Path) -> None:
    gmap = small_map(60)
    gmap.opacity_logits[:] = -9
    write_map(tmp_path / "m.gsmap", gmap)
    with pytest.raises(InputError, match=r"m\.gsmap: has no surface"):
        export_map(tmp_path / "m.gsmap", tmp_path / "out.ply", None, ExportOptions())


def test_what_is_gone_has_no_splat(tmp_path: Path) -> None:
    path = write_visited_map(tmp_path / "a.gsmap")
    facts, _ = export_splat(path, tmp_path / "s.ply", each=True)
    written = {tmp_path / f"s-{number(name)}.ply" for name, state in STATES.items() if state != "removed"}
    assert {Path(file) for file in facts["splat"]} == written == set(tmp_path.glob("s*.ply"))
    assert export_splat(path, tmp_path / "s.ply", each=True)[0] == facts
    own = min(written)
    for content in (b"ply\n", b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n1\n"):
        own.write_bytes(content)  # not of an export: as good as any name that the user did not give
        with pytest.raises(InputError, match=f"{own.name}: lies there, and is of no such export"):
            export_splat(path, tmp_path / "s.ply", each=True)
        assert own.read_bytes() == content
    with pytest.raises(InputError, match=f"no Gaussians of an instance {number('mug')}"):
        export_splat(path, tmp_path / "s.ply", only=[number("mug")])


@pytest.mark.parametrize("name", ["x", "rot_1", "f_dc_0", "scale_2"])
def test_rows_of_a_splat_that_are_no_numbers_come_back(name: str, tmp_path: Path) -> None:
    gmap = small_map(80)
    gmap.info |= {"source": str(tmp_path / "in.ply"), "scene": {"input": "splat"}}
    write_map(tmp_path / "m.gsmap", gmap)
    stored = map_ply(tmp_path / "m.gsmap" / "gaussians.ply", "vertex")
    given = {key: np.array(stored[key]) for key in stored.dtype.names or ()}
    given[name][5], given["quality"] = np.inf, np.arange(80, dtype=np.int32)
    write_ply(tmp_path / "in.ply", {"vertex": given})
    parked = read_splat(tmp_path / "in.ply")
    gmap.opacity_logits[5], gmap.means[5] = parked.opacity_logits[5], parked.means[5]
    write_map(tmp_path / "m.gsmap", gmap)
    export_splat(tmp_path / "m.gsmap", tmp_path / "out.ply")
    back = map_ply(tmp_path / "out.ply", "vertex")
    for key, values in given.items():
        np.testing.assert_array_equal(back[key], values)


def test_a_map_that_is_replaced_meanwhile_is_exported_as_it_was(tmp_path: Path, monkeypatch: Any) -> None:
    """Rows of one map would have the ids of another."""
    before, path, open_map = small_map(80), tmp_path / "m.gsmap", Map.open

    def opened(folder: Path) -> Map:
        gmap = open_map(folder)
        write_map(folder, small_map(60))
        return gmap

    write_map(path, before)
    monkeypatch.setattr(Map, "open", staticmethod(opened))
    export_splat(path, tmp_path / "out.ply")
    back = map_ply(tmp_path / "out.ply", "vertex")
    np.testing.assert_array_equal(back["x"], before.means[:, 0].astype(np.float32))
    np.testing.assert_array_equal(back["instance_id"], before.instance_ids)
