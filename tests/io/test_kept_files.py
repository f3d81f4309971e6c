"""What a user keeps in a map's folder, and whatever is no map, outlives every writer."""

from __future__ import annotations

import errno
import fcntl
import json
import os
import shutil
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from kills import children
from perception.cli import main
from perception.edit.editor import Editor
from perception.errors import InputError
from perception.io import atomic
from perception.map.write import read_map, set_labels, verify_map, write_map
from perception.types import View
from support.query_maps import NAMES
from support.synthetic_map import write_synthetic_map
from support.viewer_maps import small_map


@pytest.fixture
def gmap(tmp_path: Path) -> Path:
    write_synthetic_map(tmp_path / "a.gsmap", NAMES, None, gaussians=300, sh_degree=1)
    return tmp_path / "a.gsmap"


def keep_things(path: Path) -> None:
    (path / "photos" / "raw").mkdir(parents=True)
    (path / "photos" / "1.jpg").write_text("photo")
    (path / "photos" / "raw" / "1.dng").write_text("raw")
    (path / "notes.txt").write_text("note")
    (path / ".hidden").write_text("hidden")
    (path / "empty").mkdir()
    (path / "empty").chmod(0o555)
    (path / "elsewhere").symlink_to("/no/such/place")
    (path / "pictures").symlink_to("photos")


def things(path: Path) -> dict[str, Any]:
    """{name: (mode, content)} of what `keep_things` laid there, and of anything new."""
    own = {"map.json", "instances.json", "report.html", "gaussians.ply", "features.npy", "instance_ids.npy"}
    own |= {"membership.npy", "language.npz", "parts.npz", "groups.npz"}
    found = {}
    for item in path.rglob("*"):
        if item.name not in own:
            content = item.readlink() if item.is_symlink() else item.read_text() if item.is_file() else None
            found[str(item.relative_to(path))] = (item.lstat().st_mode, content)
    return found


@pytest.mark.parametrize("links", [True, False])
@pytest.mark.parametrize("exchange", [True, False])
def test_a_new_map_takes_over_what_lies_beside_the_old_one(
    gmap: Path, monkeypatch: pytest.MonkeyPatch, exchange: bool, links: bool
) -> None:
    """Also where folders cannot be exchanged, and where there are no hard links."""

    def none(*_: object, **__: object) -> None:
        raise OSError(errno.EPERM, "no hard links")

    if not exchange:
        monkeypatch.setattr(atomic, "exchange", lambda a, b: False)
    if not links:
        monkeypatch.setattr(os, "link", none)
    keep_things(gmap)
    before, note = things(gmap), (gmap / "notes.txt").stat().st_ino
    editor = Editor(gmap)
    editor.rename(0, "saved")
    editor.save()
    assert things(gmap) == before and (gmap / "notes.txt").stat().st_ino == note
    for words in (["upgrade"], ["scale", "--known-length", "2: 0, 1"]):
        assert main([words[0], str(gmap), *words[1:]]) == 0
        assert things(gmap) == before
    assert [item.name for item in gmap.parent.iterdir()] == ["a.gsmap"]
    assert read_map(gmap).instances[0]["label"] == "saved" and "notes.txt" not in verify_map(gmap)


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "pidfd_open"), reason="the harness needs Linux")
@pytest.mark.parametrize("links", [True, False])
@pytest.mark.parametrize("exchange", [True, False])
def test_a_writer_is_killed_at_every_change(
    gmap: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, exchange: bool, links: bool
) -> None:
    """With hard links and exchanges nothing is ever away; else the next writer puts it back."""

    def none(*_: object, **__: object) -> None:
        raise OSError(errno.EPERM, "no hard links")

    def work(place: Path) -> int:
        write_map(place / "a.gsmap", read_map(place / "a.gsmap"), keep_report=True)
        return 0

    def laid_out(name: str) -> Path:
        shutil.copytree(gmap, tmp_path / name / "a.gsmap", symlinks=True)
        return tmp_path / name

    if not exchange:
        monkeypatch.setattr(atomic, "exchange", lambda a, b: False)
    if not links:
        monkeypatch.setattr(os, "link", none)
    keep_things(gmap)
    before, place = things(gmap), laid_out("whole")
    _, changes = children.watch(lambda: work(place), place)
    for number in range(1, len(changes) + 1):
        place = laid_out(str(number))
        assert children.run(lambda place=place: work(place), place, children.Moment(0, number)).killed
        if exchange and links:
            assert things(place / "a.gsmap") == before
        set_labels(place / "a.gsmap", {0: "named"})
        assert things(place / "a.gsmap") == before and len(read_map(place / "a.gsmap")) == 300
        assert [item.name for item in place.iterdir()] == ["a.gsmap"]


