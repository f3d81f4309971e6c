"""Full and read-only disks, kills between two renames, a second writer: the last good map stays, the fault is told."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import perception
from perception.cli import main
from perception.config import load_config
from perception.edit.editor import Editor
from perception.errors import InputError
from perception.gaussians.train import Trainer
from perception.io.cloud import write_cloud
from perception.io.ply import map_ply
from perception.map.map import Map
from perception.map.replace import lock_file, writing
from perception.map.write import read_map, set_labels, verify_map, write_map
from perception.pipeline import mapping
from perception.pipeline.checkpoint import CHECKPOINT, INPUTS, load_checkpoint, save_checkpoint, work_folder
from perception.pipeline.mapping import build_map
from perception.types import PointCloud
from support.paths import SUPPORT
from support.query_maps import write_map_of

pytestmark = pytest.mark.slow

QUICK = ["train.iterations=3", "language.encoder=none", "instances.min_cluster_size=15", "train.budget=2000"]


@pytest.fixture
def gmap(tmp_path: Path) -> Path:
    return write_map_of(tmp_path / "a.gsmap", gaussians=700)


def child(code: str, *arguments: object) -> subprocess.CompletedProcess[str]:
    """A fresh interpreter, away from the repository's root."""
    command = [sys.executable, "-c", code, *map(str, arguments)]
    return subprocess.run(command, cwd=SUPPORT, capture_output=True, text=True, check=False)


# ----------------------------------------------------------------------- disks


@pytest.fixture(scope="module")
def told(tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[str, str]]:
    """What each writer said on small_disk.py's full and read-only disks; it checks the map after every one."""
    namespace = ["unshare", "--map-root-user", "--mount"]
    if shutil.which("unshare") is None or subprocess.run([*namespace, "true"], check=False).returncode:
        pytest.skip("needs Linux that lets users make a mount namespace")
    folder = tmp_path_factory.mktemp("disks")
    (folder / "disk").mkdir()
    original = write_map_of(folder / "a.gsmap", gaussians=700)
    command = [*namespace, sys.executable, SUPPORT / "small_disk.py", folder / "disk", original]
    ended = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stderr
    return json.loads(ended.stdout)


WRITERS = ("write_map", "labels", "editor", "export", "checkpoint", "scene", "masks")


@pytest.mark.parametrize("writer", WRITERS)
def test_a_full_disk_is_told_in_one_line_and_loses_nothing(told: dict[str, dict[str, str]], writer: str) -> None:
    said = told[writer]
    full = [text for room, text in said.items() if room.endswith("KiB") and "after" not in room and text != "done"]
    assert said["0 KiB"] in full and len(full) >= 2
    for text in full:
        assert ("the disk is full" in text or "No space left" in text) and "\n" not in text and ".new-" not in text
    assert {text for room, text in said.items() if "after" in room} == {"done"}


@pytest.mark.parametrize("writer", WRITERS)
def test_a_read_only_disk_is_told_in_one_line(told: dict[str, dict[str, str]], writer: str) -> None:
    assert "cannot be written (Read-only file system" in told[writer]["read-only"]


# ----------------------------------------------------------------------- kills

WITHOUT_EXCHANGE = """
import os, signal, sys
from pathlib import Path
from perception.io import atomic
from perception.map.write import read_map, write_map

path = Path(sys.argv[1])
atomic.exchange = lambda a, b: False
gmap = read_map(path)
gmap.instances[0]["label"] = "new"
renamed = []
def trap(event, arguments):
    if event == "os.rename" and str(path) in map(str, arguments):
        renamed.append(arguments)
        if len(renamed) == int(sys.argv[2]):
            os.kill(os.getpid(), signal.SIGKILL)
sys.addaudithook(trap)
write_map(path, gmap)
"""


@pytest.mark.parametrize("rename", [1, 2])
def test_where_folders_cannot_be_exchanged_the_old_map_is_put_back(gmap: Path, rename: int) -> None:
    """Killed before the first and between the two renames of such a file system."""
    before = read_map(gmap)
    assert child(WITHOUT_EXCHANGE, gmap, rename).returncode == -signal.SIGKILL
    assert gmap.exists() == (rename == 1)
    after = perception.load_map(gmap)
    assert np.array_equal(after.means, before.means) and after.instances == before.instances
    set_labels(gmap, {0: "goes on"})
    assert [path.name for path in gmap.parent.iterdir()] == ["a.gsmap"]


