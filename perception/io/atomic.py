"""Atomic writing of files and folders: they appear under their final name complete, or not at all.

A writer fills a temporary sibling `.NAME.new-PID-RANDOM`, holds a lock on it, and renames it at the end. Writers delete
temporary siblings of terminated writers, recognised by the released lock; process ids are not compared, as they are not
valid across containers and hosts. On file systems without locks these siblings are kept.

A link is written through: its target is replaced. `map.replace` writes maps, in whose folders users keep files.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import fcntl  # not filelock, which leaves lock files behind, cannot lock folders and does not name the holder
import os
import re
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO
from uuid import uuid4

from perception.errors import FullDisk, InputError

_FULL = {errno.ENOSPC, errno.EDQUOT}
_NO_SYNC = {errno.EINVAL, errno.ENOTSUP, errno.ENOSYS, errno.EBADF, errno.EACCES}
"""Of file systems that cannot sync a folder, or what is not opened for writing."""
_AT_FDCWD, _RENAME_EXCHANGE = -100, 2  # from Linux fcntl.h and fs.h
RETRY, TRIES = 0.001, 10_000  # seconds between two tries to lock what is written, and their number
_TEMPORARY = re.compile(r"(new|old)-\d.*-.{8}")
_TAKEN = {errno.ENOTEMPTY, errno.EEXIST, errno.ENOTDIR}

Discard = Callable[[Path, Path], None]
"""Removes what lies at the first path, written or replaced by a writer of the second."""


@contextmanager
def atomic_file(path: str | Path, parents: bool = True) -> Iterator[Path]:
    """Yields an empty temporary sibling to write; on success it is synced and renamed to `path`, else removed.
    parents: missing folders above it are made. InputError for every OSError: a full disk, missing rights or folders."""

    def make(new: Path) -> None:
        if parents:
            new.parent.mkdir(parents=True, exist_ok=True)
        new.touch(exist_ok=False)

    with aside(Path(path), make, os.replace) as temporary:
        yield temporary


def write_file(path: str | Path, content: str | bytes | Callable[[BinaryIO], object], parents: bool = True) -> None:
    """Writes a whole file as `atomic_file` does: a text in UTF-8, bytes, or what a function writes to the open file."""
    with atomic_file(path, parents) as new, new.open("wb") as file:
        if callable(content):
            content(file)
        else:
            file.write(content.encode("utf-8") if isinstance(content, str) else content)


@contextmanager
def atomic_directory(path: Path, fresh: bool = False) -> Iterator[Path]:
    """Yields an empty temporary sibling folder to fill; on success it replaces `path` by `swap`, else it is removed.
    Folders above it are made. fresh: nothing is replaced but an empty folder. InputError for every OSError."""
    with aside(Path(path), make_folder, put_fresh if fresh else swap) as temporary:
        yield temporary


def make_folder(path: Path) -> None:
    """Makes a folder that is not there, and those above it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.mkdir()


def delete(old: Path, path: Path | None = None) -> None:
    """Deletes a file or a folder, if it is there."""
    shutil.rmtree(old, ignore_errors=True)
    with contextlib.suppress(OSError):  # it was a folder, or was never created
        old.unlink()


@contextmanager
def aside(
    path: Path, make: Callable[[Path], Any], put: Callable[[Path, Path], Path | None], discard: Discard = delete
) -> Iterator[Path]:
    """Yields a locked temporary sibling of `path`. make: creates it. put: renames it to `path` once it is synced, and
    returns where a replaced folder lies then. An InputError that names the sibling names `path` instead."""
    path = pointed(path)
    temporary = _sibling(path, "new")
    try:
        if path.exists() and not path.is_file() and not path.is_dir():
            raise InputError(f"{path}: is a pipe, a socket or a device, which stays as it is; give another path")
        if path.exists() and not path.stat().st_mode & 0o222:  # a rename would replace it nevertheless
            raise InputError(f"{path}: is read-only, so it is kept; give another path, or allow writing (chmod u+w)")
        recover(path, discard)
        with _locked(temporary, lambda: make(temporary)):
            yield temporary
            for file in (*temporary.rglob("*"), temporary):
                _keep_rights(path / file.relative_to(temporary), file)
                _sync(file)
            old = put(temporary, path)
            _sync(path)
            _sync(path.parent)  # before deleting the old folder, so that one of the two survives a power cut
            if old is not None:
                discard(old, path)
    except InputError as error:
        if str(temporary) not in str(error):
            raise
        raise type(error)(str(error).replace(str(temporary), str(path))) from error
    except Exception as error:
        if is_full(error):
            raise FullDisk(f"{path}: the disk is full, nothing was written; free some space") from error
        if not isinstance(error, OSError):
            raise
        raise InputError(f"{path}: cannot be written ({error.strerror or error}); choose another path") from error
    finally:
        discard(temporary, path)


def is_full(error: Exception) -> bool:
    """Whether the disk is full. NumPy and SQLite, also in COLMAP, say so in words alone."""
    words = str(error).rstrip()
    if isinstance(error, OSError):
        return error.errno in _FULL or (error.errno is None and words.endswith(" written"))
    return words.endswith("disk is full")


