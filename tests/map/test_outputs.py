"""No command writes over what it reads, by its path, a link or a hard link; side files count too."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from perception.cli import main
from perception.io.ply import write_ply
from perception.map.outputs import refuse_inputs
from perception.map.write import write_map
from perception.types import View
from support.viewer_maps import small_map


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A map m.gsmap of photos/1.png and photos/2.png, their cameras, a scan, its transform and its segments."""
    monkeypatch.chdir(tmp_path)
    photos = [tmp_path / "photos" / f"{n}.png" for n in (1, 2)]
    photos[0].parent.mkdir()
    for photo in photos:
        photo.write_text("a photo")
    K, gmap = np.array([[30.0, 0, 16], [0, 30, 12], [0, 0, 1]]), small_map(60)
    write_map(tmp_path / "m.gsmap", replace(gmap, views=[View(p.name, p, K, 32, 24, np.eye(4)) for p in photos]))
    head = {"fl_x": 30, "fl_y": 30, "cx": 16, "cy": 12, "w": 32, "h": 24}
    frames = [{"file_path": f"photos/{p.stem}", "transform_matrix": np.eye(4).tolist()} for p in photos]
    (tmp_path / "transforms.json").write_text(json.dumps(head | {"frames": frames}))
    columns = {name: np.ascontiguousarray(gmap.means[:, axis]) for axis, name in enumerate("xyz")}
    write_ply(tmp_path / "scan.ply", {"vertex": {**columns, "intensity": columns["x"]}})
    (tmp_path / "place.json").write_text(json.dumps({"map_from_scan": np.eye(4).tolist()}))
    (tmp_path / "scan.segs.json").write_text(json.dumps({"segIndices": [0] * 60}))
    return tmp_path


def contents(folder: Path) -> dict[str, bytes]:
    return {str(file): file.read_bytes() for file in folder.rglob("*") if file.is_file()}


EXPORT = ["export", "m.gsmap", "--points", "scan.ply"]
REFUSED = [
    [*EXPORT, "-o", "scan.ply"],
    [*EXPORT, "-o", "./photos/../scan.ply"],
    [*EXPORT, "-o", "place.ply", "--transform", "place.json"],
    [*EXPORT, "-o", "scan.segs.ply", "--segments", "scan.segs.json"],
    [*EXPORT, "-o", "transforms.ply"],
    [*EXPORT, "-o", "new.ply", "--mesh", "scan.ply"],
    [*EXPORT, "-o", "new.ply", "--mesh", "new.ply"],
    [*EXPORT, "-o", "new.ply", "--graph", "new.json"],
    ["export", "m.gsmap", "-o", "m.gsmap/gaussians.ply"],
    ["export", "m.gsmap", "-o", "m.gsmap/instances.ply"],
    ["export", "m.gsmap", "-o", "m.gsmap/features.spz"],
    ["export", "m.gsmap", "--voxels", "m.gsmap/parts.npz"],
    ["export", "m.gsmap", "--graph", "m.gsmap/map.json"],
    ["report", "m.gsmap", "-o", "m.gsmap/map.json"],
    ["report", "m.gsmap", "-o", "photos/1.png"],
    ["query", "m.gsmap", "thing", "--points", "m.gsmap/gaussians.ply"],
    ["render", "m.gsmap", "-o", "photos"],
    ["render", "m.gsmap", "-o", "photos", "--cameras", "transforms.json"],
    ["calibrate", "photos", "-o", "photos/1.png"],
    ["calibrate", "photos/1.png", "-o", "photos/1.png"],
    ["frames", "scan.ply", "-o", "scan.ply"],
    ["demo", "-o", "scan.ply"],
]


