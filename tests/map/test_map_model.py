"""What a map's files may hold: a wrong value is told with its file and key; unknown keys are kept."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from fuzz.core import Dice
from fuzz.map_json import as_text, edited, write_full_map
from perception.cli import main
from perception.errors import InputError
from perception.export.render import as_gaussians
from perception.instances.silhouettes import render_silhouettes
from perception.map.checksums import seal
from perception.map.map import Map
from perception.map.write import read_map, write_map
from support.paths import MAPS

LARGEST = 2**31 - 1


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("model")
    shutil.copytree(MAPS / "photos", folder / "photos")
    write_full_map(folder / "a.gsmap", folder / "photos")
    return folder / "a.gsmap"


@pytest.fixture
def path(original: Path, tmp_path: Path) -> Path:
    shutil.copytree(original.parent, tmp_path / "m")
    return tmp_path / "m" / "a.gsmap"


def change(path: Path, file: str, keys: tuple[Any, ...], value: Any) -> None:
    """Sets one value, and makes the checksums good."""
    whole = json.loads((path / file).read_text())
    inner = whole
    for key in keys[:-1]:
        inner = inner[key]
    if value is ...:
        del inner[keys[-1]]
    else:
        inner[keys[-1]] = value
    (path / file).write_text(as_text(seal(whole) if file == "map.json" and value != "@1e999" else whole))


def told(path: Path, file: str, key: str) -> str:
    """The line that refuses the map, which names `file` and `key`."""
    with pytest.raises(InputError) as error:
        Map.open(path).load()
    line = str(error.value)
    assert line.startswith(f"{path / file}: ") and key in line and "\n" not in line and len(line) < 1000, line
    return line


FACTS: list[tuple[tuple[Any, ...], Any, str]] = [
    (("num_gaussians",), 10**9, "num_gaussians"), (("num_gaussians",), 10**30, "num_gaussians"),
    (("num_instances",), ..., "num_instances"), (("frame",), [], "frame"),
    (("frame",), "\ud800", "frame"), (("views",), {}, "views"), (("views", 0), 3, "views[0]"),
    (("views", 1, "name"), "../a", "views[1].name"), (("views", 1, "photo"), 3, "views[1].photo"),
    (("views", 1, "width"), 0, "views[1].width"), (("views", 1, "width"), True, "views[1].width"),
    (("views", 1, "height"), 1 << 21, "views[1].height"), (("views", 1, "K"), [[0] * 3] * 3, "views[1].K"),
    (("views", 1, "camera_from_world"), np.zeros((4, 4)).tolist(), "views[1].camera_from_world"),
    (("views", 2, "lens"), [], "views[2].lens"), (("views", 2, "lens", 1), "abc", "views[2].lens[1]"),
    (("config",), [], "config"), (("config", "language", "encoder"), 5, "config.language.encoder"),
    (("config", "photos", "max_side"), -1, "config.photos.max_side"), (("scene", "left_out"), [1], "scene.left_out[0]"),
    (("scene", "origin"), [1, 2], "scene.origin"), (("quality", "views", "0.png", "psnr"), "x", "quality.views.0.png"),
    (("gravity", "direction"), [0, 0, 0], "gravity.direction"), (("scale", "source"), ..., "scale.source"),
    (("blocks",), 5, "blocks"), (("blocks",), [{}], "blocks[0].box"),
    (("blocks",), [{"box": [[0, 0, 0]]}], "blocks[0].box"), (("blocks",), [{"box": [[0, "x", 0]] * 2}], "blocks"),
    (("map_from_input"), np.zeros((4, 4)).tolist(), "map_from_input"), (("files", "gaussians.ply"), 1, "files"),
    (("training", "seconds"), {}, "training.seconds"), (("seconds", "total"), None, "seconds.total"),
    (("peak_memory_mib",), "a", "peak_memory_mib"), (("seed",), -1, "seed"), (("other",), "@1e999", ""),
    (("other",), "@deep", "recursion"),
]  # fmt: skip


@pytest.mark.parametrize(("keys", "value", "key"), FACTS)
def test_a_wrong_fact_is_told(path: Path, keys: Any, value: Any, key: str) -> None:
    change(path, "map.json", keys if isinstance(keys, tuple) else (keys,), value)
    told(path, "map.json", key)


ENTRIES: list[tuple[tuple[Any, ...], Any, str]] = [
    (("id",), LARGEST + 1, "id"), (("id",), -1, "id"), (("id",), True, "id"), (("id",), 1, "id"),
    (("num_gaussians",), 181, "num_gaussians"), (("num_gaussians",), ..., "num_gaussians"), (("label",), 3, "label"),
    (("label",), "\ud800", "label"), (("texts",), ["MUG"], "texts[0]"), (("texts",), {}, "texts"),
    (("score",), 2, "score"), (("score",), None, "score"), (("centroid",), [0, 0], "centroid"),
    (("centroid",), [0, 0, 1e300], "centroid[2]"), (("obb", "extent"), [1, 1, -1], "obb.extent[2]"),
    (("obb", "rotation"), [], "obb.rotation"), (("aabb",), [], "aabb"), (("parts",), {}, "parts"),
    (("parts",), [{}], "parts[0]"), (("hidden",), 1, "hidden"), (("other",), "@1e999", ""),
]  # fmt: skip


@pytest.mark.parametrize(("keys", "value", "key"), ENTRIES)
def test_a_wrong_entry_is_told(path: Path, keys: tuple[Any, ...], value: Any, key: str) -> None:
    change(path, "instances.json", ("instances", 0, *keys), value)
    told(path, "instances.json", key)


def test_parts_belong_to_their_whole_and_lists_are_whole(path: Path) -> None:
    good = (path / "instances.json").read_text()
    for keys, value in (
        (("instances", 1, "parts", 0, "parent"), 0), (("instances", 1, "parts", 0, "id"), 0), (("instances", 0), ...),
    ):  # fmt: skip
        change(path, "instances.json", keys, value)
        told(path, "instances.json", "")
        (path / "instances.json").write_text(good)
    change(path, "instances.json", ("instances", 0, "id"), LARGEST)
    told(path, "instance_ids.npy", "ids: 0 is none of the 3")


ARCHIVES: list[tuple[str, str, Any]] = [
    ("language", "view_counts", [2, 2, 3, 1]), ("language", "view_counts", [-1, 3, 4, 1]),
    ("language", "view_counts", [2.0, 2, 2, 1]), ("language", "embeddings", np.zeros((2, 3), np.float32)),
    ("language", "embeddings", np.full((4, 3), np.nan, np.float32)), ("language", "view_boxes", [[0] * 4] * 5),
    ("language", "palettes", np.zeros((3, 24), np.float32)), ("language", "encoder", 3),
    ("parts", "ids", np.zeros(180, np.int32)), ("parts", "ids", np.full(20, -1)),
    ("parts", "language_embeddings", np.zeros((3, 3), np.float32)), ("groups", "of", [0, 2, -1, -1]),
    ("groups", "of", [0, 0, -1, 0, -1]), ("groups", "scores", np.zeros((1, 1))),
    ("groups", "language_view_counts", [7]), ("past", "ids", [2, 40, 0]), ("past", "until", [0, 7, 0]),
    ("past", "means", np.full((3, 3), np.nan, np.float32)),
]  # fmt: skip


@pytest.mark.parametrize(("name", "key", "value"), ARCHIVES)
def test_arrays_that_do_not_fit_are_told(path: Path, name: str, key: str, value: Any) -> None:
    whole = read_map(path)
    write_map(path, Map.of(whole, **{name: {**getattr(whole, name), key: np.asarray(value)}}))
    told(path, f"{name}.npz", key.removeprefix("language_"))
    write_map(path, Map.of(whole, **{name: {k: v for k, v in getattr(whole, name).items() if k != key}}))
    told(path, f"{name}.npz", key.removeprefix("language_"))


@pytest.mark.parametrize("name", ["membership", "features"])
def test_a_row_for_each_gaussian(path: Path, name: str) -> None:
    whole = read_map(path)
    change(path, "map.json", ("files",), {})
    np.save(path / f"{name}.npy", getattr(whole, name)[:-1])
    told(path, f"{name}.npy", "179 rows")


@pytest.mark.parametrize(("name", "value"), [("means", np.inf), ("means", np.nan), ("quats", np.nan), ("sh", np.nan)])
def test_gaussians_that_are_no_numbers_are_told(path: Path, name: str, value: float) -> None:
    array = getattr(whole := read_map(path), name).copy()
    array.reshape(-1)[7] = value
    write_map(path, Map.of(whole, **{name: array}))
    told(path, "gaussians.ply", f"{name}: holds NaN or infinity")


def test_unknown_keys_are_kept(path: Path) -> None:
    change(path, "map.json", ("robot",), {"name": "é", "list": [1, {"a": None}]})
    change(path, "instances.json", ("instances", 0, "color"), ["red", 1.5])
    assert main(["label", str(path), "0", "bowl"]) == 0
    assert main(["scale", str(path), "--known-length", "0.3: 0,0,0 0,0,1"]) == 0
    assert json.loads((path / "map.json").read_text())["robot"] == {"name": "é", "list": [1, {"a": None}]}
    entry = json.loads((path / "instances.json").read_text())["instances"][0]
    assert (entry["color"], entry["label"]) == (["red", 1.5], "bowl")


def test_paths_that_are_no_utf_8_are_kept_and_shown(path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    change(path, "map.json", ("source",), "photos\udcff")
    assert main(["info", str(path)]) == 0
    assert "photos" in capfd.readouterr().out and Map.open(path).info["source"] == "photos\udcff"


def test_a_map_without_the_sections_of_later_releases_is_reported(path: Path) -> None:
    for key in ("seconds", "training", "masks", "scene", "quality", "peak_memory_mib", "config", "source", "views"):
        change(path, "map.json", (key,), ...)
        assert main(["report", str(path), "-o", str(path.parent / "r.html")]) == 0, key
        assert main(["info", str(path)]) == 0, key


def test_large_ids_are_drawn_as_small_ones_are(path: Path) -> None:
    whole = read_map(path)
    view, gaussians = whole.views[0], as_gaussians(whole)
    moved = np.where(whole.instance_ids < 0, -1, LARGEST - 2 + whole.instance_ids).astype(np.int32)
    pose, K = (torch.from_numpy(a.astype(np.float32)) for a in (view.camera_from_world, view.K))
    small, large = (
        render_silhouettes(gaussians, [ids], pose, K, view.width, view.height)[0] for ids in (whole.instance_ids, moved)
    )
    assert (small.ids >= 0).any()
    assert np.array_equal(large.ids, np.where(small.ids < 0, -1, small.ids + LARGEST - 2))
    assert np.array_equal(large.shown, small.shown + LARGEST - 2)
    assert np.array_equal(large.pixels, small.pixels) and np.array_equal(large.visible, small.visible)


@settings(max_examples=150, derandomize=True, database=None, deadline=None)
@given(st.sampled_from(["map.json", "instances.json"]), st.binary(min_size=8, max_size=40))
def test_random_edits_are_read_or_told(original: Path, name: str, data: bytes) -> None:
    """All commands are run on such files by tools/fuzz/map_json.py."""
    good = (original / name).read_text()
    try:
        (original / name).write_text(as_text(edited(Dice(data), json.loads(good))))
        Map.open(original).load()
    except InputError as error:
        assert str(original) in str(error) and "\n" not in str(error) and len(str(error)) < 1000
    finally:
        (original / name).write_text(good)


def test_a_map_reads_a_field_once_and_keeps_what_it_is_given(path: Path) -> None:
    """From disk at the first use; `of` shares what is there, changes the rest, and reads nothing."""
    opened = Map.open(path)
    named = Map.of(opened, info={"frame": "hall"})
    assert "means" not in vars(opened) and "means" not in vars(named) and named.map_id == opened.map_id
    assert named.frame == "hall" != opened.frame and opened.means is opened.means
    np.testing.assert_array_equal(named.means, read_map(path).means)
    assert Map.of(opened).means is opened.means and Map(means=opened.means).instances == []
    with pytest.raises(AttributeError, match="without quats"):
        _ = Map(means=opened.means).quats


def test_a_map_of_one_gaussian_is_read_as_kernels_take_it(tmp_path: Path) -> None:
    """Its only opacity lies where the PLY's header ends: a view of that is contiguous, and not aligned."""
    one = np.ones((1, 3), np.float32)
    quats, logits = np.float32([[1, 0, 0, 0]]), np.float32([2])
    gmap = Map(one, quats, -one, logits, one[:, None], one, np.int32([-1]), np.float32([0]), [], {"frame": "map"}, [])
    for length in range(8):  # of the header, modulo the size of a number
        write_map(tmp_path / "a.gsmap", Map.of(gmap, sh=np.ones((1, 1 + length, 3), np.float32)))
        assert as_gaussians(Map.open(tmp_path / "a.gsmap")).opacities.item() == pytest.approx(1 / (1 + np.exp(-2.0)))
