"""Arrays of which a bounded part is in memory: the photos and labels of a large place."""

from __future__ import annotations

import mmap
import os
import tempfile
import threading
import time
import weakref
from collections.abc import Callable
from pathlib import Path

import numpy as np

CHUNK = 64 << 20  # bytes of a file; a larger array has a file of its own
INTERVAL = 0.05  # seconds between two looks at what is resident

Keep = Callable[[np.ndarray], np.ndarray]
"""Takes an array and returns the same numbers, where they are to be kept; `np.asarray` leaves them where they are."""


class DiskArrays:
    """Keeps arrays, the first of together `limit` / 2 bytes in memory, the others in unnamed mapped files of `folder`.

    A thread drops the files' pages from memory when more than `limit` / 2 bytes of them are resident. That is safe at
    any time: the numbers are in the file, and mostly in the system's cache, from which a page returns in less than a
    microsecond. Files vanish with the last array, or with the process. OSError when the disk is full.
    """

    def __init__(self, folder: Path, limit: int) -> None:
        self.folder, self.most = folder, limit // 2
        self._held = self._used = 0  # bytes of arrays in memory, and of the last file
        self._files: list[mmap.mmap] = []
        self._before = mapped_bytes()

    def keep(self, array: np.ndarray) -> np.ndarray:
        """The array, or a copy on disk."""
        self._held += array.nbytes
        if self._held <= self.most:
            return array
        if not self._files:
            threading.Thread(target=_watch, args=(weakref.ref(self),), daemon=True).start()
        needed = -(-array.nbytes // 64) * 64  # compiled loops rely on aligned numbers
        if not self._files or self._used + needed > len(self._files[-1]):
            self._files.append(_new_file(self.folder, max(CHUNK, needed)))
            self._used = 0
        flat = np.frombuffer(self._files[-1], array.dtype, array.size, self._used)
        self._used += needed
        flat[:] = array.reshape(-1)
        return flat.reshape(array.shape)

    def trim(self) -> None:
        """Drops the pages of all files if there are too many."""
        if mapped_bytes() - self._before >= self.most and hasattr(mmap, "MADV_DONTNEED"):
            for file in list(self._files):
                file.madvise(mmap.MADV_DONTNEED)


def _watch(arrays: weakref.ref[DiskArrays]) -> None:
    while (held := arrays()) is not None:
        held.trim()
        del held
        time.sleep(INTERVAL)


def _new_file(folder: Path, size: int) -> mmap.mmap:
    with tempfile.TemporaryFile(dir=folder) as file:
        if hasattr(os, "posix_fallocate"):
            os.posix_fallocate(file.fileno(), 0, size)  # a full disk is an error here, not a fatal signal later
        file.truncate(size)
        return mmap.mmap(file.fileno(), size)


def mapped_bytes() -> int:
    """Bytes of mapped files that are resident in this process; very many where the system does not tell."""
    try:
        return int(Path("/proc/self/statm").read_text(encoding="ascii").split()[2]) * mmap.PAGESIZE
    except OSError:
        return 1 << 62
