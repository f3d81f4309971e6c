"""Copies from and to object stores, against the files themselves. fsspec's stores in memory and on disk are used."""

from __future__ import annotations

import errno
import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, ClassVar

import fsspec
import pytest
from fsspec.implementations.memory import MemoryFileSystem

from perception.errors import InputError
from perception.io import object_store
from perception.io.object_store import fetch, is_url, place, publish, published
from perception.progress import Progress

QUIET = Progress(quiet=True)
FILES = {"a.jpg": b"first", "deep/down/b.png": b"", "deep/c.jpg": b"third" * 1000, "transforms.json": b"{}"}


class FullStore(MemoryFileSystem):  # type: ignore[misc]
    """A store with room for 64 bytes more."""

    protocol = ("full",)
    store: ClassVar[dict[str, Any]] = {}
    pseudo_dirs: ClassVar[list[str]] = [""]
    left = 64

    def put_file(self, lpath: str, rpath: str, *more: Any, **named: Any) -> None:
        FullStore.left -= Path(lpath).stat().st_size
        if FullStore.left < 0:
            raise OSError(errno.ENOSPC, "quota exceeded")
        super().put_file(lpath, rpath, *more, **named)


@pytest.fixture(params=["memory", "file"])
def url(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[str]:
    if request.param == "file":
        yield f"file://{tmp_path / 'store'}"
    else:
        yield "memory://bucket/place"
        MemoryFileSystem.store.clear()
        MemoryFileSystem.pseudo_dirs[:] = [""]


def filled(url: str, files: dict[str, bytes] = FILES) -> None:
    store, root = fsspec.core.url_to_fs(url)
    for name, content in files.items():
        store.makedirs(f"{root}/{name}".rpartition("/")[0], exist_ok=True)
        store.pipe_file(f"{root}/{name}", content)


def content(folder: Path) -> dict[str, bytes]:
    files = (path for path in folder.rglob("*") if path.is_file() and path.name != ".copied")
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in files}


def test_urls_and_paths_are_told_apart() -> None:
    for text in ("s3://bucket/photos", "gs://b/x.json", "https://host/x", "memory://a"):
        assert is_url(text) and place(text) == text
    for text in ("photos", "/a/b", "C://x", "s3:/bucket", "a b://c", "://x", "s3://"):
        assert not is_url(text) and place(text) == Path(text)


@pytest.mark.parametrize("at_once", [1, 3, 64])
def test_a_folder_comes_whole_and_once(url: str, at_once: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(object_store, "AT_ONCE", at_once)
    filled(url)
    folder = tmp_path / "here"
    assert fetch(url + "/", folder, QUIET) == folder
    assert content(folder) == FILES
    times = {name: (folder / name).stat().st_mtime_ns for name in FILES}
    (folder / "a.jpg").unlink()
    filled(url, {"deep/c.jpg": b"other" * 1000})  # of the same size
    assert fetch(url, folder, QUIET) == folder
    assert content(folder) == {**FILES, "deep/c.jpg": b"other" * 1000}
    for name in ("deep/down/b.png", "transforms.json"):
        assert (folder / name).stat().st_mtime_ns == times[name]


def test_a_json_brings_what_lies_beside_it_and_a_video_comes_alone(url: str, tmp_path: Path) -> None:
    filled(url)
    assert fetch(f"{url}/transforms.json", tmp_path / "all", QUIET) == tmp_path / "all" / "transforms.json"
    assert content(tmp_path / "all") == FILES
    assert fetch(f"{url}/deep/c.jpg", tmp_path / "one", QUIET) == tmp_path / "one" / "c.jpg"
    assert content(tmp_path / "one") == {"c.jpg": FILES["deep/c.jpg"]}


def test_an_interrupted_copy_goes_on(url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(object_store, "AT_ONCE", 2)
    filled(url)

    class Stopped(Progress):
        def update(self, *_: object) -> None:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fetch(url, tmp_path / "here", Stopped(quiet=True))
    first = sorted(FILES)[:2]
    assert sorted(content(tmp_path / "here")) == first
    times = {name: (tmp_path / "here" / name).stat().st_mtime_ns for name in first}
    fetch(url, tmp_path / "here", QUIET)
    assert content(tmp_path / "here") == FILES
    assert times == {name: (tmp_path / "here" / name).stat().st_mtime_ns for name in first}


def test_names_do_not_lead_out_of_the_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = {"/bucket/../../evil.jpg": {"size": 1}}
    monkeypatch.setattr(MemoryFileSystem, "find", lambda *_, **__: found)
    with pytest.raises(InputError, match="no name of a file below"):
        fetch("memory://bucket", tmp_path / "here", QUIET)
    assert not (tmp_path / "here").exists()


def test_a_published_map_is_whole_where_it_has_a_map_json(url: str, tmp_path: Path) -> None:
    folder = tmp_path / "x.gsmap"
    for name, data in {**FILES, "map.json": b'{"seed": 3}'}.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(data)
    assert published(url) is None
    store, root = fsspec.core.url_to_fs(url)
    assert not store.exists(f"{root}/.probe")

    class Looks(Progress):
        def update(self, stage: str, done: int, total: int, *_: str) -> None:
            assert store.exists(f"{root}/map.json") == (done == total)

    publish(folder, url, Looks(quiet=True))
    assert published(url) == {"seed": 3}
    fetch(url, tmp_path / "again", QUIET)
    assert content(tmp_path / "again") == content(folder)


def test_a_full_store_is_one_line_and_nothing_is_left_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fsspec.register_implementation("full", FullStore, clobber=True)
    (tmp_path / "x").mkdir()
    for name in ("a.npy", "b.npy", "map.json"):
        (tmp_path / "x" / name).write_bytes(b"0" * 40)
    assert published("full://b/x") is None
    with pytest.raises(InputError, match=r"full://b/x: cannot be written \(.*quota exceeded\); mend that") as told:
        publish(tmp_path / "x", "full://b/x", QUIET)
    assert "\n" not in str(told.value)
    assert FullStore().find("/b") == []


@pytest.mark.parametrize(
    ("asked", "told"),
    [
        ("memory://nowhere/x", "nothing lies there"),
        ("s4://bucket/x", "cannot be read (Protocol not known: s4"),
        ("file:///root-only/x", "nothing lies there"),
    ],
)
def test_what_cannot_be_read_is_one_line(asked: str, told: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=re.escape(asked) + ".*" + re.escape(told)):
        fetch(asked, tmp_path / "here", QUIET)
    assert not (tmp_path / "here").exists()


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_a_store_without_rights_is_found_before_any_work(tmp_path: Path) -> None:
    (tmp_path / "closed").mkdir(mode=0o500)
    with pytest.raises(InputError, match="cannot be written"):
        published(f"file://{tmp_path / 'closed' / 'x.gsmap'}")
