"""What people type by mistake is told in one line, before any work, and nothing they have is changed."""

from __future__ import annotations

import errno
import importlib.util
import os
import sqlite3
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image

from perception.cli import main
from perception.errors import FullDisk, InputError
from perception.inputs.load import load_scene
from perception.machine import refuse_full_disk
from perception.map.outputs import refuse_inputs
from perception.map.replace import writing
from perception.map.write import read_map, write_map
from perception.pipeline.checkpoint import work_folder, working
from perception.sfm.incremental import write_models
from perception.sfm.options import ReadOptions
from support.given_poses import NAMES, photo, write_model
from support.viewer_maps import small_map
from support.visited_map import write_visited_map


def told(capsys: pytest.CaptureFixture[str], *argv: Any) -> str:
    """The one line of a command that is refused."""
    assert main([str(argument) for argument in argv]) == 2
    out, err = capsys.readouterr()
    assert out == "" and len(err.splitlines()) == 1 and err.startswith("error: ")
    return err.strip()


@pytest.fixture
def gmap(tmp_path: Path) -> Path:
    return write_visited_map(tmp_path / "a.gsmap")


@pytest.mark.parametrize(
    ("argv", "line"),
    [
        ("map . -o m --iterations many", "--iterations: found 'many', expected a whole number from 0 to 100000000"),
        ("map . -o m --max-side 3", "--max-side: found '3', expected a whole number from 16"),
        ("map . -o m --set photos.max_side=3", "--set photos.max_side: found '3'"),
        (
            "map . -o m --max-sied 640",
            "perception map: unrecognized arguments: --max-sied 640, did you mean --max-side?",
        ),
        ("update m v -o n --preset fast", "perception update: unrecognized arguments: --preset fast (see"),
        ("node m --domain x", "--domain: found 'x', expected a whole number from 0 to 232"),
        ("serve none", "none: no map lies there, or it is gone (No such file or directory); give a directory"),
        ("map . there -o m", "perception map: unrecognized arguments: there; options stand after all other"),
        ("query m mug --top 3 cup", "perception query: unrecognized arguments: cup; options stand after all other"),
        ("scale m --tag-size 5cm", "--tag-size: found '5cm', expected a number above 0 to 1000"),
        ("serve m --queue 0", "--queue: found 0, expected a whole number from 1"),
        ("mcp m --http 127.0.0.1:99999", "--http port: found '99999', expected a whole number from 0 to 65535"),
        ("query m mug --min-score 80", "--min-score: found 80, expected a probability, at most 1"),
    ],
)
def test_messages_name_what_was_typed(argv: str, line: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert line in told(capsys, *argv.split())


def test_an_empty_path_is_not_the_working_folder(capsys: pytest.CaptureFixture[str]) -> None:
    """As of a variable of the shell that is not set."""
    assert "argument INPUT: found an empty text, expected a path" in told(capsys, "map", "", "-o", "m.gsmap")


def test_the_number_of_hits_is_named_as_the_option_is(gmap: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "(top_k, --top) is 0, expected at least 1 and at most 1000" in told(capsys, "query", gmap, "mug", "--top", 0)


@pytest.mark.parametrize(
    ("command", "line"),
    [
        ("map", "what was done is kept, go on with: perception map a --resume"),
        ("index", "what was done is kept, go on with: perception index a"),
        ("export", "begin again with: perception export a"),
    ],
)
def test_what_an_interrupted_command_keeps(
    command: str, line: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupt(*_: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("perception.cli.build_parser", interrupt)
    assert main([command, "a"]) == 130
    assert capsys.readouterr().err == f"interrupted; {line}\n"


def test_the_demo_wants_its_extra_before_any_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *_: None if name == "tokenizers" else find(name))
    line = told(capsys, "demo", "-o", tmp_path / "demo")
    assert line.endswith("the package 'tokenizers' is not installed; run in its clone: pip install \".[demo]\"")
    assert not list(tmp_path.iterdir())


def test_a_demo_that_was_stopped_can_begin_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("perception.pipeline.demo.build_map", interrupt)
    assert main(["demo", "-o", str(tmp_path / "demo")]) == 130
    assert not list(tmp_path.iterdir())


def test_an_update_refuses_photos_too_small_to_be_scored_as_a_map_does(
    gmap: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    held = read_map(gmap)
    held.language = {}  # of an encoder of tests, which a visit cannot have
    write_map(gmap, held)
    visit = tmp_path / "visit"
    visit.mkdir()
    Image.new("RGB", (640, 64)).save(visit / "a.png")
    new = tmp_path / "new.gsmap"
    line = told(capsys, "update", gmap, visit, "-o", new, "--max-side", 100, "--device", "cpu")
    assert "1 photos of 640×64 pixels would have a side of less than 11; give --max-side 110 or more" in line
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.gsmap", "visit"]


def test_pictures_of_a_map_never_lie_among_photos(
    gmap: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A map of that folder would be made of them, too."""
    folder = tmp_path / "photos"
    photo(folder / "0.jpg")
    held = read_map(gmap)
    for view in held.views:
        object.__setattr__(view, "photo", folder / "0.jpg")
    write_map(gmap, held)
    assert "holds photos" in told(capsys, "render", gmap, "-o", folder, "--what", "rgb")
    assert [path.name for path in folder.iterdir()] == ["0.jpg"]
    assert main(["render", str(gmap), "-o", str(tmp_path / "new"), "--what", "rgb, depth"]) == 0  # a blank is no matter


def test_a_folder_that_cannot_be_written_is_refused_before_the_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    refuse_inputs([tmp_path / "new" / "deep" / "out.ply"], [])  # is made
    (tmp_path / "file").touch()
    with pytest.raises(ValueError, match=r"out\.ply: cannot be written, as .*file is no folder"):
        refuse_inputs([tmp_path / "file" / "out.ply"], [])
    monkeypatch.setattr(os, "access", lambda *_: False)  # tests may run as root, whom nothing stops
    with pytest.raises(ValueError, match=r"out\.ply: cannot be written, as .* does not allow it"):
        refuse_inputs([tmp_path / "out.ply"], [])


def test_a_run_that_is_going_on_is_not_told_to_be_unfinished(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Else people would remove the folder that it works in."""
    photo(tmp_path / "photos/a.jpg")
    out, argv = tmp_path / "m.gsmap", ("map", tmp_path / "photos", "-o", tmp_path / "m.gsmap")
    work_folder(out).mkdir()
    with ThreadPoolExecutor(1) as other, writing(out):
        assert "is writing this map; wait for it to finish" in other.submit(told, capsys, *argv).result()
    assert "an unfinished run lies there; go on with --resume or remove the folder" in told(capsys, *argv)


def test_poses_that_were_found_outlive_an_error_after_them(tmp_path: Path) -> None:
    """Such as --tag-size where no photo shows a tag: what took longest is not thrown away."""
    photo(tmp_path / "photos/a.jpg")
    kept = pytest.raises(InputError, match="no tag; the poses that were found are kept: go on with --resume")
    with kept, working(tmp_path / "photos", tmp_path / "a.gsmap", resume=False) as work:
        (work / "sfm" / "mark" / "model").mkdir(parents=True)
        (work / "sfm" / "mark" / "model" / "report.json").touch()
        (work / "inputs.json").write_text('{"input=/photos": {"a.jpg": "1 2"}, "masks=/labels": {"a.png": "3 4"}}')
        raise InputError("no tag")
    assert (work / "sfm" / "mark" / "model").is_dir()
    assert "labels" not in (work / "inputs.json").read_text()  # which may be mended
    with pytest.raises(InputError, match=r"^too few$"), working(tmp_path / "photos", tmp_path / "b", False) as other:
        raise InputError("too few")
    assert not other.exists()


def test_a_map_is_no_photos(gmap: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert f"{gmap}: is a map; give a folder of photos" in told(capsys, "map", gmap, "-o", tmp_path / "m.gsmap")


@pytest.mark.parametrize(
    "error",
    [
        FullDisk("a: the disk is full, nothing was written; free some space"),
        OSError(errno.ENOSPC, "No space left on device"),
        sqlite3.OperationalError("database or disk is full"),
    ],
)
def test_work_stays_when_the_disk_is_full(error: Exception, tmp_path: Path) -> None:
    photo(tmp_path / "photos/a.jpg")
    told = pytest.raises(FullDisk, match=r"the disk is full.*free some space, and go on with --resume$")
    with told, working(tmp_path / "photos", tmp_path / "a.gsmap", resume=False) as work:
        (work / "sfm").mkdir()
        raise error
    assert (work / "sfm").is_dir()


def test_a_model_is_not_written_where_the_disk_is_nearly_full(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """COLMAP writes files that are cut short, and says nothing."""
    monkeypatch.setattr("shutil.disk_usage", lambda _: SimpleNamespace(free=1 << 20))
    model = SimpleNamespace(write=lambda _: pytest.fail("written"))
    with pytest.raises(FullDisk, match="has 1 MiB free, at least 256 are needed"):
        write_models([model], tmp_path)


def test_a_full_disk_is_told_by_the_number_of_photos(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """COLMAP aborts the process where it cannot write."""
    refuse_full_disk(tmp_path)
    monkeypatch.setattr("shutil.disk_usage", lambda _: SimpleNamespace(free=300 << 20))
    refuse_full_disk(tmp_path, 40 << 20)
    with pytest.raises(ValueError, match="has 300 MiB free, at least 1256 are needed"):
        refuse_full_disk(tmp_path, 1000 << 20)


@pytest.mark.parametrize(
    ("option", "names", "line"),
    [
        ("--ignore-masks", [], "holds no PNG; expected a PNG of the same stem for each, such as a.png"),
        (
            "--ignore-masks",
            ["c"],
            "none of its 1 PNG files is named as a photo; expected a PNG of the same stem for each",
        ),
        ("--masks", ["mask_a", "c"], "none of its 2 PNG files is named as a photo"),
    ],
)
def test_masks_of_other_photos_are_refused_before_poses_are_looked_for(
    option: str, names: list[str], line: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    photo(tmp_path / "photos/a.jpg")
    photo(tmp_path / "photos/b.jpg")
    masks = tmp_path / "masks"
    masks.mkdir()
    for name in names:
        photo(masks / f"{name}.png")
    value = f"labels:{masks}" if option == "--masks" else masks
    assert f"{masks}: {line}" in told(capsys, "map", tmp_path / "photos", "-o", tmp_path / "m.gsmap", option, value)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["masks", "photos"]


@pytest.mark.parametrize("given", ["sparse", "sparse/0"])
def test_the_photos_of_a_model_lie_beside_its_sparse(tmp_path: Path, given: str) -> None:
    """docs/formats.md: "give that folder alone", of several models."""
    for index, name in enumerate(NAMES):
        photo(tmp_path / "images" / name, index)
    write_model(tmp_path / "sparse" / "0")
    scene = load_scene(tmp_path / given, ReadOptions(tmp_path / "work"))
    whole = load_scene(tmp_path, ReadOptions(tmp_path / "work2"))
    assert [view.photo for view in scene.views] == [view.photo for view in whole.views]
    assert all(np.array_equal(a.K, b.K) for a, b in zip(scene.views, whole.views, strict=True))


def test_without_a_folder_for_temporary_files_the_remedy_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    write_map(tmp_path / "a.gsmap", small_map(100))
    monkeypatch.setattr("tempfile.tempdir", None)
    monkeypatch.setattr("tempfile._candidate_tempdir_list", lambda: ["/no/such"])  # as in a read-only container
    assert main(["localise", str(tmp_path / "a.gsmap"), str(tmp_path)]) == 2
    told = capsys.readouterr().err
    assert told.count("\n") == 1 and "No usable temporary directory" in told and "TMPDIR" in told


def test_full_memory_is_told(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr("perception.map.files.read_info", lambda _: np.empty(1 << 60, np.uint8))
    assert main(["info", "a.gsmap"]) == 2
    told = capsys.readouterr().err
    assert told.startswith("error: the memory is full") and told.count("\n") == 1 and "--max-side" in told
