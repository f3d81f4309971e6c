"""All or nothing: what is written appears under its name complete, or not at all."""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from uuid import uuid4

from perception.errors import InputError

_FULL = {errno.ENOSPC, errno.EDQUOT}
_REFUSED = {errno.EACCES, errno.EPERM, errno.EROFS}


@contextmanager
def atomic_file(path: Path) -> Iterator[Path]:
    """Yield a temporary sibling to write; on success it is synced and renamed to `path`, else removed."""
    path = Path(path)
    temporary = _sibling(path, "new")
    try:
        with _disk_errors(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            yield temporary
            _sync(temporary)
            temporary.replace(path)
            _sync(path.parent)
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def atomic_directory(path: Path) -> Iterator[Path]:
    """Yield an empty temporary sibling folder to fill; on success it takes the place of `path`, else it is removed.

    An existing `path` is moved aside first and deleted last. POSIX has no portable swap of two folders, so between
    the two renames (microseconds) `path` does not exist; a process killed right there leaves the old folder
    beside it, and the next `atomic_directory(path)` or `recover(path)` puts it back. It is never half of one.
    """
    path = Path(path)
    temporary, old = _sibling(path, "new"), _sibling(path, "old")
    try:
        with _disk_errors(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            recover(path)
            temporary.mkdir()
            yield temporary
            for file in temporary.rglob("*"):
                _sync(file)
            _sync(temporary)
            _swap(temporary, path, old)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def recover(path: Path) -> None:
    """Put `path` back when a writer died between its two renames, and delete leftovers of writers that are gone."""
    path = Path(path)
    leftovers = sorted(path.parent.glob(f".{path.name}.*"), key=lambda item: item.stat().st_mtime)
    for item in leftovers:
        kind, writer = _parse(item, path)
        if kind is None or _alive(writer):
            continue
        if kind == "old" and not path.exists():
            item.rename(path)
        elif item.is_dir():
            shutil.rmtree(item, ignore_errors=True)
        else:
            item.unlink(missing_ok=True)


def _swap(new: Path, path: Path, old: Path) -> None:
    if not path.exists():
        new.rename(path)
    else:
        path.rename(old)
        try:
            new.rename(path)
        except OSError:
            old.rename(path)
            raise
        shutil.rmtree(old, ignore_errors=True)
    _sync(path.parent)


def _sibling(path: Path, kind: str) -> Path:
    return path.with_name(f".{path.name}.{kind}-{os.getpid()}-{uuid4().hex[:8]}")


def _parse(item: Path, path: Path) -> tuple[str | None, int]:
    parts = item.name[len(path.name) + 2 :].split("-")
    if len(parts) == 3 and parts[0] in ("new", "old") and parts[1].isdigit():
        return parts[0], int(parts[1])
    return None, 0


def _alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True


def _sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.ENOTSUP):  # some file systems cannot sync a folder
            raise
    finally:
        os.close(descriptor)


@contextmanager
def _disk_errors(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        if error.errno in _FULL:
            raise InputError(f"{path}: the disk is full, nothing was written; free some space") from error
        if error.errno in _REFUSED:
            raise InputError(
                f"{path}: cannot be written ({error.strerror}); choose a place you may write to"
            ) from error
        raise
