"""The engine's bounded request queue, and its counters."""

from __future__ import annotations

import threading
import time
from collections import Counter, deque
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from perception.query.query_map import QueryMap

_REMEMBERED = 1000
"""Number of latencies kept for `health`."""


@dataclass(eq=False)
class Job:
    """A queued request: `work` is called with the map, `future` gets its result. asked, deadline: monotonic seconds."""

    work: Callable[[QueryMap], Any]
    future: Future[Any]
    asked: float
    deadline: float


class RequestQueue:
    """A FIFO queue of at most `most` jobs. When it is full, cancelled and expired jobs are removed, and `drop` is
    called with each of them."""

    def __init__(self, most: int, drop: Callable[[Job], None]) -> None:
        self.most, self._drop = most, drop
        self._jobs: deque[Job] = deque()
        self._changed = threading.Condition()
        self._open = True

    def __len__(self) -> int:
        return len(self._jobs)

    def put(self, job: Job) -> bool:
        """Appends a job; False when the queue is full or closed."""
        late: list[Job] = []
        with self._changed:
            if len(self._jobs) >= self.most:
                now = time.monotonic()
                late = [waiting for waiting in self._jobs if waiting.future.cancelled() or now > waiting.deadline]
                self._jobs = deque(waiting for waiting in self._jobs if waiting not in late)
            taken = self._open and len(self._jobs) < self.most
            if taken:
                self._jobs.append(job)
                self._changed.notify()
        for waiting in late:
            self._drop(waiting)
        return taken

    def get(self) -> Job | None:
        """The oldest job; blocks until there is one. None once the queue is closed."""
        with self._changed:
            while self._open and not self._jobs:
                self._changed.wait()
            return self._jobs.popleft() if self._open else None

    def close(self) -> list[Job]:
        """Closes the queue; returns the jobs that were still waiting."""
        with self._changed:
            self._open = False
            self._changed.notify_all()
            left, self._jobs = list(self._jobs), deque()
        return left


class Counters:
    """Totals of requests by outcome since the start, and the latencies of the last answers."""

    _NAMES = ("answered", "bad_input", "failed", "refused", "timed_out", "reloads")

    def __init__(self) -> None:
        self._totals: Counter[str] = Counter()
        self._recent: deque[float] = deque(maxlen=_REMEMBERED)
        self._lock = threading.Lock()
        self._started = time.monotonic()

    def count(self, name: str) -> None:
        with self._lock:
            self._totals[name] += 1

    def answered(self, seconds: float) -> None:
        with self._lock:
            self._totals["answered"] += 1
            self._recent.append(seconds)

    def to_json(self) -> dict[str, Any]:
        with self._lock:
            recent = np.array(self._recent) * 1e3
            totals = {name: self._totals[name] for name in self._NAMES}
        latency = {}
        if len(recent):
            median, high = np.percentile(recent, [50, 99])
            latency = {"median_ms": round(float(median), 2), "p99_ms": round(float(high), 2)}
        return {"uptime_s": round(time.monotonic() - self._started, 1), **totals, **latency}