def test_what_a_killed_writer_did_not_take_over_comes_with_the_next(gmap: Path) -> None:
    """Without hard links: killed after the exchange of two maps, before the user's files followed."""
    old = gmap.with_name(".a.gsmap.new-999999999-0a1b2c3d")
    shutil.copytree(gmap, old)
    keep_things(old)
    (gmap / "photos").mkdir()
    (gmap / "photos" / "2.jpg").write_text("another")
    (gmap / "notes.txt").write_text("a new note")
    before = things(old)
    set_labels(gmap, {0: "named"})
    after = things(gmap)
    assert not old.exists() and after.pop("photos/2.jpg")[1] == "another"
    assert after.pop("notes.1.txt") == before.pop("notes.txt") and after.pop("notes.txt")[1] == "a new note"
    assert after == before


def test_what_is_killed_before_the_exchange_leaves_nothing_twice(gmap: Path) -> None:
    keep_things(gmap)
    before, new = things(gmap), gmap.with_name(".a.gsmap.new-999999999-0a1b2c3d")
    shutil.copytree(gmap, new, copy_function=lambda a, b: os.link(a, b, follow_symlinks=False), symlinks=True)
    for link in ("elsewhere", "pictures"):
        (new / link).unlink()
        os.link(gmap / link, new / link, follow_symlinks=False)
    set_labels(gmap, {0: "named"})
    assert things(gmap) == before and not new.exists()