def pointed(path: Path) -> Path:
    """Where `path` leads if it is a symbolic link, or ends without a name, else `path` itself."""
    return Path(os.path.realpath(path)) if path.is_symlink() or path.name in ("", "..") else path


def recover(path: Path, discard: Discard = delete) -> None:
    """For writers: restores `path` if a writer was killed between its renames; discards unlocked temporary siblings."""
    path = pointed(Path(path))
    for kind, item in sorted(_leftovers(path), key=lambda left: left[0] != "old"):
        with contextlib.suppress(OSError):
            descriptor = os.open(item, os.O_RDONLY)
            try:
                if not lock(descriptor) or not names(item, descriptor):
                    continue
                if kind == "old" and not path.exists():
                    item.rename(path)
                else:
                    discard(item, path)
            finally:
                os.close(descriptor)


def current(path: Path) -> Path:
    """For readers: `path`, or the previous folder if a writer is, or was killed, between its two renames."""
    path = pointed(path)
    if path.exists():
        return path
    return next((item for kind, item in reversed(_leftovers(path)) if kind == "old"), path)


@contextmanager
def _locked(path: Path, make: Callable[[], None]) -> Iterator[None]:
    """Calls `make` to create `path` and holds a lock on it, if the file system supports locks. Another writer may take
    it for one that a killed writer left, and delete it before it is locked; then it is made anew."""
    while True:
        make()
        try:
            descriptor = os.open(path, os.O_RDONLY)
        except FileNotFoundError:
            continue
        try:
            for _ in range(TRIES):
                if _locks(descriptor) or not names(path, descriptor):
                    break
                time.sleep(RETRY)  # the other writer has it, and is about to delete it
            if names(path, descriptor):
                yield
                return
        finally:
            os.close(descriptor)


def _leftovers(path: Path) -> list[tuple[str, Path]]:
    """("new" or "old", location) of all temporary siblings of `path`, oldest first."""
    own, found = f".{path.name}.", []
    with contextlib.suppress(OSError):  # no folder, or not readable
        for name in os.listdir(path.parent):  # noqa: PTH208 - a third of the time that glob takes among many files
            if name.startswith(own) and (kind := _TEMPORARY.fullmatch(name, len(own))):
                with contextlib.suppress(OSError):  # an active writer has just renamed it
                    found.append(((path.parent / name).lstat().st_mtime_ns, kind[1], path.parent / name))
    return [(kind, item) for _, kind, item in sorted(found)]


def put_fresh(new: Path, path: Path) -> None:
    """Renames `new` to `path`. InputError if anything but an empty folder is there."""
    try:
        new.rename(path)
    except OSError as error:
        if error.errno not in _TAKEN:
            raise
        raise InputError(
            f"{path}: was put there by another program meanwhile and is kept; move it away and repeat the command (map "
            "with --resume: its work is kept)"
        ) from error


def swap(new: Path, path: Path) -> Path | None:
    """Puts folder `new` in place of `path`; returns where the old folder lies then, None if there was none.

    On Linux renameat2 exchanges the two in one step. On other systems the old folder is renamed first; if the process
    is killed then, `current(path)` gives readers the old folder, and the next writer or `recover(path)` restores it.
    """
    if not path.exists():
        put_fresh(new, path)
        return None
    if exchange(new, path):
        return new
    old = _sibling(path, "old")
    with _locked(path, lambda: None):  # so that `recover` does not restore it between the renames
        path.rename(old)
        try:
            new.rename(path)
        except OSError:
            old.rename(path)
            raise
    return old


def exchange(a: Path, b: Path) -> bool:
    """Exchanges two names in one step with Linux renameat2; False where this is not supported."""
    try:
        call = ctypes.CDLL(None, use_errno=True).renameat2
    except (OSError, AttributeError):
        return False
    done = call(_AT_FDCWD, os.fsencode(a), _AT_FDCWD, os.fsencode(b), _RENAME_EXCHANGE) == 0
    if not done and (code := ctypes.get_errno()) not in (errno.ENOSYS, errno.EINVAL, errno.ENOTSUP):
        raise OSError(code, os.strerror(code), str(b))
    return bool(done)


def _sibling(path: Path, kind: str) -> Path:
    return path.with_name(f".{path.name}.{kind}-{os.getpid()}-{uuid4().hex[:8]}")


def _keep_rights(old: Path, new: Path) -> None:
    """Gives `new` the rights, the group and, for root, the owner of `old`, if that is there."""
    with contextlib.suppress(OSError):  # it is not there, or the file system has no rights
        facts = old.stat()
        for owner in (facts.st_uid, -1):
            with contextlib.suppress(OSError):  # of another user, or a group of others
                os.chown(new, owner, facts.st_gid)
                break
        new.chmod(facts.st_mode & 0o7777)


def _sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno not in _NO_SYNC:
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


def _locks(descriptor: int) -> bool:
    """`lock`; True where the file system does not support it."""
    try:
        return lock(descriptor)
    except OSError:
        return True


def names(path: Path, descriptor: int) -> bool:
    """Whether `path` still names the file or folder that was opened as `descriptor`."""
    try:
        there, here = path.stat(), os.fstat(descriptor)
    except FileNotFoundError:
        return False
    return (there.st_dev, there.st_ino) == (here.st_dev, here.st_ino)
