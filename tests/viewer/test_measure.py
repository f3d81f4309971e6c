"""A known length by two clicks: where a click lies against ray and plane, and what is written into the map."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from perception.cli import main
from perception.errors import InputError
from perception.map.write import Map, read_map, set_labels, write_map
from perception.viewer.picking import pick_point
from perception.viewer.session import Session
from support.viewer_maps import free_port, small_map

FRONT, BACK = np.array([-0.3, 0.0, 1.0]), np.array([0.27, -0.05, 1.0])
"""Rays from small_map's camera that meet its first and its third ball."""


def discs(centres: np.ndarray, quat: np.ndarray, opacities: np.ndarray) -> Map:
    """Flat Gaussians of radius 0.1 and thickness 1e-4, across the axis that `quat` (wxyz) makes of z."""
    n = len(centres)
    return Map(
        centres.astype(np.float32),
        np.tile(quat, (n, 1)).astype(np.float32),
        np.tile(np.log([0.1, 0.1, 1e-4]), (n, 1)).astype(np.float32),
        np.log(opacities / (1 - opacities)).astype(np.float32),
        np.zeros((n, 1, 3), np.float32),
        np.zeros((n, 4), np.float32),
        np.full(n, -1, np.int32),
        np.zeros(n, np.float32),
    )


def test_a_click_lies_where_its_ray_meets_the_plane() -> None:
    """A slanted wall of discs against o + d (n·c − n·o) / (n·d) in float64, for rays from many places."""
    from scipy.spatial.transform import Rotation

    rng, turn = np.random.default_rng(0), Rotation.from_euler("xyz", [35, -20, 10], degrees=True)
    axes, centre = turn.as_matrix(), np.array([0.3, -0.2, 5.0])
    x, y = (0.1 * grid.ravel() for grid in np.mgrid[-15:16, -15:16])
    quat = turn.as_quat()[[3, 0, 1, 2]]
    wall = discs(centre + x[:, None] * axes[:, 0] + y[:, None] * axes[:, 1], quat, np.full(len(x), 0.9))
    everything, normal = np.ones(len(wall), bool), axes[:, 2]
    for _ in range(20):
        origin = rng.uniform([-1, -1, -1], [1, 1, 1])
        direction = rng.uniform(0.1, 9) * (centre + axes[:, :2] @ rng.uniform(-1, 1, 2) - origin)
        expected = origin + direction * (normal @ (centre - origin)) / (normal @ direction)
        # A disc's thickness, squared, in its radius: its density is largest as far from its plane. Float32 means too.
        np.testing.assert_allclose(pick_point(wall, everything, origin, direction), expected, atol=3e-6)
    assert pick_point(wall, everything, np.zeros(3), -centre) is None
    assert pick_point(wall, ~everything, np.zeros(3), centre) is None
    assert pick_point(wall, everything, np.full(3, np.nan), centre) is None
    wall.quats[:] = 0  # no rotation
    assert pick_point(wall, everything, np.zeros(3), centre) is not None


@pytest.mark.parametrize(("opacity", "depth"), [(0.7, 2.0), (0.3, 4.0)])
def test_a_click_on_an_edge_lies_on_one_of_the_two_surfaces(opacity: float, depth: float) -> None:
    """The one that gives most of the colour; the mean depth, 2.6 and 3.4, is no surface."""
    two = discs(np.array([[0, 0, 2.0], [0, 0, 4.0]]), np.array([1.0, 0, 0, 0]), np.array([opacity, 0.999]))
    found = pick_point(two, np.ones(2, bool), np.zeros(3), np.array([0, 0, 3.0]))
    np.testing.assert_allclose(found, [0, 0, depth], atol=1e-6)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    gmap = small_map()
    gmap.info = {**gmap.info, "metric": False}
    for entry in gmap.instances:  # boxes that hold the points, as a map's do
        points = gmap.means[gmap.instance_ids == entry["id"]]
        entry["aabb"] = {"min": points.min(axis=0).tolist(), "max": points.max(axis=0).tolist()}
    write_map(tmp_path / "m.gsmap", gmap)
    return tmp_path / "m.gsmap"


def files(path: Path) -> list[tuple[str, bytes]]:
    return sorted((f.name, f.read_bytes()) for f in path.iterdir())


def measured(path: Path) -> Session:
    """A session in which two balls were clicked."""
    session = Session(path)
    session.measure()
    for direction in (FRONT, BACK):
        assert session.pick(np.zeros(3), direction) is None
    assert session.selected == [] and not session.measuring
    assert session.pick(np.zeros(3), FRONT) == 0  # clicks select again
    return session


