"""Arrays of which a bounded part is in memory: photos and labels of a large scene."""

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
PIECE = 1 << 20  # numbers of an array that are copied between two looks at what is resident
INTERVAL = 0.05  # seconds between two looks at what is resident

Keep = Callable[[np.ndarray], np.ndarray]
"""Takes an array and returns the same numbers, where they are to be kept; `np.asarray` leaves them where they are."""


class DiskArrays:
    """Keeps arrays, those of the first `limit` / 2 bytes in memory, the others in unnamed mapped files of `folder`.

    A thread drops the files' pages from memory when more than `limit` / 2 bytes of them are resident; left to the
    system alone, as np.memmap does, 1,000 photos with a limit of 300 MiB peak at 2,308 MiB instead of 882. It is safe
    at any time: the numbers are in the file, and mostly in the system's cache, from which a page returns in less than a
    microsecond. Files vanish with the last array, or with the process. OSError when the disk is full. beside: others,
    whose arrays fill the same limit.

    Memory is taken in blocks of CHUNK bytes, apart from the allocator's, whose space kept arrays would split.
    """

    def __init__(self, folder: Path, limit: int, beside: DiskArrays | None = None) -> None:
        self.folder, self.most = folder, limit // 2
        self._held: int = 0 if beside is None else beside._held  # bytes of blocks in memory
        self._before: int = mapped_bytes() if beside is None else beside._before
        self._block, self._used = mmap.mmap(-1, 1), 1  # the block that is being filled, and its bytes in use
        self._files: list[mmap.mmap] = []

    def keep(self, array: np.ndarray) -> np.ndarray:
        """A copy of the array. Pages are dropped on the way: the thread may have no turn meanwhile."""
        needed = -(-array.nbytes // 64) * 64  # compiled loops rely on aligned numbers
        if self._used + needed > len(self._block):
            self._block, self._used = self._new_block(max(CHUNK, needed)), 0
        flat = np.frombuffer(self._block, array.dtype, array.size, self._used)
        self._used += needed
        given = array.reshape(-1)
        for start in range(0, array.size, PIECE):
            flat[start : start + PIECE] = given[start : start + PIECE]
            self.trim()
        return flat.reshape(array.shape)

    def _new_block(self, size: int) -> mmap.mmap:
        if self._held + size <= self.most:
            self._held += size
            return mmap.mmap(-1, size, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
        if not self._files:
            threading.Thread(target=_watch, args=(weakref.ref(self),), daemon=True).start()
        self._files.append(_new_file(self.folder, size))
        return self._files[-1]

    def trim(self) -> None:
        """Drops the pages of all files if there are too many."""
        if self._files and mapped_bytes() - self._before >= self.most and hasattr(mmap, "MADV_DONTNEED"):
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
    """Bytes of mapped files that are resident in this process; very many where the system does not report it."""
    try:
        return int(Path("/proc/self/statm").read_text(encoding="ascii").split()[2]) * mmap.PAGESIZE
    except OSError:
        return 1 << 62
