"""Files and folders that appear under their name complete, or not at all.

A writer fills a temporary sibling `.NAME.new-PID-RANDOM`, on which it holds a lock, and renames it. Only writers remove
what writers left behind, and only what nobody holds a lock on: a process number says nothing about a process in another
container or on another host. Where there are no locks, leftovers stay.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO
from uuid import uuid4

from perception.errors import InputError
from perception.io.file_locks import lock, names

_FULL = {errno.ENOSPC, errno.EDQUOT}
_AT_FDCWD, _RENAME_EXCHANGE = -100, 2  # Linux' fcntl.h and fs.h
_REFUSED = {errno.EACCES, errno.EPERM, errno.EROFS}


@contextmanager
def atomic_file(path: Path) -> Iterator[Path]:
    """Yield a temporary sibling to write; on success it is synced and renamed to `path`, else removed.

    What killed writers of `path` left beside it goes too.
    """
    path = Path(path)
    temporary = _sibling(path, "new")
    try:
        with contextlib.ExitStack() as held, _disk_errors(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            recover(path)
            held.enter_context(_locked(temporary, lambda: temporary.touch(exist_ok=False)))
            yield temporary
            _sync(temporary)
            temporary.replace(path)
            _sync(path.parent)
    finally:
        with contextlib.suppress(OSError):  # where nothing may be written there is nothing to remove
            temporary.unlink()


@contextmanager
def replacing(path: str | Path) -> Iterator[BinaryIO]:
    """A binary file to write into; it takes the place of `path` only when the block ends without an error.

    Its folder must exist; whatever the system refuses is an InputError.
    """
    path = Path(path)
    try:
        if not path.parent.is_dir():
            raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT))
        with atomic_file(path) as temporary, temporary.open("wb") as file:
            yield file
    except OSError as error:
        reason = error.strerror or error
        raise InputError(f"{path}: cannot be written ({reason}); give a writable place") from error


@contextmanager
def atomic_directory(path: Path) -> Iterator[Path]:
    """Yield an empty temporary sibling folder to fill; on success it takes the place of `path`, else it is removed.

    On Linux the two folders are exchanged in one step, so there is no instant without a `path`. Where the system
    cannot, the old folder is moved aside first: between the two renames (microseconds) `path` does not exist, and a
    process killed right there leaves the old folder beside it: `standing(path)` for readers, and the next
    `atomic_directory(path)` or `recover(path)` puts it back. It is never half of one.
    """
    path = Path(path)
    temporary, old = _sibling(path, "new"), _sibling(path, "old")
    try:
        with contextlib.ExitStack() as held, _disk_errors(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            recover(path)
            held.enter_context(_locked(temporary, temporary.mkdir))
            with _told_of(path, temporary):
                yield temporary
            for file in temporary.rglob("*"):
                _sync(file)
            _sync(temporary)
            _swap(temporary, path, old)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def recover(path: Path) -> None:
    """For writers: puts `path` back when a writer died between its two renames, and deletes leftovers nobody holds."""
    path = Path(path)
    for kind, item in _leftovers(path):
        with contextlib.suppress(OSError):
            descriptor = os.open(item, os.O_RDONLY)
            try:
                if not lock(descriptor) or not names(item, descriptor):
                    continue
                if kind == "old" and not path.exists():
                    item.rename(path)
                elif item.is_dir():
                    shutil.rmtree(item, ignore_errors=True)
                else:
                    item.unlink(missing_ok=True)
            finally:
                os.close(descriptor)


def standing(path: Path) -> Path:
    """For readers: `path`, or the folder that lay there when a writer stands or died between its two renames."""
    if path.exists():
        return path
    return next((item for kind, item in reversed(_leftovers(path)) if kind == "old"), path)


@contextlib.contextmanager
def _locked(path: Path, make: Callable[[], None]) -> Iterator[None]:
    """Makes a temporary file or folder and holds a lock on it, where there are locks."""
    while True:
        make()
        descriptor = os.open(path, os.O_RDONLY)
        try:
            with contextlib.suppress(OSError):
                lock(descriptor)
            if names(path, descriptor):
                yield
                return
        finally:  # else another writer took it for a leftover between our two calls: once more
            os.close(descriptor)


def _leftovers(path: Path) -> list[tuple[str, Path]]:
    """(new or old, where) of all temporary siblings of `path`, oldest first."""
    found = []
    with contextlib.suppress(FileNotFoundError, NotADirectoryError), os.scandir(path.parent) as entries:
        for entry in entries:
            kind = _kind(entry.name, path)
            if kind is not None:
                with contextlib.suppress(FileNotFoundError):  # a living writer has just renamed it
                    found.append((entry.stat(follow_symlinks=False).st_mtime_ns, kind, Path(entry.path)))
    return [(kind, item) for _, kind, item in sorted(found)]


def _swap(new: Path, path: Path, old: Path) -> None:
    if not path.exists():
        new.rename(path)
    elif _exchange(new, path):
        old = new  # where the old folder lies now
    else:
        with _locked(path, lambda: None):  # between the renames too: nobody is to put the old folder back
            path.rename(old)
            try:
                new.rename(path)
            except OSError:
                old.rename(path)
                raise
    _sync(path.parent)  # before the old folder goes: a power cut must not leave neither
    shutil.rmtree(old, ignore_errors=True)


def _exchange(a: Path, b: Path) -> bool:
    """Swap two names in one step by Linux' renameat2; False where the system or its file system has no such call."""
    try:
        call = ctypes.CDLL(None, use_errno=True).renameat2
    except (OSError, AttributeError):
        return False
    result: int = call(_AT_FDCWD, os.fsencode(a), _AT_FDCWD, os.fsencode(b), _RENAME_EXCHANGE)
    if result != 0 and ctypes.get_errno() not in (errno.ENOSYS, errno.EINVAL, errno.ENOTSUP):
        raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()), str(b))
    return result == 0


def _sibling(path: Path, kind: str) -> Path:
    return path.with_name(f".{path.name}.{kind}-{os.getpid()}-{uuid4().hex[:8]}")


def _kind(name: str, path: Path) -> str | None:
    """Whether a file name is one that `_sibling` makes for `path`: "new", "old" or None."""
    start = f".{path.name}."
    parts = name[len(start) :].split("-") if name.startswith(start) else []
    return parts[0] if len(parts) == 3 and parts[0] in ("new", "old") and parts[1].isdigit() else None


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
def _told_of(path: Path, temporary: Path) -> Iterator[None]:
    """What is said of a file inside the temporary folder names the folder that was asked for."""
    try:
        yield
    except InputError as error:
        if str(temporary) not in str(error):
            raise
        raise InputError(str(error).replace(str(temporary), str(path))) from error


@contextmanager
def _disk_errors(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        short = error.errno is None and str(error).endswith(" written")  # all that numpy tells of a full disk
        if error.errno in _FULL or short:
            raise InputError(f"{path}: the disk is full, nothing was written; free some space") from error
        if error.errno in _REFUSED:
            raise InputError(
                f"{path}: cannot be written ({error.strerror}); choose a place you may write to"
            ) from error
        raise
