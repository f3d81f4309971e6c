"""What counts as an input file of a run, and what as a change: the oracle is the files that each test writes."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from perception.config import MapConfig, load_config
from perception.errors import InputError
from perception.pipeline.changes import hold_inputs, inputs_of, refuse_changed
from perception.pipeline.checkpoint import clear_work, frames_folder, work_folder, working
from support.onnx_files import FLOAT, write_onnx
from support.rgbd_folders import NAMED, write_recording

PLAIN = load_config(None, ["masks=builtin"])


def filled(folder: Path, *names: str) -> Path:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(name.encode())
    return folder


def listed(source: Path, config: MapConfig = PLAIN, output: Path = Path("nowhere.gsmap")) -> dict[str, set[str]]:
    return {key.partition("=")[0]: set(files) for key, files in inputs_of(source, config, output).items()}


def test_photos_count_and_what_the_run_writes_beside_them_does_not(tmp_path: Path) -> None:
    photos = filled(tmp_path / "in", "a.jpg", "deep/b.PNG", "note.txt", "run.log", ".hidden.jpg", "x.gsmap/page.jpg")
    assert listed(photos) == {"input": {"a.jpg", "deep/b.PNG"}}
    output = photos / "map"  # a name without .gsmap
    filled(output, "c.jpg")
    filled(work_folder(output), "sfm/photos/0.jpg")
    filled(frames_folder(output), "0.jpg")
    link = tmp_path / "link"
    link.symlink_to(photos)
    for spelled in (output, link / "map", photos / "deep" / ".." / "map"):
        assert listed(photos, PLAIN, spelled) == listed(link, PLAIN, spelled) == {"input": {"a.jpg", "deep/b.PNG"}}


def test_all_that_a_transforms_json_names_counts(tmp_path: Path) -> None:
    filled(tmp_path, "t/in/a.jpg", "depth/a.png", "t/in/mask.png", "t/cloud.ply", "t/unlisted.jpg")
    frame = {"file_path": "in/a", "depth_file_path": "../depth/a.png", "mask_path": "in/mask.png"}
    frames = [{**frame, "transform_matrix": []}, {"file_path": "in/lost.jpg", "transform_matrix": []}]
    source = tmp_path / "t" / "transforms.json"
    source.write_text(json.dumps({"frames": frames, "ply_file_path": "cloud.ply"}))
    expected = {"input": {"transforms.json", "in/a.jpg", "../depth/a.png", "in/mask.png", "cloud.ply"}}
    assert listed(source) == listed(tmp_path / "t") == expected


def test_photos_and_models_of_a_workspace_count(tmp_path: Path) -> None:
    models = [f"sparse/{n}/{part}.{kind}" for n, kind in ((0, "bin"), (1, "txt")) for part in ("images", "cameras")]
    filled(tmp_path, "images/a.jpg", "images/deep/b.jpg", "database.db", "sparse/0/points.ply", *models)
    assert listed(tmp_path) == {"input": {"images/a.jpg", "images/deep/b.jpg", *models}}


@pytest.mark.parametrize("layout", sorted(NAMED))
def test_files_of_a_recording_count(layout: str, tmp_path: Path) -> None:
    source = write_recording(tmp_path, layout)
    filled(source, "renders/a.png", "notes.txt")
    written = {path.relative_to(source).as_posix() for path in source.rglob("*") if path.is_file()}
    found = listed(source)["input"]
    assert {"renders/a.png", "notes.txt"}.isdisjoint(found) and found <= written
    assert {Path(name).suffix for name in found} >= {".png"} and len(found) > 20


def test_files_of_settings_and_models_count(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    filled(
        tmp_path, "in/a.jpg", "camera.yaml", "cloud.ply", "held.txt", "ignore/a.png", "ignore/a.txt", "labels/b/a.png"
    )
    pairs = ["photos.camera=camera.yaml", "photos.init_points=cloud.ply", "photos.held_out=held.txt"]
    config = load_config(None, [*pairs, "photos.ignore_masks=ignore", "masks=labels:labels"])
    assert listed(Path("in"), config) == {
        "input": {"a.jpg"},
        "photos.camera": {"camera.yaml"},
        "photos.init_points": {"cloud.ply"},
        "photos.held_out": {"held.txt"},
        "photos.ignore_masks": {"a.png"},
        "masks": {"b/a.png"},
    }
    filled(tmp_path, "sam/config.json", "sam/other.json", "clip/x.onnx")
    for name in ("sam/encoder.onnx", "sam/decoder.onnx"):
        write_onnx(tmp_path / name, {"x": ((1,), FLOAT)}, {"y": np.zeros(1, np.float32)})
    graphs = {"encoder.onnx", "decoder.onnx", "config.json"}
    for spec in ("sam", "sam/encoder.onnx"):
        assert listed(Path("in"), load_config(None, [f"masks=sam:{spec}"]))["masks"] == graphs
    monkeypatch.setenv("PERCEPTION_SAM", str(tmp_path / "sam"))
    config = load_config(None, ["masks=auto", "language.encoder=clip:clip/x.onnx"])
    assert listed(Path("in"), config) == {"input": {"a.jpg"}, "masks": graphs, "language.encoder": {"x.onnx"}}


def touch(folder: Path) -> None:
    os.utime(folder / "in" / "b.jpg", ns=(1, 1))


def grow(folder: Path) -> None:
    stat = (folder / "in" / "b.jpg").stat()
    (folder / "in" / "b.jpg").write_bytes(b"longer than it was")
    os.utime(folder / "in" / "b.jpg", ns=(stat.st_atime_ns, stat.st_mtime_ns))


def move(folder: Path) -> None:
    (folder / "in" / "b.jpg").rename(folder / "in" / "z.jpg")


CHANGES: list[tuple[Callable[[Path], object], str]] = [
    (touch, r"1 in all: b\.jpg \(changed\);"),
    (grow, r"1 in all: b\.jpg \(changed\);"),
    (move, r"2 in all: b\.jpg \(gone\), z\.jpg \(new\);"),
    (lambda folder: filled(folder, "in/new.jpg"), r"1 in all: new\.jpg \(new\);"),
    (lambda folder: shutil.rmtree(folder / "labels"), r"4 in all: 0\.png \(gone\), .* and 1 more;"),
    (lambda folder: (folder / "camera.yaml").unlink(), r"1 in all: camera\.yaml \(gone\);"),
]


@pytest.mark.parametrize(("change", "told"), CHANGES)
def test_a_changed_file_is_named(change: Callable[[Path], object], told: str, tmp_path: Path) -> None:
    labels = [f"labels/{number}.png" for number in range(4)]
    filled(tmp_path, "in/a.jpg", "in/b.jpg", "camera.yaml", *labels)
    config = load_config(None, [f"photos.camera={tmp_path / 'camera.yaml'}", f"masks=labels:{tmp_path / 'labels'}"])
    source, output, work = tmp_path / "in", tmp_path / "m.gsmap", filled(tmp_path / "m.gsmap.work")
    work.mkdir()
    kept = hold_inputs(work, source, config, output)
    info = json.loads(json.dumps({"inputs": kept}))
    assert hold_inputs(work, source, config, output) == kept
    refuse_changed(output, info, inputs_of(source, config, output))
    change(tmp_path)
    before = (work / "inputs.json").read_bytes()
    with pytest.raises(InputError, match=told):
        hold_inputs(work, source, config, output)
    with pytest.raises(InputError, match=told):
        refuse_changed(output, info, inputs_of(source, config, output))
    assert (work / "inputs.json").read_bytes() == before


def test_files_of_another_setting_are_compared_when_it_comes_back(tmp_path: Path) -> None:
    filled(tmp_path, "in/a.jpg", "one/a.png", "two/a.png", "work/.left.new-1")
    source, output = tmp_path / "in", tmp_path / "m.gsmap"
    one, two = (load_config(None, [f"masks=labels:{tmp_path / name}"]) for name in ("one", "two"))
    for config in (one, two, one):
        hold_inputs(tmp_path / "work", source, config, output)
    os.utime(tmp_path / "one" / "a.png", ns=(1, 1))
    hold_inputs(tmp_path / "work", source, two, output)
    with pytest.raises(InputError, match=r"a\.png \(changed\)"):
        hold_inputs(tmp_path / "work", source, one, output)


def test_runs_that_tell_no_input_files_or_damaged_ones_are_refused(tmp_path: Path) -> None:
    filled(tmp_path, "in/a.jpg", "work/checkpoint.pt")
    source, output, work = tmp_path / "in", tmp_path / "m.gsmap", tmp_path / "work"
    with pytest.raises(InputError, match="recorded no input files"):
        hold_inputs(work, source, PLAIN, output)
    key = next(iter(inputs_of(source, PLAIN, output)))
    for found in ([], {key: 1}, {key: []}, {key: [[]]}, "x"):
        (work / "inputs.json").write_text(json.dumps(found))
        with pytest.raises(InputError, match="damaged"):
            hold_inputs(work, source, PLAIN, output)
    with pytest.raises(InputError, match="recorded no input files"):
        refuse_changed(output, {}, {})
    for found in (None, 3, {"a": 1}, {"a": [[]]}):
        with pytest.raises(InputError, match="damaged"):
            refuse_changed(output, {"inputs": found}, {})


def test_only_what_a_run_wrote_is_removed_from_its_folders(tmp_path: Path) -> None:
    source, output = filled(tmp_path / "in", "1.jpg"), tmp_path / "m.gsmap"
    work = filled(work_folder(output), "notes.txt")  # of the user, beside a finished map
    clear_work(output)
    assert (work / "notes.txt").exists()
    shutil.rmtree(work)
    with working(source, output, resume=False):
        filled(work, "inputs.json", "checkpoint.pt", "masks/1.png", "poses-1/scene.json", "notes.txt")
    assert [file.name for file in work.iterdir()] == ["notes.txt"]
    shutil.rmtree(work)
    with pytest.raises(InputError), working(source, output, resume=False):
        filled(frames_folder(output), "notes.txt")  # by somebody else meanwhile
        raise InputError("the frames cannot be written")
    assert (frames_folder(output) / "notes.txt").exists() and not work.exists()


@pytest.mark.parametrize("name", ["checkpoint.pt", "block-1/checkpoint.pt", "block-1/result.pt"])
def test_what_was_trained_is_kept_when_the_first_run_ends_with_an_error(tmp_path: Path, name: str) -> None:
    """Such as that of the second block, where the first one is finished and has no checkpoint any more."""
    source, output = filled(tmp_path / "in", "1.jpg"), tmp_path / "m.gsmap"
    with pytest.raises(InputError), working(source, output, resume=False) as work:
        filled(work, "inputs.json", name)
        raise InputError("cuda: its memory is full")
    assert (work / name).exists()
