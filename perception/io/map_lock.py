"""Write lock of a map, so that concurrent mapping, label editing and copying do not overwrite each other."""

from __future__ import annotations

import contextlib
import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from perception.errors import InputError
from perception.io.atomic import SUPPORTED, lock, names, recover

_held: set[tuple[Path, int]] = set()
"""Locks of this process: resolved path and thread."""


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
        if descriptor is not None:
            with contextlib.suppress(OSError):
                lock_file(path).unlink()  # before the release, so that no other process has locked this file
            os.close(descriptor)


def lock_file(path: Path) -> Path:
    """Path of the lock file of the map at `path`, which exists while the map is written."""
    return path.with_name(f".{path.name}.lock")


def _take(path: Path) -> int | None:
    if not SUPPORTED:  # readers are still safe through atomic renames
        return None
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
        raise InputError(
            f"{path}: cannot be written ({error.strerror}: {file.parent}); choose a place you may write to"
        ) from error