@pytest.mark.parametrize("name", ["instances.json", "map.json", "report.html"])
def test_what_a_killed_writer_left_inside_a_map_is_no_part_of_it(gmap: Path, name: str) -> None:
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    left = gmap / f".{name}.new-{ended.pid}-0a1b2c3d"
    left.write_text("half of it")
    assert left.name not in verify_map(gmap)
    set_labels(gmap, {0: "named"})
    assert left.name not in json.loads((gmap / "map.json").read_text())["files"]
    assert left.exists() == (name == "report.html")
    left.unlink(missing_ok=True)
    assert set(verify_map(gmap).values()) == {"ok"}


# --------------------------------------------------------------------- damage


def test_naming_an_instance_does_not_bless_damage(gmap: Path) -> None:
    """The checksums of files that a label does not touch must stay those of what was written."""
    raw = bytearray((gmap / "gaussians.ply").read_bytes())
    raw[len(raw) // 2] ^= 1
    (gmap / "gaussians.ply").write_bytes(raw)
    set_labels(gmap, {0: "named"})
    with pytest.raises(InputError, match=r"gaussians\.ply: its bytes are not those"):
        verify_map(gmap)


@pytest.mark.parametrize("keep", [0, 10, 0.5, 0.99])
def test_a_damaged_checkpoint_is_told(tmp_path: Path, keep: float) -> None:
    import torch

    path = tmp_path / CHECKPOINT
    save_checkpoint(path, {"values": torch.arange(1000)}, "mark")
    raw = path.read_bytes()
    path.write_bytes(raw[: int(keep * len(raw)) if isinstance(keep, float) else keep])
    with pytest.raises(InputError, match=r"checkpoint\.pt: the checkpoint is damaged; delete"):
        load_checkpoint(path, "mark")


# --------------------------------------------------------------- two writers


def test_a_lock_that_cannot_be_signed_is_a_lock_and_is_given_back(gmap: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A full disk has room for the lock's file but none for what it says."""

    def full(*args: object) -> int:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "pwrite", full)
    with writing(gmap):
        assert lock_file(gmap).read_bytes() == b""
        assert "another process" in child(TRY, gmap).stdout
    assert not lock_file(gmap).exists() and child(TRY, gmap).stdout == ""


TRY = """
import sys
from pathlib import Path
from perception.errors import InputError
from perception.map.write import set_labels
try:
    set_labels(Path(sys.argv[1]), {0: "x"})
except InputError as error:
    print(error)
"""


def test_a_label_set_while_the_viewer_saves_is_not_lost(gmap: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever comes between the editor's look at the map and its write must be refused or seen."""
    editor = Editor(gmap)
    editor.rename(1, "by the editor")
    told = []
    current = editor.current
    monkeypatch.setattr(editor, "current", lambda: (told.append(child(TRY, gmap).stdout), current())[1])
    editor.save()
    assert "is writing this map" in told[0]
    assert [entry["label"] for entry in read_map(gmap).instances[:2]] == [None, "by the editor"]


def test_the_viewer_sees_labels_written_by_hand_and_into_old_maps(gmap: Path) -> None:
    editor = Editor(gmap)
    editor.rename(1, "by the editor")
    text = (gmap / "instances.json").read_text()
    (gmap / "instances.json").write_text(text.replace('"label": null', '"label": "by hand"', 1))
    assert editor.outdated
    with pytest.raises(InputError, match="another program"):
        editor.save()
    editor.reopen()
    editor.rename(1, "by the editor")
    editor.save()
    assert [entry["label"] for entry in read_map(gmap).instances[:2]] == ["by hand", "by the editor"]


def test_a_second_mapper_is_refused_and_harms_nothing(small_scene: Path, tmp_path: Path) -> None:
    out = tmp_path / "m.gsmap"
    work_folder(out).mkdir()
    (work_folder(out) / "kept").touch()
    code = (
        "import sys; from pathlib import Path; from perception.map.replace import writing\n"
        "with writing(Path(sys.argv[1])):\n    print(flush=True); sys.stdin.read()"
    )
    holder = subprocess.Popen(
        [sys.executable, "-c", code, out], cwd=tmp_path, stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    try:
        assert holder.stdout is not None and holder.stdout.readline()
        with pytest.raises(InputError, match=f"process {holder.pid} is writing this map"):
            build_map(small_scene / "transforms.json", out, config(small_scene), resume=True)
    finally:
        holder.communicate()
    assert [path.name for path in work_folder(out).iterdir()] == ["kept"] and not out.exists()


# ------------------------------------------------------------------- mapping


def config(scene: Path, *more: str):
    return load_config(None, [*QUICK, f"masks=labels:{scene / 'labels'}", *more])


def test_a_folder_that_comes_to_the_output_is_kept_and_so_is_the_work(
    small_scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The training is not done again once the folder has been moved away."""
    out, source = tmp_path / "m.gsmap", small_scene / "transforms.json"

    def late(path: Path, *arguments: object, **options: object) -> None:
        path.mkdir()
        (path / "notes.txt").write_text("field notes")
        write_map(path, *arguments, **options)

    with monkeypatch.context() as patch, pytest.raises(InputError, match=r"m\.gsmap: was put there.*--resume"):
        patch.setattr(mapping, "write_map", late)
        build_map(source, out, config(small_scene))
    assert [(file.name, file.read_text()) for file in out.iterdir()] == [("notes.txt", "field notes")]
    with pytest.raises(InputError, match="exists already"):
        build_map(source, out, config(small_scene), resume=True)
    out.rename(tmp_path / "notes")
    steps: list[int] = []
    monkeypatch.setattr(Trainer, "step", lambda *_: steps.append(1))
    build_map(source, out, config(small_scene), resume=True)
    assert not steps and len(read_map(out)) > 0 and not work_folder(out).exists()


def test_resuming_a_finished_run_tidies_up_and_changes_nothing(small_scene: Path, tmp_path: Path) -> None:
    """A kill may fall after the map took its place, before its work folder went and its report came."""
    out, source = tmp_path / "m.gsmap", small_scene / "transforms.json"
    build_map(source, out, config(small_scene))
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    work_folder(out).mkdir()
    (work_folder(out) / CHECKPOINT).touch()
    (work_folder(out) / INPUTS).touch()
    build_map(source, out, config(small_scene), resume=True)
    assert {path.name: path.read_bytes() for path in out.iterdir()} == before and not work_folder(out).exists()
    for other in (config(small_scene, "seed=1"), config(small_scene, "train.budget=3000")):
        with pytest.raises(InputError, match="exists already"):
            build_map(source, out, other, resume=True)
    assert main(["map", str(source), "-o", str(out)]) == 2


def test_exported_splats_overwrite_no_input(gmap: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The file of an instance, OUT-ID.ply, was written over the scan to label, and then read as the scan."""
    ids = Map.open(gmap).instance_ids
    scan = tmp_path / "scan-0.ply"
    write_cloud(scan, PointCloud(np.random.default_rng(0).normal(size=(50, 3))))
    before = scan.read_bytes()
    command = ["export", str(gmap), "--splat", str(tmp_path / "scan.ply"), "--each"]
    assert main([*command, "--points", str(scan), "-o", str(tmp_path / "labelled.ply")]) == 2
    assert "scan-0.ply: lies there" in capsys.readouterr().err and scan.read_bytes() == before
    assert main([*command[:-1], "--only", "0", "1", "--without", "1"]) == 0
    assert len(map_ply(tmp_path / "scan.ply", "vertex")) == np.sum(ids == 0)


def test_an_answer_that_cannot_be_written_is_one_line(gmap: Path) -> None:
    if not Path("/dev/full").exists():
        pytest.skip("no /dev/full")
    code = "import sys; from perception.cli import main; sys.exit(main(sys.argv[1:]))"
    with open("/dev/full", "w") as full:  # noqa: PTH123 - a device
        run = subprocess.run([sys.executable, "-c", code, "info", str(gmap)], stdout=full, stderr=subprocess.PIPE)
    assert run.returncode == 2 and run.stderr.decode().startswith("error: the answer cannot be written: No space")
    assert run.stderr.count(b"\n") == 1


@pytest.mark.parametrize(
    ("setting", "why"),
    [
        ("frame.known_length=0.3: 0, 1", "before the map exists"),
        ("frame.board=charuco", "expected KIND:COLSxROWS:SQUARE"),
        ("photos.held_out=/nowhere/list.txt", "cannot be read"),
    ],
)
def test_settings_that_cannot_be_used_are_told_before_any_work(
    setting: str, why: str, small_scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They were told after structure from motion, whose results were then deleted."""
    monkeypatch.setattr("perception.pipeline.mapping.load_scene", None)
    with pytest.raises(InputError, match=why):
        build_map(small_scene, tmp_path / "a.gsmap", config(small_scene, setting))
