"""Atomic writing of files and folders: they appear under their final name complete, or not at all.

A writer fills a temporary sibling `.NAME.new-PID-RANDOM`, holds a lock on it, and renames it at the end. Writers delete
temporary siblings of terminated writers, recognised by the released lock; process ids are not compared, as they are not
valid across containers and hosts. On file systems without locks these siblings are kept. `writing` is the write lock of
a map, so that concurrent mapping, label editing and copying do not overwrite each other.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import fcntl  # not filelock, which leaves lock files behind, cannot lock folders and does not name the holder
import os
import shutil
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from glob import escape
from pathlib import Path
from typing import Any, BinaryIO
from uuid import uuid4

from perception.errors import InputError

_FULL = {errno.ENOSPC, errno.EDQUOT}
_AT_FDCWD, _RENAME_EXCHANGE = -100, 2  # from Linux fcntl.h and fs.h
_REFUSED = {errno.EACCES, errno.EPERM, errno.EROFS}
_held: set[tuple[Path, int]] = set()
"""Locks of this process: resolved path and thread."""


@contextmanager
def atomic_file(path: Path) -> Iterator[Path]:
    """Yield a temporary sibling to write; on success it is synced and renamed to `path`, else removed.
    Temporary siblings left by killed writers of `path` are deleted. InputError for a full disk or missing rights."""
    with _aside(Path(path), lambda new: new.touch(exist_ok=False), Path.replace) as temporary:
        yield temporary


@contextmanager
def atomic_directory(path: Path) -> Iterator[Path]:
    """Yield an empty temporary sibling folder to fill; on success it replaces `path`, else it is removed.

    On Linux renameat2 exchanges the two folders in one step, so `path` exists at all times. On other systems the old
    folder is renamed first, and `path` does not exist between the two renames (microseconds). If the process is killed
    there, `standing(path)` gives readers the old folder; the next `atomic_directory(path)` or `recover(path)` restores
    it. `path` is never partly written.
    """
    with _aside(Path(path), Path.mkdir, _swap) as temporary:
        yield temporary


@contextmanager
def _aside(path: Path, make: Callable[[Path], Any], put: Callable[[Path, Path], Any]) -> Iterator[Path]:
    """Yields a locked temporary sibling of `path`. make: creates it. put: renames it to `path` once it is synced.
    An InputError that names the sibling names `path` instead."""
    temporary = _sibling(path, "new")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        recover(path)
        with _locked(temporary, lambda: make(temporary)):
            yield temporary
            for file in (*temporary.rglob("*"), temporary):
                _sync(file)
            put(temporary, path)
            _sync(path.parent)
    except InputError as error:
        if str(temporary) not in str(error):
            raise
        raise InputError(str(error).replace(str(temporary), str(path))) from error
    except OSError as error:
        short = error.errno is None and str(error).endswith(" written")  # numpy's only sign of a full disk
        if error.errno in _FULL or short:
            raise InputError(f"{path}: the disk is full, nothing was written; free some space") from error
        if error.errno in _REFUSED:
            raise InputError(f"{path}: cannot be written ({error.strerror}); choose another place") from error
        raise
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
        with contextlib.suppress(OSError):  # it was a folder, took its place, or was never created
            temporary.unlink()


@contextmanager
def replacing(path: str | Path) -> Iterator[BinaryIO]:
    """Yields a binary file to write; it replaces `path` only when the block ends without an error.
    The folder of `path` must exist. Every OSError is raised as InputError."""
    path = Path(path)
    try:
        if not path.parent.is_dir():
            raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT))
        with atomic_file(path) as temporary, temporary.open("wb") as file:
            yield file
    except OSError as error:
        reason = error.strerror or error
        raise InputError(f"{path}: cannot be written ({reason}); give a writable place") from error


def recover(path: Path) -> None:
    """For writers: restores `path` if a writer was killed between its renames; deletes unlocked temporary siblings."""
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
    """For readers: `path`, or the previous folder if a writer is, or was killed, between its two renames."""
    if path.exists():
        return path
    return next((item for kind, item in reversed(_leftovers(path)) if kind == "old"), path)


@contextmanager
def _locked(path: Path, make: Callable[[], None]) -> Iterator[None]:
    """Calls `make` to create `path` and holds a lock on it, if the file system supports locks."""
    while True:
        make()
        descriptor = os.open(path, os.O_RDONLY)
        try:
            with contextlib.suppress(OSError):
                lock(descriptor)
            if names(path, descriptor):
                yield
                return
        finally:  # if another writer deleted it before it was locked: retry
            os.close(descriptor)


def _leftovers(path: Path) -> list[tuple[str, Path]]:
    """("new" or "old", location) of all temporary siblings of `path`, oldest first."""
    found = []
    for kind in ("new", "old"):
        for item in path.parent.glob(f".{escape(path.name)}.{kind}-[0-9]*-????????"):
            with contextlib.suppress(OSError):  # an active writer has just renamed it
                found.append((item.lstat().st_mtime_ns, kind, item))
    return [(kind, item) for _, kind, item in sorted(found)]


def _swap(new: Path, path: Path) -> None:
    old = _sibling(path, "old")
    if not path.exists():
        new.rename(path)
    elif _exchange(new, path):
        old = new  # where the old folder lies now
    else:
        with _locked(path, lambda: None):  # so that `recover` does not restore it between the renames
            path.rename(old)
            try:
                new.rename(path)
            except OSError:
                old.rename(path)
                raise
    _sync(path.parent)  # before deleting the old folder, so that one of the two survives a power cut
    shutil.rmtree(old, ignore_errors=True)


def _exchange(a: Path, b: Path) -> bool:
    """Exchanges two names in one step with Linux renameat2; False where this is not supported."""
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


def _sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.ENOTSUP):  # some file systems cannot sync a folder
            raise
    finally:
        os.close(descriptor)


def lock(descriptor: int) -> bool:
    """Takes the exclusive lock on an open file or folder; False when another descriptor holds it.
    OSError where the file system does not support flock."""
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        if error.errno in (errno.EWOULDBLOCK, errno.EACCES):
            return False
        raise
    return True


def names(path: Path, descriptor: int) -> bool:
    """Whether `path` still names the file or folder that was opened as `descriptor`."""
    try:
        there, here = path.stat(), os.fstat(descriptor)
    except FileNotFoundError:
        return False
    return (there.st_dev, there.st_ino) == (here.st_dev, here.st_ino)


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Holds the write lock of the map at `path`; InputError at once when another process or thread holds it.

    The lock is an advisory flock on the sibling `.NAME.lock`, which the system releases when the process ends in any
    way. The file holds the process id and is deleted on release. The lock is re-entrant per thread. Readers need none.
    Leftovers of killed writers are first restored or deleted (see `atomic.recover`).
    """
    path = Path(path).resolve()
    mine = (path, threading.get_ident())
    if mine in _held:
        yield
        return
    descriptor = _take(path)
    try:
        _held.add(mine)
        recover(path)
        yield
    finally:
        _held.discard(mine)
        with contextlib.suppress(OSError):
            lock_file(path).unlink()  # before the release, so that no other process has locked this file
        os.close(descriptor)


def lock_file(path: Path) -> Path:
    """Path of the lock file of the map at `path`, which exists while the map is written."""
    return path.with_name(f".{path.name}.lock")


def _take(path: Path) -> int:
    file = lock_file(path)
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        while True:
            descriptor = os.open(file, os.O_RDWR | os.O_CREAT, 0o644)
            if not lock(descriptor):
                holder = os.pread(descriptor, 32, 0).decode("ascii", "replace").strip()
                os.close(descriptor)
                who = f"process {holder}" if holder.isdigit() else "another process"
                who = "another thread of this process" if holder == str(os.getpid()) else who
                raise InputError(f"{path}: {who} is writing this map; wait for it to finish, or write to another place")
            if names(file, descriptor):
                break
            os.close(descriptor)  # the last holder deleted the file between open and lock: retry
        with contextlib.suppress(OSError):  # on a full disk the lock is still valid, without the process id
            os.ftruncate(descriptor, 0)
            os.pwrite(descriptor, f"{os.getpid()}\n".encode(), 0)
        return descriptor
    except OSError as error:
        why = f"{error.strerror}: {file.parent}"
        raise InputError(f"{path}: cannot be written ({why}); choose another place") from error
