"""Files in object stores (S3, GCS, Azure and what else fsspec knows), named by URLs such as s3://BUCKET/PHOTOS."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path, PurePosixPath
from typing import Any

from perception.errors import InputError
from perception.map.checksums import FACTS
from perception.progress import Progress

AT_ONCE = 64
"""Files that are copied at the same time."""
_URL = re.compile(r"[a-z][a-z0-9+.-]+://.", re.IGNORECASE)
_COPIED = ".copied"  # in a folder of copies: a line per file, of its mark in the store and its name


def is_url(place: str | Path) -> bool:
    """Whether `place` names something in an object store, and not a path."""
    return isinstance(place, str) and _URL.match(place) is not None


def place(text: str) -> str | Path:
    """What a word of the command line or of a list of jobs names: a URL stays text."""
    return text if is_url(text) else Path(text)


def fetch(url: str, folder: Path, progress: Progress) -> Path:
    """Copies the file or folder at `url` into `folder`, and returns where it lies there.

    A JSON file brings all that lies beside it. What an earlier call has copied is kept where the store tells the same
    of it. InputError where nothing lies there, or it cannot be read.
    """
    with _errors(url, "read"):
        store, root = _opened(url)
        asked = ""
        if store.isfile(root):
            root, _, asked = root.rpartition("/")
        alone = asked and not asked.endswith(".json")
        listed = {f"{root}/{asked}": store.info(f"{root}/{asked}")} if alone else store.find(root, detail=True)
        files = {_below(name, root): about for name, about in listed.items()}
        if not files:
            raise InputError(f"{url}: nothing lies there; give the URL of photos or of a transforms.json")
        told = {name: json.dumps(about, sort_keys=True, default=str) for name, about in files.items()}
        marks = {name: hashlib.sha256(about.encode()).hexdigest()[:16] for name, about in told.items()}
        folder.mkdir(parents=True, exist_ok=True)
        kept = _kept(folder)
        missing = [name for name in sorted(files) if kept.get(name) != marks[name] or not (folder / name).is_file()]
        for some, done in _batches(missing):
            for name in some:
                (folder / name).parent.mkdir(parents=True, exist_ok=True)
            store.get([f"{root}/{name}" for name in some], [str(folder / name) for name in some])
            with (folder / _COPIED).open("a", encoding="utf-8") as record:
                record.writelines(f"{marks[name]} {name}\n" for name in some)
            progress.update("copy from store", done, len(missing))
    return folder / asked


def publish(folder: Path, url: str, progress: Progress) -> None:
    """Copies a map to `url`, its map.json last: a map in a store is whole where it has one.

    InputError where that is not possible, for example in a full store; what was copied is then removed.
    """
    files = sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file())
    files.sort(key=lambda name: name == FACTS)
    with _errors(url, "written"):
        store, root = _opened(url)
        try:
            for some, done in [*_batches(files[:-1]), (files[-1:], len(files))]:
                store.put([str(folder / name) for name in some], [f"{root}/{name}" for name in some])
                progress.update("copy to store", done, len(files))
        except BaseException:
            with suppress(Exception):
                store.rm(root, recursive=True)
            raise


def published(url: str) -> dict[str, Any] | None:
    """The content of map.json of the map at `url`, or None. InputError where the store cannot be written to."""
    with _errors(url, "written"):
        store, root = _opened(url)
        if store.isfile(f"{root}/{FACTS}"):
            found: dict[str, Any] = json.loads(store.cat_file(f"{root}/{FACTS}"))
            return found
        probe = f"{root}/.probe"
        store.pipe_file(probe, b"0")
        store.rm_file(probe)
        return None


def _opened(url: str) -> tuple[Any, str]:
    """(file system, path in it) of `url`."""
    from fsspec.core import url_to_fs

    local = url.lower().startswith(("file:", "local:"))
    store, root = url_to_fs(url, **({"auto_mkdir": True} if local else {}))
    store.invalidate_cache()
    return store, root.rstrip("/")


def _below(name: str, root: str) -> str:
    """A file's path relative to `root`. InputError where it would lead out of the folder it is copied to."""
    path = PurePosixPath(name[len(root) :].lstrip("/"))
    if ".." in path.parts or not path.parts:
        raise InputError(f"{name}: is no name of a file below {root}")
    return path.as_posix()


def _kept(folder: Path) -> dict[str, str]:
    record = folder / _COPIED
    lines = record.read_text(encoding="utf-8").splitlines() if record.is_file() else []
    return {name: mark for mark, _, name in (line.partition(" ") for line in lines)}


def _batches(names: list[str]) -> Iterator[tuple[list[str], int]]:
    """The names, AT_ONCE at a time; with each, how many there are up to its end."""
    for start in range(0, len(names), AT_ONCE):
        some = names[start : start + AT_ONCE]
        yield some, start + len(some)


@contextmanager
def _errors(url: str, done: str) -> Iterator[None]:
    """InputError for whatever a store raises: each kind has errors of its own."""
    try:
        yield
    except InputError:
        raise
    except Exception as error:
        why = " ".join(str(error).split()) or type(error).__name__
        todo = "install it" if isinstance(error, ImportError) else "mend that and run again, with --resume"
        raise InputError(f"{url}: cannot be {done} ({why}); {todo}") from error
