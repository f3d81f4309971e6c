"""Replaces the folder of a map, in which its user may keep files, and locks maps for writing.

A new map takes over what no map wrote (`checksums.own_files`): it has hard links to these files before it takes the old
one's place, then it gets the user's folders themselves. Only files that a map wrote are deleted; all else that a killed
writer left is moved to the map. The lock keeps concurrent mapping, label editing and copying from overwriting each
other.
"""

from __future__ import annotations

import contextlib
import errno
import os
import shutil
import threading
import warnings
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path

from perception.errors import InputError
from perception.io.atomic import aside, delete, exchange, lock, make_folder, names, put_fresh, recover, swap
from perception.map.checksums import FACTS, is_map, own_files

_NO_LOCKS = {errno.ENOLCK, errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP, errno.EINVAL}
_DELETED = ".nfs"
"""How names of files begin that were deleted on NFS while a reader has them open; they go with the reader."""
_held: set[tuple[Path, int]] = set()
"""Locks of this process: resolved path and thread."""


@contextmanager
def map_directory(path: Path, fresh: bool = False) -> Iterator[Path]:
    """As `atomic.atomic_directory`, for a map: it replaces nothing but a map, whose user's files it takes over, or an
    empty folder. InputError otherwise; what lies at `path` is kept."""
    with aside(path, make_folder, put_fresh if fresh else _replace, _discard) as temporary:
        yield temporary


def _replace(new: Path, path: Path) -> Path | None:
    if path.exists():
        if not is_map(path) and not (path.is_dir() and not any(path.iterdir())):
            raise InputError(f"{path}: is no map, and a map replaces nothing else; choose another path")
        _link(path, new, own_files(path) or ())
    old = swap(new, path)
    # The new map gets the user's folders, the old one those of links.
    for folder in _folders(old) if old == new else ():
        with contextlib.suppress(OSError):
            exchange(folder, path / folder.name)
    return old


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
        with contextlib.suppress(OSError):  # a file system without rights or times
            shutil.copystat(folder, new / folder.name)
    for file in set(old.iterdir()).difference(folders):
        if file.name not in own:
            with contextlib.suppress(OSError):  # a file system without hard links, or a file of another user
                os.link(file, new / file.name, follow_symlinks=False)


def _discard(old: Path, path: Path) -> None:
    """Deletes what was written aside for `path`, or was replaced there. Of a map, only its own files; what else lies
    there moves to `path`, or stays where it is, with a warning, if it cannot."""
    if not old.is_dir() or not (old / FACTS).exists():
        delete(old)
        return
    try:
        own = own_files(old) or set()
        _merge(old, path, own)
        for name in sorted(own, key=FACTS.__eq__):  # map.json last, by which a map is recognised
            (old / name).unlink(missing_ok=True)
        _merge(old, path)  # what came meanwhile
        old.rmdir()
    except OSError as error:
        if old.exists() and not all(item.name.startswith(_DELETED) for item in old.iterdir()):
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
        if item.name in own or item.name.startswith(_DELETED):
            continue
        if os.path.lexists(there) and os.path.samestat(there.lstat(), item.lstat()):
            item.unlink()
            continue
        while os.path.lexists(there):
            there = path / f"{item.stem}.{(count := count + 1)}{item.suffix}"
        item.rename(there)


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
        recover(path, _discard)
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
            try:
                locked = lock(descriptor)
            except OSError as error:
                if error.errno not in _NO_LOCKS:
                    raise
                what = "its file system has no locks; let only one program write there at once"
                warnings.warn(f"{file.parent}: {what}", stacklevel=2)
                locked = True
            if not locked:
                holder = os.pread(descriptor, 32, 0).decode("ascii", "replace").strip()
                os.close(descriptor)
                who = f"process {holder}" if holder.isdigit() else "another process"
                who = "another thread of this process" if holder == str(os.getpid()) else who
                raise InputError(f"{path}: {who} is writing this map; wait for it to finish, or write to another path")
            if names(file, descriptor):
                break
            os.close(descriptor)  # the last holder deleted the file between open and lock: retry
        with contextlib.suppress(OSError):  # on a full disk the lock is still valid, without the process id
            os.ftruncate(descriptor, 0)
            os.pwrite(descriptor, f"{os.getpid()}\n".encode(), 0)
        return descriptor
    except OSError as error:
        why = f"{error.strerror}: {file.parent}"
        raise InputError(f"{path}: cannot be written ({why}); choose another path") from error
