"""Atomic writing of files and folders: they appear under their final name complete, or not at all.

A writer fills a temporary sibling `.NAME.new-PID-RANDOM`, holds a lock on it, and renames it at the end. Writers delete
temporary siblings of terminated writers, recognised by the released lock; process ids are not compared, as they are not
valid across containers and hosts. On file systems without locks these siblings are kept. `writing` is the write lock of
a map, so that concurrent mapping, label editing and copying do not overwrite each other.

A link is written through: its target is replaced. The folder of a map may also hold files of its user. A new map takes
them over: it has hard links to them before it takes the old one's place, then it gets the user's folders themselves.
Only files that a map wrote are deleted (`checksums.own_files`); all else that a killed writer left is moved to the map.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import fcntl  # not filelock, which leaves lock files behind, cannot lock folders and does not name the holder
import os
import shutil
import threading
import warnings
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from glob import escape
from pathlib import Path
from typing import Any, BinaryIO
from uuid import uuid4

from perception.errors import InputError
from perception.map.checksums import FACTS, is_map, own_files

_FULL = {errno.ENOSPC, errno.EDQUOT}
_AT_FDCWD, _RENAME_EXCHANGE = -100, 2  # from Linux fcntl.h and fs.h
_REFUSED = {errno.EACCES, errno.EPERM, errno.EROFS, errno.EBUSY, errno.ELOOP, errno.ENAMETOOLONG}
_REFUSED |= {errno.EXDEV, errno.EISDIR, errno.ENOTDIR, errno.EEXIST, errno.ENOTEMPTY}
_TAKEN = {errno.ENOTEMPTY, errno.EEXIST, errno.ENOTDIR}
_NO_LOCKS = {errno.ENOLCK, errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP, errno.EINVAL}
_held: set[tuple[Path, int]] = set()
"""Locks of this process: resolved path and thread."""


@contextmanager
def atomic_file(path: Path) -> Iterator[Path]:
    """Yield a temporary sibling to write; on success it is synced and renamed to `path`, else removed.
    Temporary siblings left by killed writers of `path` are deleted. InputError for a full disk or missing rights."""
    with _aside(Path(path), lambda new: new.touch(exist_ok=False), Path.replace) as temporary:
        yield temporary


@contextmanager
def atomic_directory(path: Path, fresh: bool = False) -> Iterator[Path]:
    """Yield an empty temporary sibling folder to fill; on success it replaces `path`, else it is removed.

    fresh: nothing is replaced but an empty folder. A map replaces nothing but a map, whose user's files it takes over.
    InputError otherwise; what lies at `path` is kept.

    On Linux renameat2 exchanges the two folders in one step, so `path` exists at all times. On other systems the old
    folder is renamed first, and `path` does not exist between the two renames (microseconds). If the process is killed
    there, `standing(path)` gives readers the old folder; the next `atomic_directory(path)` or `recover(path)` restores
    it. `path` is never partly written.
    """
    with _aside(Path(path), Path.mkdir, _put_fresh if fresh else _swap) as temporary:
        yield temporary


@contextmanager
def _aside(path: Path, make: Callable[[Path], Any], put: Callable[[Path, Path], Any]) -> Iterator[Path]:
    """Yields a locked temporary sibling of `path`. make: creates it. put: renames it to `path` once it is synced.
    An InputError that names the sibling names `path` instead."""
    path = pointed(path)
    temporary = _sibling(path, "new")
    try:
        if path.exists() and not path.is_file() and not path.is_dir():
            raise InputError(f"{path}: is a pipe, a socket or a device, which stays as it is; give another place")
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
        _discard(temporary, path)


def pointed(path: Path) -> Path:
    """Where `path` leads if it is a symbolic link, or ends without a name, else `path` itself."""
    return Path(os.path.realpath(path)) if path.is_symlink() or path.name in ("", "..") else path


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
    """For writers: restores `path` if a writer was killed between its renames; deletes unlocked temporary siblings, but
    for files of the user of a map, which are moved to `path`."""
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
                    _discard(item, path)
            finally:
                os.close(descriptor)


def standing(path: Path) -> Path:
    """For readers: `path`, or the previous folder if a writer is, or was killed, between its two renames."""
    path = pointed(path)
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


def _put_fresh(new: Path, path: Path) -> None:
    try:
        new.rename(path)
    except OSError as error:
        if error.errno not in _TAKEN:
            raise
        raise InputError(
            f"{path}: was put there by somebody else meanwhile and is kept; move it away and repeat the command (map "
            "with --resume: its work is kept)"
        ) from error


def _swap(new: Path, path: Path) -> None:
    old = _sibling(path, "old")
    if not path.exists():
        _put_fresh(new, path)
        return
    if maps := is_map(new):
        if not is_map(path) and not (path.is_dir() and not any(path.iterdir())):
            raise InputError(f"{path}: is no map, and a map replaces nothing else; give another place")
        _link(path, new, own_files(path) or ())
    if _exchange(new, path):
        old = new  # where the old folder lies now
        for folder in _folders(old) if maps else ():  # the new map gets the user's folders, the old one those of links
            with contextlib.suppress(OSError):
                _exchange(folder, path / folder.name)
    else:
        with _locked(path, lambda: None):  # so that `recover` does not restore it between the renames
            path.rename(old)
            try:
                new.rename(path)
            except OSError:
                old.rename(path)
                raise
    _sync(path)
    _sync(path.parent)  # before deleting the old folder, so that one of the two survives a power cut
    _discard(old, path)


def _folders(folder: Path) -> list[Path]:
    return [item for item in folder.iterdir() if item.is_dir() and not item.is_symlink()]


def _link(old: Path, new: Path, own: Collection[str] = ()) -> None:
    """Makes hard links in folder `new` to all files below `old` but those named in `own`, as far as that is possible.
    InputError for a folder that cannot be moved."""
    folders = _folders(old)
    for folder in folders:
        if folder.is_mount() or not (os.access(folder, os.W_OK) or folder.stat().st_uid == os.geteuid()):
            raise InputError(f"{folder}: cannot be moved with its map (mounted, or of another user); move it elsewhere")
        (new / folder.name).mkdir()
        _link(folder, new / folder.name)
        shutil.copystat(folder, new / folder.name)
    for file in set(old.iterdir()).difference(folders):
        if file.name not in own:
            with contextlib.suppress(OSError):  # a file system without hard links, or a file of another user
                os.link(file, new / file.name, follow_symlinks=False)


def _discard(old: Path, path: Path) -> None:
    """Deletes what was written aside for `path`, or was replaced there. Of a map, only its own files; what else lies
    there moves to `path`, or stays where it is, with a warning, if it cannot."""
    if not old.is_dir() or not (old / FACTS).exists():
        shutil.rmtree(old, ignore_errors=True)
        with contextlib.suppress(OSError):  # it was a folder, took its place, or was never created
            old.unlink()
        return
    try:
        own = own_files(old) or set()
        _merge(old, path, own)
        for name in sorted(own, key=FACTS.__eq__):  # map.json last, as it tells that this is a map
            (old / name).unlink(missing_ok=True)
        _merge(old, path)  # what came meanwhile
        old.rmdir()
    except OSError as error:
        if old.exists():
            warnings.warn(f"{old}: holds files from beside the map that cannot be moved to it ({error})", stacklevel=2)


def _merge(old: Path, path: Path, own: Collection[str] = ()) -> None:
    """Moves all in folder `old` but the files named in `own` to folder `path`, whose own entries keep their names."""
    for folder in _folders(old):
        there = path / folder.name
        if there.is_dir() and not there.is_symlink():
            mode = there.stat().st_mode
            for side in (folder, there):
                if not os.access(side, os.W_OK):
                    side.chmod(0o700)
            _merge(folder, there)
            folder.rmdir()
            if there.stat().st_mode != mode:
                there.chmod(mode)
    for item in old.iterdir():
        there, count = path / item.name, 0
        if item.name in own:
            continue
        if os.path.lexists(there) and os.path.samestat(there.lstat(), item.lstat()):
            item.unlink()
            continue
        while os.path.lexists(there):
            there = path / f"{item.stem}.{(count := count + 1)}{item.suffix}"
        item.rename(there)


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
    Leftovers of killed writers are first restored or deleted (see `atomic.recover`). A file system without locks gets a
    warning, and is written to.
    """
    path = Path(os.path.realpath(path))
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


def _lock_if_possible(descriptor: int, folder: Path) -> bool:
    try:
        return lock(descriptor)
    except OSError as error:
        if error.errno not in _NO_LOCKS:
            raise
        warnings.warn(f"{folder}: its file system has no locks; let only one program write there at once", stacklevel=2)
        return True


def lock_file(path: Path) -> Path:
    """Path of the lock file of the map at `path`, which exists while the map is written."""
    return path.with_name(f".{path.name}.lock")


def _take(path: Path) -> int:
    file = lock_file(path)
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        while True:
            descriptor = os.open(file, os.O_RDWR | os.O_CREAT, 0o644)
            if not _lock_if_possible(descriptor, file.parent):
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
