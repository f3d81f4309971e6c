"""Crops of photos, read in separate threads: a photo on a mount that hangs must not delay queries."""

from __future__ import annotations

import io
import threading
import time
from collections import OrderedDict, deque
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any

from perception.query.engine import EngineBusy

WORKERS = 2
"""Number of photos read at the same time."""
MAX_HUNG = 8
"""Largest number of hung threads; with more, crops are refused until one returns."""
MAX_WAITING = 64
_MAX_KEPT = 256

Key = tuple[Any, ...]


class Crops:
    """JPEGs by key: cached, in progress, or to be made by `work`. timeout: seconds after which a photo counts as hung.

    A thread that reads cannot be interrupted. One that takes longer than `timeout` is counted as hung, and another
    replaces it. Thread-safe; the threads end when no work waits, or with the process.
    """

    def __init__(self, timeout: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._timeout, self._clock = timeout, clock
        self._kept: OrderedDict[Key, bytes | None] = OrderedDict()
        self._asked: dict[Key, Future[bytes | None]] = {}
        self._waiting: deque[tuple[Key, Callable[[], Any]]] = deque()
        self._since: dict[int, float] = {}
        self._lock = threading.Lock()

    def jpeg(self, key: Key, work: Callable[[], Any]) -> Future[bytes | None]:
        """The future JPEG of the picture that `work` returns, None for None; all requests for one key share it.

        EngineBusy when too many requests wait, or too many photos hang.
        """
        with self._lock:
            if key in self._kept:
                done: Future[bytes | None] = Future()
                done.set_result(self._kept[key])
                return done
            if key in self._asked:
                return self._asked[key]
            hung = self._hung()
            if hung >= MAX_HUNG or len(self._waiting) >= MAX_WAITING:
                raise EngineBusy(f"{hung} photos hang and {len(self._waiting)} wait to be read; ask again later")
            self._waiting.append((key, work))
            future = self._asked[key] = Future()
            future.set_running_or_notify_cancel()  # one client that gives up must not cancel it for the others
            if len(self._since) - hung < WORKERS:
                thread = threading.Thread(target=self._read, name="crops", daemon=True)
                thread.start()
            return future

    def hung(self) -> int:
        """The number of photos that take longer than `timeout` to read."""
        with self._lock:
            return self._hung()

    def _hung(self) -> int:
        now = self._clock()
        return sum(now - since > self._timeout for since in self._since.values())

    def _read(self) -> None:
        """Processes waiting requests until there are none."""
        own = threading.get_ident()
        while True:
            with self._lock:
                if not self._waiting:
                    self._since.pop(own, None)
                    return
                key, work = self._waiting.popleft()
                self._since[own] = self._clock()
            try:
                data, error = _encode_jpeg(work()), None
            except Exception as raised:  # passed on by the future
                data, error = None, raised
            with self._lock:
                future = self._asked.pop(key)
                if error is None:
                    self._kept[key] = data
                    if len(self._kept) > _MAX_KEPT:
                        self._kept.popitem(last=False)
            if error is None:
                future.set_result(data)
            else:
                future.set_exception(error)


def _encode_jpeg(picture: Any) -> bytes | None:
    """[h, w, 3] uint8 RGB as a JPEG."""
    if picture is None:
        return None
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(picture).save(buffer, "JPEG", quality=85)
    return buffer.getvalue()