def test_a_folder_that_cannot_be_moved_is_told_and_nothing_changes(gmap: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    keep_things(gmap)
    before, whole = things(gmap), read_map(gmap)
    monkeypatch.setattr(Path, "is_mount", lambda path: path.name == "photos")
    with pytest.raises(InputError, match=r"photos: cannot be moved with its map"):
        write_map(gmap, whole)
    assert things(gmap) == before and set(verify_map(gmap).values()) == {"ok"}
    assert [item.name for item in gmap.parent.iterdir()] == ["a.gsmap"]


@pytest.mark.parametrize("fresh", [True, False])
@pytest.mark.parametrize("kind", ["folder", "map", "map.json", "file"])
def test_a_map_replaces_nothing_but_a_map(gmap: Path, tmp_path: Path, kind: str, fresh: bool) -> None:
    """fresh: of `map`, where something came to the place of its output meanwhile."""
    target = tmp_path / "b"
    if kind == "map":
        shutil.copytree(gmap, target)
    elif kind == "file":
        target.write_text("mine")
    else:
        target.mkdir()
        (target / ("map.json" if kind == "map.json" else "notes.txt")).write_text('{"type": "FeatureCollection"}')
    before = {str(file): file.read_bytes() for file in (target, *target.rglob("*")) if file.is_file()}
    if kind == "map" and not fresh:
        write_map(target, small_map(50))
        assert len(read_map(target)) == 50
        return
    with pytest.raises(InputError, match=r"b: (was put there|is no map)") as error:
        write_map(target, read_map(gmap), fresh=fresh)
    assert "\n" not in str(error.value)
    assert before == {str(file): file.read_bytes() for file in (target, *target.rglob("*")) if file.is_file()}
    assert sorted(item.name for item in tmp_path.iterdir()) == ["a.gsmap", "b"]


def test_a_link_is_written_through(gmap: Path, tmp_path: Path) -> None:
    moved = tmp_path / "deep" / "v3.gsmap"
    moved.parent.mkdir()
    gmap.rename(moved)
    link = tmp_path / "current.gsmap"
    link.symlink_to(moved)
    photo = moved.parent / "photos" / "1.jpg"
    photo.parent.mkdir()
    photo.write_text("photo")
    write_map(moved, replace(read_map(moved), views=[View("1.jpg", photo, np.eye(3), 8, 8, np.eye(4))]))
    editor = Editor(link)
    editor.rename(0, "through the link")
    editor.save()
    assert main(["upgrade", str(link)]) == 0
    assert link.is_symlink() and read_map(moved).instances[0]["label"] == "through the link"
    views = json.loads((moved / "map.json").read_text())["views"]
    assert [view["photo_beside"] for view in views] == ["../photos/1.jpg"]
    moved.parent.rename(tmp_path / "elsewhere")
    link.unlink()
    link.symlink_to(tmp_path / "elsewhere" / "v3.gsmap")
    photo = read_map(link).located_views()[0].photo
    assert photo == tmp_path / "elsewhere" / "photos" / "1.jpg"
    moved = link.resolve()
    assert main(["export", str(link), "-o", str(moved / "x.ply")]) == 0
    (tmp_path / "link.ply").symlink_to(moved / "x.ply")
    assert main(["export", str(link), "-o", str(tmp_path / "link.ply")]) == 0
    assert (tmp_path / "link.ply").is_symlink()


def test_a_map_is_saved_from_within_its_folder(gmap: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(gmap)
    assert main(["upgrade", "."]) == 0
    assert [item.name for item in gmap.parent.iterdir()] == ["a.gsmap"]


def test_where_there_are_no_locks_is_written_with_a_warning(gmap: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def none(*_: object) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(fcntl, "flock", none)
    with pytest.warns(UserWarning, match="has no locks"):
        set_labels(gmap, {0: "mug"})
    assert read_map(gmap).instances[0]["label"] == "mug"


@pytest.mark.parametrize("writer", ["label", "save"])
@pytest.mark.parametrize("mode", [0o600, 0o664])
def test_rights_and_group_outlive_writers(gmap: Path, mode: int, writer: str) -> None:
    files, folder = sorted(gmap.iterdir()), mode | 0o2110
    group = 12345 if os.geteuid() == 0 else os.getegid()
    for file in (*files, gmap):
        os.chown(file, -1, group)
        file.chmod(folder if file == gmap else mode)
    if writer == "label":
        set_labels(gmap, {0: "mug"})
    else:
        write_map(gmap, read_map(gmap))
    for file in (*files, gmap):
        found = file.stat()
        assert (oct(found.st_mode & 0o7777), found.st_gid) == (oct(folder if file == gmap else mode), group), file


@pytest.mark.parametrize("name", ["", "map.json", "notes.ply"])
def test_what_is_read_only_is_kept(gmap: Path, name: str) -> None:
    (gmap / "notes.ply").write_text("note")
    kept = gmap / name
    kept.chmod(kept.stat().st_mode & ~0o222)
    before = {file.name: file.read_bytes() for file in gmap.iterdir()}
    with pytest.raises(InputError, match=f"{kept.name}: is read-only"):
        if name == "map.json":
            set_labels(gmap, {0: "mug"})
        elif name:
            atomic.write_file(kept, "other")
        else:
            write_map(gmap, read_map(gmap))
    assert before == {file.name: file.read_bytes() for file in gmap.iterdir()}


def test_files_that_nfs_keeps_for_their_readers_stay_behind(gmap: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """NFS renames an open file that is deleted."""
    keep_things(gmap)
    kept, unlink = things(gmap), Path.unlink

    def silly(self: Path, missing_ok: bool = False) -> None:
        if self.suffix == ".npy" and self.exists():
            self.rename(self.with_name(f".nfs{self.stem}"))
        else:
            unlink(self, missing_ok)

    with monkeypatch.context() as patch, warnings.catch_warnings():
        warnings.simplefilter("error")
        patch.setattr(Path, "unlink", silly)
        write_map(gmap, read_map(gmap))
    assert things(gmap) == kept
    assert list(gmap.parent.iterdir()) == [gmap]


@pytest.mark.parametrize("lacking", ["chmod", "utime", "chown", "link", "fsync"])
def test_a_file_system_without_rights_or_times_keeps_all(
    gmap: Path, monkeypatch: pytest.MonkeyPatch, lacking: str
) -> None:
    def refuse(*_: Any, **__: Any) -> None:
        raise OSError(errno.EACCES if lacking == "fsync" else errno.EPERM, "not supported")

    keep_things(gmap)
    (gmap / "empty").chmod(0o755)
    kept = {name: content for name, (_, content) in things(gmap).items()}
    monkeypatch.setattr(os, lacking, refuse)
    set_labels(gmap, {0: "mug"})
    write_map(gmap, read_map(gmap))
    assert kept == {name: content for name, (_, content) in things(gmap).items()}
    assert read_map(gmap).instances[0]["label"] == "mug"
