"""What a living writer has not finished is left alone by readers and other writers, in whatever container they run."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

import perception
from perception.errors import InputError
from perception.io import atomic
from perception.io.atomic import atomic_directory, atomic_file, recover, write_file
from perception.map.files import map_signature
from perception.map.write import read_map, write_map
from support.paths import SUPPORT
from support.query_maps import write_map_of

READER = """
import sys
import perception
try:
    perception.load_map(sys.argv[1])
except perception.InputError as error:
    print(error)
"""


@pytest.fixture
def gmap(tmp_path: Path) -> Path:
    return write_map_of(tmp_path / "a.gsmap", gaussians=300)


@pytest.fixture
def elsewhere(monkeypatch: pytest.MonkeyPatch) -> None:
    """Temporaries are named as by a process of another PID namespace: here no process has its number."""
    monkeypatch.setattr(
        atomic, "_sibling", lambda path, kind: path.with_name(f".{path.name}.{kind}-999999999-0a1b2c3d")
    )


def test_a_reader_in_another_pid_namespace_leaves_the_first_map_being_written(gmap: Path, tmp_path: Path) -> None:
    namespace = ["unshare", "--map-root-user", "--pid", "--fork"]
    if shutil.which("unshare") is None or subprocess.run([*namespace, "true"], check=False).returncode:
        pytest.skip("needs Linux that lets users make a PID namespace")
    target = tmp_path / "b.gsmap"
    with atomic_directory(target) as folder:
        shutil.copytree(gmap, folder, dirs_exist_ok=True)
        ended = subprocess.run(
            [*namespace, sys.executable, "-c", READER, target], cwd=SUPPORT, capture_output=True, text=True, check=True
        )
        assert "is no map" in ended.stdout and (folder / "map.json").is_file()
    assert len(read_map(target)) == 300


@pytest.mark.usefixtures("elsewhere")
def test_neither_reader_nor_writer_deletes_what_is_being_written(gmap: Path, tmp_path: Path) -> None:
    target, file = tmp_path / "b.gsmap", tmp_path / "f.txt"
    with atomic_directory(target) as folder, atomic_file(file) as temporary:
        temporary.write_text("whole")
        shutil.copytree(gmap, folder, dirs_exist_ok=True)
        with pytest.raises(InputError, match="is no map"):
            perception.load_map(target)
        recover(target)
        recover(file)
    assert len(read_map(target)) == 300 and file.read_text() == "whole"


@pytest.mark.usefixtures("elsewhere")
def test_what_nobody_holds_is_deleted_by_the_next_writer_and_by_no_reader(gmap: Path) -> None:
    left = gmap.with_name(".a.gsmap.new-999999999-ffffffff")
    left.mkdir()
    (left / "map.json").write_text("half")
    perception.load_map(gmap)
    assert left.is_dir()
    write_map(gmap, read_map(gmap))
    assert [path.name for path in gmap.parent.iterdir()] == ["a.gsmap"]


def test_between_the_two_renames_readers_read_the_old_map_and_move_nothing(gmap: Path) -> None:
    """Where two folders cannot be exchanged: the writer has put the old map aside and is about to rename the new."""
    before = map_signature(gmap)
    aside = gmap.with_name(f".a.gsmap.old-{os.getpid()}-0a1b2c3d")
    gmap.rename(aside)
    assert len(perception.load_map(gmap).means) == 300 and len(read_map(gmap)) == 300
    assert map_signature(gmap) == before and not gmap.exists()
    aside.rename(gmap)


def test_many_writers_of_one_file_are_not_in_each_others_way(tmp_path: Path) -> None:
    """Blocks of a scene write the label images of the photos that they share. Locks are of descriptors, so threads race
    as processes do. Each writer has a moment before it holds the lock on its temporary."""
    file = tmp_path / "label.png"
    with ThreadPoolExecutor(8) as pool:
        list(pool.map(lambda n: write_file(file, bytes([n % 250]) * 5000), range(2000)))
    assert len(set(file.read_bytes())) == 1 and list(tmp_path.iterdir()) == [file]