def test_two_clicks_and_a_length_make_the_map_metric(path: Path) -> None:
    """Every length of the map is multiplied; the file is that of `perception scale` between the same two points."""
    before, other = read_map(path), path.with_name("other.gsmap")
    shutil.copytree(path, other)
    session = measured(path)
    ends = np.array(session.ends)
    assert np.abs(np.linalg.norm(ends[0] - [-1.2, 0, 4])) < 0.6 and np.linalg.norm(ends[1] - [1.2, -0.2, 4.5]) < 0.6
    units = float(np.linalg.norm(ends[1] - ends[0]))
    assert session.length == f"{units:.4g} map units"
    session.set_scale(1.2)
    gmap = read_map(path)
    assert gmap.metric and session.length == "1.2 m" and not session.editor.dirty
    np.testing.assert_allclose(gmap.means, before.means * (1.2 / units), rtol=1e-6)
    np.testing.assert_allclose(session.editor.original.scales, before.scales * (1.2 / units), rtol=1e-5)
    # Each end is off by the median of the Gaussians' longest radii, independently.
    error = np.sqrt(2) * float(np.median(before.scales.max(axis=1))) / units
    assert gmap.info["scale"]["standard_error"] == pytest.approx(error, rel=1e-6)
    assert gmap.info["scale"]["metres_per_unit"] == 1 and "1.2 m between two points" in gmap.info["scale"]["source"]
    words = " ".join(",".join(map(repr, end)) for end in ends.tolist())
    assert main(["scale", str(other), "--known-length", f"1.2: {words}"]) == 0
    assert files(other) == files(path)
    session.editor.rename(1, "pear")  # the map that was opened anew can be edited and saved
    session.editor.save()
    assert read_map(path).instances[1]["label"] == "pear" and read_map(path).metric


@pytest.mark.parametrize(
    ("metres", "scale", "message"),
    [
        (0.0, None, "found 0 m, expected a length above 0"),
        (float("nan"), None, "known length: found 'nan"),
        (1.2, {"metres_per_unit": 1.0, "source": "board", "standard_error": 0.001}, "in metres already, within ± 0.1%"),
        (1.2, {"metres_per_unit": 1.0, "source": "the input", "standard_error": None}, "as its input states"),
    ],
)
def test_a_length_that_tells_nothing_new_is_refused(
    path: Path, metres: float, scale: dict[str, Any] | None, message: str
) -> None:
    if scale is not None:
        gmap = read_map(path)
        write_map(path, Map.of(gmap, info={**gmap.info, "metric": True, "scale": scale}))
    session, before = measured(path), files(path)
    with pytest.raises(InputError, match=message):
        session.set_scale(metres)
    assert files(path) == before and not session.editor.outdated
    if scale is not None and scale["standard_error"]:  # a less certain scale is replaced
        gmap = read_map(path)
        write_map(path, Map.of(gmap, info={**gmap.info, "scale": {**scale, "standard_error": 0.5}}))
        measured(path).set_scale(1.2)
        assert "two points" in read_map(path).info["scale"]["source"]


def test_ends_that_measure_nothing_are_refused(path: Path) -> None:
    session, before = Session(path), files(path)
    session.measure()
    with pytest.raises(InputError, match="nothing at that place"):
        session.pick(np.zeros(3), -FRONT)
    session.pick(np.zeros(3), FRONT)
    with pytest.raises(InputError, match="click both ends"):
        session.set_scale(1.0)
    session.pick(np.zeros(3), FRONT)
    with pytest.raises(InputError, match="two different points"):
        session.set_scale(1.0)
    session.ends[1] = session.ends[1] + 0.01
    with pytest.raises(InputError, match="too near each other"):
        session.set_scale(1.0)
    assert files(path) == before


def test_neither_unsaved_corrections_nor_another_programs_work_is_lost(path: Path) -> None:
    session = measured(path)
    session.editor.rename(1, "pear")
    with pytest.raises(InputError, match="unsaved corrections"):
        session.set_scale(1.2)
    session.editor.undo()
    set_labels(path, {2: "plum"})
    before = files(path)
    with pytest.raises(InputError, match="another program"):
        session.set_scale(1.2)
    assert files(path) == before
    session.reopen()
    assert session.ends == []


@pytest.fixture
def viewer(path: Path) -> Iterator[Any]:
    pytest.importorskip("viser")
    from perception.viewer import Viewer

    running = Viewer(path, port=free_port())
    yield running
    running.stop()


def test_the_page_measures_and_sets_the_scale(viewer: Any, path: Path) -> None:
    """The controls' own handlers, as the page calls them; the line is drawn in the page's units, ten a map."""
    controls = {h.label: h for h in viewer.server.gui._gui_input_handle_from_uuid.values() if hasattr(h, "label")}

    def press(label: str) -> None:
        for handler in controls[label]._impl.update_cb:
            handler(SimpleNamespace(client=None))

    press("Two points")
    assert "end 1 of 2" in viewer.panel._measured.content
    for direction in (FRONT, BACK):
        viewer._clicked(SimpleNamespace(ray_origin=(0, 0, 0), ray_direction=tuple(direction)), add=False)
    line, label = viewer._overlays
    ends = np.array(viewer.session.ends)
    np.testing.assert_allclose(line.points[0], ends * viewer.scale, rtol=1e-6)
    assert label.text == viewer.session.length and label.text.endswith("map units")
    before = files(path)
    press("Set scale")  # no length was typed
    assert files(path) == before
    controls["true length (m)"].value = 0.8
    press("Set scale")
    assert json.loads((path / "map.json").read_text())["metric"] is True
    assert viewer._overlays[1].text == "0.8 m" and "known length" in viewer.panel._measured.content
    line = viewer._overlays[0]
    np.testing.assert_allclose(line.points[0], ends * 0.8 / np.linalg.norm(ends[1] - ends[0]) * viewer.scale, rtol=1e-5)
