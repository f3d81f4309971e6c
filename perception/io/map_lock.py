"""One writer at a time on a map: mapping, label editing and copying onto it must not lose each other's work."""

from __future__ import annotations

import contextlib
import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from perception.errors import InputError
from perception.io.atomic import recover
from perception.io.file_locks import SUPPORTED, lock, names

_held: dict[Path, tuple[int, int]] = {}
"""Locks of this process: resolved path → (thread, depth)."""
_guard = threading.Lock()


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Holds the right to write the map at `path`; InputError at once when another process or thread holds it.

    The lock is an advisory flock on the sibling `.NAME.lock`, so it ends with its process, however that ends; the file
    says who holds it and goes when the lock does. A thread may take a lock again that it holds. Readers need none.
    What writers that were killed left beside the map is put back or deleted first.
    """
    path = Path(path).resolve()
    me = threading.get_ident()
    with _guard:
        owner, depth = _held.get(path, (me, 0))
        if owner != me:
            raise InputError(f"{path}: another thread of this process is writing this map; wait for it to finish")
        _held[path] = (me, depth + 1)
    descriptor = None
    try:
        if depth == 0:
            descriptor = _take(path)
            recover(path)
        yield
    finally:
        with _guard:
            if depth == 0:
                _drop(path, descriptor)
                del _held[path]
            else:
                _held[path] = (me, depth)


def lock_file(path: Path) -> Path:
    """Where the lock on the map at `path` lies while someone writes it."""
    return path.with_name(f".{path.name}.lock")


def _take(path: Path) -> int | None:
    if not SUPPORTED:  # renames still keep readers safe
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
                raise InputError(f"{path}: {who} is writing this map; wait for it to finish, or write to another place")
            if names(file, descriptor):
                break
            os.close(descriptor)  # its last holder removed the file between our open and our lock: once more
        with contextlib.suppress(OSError):  # on a full disk the lock holds too, it only does not say whose it is
            os.ftruncate(descriptor, 0)
            os.pwrite(descriptor, f"{os.getpid()}\n".encode(), 0)
        return descriptor
    except OSError as error:
        raise InputError(
            f"{path}: cannot be written ({error.strerror}: {file.parent}); choose a place you may write to"
        ) from error


def _drop(path: Path, descriptor: int | None) -> None:
    if descriptor is None:
        return
    with contextlib.suppress(OSError):
        lock_file(path).unlink()  # while we hold it: no one else can have locked this very file
    os.close(descriptor)
