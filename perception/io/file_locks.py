"""Advisory locks (flock) on open files and folders; the system releases them when the process ends in any way.

The package `filelock` is not used: it leaves lock files behind, cannot lock folders and does not name the holder.
"""

from __future__ import annotations

import errno
import os
from pathlib import Path

try:
    import fcntl
except ImportError:  # Windows has no flock
    fcntl = None  # type: ignore[assignment]

SUPPORTED = fcntl is not None


def lock(descriptor: int) -> bool:
    """Takes the exclusive lock on an open file or folder; False when another descriptor holds it.

    OSError where the file system or the operating system does not support flock.
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
    """Whether `path` still names the file or folder that was opened as `descriptor`."""
    try:
        there, here = path.stat(), os.fstat(descriptor)
    except FileNotFoundError:
        return False
    return (there.st_dev, there.st_ino) == (here.st_dev, here.st_ino)