@pytest.mark.parametrize("words", REFUSED, ids=" ".join)
def test_an_output_that_is_an_input_is_refused(
    place: Path, words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    before = contents(place)
    assert main(words) == 2
    told = capsys.readouterr().err
    reasons = ("which this command reads", "would be written twice", "of that map", "is not empty", "lies there")
    assert told.startswith("error: ") and told.count("\n") == 1 and any(reason in told for reason in reasons)
    assert contents(place) == before


@pytest.mark.parametrize("link", [os.symlink, os.link])
def test_links_to_an_input_are_refused(place: Path, link: Callable[[str, str], None]) -> None:
    link("scan.ply", "other.ply")
    before = contents(place)
    assert main([*EXPORT, "-o", "other.ply"]) == 2 and contents(place) == before
    Path("out").mkdir()
    link(str(place / "photos" / "1.png"), "out/1.png")
    before = contents(place)
    assert main(["render", "m.gsmap", "-o", "out"]) == 2 and contents(place) == before


def test_exports_lie_in_a_maps_folder_and_are_written_anew(place: Path) -> None:
    for _ in range(2):
        assert main([*EXPORT, "-o", "m.gsmap/labelled.ply", "--no-smooth"]) == 0
        assert main(["export", "m.gsmap", "-o", "m.gsmap/web.spz"]) == 0
    refuse_inputs([place / "m.gsmap" / "report.html"], [place / "m.gsmap"])
    (place / "ids.npy").write_bytes((place / "m.gsmap" / "features.npy").read_bytes())
    assert main(["export", "m.gsmap", "-o", "ids.spz"]) == 2
    copy = place / "instances.json"  # of a map: with the list of them, not with what an export says of each
    copy.write_bytes((place / "m.gsmap" / copy.name).read_bytes())
    before = contents(place)
    assert main(["export", "m.gsmap", "-o", "instances.ply"]) == 2 and contents(place) == before


def test_clouds_of_one_stem_do_not_replace_one_anothers_facts(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    export = ["export", "m.gsmap", "-o"]
    assert main([*export, "a.ply"]) == 0
    before, _ = contents(place), capsys.readouterr()
    assert main([*export, "a.npz"]) == 2 and contents(place) == before
    assert "a.json: is of a.ply, which lies beside it" in capsys.readouterr().err
    assert main([*export, "b.npz"]) == 0 and main([*export, "a.ply"]) == 0
    Path("a.ply").unlink()
    assert main([*export, "a.npz"]) == 0 and json.loads(Path("a.json").read_text())["cloud"] == "a.npz"


def test_pictures_of_photos_with_one_stem_get_names_of_their_own(place: Path) -> None:
    text = (place / "transforms.json").read_text()
    text = text.replace("photos/1", "photos/floor.1").replace("photos/2", "photos/floor.2")
    (place / "transforms.json").write_text(text)
    assert main(["render", "m.gsmap", "-o", "out", "--cameras", "transforms.json"]) == 0
    assert {file.name for file in (place / "out").iterdir()} == {"floor.1.png", "floor.2.png"}
    (place / "transforms.json").write_text(text.replace("floor.1", "a.jpg").replace("floor.2", "a.png"))
    assert main(["render", "m.gsmap", "-o", "two", "--cameras", "transforms.json"]) == 0
    assert {file.name for file in (place / "two").iterdir()} == {"a.jpg.png", "a.png.png"}


def test_what_a_map_was_made_from_is_not_written_over(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Label images are named as the pictures that render writes."""
    facts = place / "m.gsmap" / "map.json"
    (place / "labels").mkdir()
    labels = [place / "labels" / f"{n}.png" for n in (1, 2)]
    for file in labels:
        file.write_text("by hand")
    listed = {
        f"masks={place / 'labels'}": {"1.png": "7 0", "2.png": "7 0"},
        f"input={place / 'scan.ply'}": {"scan.ply": "1 0"},
    }
    facts.write_text(json.dumps({**json.loads(facts.read_text()), "inputs": listed}))
    scan = (place / "scan.ply").read_bytes()
    assert main(["render", "m.gsmap", "-o", "labels"]) == 2
    assert main(["report", "m.gsmap", "-o", "scan.ply"]) == 2
    assert "labels/1.png" in capsys.readouterr().err
    assert [file.read_text() for file in labels] == ["by hand"] * 2 and (place / "scan.ply").read_bytes() == scan


@pytest.mark.parametrize(
    "option", ["--align", "--transform t", "--segments s", "--max-distance 0", "--granularity parts"]
)
@pytest.mark.parametrize("output", ["--graph g.json", "--mesh m.ply", "-o new.spz"])
def test_an_option_that_changes_nothing_that_is_written_is_refused(
    option: str, output: str, place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = contents(place)
    assert main(["export", "m.gsmap", *output.split(), *option.split()]) == 2
    name, told = option.split()[0], capsys.readouterr().err
    assert f"{name} changes nothing" in told and told.count("\n") == 1 and contents(place) == before


@pytest.mark.parametrize(
    "option",
    [
        *("--only 0", "--each", "--voxel-size 1", "--instance 0", "--max-distance 1"),
        "--segments scannet --no-smooth --points scan.ply",
    ],
)
def test_an_option_of_another_output_is_refused(option: str, place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["export", "m.gsmap", "-o", "new.ply", *option.split()]) == 2
    assert f"{option.split()[0]} changes nothing" in capsys.readouterr().err and not (place / "new.ply").exists()


@pytest.mark.parametrize("name", ["pipe.ply", "pipe.npy", "pipe.json"])
def test_a_named_pipe_is_neither_replaced_nor_waited_for(
    name: str, place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    os.mkfifo(place / name)
    output = {".npy": "pipe.spz"}.get(Path(name).suffix, "pipe.ply")
    assert main(["export", "m.gsmap", "-o", output]) == 2
    assert (place / name).is_fifo()
    assert capsys.readouterr().err.count("\n") == 1


@pytest.mark.parametrize("path", ["x" * 300 + ".ply", "loop.ply"])
@pytest.mark.parametrize(
    "command",
    [
        ["info", "PATH"],
        ["upgrade", "m.gsmap", "-o", "PATH"],
        ["scale", "m.gsmap", "--known-length", "1: 0,0,0 9,9,9", "-o", "PATH"],
        ["export", "m.gsmap", "--points", "PATH", "-o", "out.ply"],
        ["export", "m.gsmap", "--points", "scan.ply", "--transform", "PATH", "-o", "out.ply"],
        ["index", "PATH", "-o", "all"],
        ["index", "m.gsmap", "--remove", "PATH", "-o", "all"],
        ["map", "PATH", "-o", "new.gsmap"],
        ["map", "transforms.json", "-o", "PATH"],
        ["map", "transforms.json", "-o", "new.gsmap", "--init-points", "PATH"],
        ["map", "transforms.json", "-o", "new.gsmap", "--masks", "labels:PATH"],
        ["fleet", "PATH"],
        ["models", "check", "PATH"],
    ],
)
def test_paths_that_the_system_refuses_are_told_in_one_line(
    command: list[str], path: str, place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (place / "loop.ply").symlink_to("loop.ply")
    assert main([word.replace("PATH", path) for word in command]) == 2
    told = capsys.readouterr().err.splitlines()[-1]
    assert told.startswith("error: ") and path[:40] in told
