"""Crops of photos, read in threads of their own: a photo on a mount that hangs must not delay queries."""

from __future__ import annotations

import io
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from multiprocessing.pool import ThreadPool  # its threads are daemons: one that hangs does not hold up the end
from typing import Any

from perception.query.engine import EngineBusy

MAX_HUNG = 4
"""Number of photos read at the same time; when all of them hang, crops are refused until one returns."""
MAX_WAITING = 64
_MAX_KEPT = 256

Key = tuple[Any, ...]


class Crops:
    """JPEGs by key: cached, in progress, or to be made by `work`. timeout: seconds after which a photo counts as hung.

    Thread-safe.
    """

    def __init__(self, timeout: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._timeout, self._clock = timeout, clock
        self._asked: dict[Key, Future[bytes | None]] = {}
        self._since: dict[int, float] = {}
        self._lock, self._pool = threading.Lock(), ThreadPool(MAX_HUNG)

    def jpeg(self, key: Key, work: Callable[[], Any]) -> Future[bytes | None]:
        """The future JPEG of the picture that `work` returns, None for None; all requests for one key share it.

        EngineBusy when too many requests wait, or too many photos hang.
        """
        with self._lock:
            if key in self._asked:
                return self._asked[key]
            waiting, hung = sum(not future.done() for future in self._asked.values()), self.hung()
            if hung >= MAX_HUNG or waiting >= MAX_WAITING:
                raise EngineBusy(f"{hung} photos hang and {waiting} are to be read; ask again later")
            if len(self._asked) >= _MAX_KEPT:
                del self._asked[next(old for old, future in self._asked.items() if future.done())]
            future = self._asked[key] = Future()
            future.set_running_or_notify_cancel()  # one client that gives up must not cancel it for the others
            self._pool.apply_async(self._read, (key, work, future))
            return future

    def hung(self) -> int:
        """The number of photos that take longer than `timeout` to read."""
        now = self._clock()
        return sum(now - since > self._timeout for since in list(self._since.values()))

    def _read(self, key: Key, work: Callable[[], Any], future: Future[bytes | None]) -> None:
        own = threading.get_ident()
        self._since[own] = self._clock()
        try:
            data = _encode_jpeg(work())
        except Exception as error:  # passed on by the future; the next request tries again
            del self._since[own]
            with self._lock:
                del self._asked[key]
            future.set_exception(error)
        else:
            del self._since[own]
            future.set_result(data)


def _encode_jpeg(picture: Any) -> bytes | None:
    """[h, w, 3] uint8 RGB as a JPEG."""
    if picture is None:
        return None
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(picture).save(buffer, "JPEG", quality=85)
    return buffer.getvalue()
