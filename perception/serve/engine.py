"""The query engine of all servers: one map, worker threads, a bounded request queue, reload of a changed map.

Servers (HTTP, ROS) only convert messages. Queueing, rejection, time-outs and reloading are implemented here.
"""

from __future__ import annotations

import asyncio
import gc
import logging
import threading
import time
from collections import Counter, deque
from collections.abc import Callable
from concurrent.futures import Future
from concurrent.futures import TimeoutError as FutureTimeout
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from perception.config import settings_from
from perception.errors import InputError
from perception.language.base import Encoder
from perception.language.encoders import make_encoder
from perception.map.files import map_signature
from perception.query import QueryMap, load_map
from perception.serve.requests import (
    AnswerTimeout,
    EngineBusy,
    EngineClosed,
    EngineSettings,
    OtherMap,
    Reply,
    Request,
    error_line,
)

T = TypeVar("T")
_log = logging.getLogger("perception.query")
_SELDOM = 32  # largest interval between attempts to open an unreadable new map, in multiples of `watch`
_REMEMBERED = 1000  # number of latencies kept for `health`


class QueryEngine:
    """Answers requests on the map at `path` in `workers` threads, and reloads the map when it changes on disk.

    At most `queue_size` requests wait; further ones raise EngineBusy. A request without an answer after `timeout`
    seconds raises AnswerTimeout. Every `watch` seconds (0 or None: never) the map's directory is checked. A changed
    map, or changed labels, is loaded beside the current map and then swapped in atomically: each answer comes from one
    map only. When a new map cannot be read, `health` reports it and the current map stays in use. The directory may be
    deleted meanwhile: queries use only data in memory. Thread-safe; a context manager.

    >>> with QueryEngine("kitchen.gsmap", workers=2, timeout=30.0) as engine:
    ...     reply = engine.ask(Request("red mug", top_k=1))
    >>> [hit.instance_id for hit in reply.hits]
    [0]
    """

    def __init__(
        self, path: str | Path, *, encoders: Callable[[str], Encoder | None] | None = None, **settings: Any
    ) -> None:
        """settings: the fields of `EngineSettings`; InputError when one is unknown or out of range, or for a folder
        that is no map."""
        chosen = settings_from(EngineSettings, {name: (value, "engine") for name, value in settings.items()})
        self.path, self.timeout = Path(path), chosen.timeout
        self._encoders = lru_cache(encoders or make_encoder)  # shared by the current map and a reloaded one
        self._signature = map_signature(self.path)
        self._map = self.open_map()
        self._counters = Counters()
        self._queue = RequestQueue(chosen.queue_size, self._drop)
        self._reloading = threading.Lock()
        self._listeners: list[Callable[[QueryMap], object]] = []
        self._problem: str | None = None
        self._unserved: str | None = None
        self._busy_since: dict[int, float] = {}
        self._closed = threading.Event()
        tasks = {f"query-{n}": self._work for n in range(chosen.workers)}
        if chosen.watch:
            tasks["query-watch"] = partial(self._watch, chosen.watch)
        self._threads = [threading.Thread(target=task, name=name, daemon=True) for name, task in tasks.items()]
        for thread in self._threads:
            thread.start()

    # ------------------------------------------------------------------ asking

    @property
    def current(self) -> QueryMap:
        """The map in use. Keep the reference while several calls must read the same map."""
        return self._map

    def ask(self, request: Request | str, timeout: float | None = None) -> Reply:
        """The reply to a prompt; blocks. Raises InputError, EngineBusy, AnswerTimeout or EngineClosed."""
        return self.wait(self.submit(request, timeout), timeout)

    def submit(self, request: Request | str, timeout: float | None = None) -> Future[Reply]:
        """Queues a prompt and returns its future, which raises as `ask` does. EngineBusy when the queue is full."""
        prompt = Request(request) if isinstance(request, str) else request
        return self.run(prompt.answered, timeout)

    def run(self, work: Callable[[QueryMap], T], timeout: float | None = None, map_id: str | None = None) -> Future[T]:
        """Queues `work`, which a worker thread calls with the current map. EngineBusy when the queue is full. The
        future raises OtherMap when `map_id` is given and is not the id of the map."""

        def checked(gmap: QueryMap) -> T:
            if map_id is not None and map_id != gmap.map_id:
                raise OtherMap(f"the map is now {gmap.map_id}, not {map_id[:40]}; ask again")
            return work(gmap)

        now = time.monotonic()
        job = Job(checked, Future(), now, now + (self.timeout if timeout is None else timeout))
        if not self._queue.put(job):
            if self._closed.is_set():
                raise EngineClosed(f"{self.path}: the engine has been closed")
            self._counters.count("refused")
            raise EngineBusy(f"{self._queue.most} questions are waiting already; ask again later")
        return job.future

    def wait(self, future: Future[T], timeout: float | None = None) -> T:
        """The future's result; AnswerTimeout after `timeout` seconds (None: the engine's own)."""
        seconds = self.timeout if timeout is None else timeout
        try:
            return future.result(seconds)
        except FutureTimeout as error:
            if isinstance(error, AnswerTimeout):
                raise
            future.cancel()  # drops it if it has not begun
            self._counters.count("timed_out")
            raise AnswerTimeout(f"no answer within {seconds:g} s") from None

    async def awaited(self, future: Future[T]) -> T:
        """`wait` as a coroutine, for servers with an event loop."""
        try:
            return await asyncio.wait_for(asyncio.wrap_future(future), self.timeout)  # cancels what has not begun
        except (TimeoutError, asyncio.TimeoutError) as error:
            if isinstance(error, AnswerTimeout):
                raise
            self._counters.count("timed_out")
            raise AnswerTimeout(f"no answer within {self.timeout:g} s") from None

    # --------------------------------------------------------------- reloading

    def reload(self) -> bool:
        """Loads the map now at the path and swaps it in; False when it is the current map already.

        Raises InputError when it cannot be loaded, whatever the reason; the current map then stays in use.
        """
        with self._reloading:
            try:
                signature = map_signature(self.path)
                if signature == self._signature and self._problem is None:
                    return False
                fresh = self.open_map()
            except Exception as error:  # of any class: people edit instances.json by hand
                raise self._unreadable(error) from error
            known = self._map.map_id
            self._signature, self._problem, self._map = signature, None, fresh
            self._counters.count("reloads")
            if fresh.map_id == known:
                return False
            self._unserved = None
            for listener in list(self._listeners):
                try:
                    listener(fresh)
                except Exception as error:
                    _log.error("%s: not all of the new map can be served", self.path, exc_info=error)
                    self._unserved = f"{self.path}: not all of the map can be served ({_brief(error)})"
            gc.collect()  # maps lie in circles of references, and would pile up: Python does not count arrays
            return True

    def _unreadable(self, error: Exception) -> InputError:
        """The error as an InputError, which `health` reports from now on; logged when it is a new one."""
        known = isinstance(error, InputError)
        line = error_line(error) if known else f"{self.path}: cannot be opened ({_brief(error)}); mend or replace it"
        if line != self._problem:
            _log.warning("%s; the map opened before stays in use", line, exc_info=None if known else error)
        self._problem = line
        return InputError(line)

    def on_reload(self, listener: Callable[[QueryMap], object]) -> None:
        """Registers `listener(new map)`, called by the reloading thread after a swap; `health` reports its errors."""
        self._listeners.append(listener)

    def open_map(self) -> QueryMap:
        """The map now at the path, ready for its first query; a subclass may change it."""
        gmap = load_map(self.path, encoders=self._encoders)
        gmap.warm()
        return gmap

    def _watch(self, every: float) -> None:
        """Reloads the map when its signature changes. A map that cannot be opened may still be being copied file by
        file, so it is tried again, at intervals that double up to _SELDOM times `every`. No error ends this."""
        tried: Any = None
        wait, left = every, 0.0
        while not self._closed.wait(every):
            left -= every
            try:
                signature = map_signature(self.path)
            except Exception as error:
                self._unreadable(error)
                tried = None
                continue
            if signature == self._signature:
                self._problem = None
            elif signature != tried or left <= 0:
                wait = every if signature != tried else min(2 * wait, _SELDOM * every)
                tried, left = signature, wait
                with suppress(InputError):  # reported by `health`
                    self.reload()

    # ------------------------------------------------------------------ health

    def health(self) -> dict[str, Any]:
        """The state of the engine. status: "ok", "closed", or "degraded" with the reason in `problem`: the map on disk
        is missing or unreadable, not all of it can be served, prompts cannot be answered, or answers are overdue.
        Further: the map's identity and counts, the queue, totals since the start, and the latency of the last thousand
        answers in ms."""
        gmap = self._map
        now = time.monotonic()
        late = sum(now - since > self.timeout for since in list(self._busy_since.values()))
        overdue = f"{late} answers take longer than {self.timeout:g} s" if late else None
        problem = self._problem or self._unserved or gmap.problem or overdue
        return {
            "status": "closed" if self._closed.is_set() else "degraded" if problem else "ok",
            "problem": problem,
            "map": str(self.path),
            "map_id": gmap.map_id,
            "frame": gmap.frame,
            "metric": gmap.metric,
            **gmap.counts,
            "waiting": len(self._queue),
            "queue_size": self._queue.most,
            **self._counters.to_json(),
        }

    def close(self, wait: float | None = None) -> None:
        """Finishes running requests, for at most `wait` seconds (None: the engine's timeout), ends waiting ones with
        EngineClosed, and joins the threads."""
        if self._closed.is_set():
            return
        self._closed.set()
        for job in self._queue.close():
            if job.future.set_running_or_notify_cancel():
                job.future.set_exception(EngineClosed(f"{self.path}: the engine has been closed"))
        for thread in self._threads:
            if thread is not threading.current_thread():
                thread.join(timeout=self.timeout if wait is None else wait)

    def __enter__(self) -> QueryEngine:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # ----------------------------------------------------------------- workers

    def _work(self) -> None:
        own = threading.get_ident()
        while (job := self._queue.get()) is not None:
            if time.monotonic() > job.deadline:
                self._drop(job)
            elif job.future.set_running_or_notify_cancel():
                self._busy_since[own] = time.monotonic()
                self._answer(job)
                del self._busy_since[own]
            del job  # its answer holds the map

    def _drop(self, job: Job) -> None:
        """Ends a job with AnswerTimeout, unless its future was cancelled."""
        if job.future.set_running_or_notify_cancel():
            self._counters.count("timed_out")
            job.future.set_exception(AnswerTimeout("the question waited too long and was dropped"))

    def _answer(self, job: Job) -> None:
        try:
            result = job.work(self._map)
        except InputError as error:
            self._counters.count("bad_input")
            job.future.set_exception(error)
        except Exception as error:  # a defect in one answer must not end the worker
            self._counters.count("failed")
            job.future.set_exception(error)
        else:
            self._counters.count("answered", time.monotonic() - job.since)
            job.future.set_result(result)


def _brief(error: Exception) -> str:
    return f"{type(error).__name__}: {error_line(error)[:200]}"


@dataclass(eq=False)
class Job:
    """A queued request: `work` is called with the map, `future` gets its result. since, deadline: monotonic seconds."""

    work: Callable[[QueryMap], Any]
    future: Future[Any]
    since: float
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
                now, before, self._jobs = time.monotonic(), self._jobs, deque()
                for waiting in before:
                    (late if waiting.future.cancelled() or now > waiting.deadline else self._jobs).append(waiting)
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

    def count(self, name: str, seconds: float | None = None) -> None:
        """One more; seconds: the latency of an answer."""
        with self._lock:
            self._totals[name] += 1
            if seconds is not None:
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
