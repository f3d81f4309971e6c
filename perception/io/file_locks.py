"""Advisory locks (flock) on open files and folders; they end with the process that holds them, however it ends.

The package `filelock` would leave its lock files behind, locks no folders, and does not say who holds a lock.
"""

from __future__ import annotations

import errno
import os
from pathlib import Path

try:
    import fcntl
except ImportError:  # Windows has no locks of this kind
    fcntl = None  # type: ignore[assignment]

SUPPORTED = fcntl is not None


def lock(descriptor: int) -> bool:
    """Takes the exclusive lock on an open file or folder; False when another descriptor holds it.

    OSError where the file system has no such locks, or the system has none.
    """
    if fcntl is None:
        raise OSError(errno.ENOTSUP, os.strerror(errno.ENOTSUP))
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        if error.errno in (errno.EWOULDBLOCK, errno.EACCES):
            return False
        raise
    return True


def names(path: Path, descriptor: int) -> bool:
    """Whether `path` is still the file or folder that was opened."""
    try:
        there, here = path.stat(), os.fstat(descriptor)
    except FileNotFoundError:
        return False
    return (there.st_dev, there.st_ino) == (here.st_dev, here.st_ino)
