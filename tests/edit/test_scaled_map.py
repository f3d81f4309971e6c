"""A scaled map shows the same pictures, and `perception scale` makes its lengths metres."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from perception.cli import main
from perception.edit.scale import scaled
from perception.frame.recentre import map_from_input
from perception.gaussians.model import as_gaussians
from perception.gaussians.views import render
from perception.map.write import Map, read_map, set_labels, write_map
from perception.report.text import depth_text
from support.viewer_maps import small_map
from support.visited_map import number, write_visited_map


def some_map() -> Map:
    """small_map with random harmonics of degree 3, boxes that hold its points, a label and a part."""
    gmap, rng = small_map(), np.random.default_rng(1)
    gmap.sh = np.concatenate([gmap.sh, 0.2 * rng.normal(size=(len(gmap), 15, 3))], axis=1).astype(np.float32)
    for entry in gmap.instances:
        points = gmap.means[gmap.instance_ids == entry["id"]]
        entry["aabb"] = {"min": points.min(axis=0).tolist(), "max": points.max(axis=0).tolist()}
        entry["label"] = "ABC"[entry["id"]]
    part = np.where((gmap.instance_ids == 0) & (np.arange(len(gmap)) % 2 == 0), 3, -1).astype(np.int32)
    gmap.parts = {"ids": part}
    gmap.instances[0]["parts"] = [{**gmap.instances[0], "id": 3, "parent": 0}]
    gmap.info = {**gmap.info, "metric": False, "scene": {"input": "photos"}}
    return gmap


def pictures(gmap: Map) -> tuple[np.ndarray, np.ndarray]:
    """Colours and depth of the map's first view."""
    view = gmap.views[0]
    pose, K = (torch.from_numpy(x.astype(np.float32)) for x in (view.camera_from_world, view.K))
    out = render(as_gaussians(gmap), pose, K, view.width, view.height, harmonics=True)
    return out.colors[0].detach().numpy(), out.depths[0].detach().numpy()


def test_a_scaled_map_shows_the_same_pictures() -> None:
    """Means, sizes and cameras grow as one; depths and boxes with them."""
    gmap = some_map()
    moved = scaled(gmap, 3.0)
    (colors, depth), (other, far) = pictures(gmap), pictures(moved)
    assert colors.std() > 0.05
    # The rasterizer's blur of 0.3 pixels and its depths are the same up to float32 of coordinates of size 20.
    np.testing.assert_allclose(other, colors, atol=2e-3)
    np.testing.assert_allclose(far, 3 * depth, atol=2e-2)
    for old, new in zip(gmap.instances, moved.instances, strict=True):
        inside = moved.means[moved.instance_ids == new["id"]]
        corners = [new["aabb"]["min"], new["aabb"]["max"]]
        np.testing.assert_allclose(corners, [inside.min(axis=0), inside.max(axis=0)], rtol=1e-6)
        np.testing.assert_allclose(new["centroid"], 3 * np.array(old["centroid"]), atol=1e-9)
        np.testing.assert_allclose(new["obb"]["extent"], 3 * np.array(old["obb"]["extent"]))
        assert np.array_equal(moved.index.of(new["id"]), inside)
    part, whole = moved.instances[0]["parts"][0], gmap.instances[0]["parts"][0]
    np.testing.assert_allclose(part["aabb"]["min"], 3 * np.array(whole["aabb"]["min"]))
    assert "map_from_input" not in moved.info  # of photos without poses
    blocks = [{"photos": 4, "box": [[None, 0.0, None], [0.5, None, -2.0]]}]
    given = scaled(Map.of(gmap, info={"scene": {"input": "colmap"}, "blocks": blocks}), 3.0)
    assert given.info["blocks"] == [{"photos": 4, "box": [[None, 0.0, None], [1.5, None, -6.0]]}]
    np.testing.assert_allclose(map_from_input(Path("x"), given.info), np.diag([3, 3, 3, 1.0]))


@pytest.mark.parametrize(("unit", "told"), [("m", "3.6 cm in the median, 90% within 15 cm"), ("relative", "1.2 %")])
def test_errors_of_depth_are_scaled_where_they_are_lengths(unit: str, told: str) -> None:
    depth = {"median": 0.012, "close": 0.9, "tolerance": 0.05, "unit": unit, "rendered": 1.0}
    info = {**some_map().info, "quality": {"depth": depth, "views": {}}}
    assert told in depth_text(scaled(Map.of(some_map(), info=info), 3.0).info["quality"]["depth"])
    assert info["quality"]["depth"] == {**depth, "median": 0.012}


def test_scale_by_two_instances_and_by_two_points(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path, made = tmp_path / "m.gsmap", tmp_path / "metres.gsmap"
    write_map(path, some_map())
    before = (path / "gaussians.ply").read_bytes()
    assert main(["scale", str(path), "-o", str(made), "--known-length", "0.5: A, 2", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    distance = np.linalg.norm(np.subtract([-1.2, 0, 4], [1.2, -0.2, 4.5]))
    assert told["factor"] == pytest.approx(0.5 / distance) and "between A and 2" in told["scale"]["source"]
    gmap, old = read_map(made), read_map(path)
    assert gmap.metric and gmap.info["scale"]["metres_per_unit"] == 1
    assert (path / "gaussians.ply").read_bytes() == before
    np.testing.assert_allclose(gmap.means, old.means * told["factor"], rtol=1e-6)
    np.testing.assert_allclose(gmap.scales, old.scales * told["factor"], rtol=1e-5)
    assert np.array_equal(gmap.quats, old.quats) and np.array_equal(gmap.sh, old.sh)
    assert main(["info", str(made)]) == 0
    assert "scale: a unit is 1 m ± 0.0" in capsys.readouterr().out
    assert main(["scale", str(path), "--known-length", "2: 0,0,0 0,0,4"]) == 0  # in place
    assert read_map(path).means[0] == pytest.approx(old.means[0] / 2, rel=1e-5)


def test_a_name_means_the_thing_that_stands_today(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The mug is gone; the drum in cell 5 has its name now, the violin stands in cell 4."""
    path = write_visited_map(tmp_path / "m.gsmap")
    set_labels(path, {number("mug"): "cup", number("drum"): "cup"})
    assert main(["scale", str(path), "--known-length", f"5: cup, {number('violin')}", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["factor"] == pytest.approx(5, rel=0.02)  # they are 1 apart
    assert main(["scale", str(path), "--known-length", f"5: {number('mug')}, cup"]) == 2
    assert "0 instances are called '10' today" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "nothing tells its unit"),
        (["--known-length", "0: A, B"], "above 0"),
        (["--known-length", "nan: A, B"], "METRES: LABEL, LABEL"),
        (["--known-length", "1: A, mug"], "0 instances are called 'mug'"),
        (["--known-length", "1: 0,0,0 0,0,0.01"], "too near each other"),
        (["--tag-size", "-1"], "--tag-size: found '-1', expected a number above 0"),
        (["--tag-size", "0.1"], "photo is missing"),
    ],
)
def test_what_tells_nothing_is_one_line_and_writes_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], words: list[str], message: str
) -> None:
    path = tmp_path / "m.gsmap"
    write_map(path, some_map())
    before = sorted((f.name, f.read_bytes()) for f in path.iterdir())
    assert main(["scale", str(path), *words]) == 2
    error = capsys.readouterr().err.splitlines()[-1]
    assert error.startswith("error: ") and message in error
    assert sorted((f.name, f.read_bytes()) for f in path.iterdir()) == before
