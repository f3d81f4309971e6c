"""The engine of every server: one map, many askers, a bounded queue, and a new map while it answers.

Servers (HTTP, DDS, ROS) only convert messages; waiting, refusing, timing out and reloading happen here.
"""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from concurrent.futures import TimeoutError as FutureTimeout
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeVar

from perception.errors import InputError
from perception.io.store import map_signature
from perception.language.base import Encoder
from perception.language.encoders import make_encoder
from perception.query.query_map import QueryMap, load_map
from perception.query.request_queue import Counters, Job, RequestQueue
from perception.query.requests import Reply, Request

T = TypeVar("T")
_SELDOM = 32
"""A new map that cannot be opened is tried again at most this many looks later."""


class EngineBusy(RuntimeError):
    """The queue is full: ask again later, or ask another."""


class AnswerTimeout(TimeoutError):
    """No answer within the time given; work that had not begun is dropped."""


class EngineClosed(RuntimeError):
    """The engine has been closed."""


class QueryEngine:
    """Owns the map at `path`, answers from `workers` threads, and takes over a new map without dropping a question.

    At most `queue_size` questions wait; more are refused with EngineBusy. A question not answered within `timeout`
    seconds raises AnswerTimeout. Every `watch` seconds (None: never) the directory is looked at; when another map or
    new labels lie there it is opened beside the old one, made ready, and put in its place in one step: every answer
    comes from one map or the other. A new map that cannot be read is told in `health`, the old one goes on. The map
    may be deleted meanwhile; what answers need is in memory. Thread-safe; a context manager.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        workers: int = 2,
        queue_size: int = 64,
        timeout: float = 10.0,
        watch: float | None = 1.0,
        encoders: Callable[[str], Encoder | None] | None = None,
    ) -> None:
        for name, value, least in (("workers", workers, 1), ("queue_size", queue_size, 1), ("timeout", timeout, 1e-3)):
            if not value >= least:
                raise InputError(f"engine: {name} is {value}, expected at least {least}")
        self.path, self.timeout = Path(path), timeout
        self._encoders = _Shared(encoders or make_encoder)
        self._signature = map_signature(self.path)
        self._map = self._open()
        self._counters = Counters()
        self._queue = RequestQueue(queue_size, self._drop)
        self._reloading = threading.Lock()
        self._listeners: list[Callable[[QueryMap], None]] = []
        self._problem: str | None = None
        self._busy_since: dict[int, float] = {}
        self._closed = threading.Event()
        self._threads = [threading.Thread(target=self._work, name=f"query-{n}", daemon=True) for n in range(workers)]
        if watch is not None:
            self._threads.append(threading.Thread(target=self._watch, args=(watch,), name="query-watch", daemon=True))
        for thread in self._threads:
            thread.start()

    # ------------------------------------------------------------------ asking

    @property
    def current(self) -> QueryMap:
        """The map that answers now. Keep the reference for as long as one answer needs one map."""
        return self._map

    def ask(self, request: Request | str, timeout: float | None = None) -> Reply:
        """The answer to a prompt; blocks. InputError, EngineBusy, AnswerTimeout, EngineClosed."""
        return self.wait(self.submit(request, timeout), timeout)

    def submit(self, request: Request | str, timeout: float | None = None) -> Future[Reply]:
        """Queues a prompt and returns at once; EngineBusy when the queue is full. The future raises as `ask` does."""
        asked = time.monotonic()
        item = Request(request) if isinstance(request, str) else request

        def work(gmap: QueryMap) -> Reply:
            hits = gmap.query(item.text, item.top_k, item.min_score, where=item.where, frame=item.frame)
            frame = item.frame.name if item.frame else gmap.frame
            return Reply(item, tuple(hits), gmap.map_id, frame, gmap.metric, time.monotonic() - asked)

        return self.run(work, timeout)

    def run(self, work: Callable[[QueryMap], T], timeout: float | None = None) -> Future[T]:
        """Queues any question to the map: `work` is called with it by a worker. EngineBusy when the queue is full."""
        if self._closed.is_set():
            raise EngineClosed(f"{self.path}: the engine has been closed")
        now = time.monotonic()
        job = Job(work, Future(), now, now + (self.timeout if timeout is None else timeout))
        if not self._queue.put(job):
            if self._closed.is_set():
                raise EngineClosed(f"{self.path}: the engine has been closed")
            self._counters.count("refused")
            raise EngineBusy(f"{self._queue.most} questions are waiting already; ask again later")
        return job.future

    def wait(self, future: Future[T], timeout: float | None = None) -> T:
        """The future's result, AnswerTimeout after `timeout` seconds (the engine's own when None)."""
        seconds = self.timeout if timeout is None else timeout
        try:
            return future.result(seconds)
        except FutureTimeout as error:
            if isinstance(error, AnswerTimeout):
                raise
            future.cancel()  # drops it if it has not begun
            self._counters.count("timed_out")
            raise AnswerTimeout(f"no answer within {seconds:g} s") from None

    async def awaited(self, future: Future[T], timeout: float | None = None) -> T:
        """`wait` for servers that run an event loop."""
        seconds = self.timeout if timeout is None else timeout
        try:
            return await asyncio.wait_for(asyncio.wrap_future(future), seconds)  # cancels what has not begun
        except (TimeoutError, asyncio.TimeoutError) as error:
            if isinstance(error, AnswerTimeout):
                raise
            self._counters.count("timed_out")
            raise AnswerTimeout(f"no answer within {seconds:g} s") from None

    # --------------------------------------------------------------- reloading

    def reload(self) -> bool:
        """Opens what lies at the path now and swaps it in; False when it is the map that answers already.

        InputError when it cannot be opened; the old map goes on answering.
        """
        with self._reloading:
            try:
                signature = map_signature(self.path)
                if signature == self._signature and self._problem is None:
                    return False
                fresh = self._open()
            except InputError as error:
                self._problem = str(error)
                raise
            self._signature, self._problem, old = signature, None, self._map
            self._map = fresh
            self._counters.count("reloads")
            if fresh.map_id == old.map_id:
                return False
            for listener in list(self._listeners):
                listener(fresh)
            return True

    def on_reload(self, listener: Callable[[QueryMap], None]) -> None:
        """Calls `listener(new map)` after each swap, from the thread that reloaded; it must not raise."""
        self._listeners.append(listener)

    def _open(self) -> QueryMap:
        gmap = load_map(self.path, encoders=self._encoders)
        gmap.warm()
        return gmap

    def _watch(self, every: float) -> None:
        """Looks, and takes over. A map that cannot be opened may still be on its way (someone copies it file by file),
        so it is tried again, less and less often."""
        tried: Any = None
        wait, left = every, 0.0
        while not self._closed.wait(every):
            left -= every
            try:
                signature = map_signature(self.path)
            except InputError as error:
                self._problem, tried = str(error), None
                continue
            if signature == self._signature:
                self._problem = None
            elif signature != tried or left <= 0:
                wait = every if signature != tried else min(2 * wait, _SELDOM * every)
                tried, left = signature, wait
                with suppress(InputError):  # told in health
                    self.reload()

    # ------------------------------------------------------------------ health

    def health(self) -> dict[str, Any]:
        """status: ok, closed or degraded, and the problem then: the map on disk is gone or unreadable and the one in
        memory answers, prompts cannot be answered, or answers are overdue; the map's identity and counts, the queue,
        totals since the start, and latency of the last thousand answers in ms."""
        gmap = self._map
        problem = self._problem or gmap.problem or self._overdue()
        return {
            "status": "closed" if self._closed.is_set() else "degraded" if problem else "ok",
            "problem": problem,
            "map": str(self.path),
            "map_id": gmap.map_id,
            "frame": gmap.frame,
            "metric": gmap.metric,
            "instances": len(gmap.instances),
            "gaussians": int(gmap.info.get("num_gaussians", 0)),
            "waiting": len(self._queue),
            "queue_size": self._queue.most,
            **self._counters.to_json(),
        }

    def _overdue(self) -> str | None:
        now = time.monotonic()
        late = sum(now - since > self.timeout for since in list(self._busy_since.values()))
        return f"{late} answers take longer than {self.timeout:g} s" if late else None

    def close(self) -> None:
        """Answers what runs, refuses what waits, and ends the threads."""
        if self._closed.is_set():
            return
        self._closed.set()
        for job in self._queue.close():
            if job.future.set_running_or_notify_cancel():
                job.future.set_exception(EngineClosed(f"{self.path}: the engine has been closed"))
        for thread in self._threads:
            if thread is not threading.current_thread():
                thread.join(timeout=self.timeout)

    def __enter__(self) -> QueryEngine:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # ----------------------------------------------------------------- workers

    def _work(self) -> None:
        while (job := self._queue.get()) is not None:
            if time.monotonic() > job.deadline:
                self._drop(job)
            elif job.future.set_running_or_notify_cancel():
                own = threading.get_ident()
                self._busy_since[own] = time.monotonic()
                self._answer(job)
                del self._busy_since[own]

    def _drop(self, job: Job) -> None:
        """Tells who asked that the time is over; nothing when they have gone already."""
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
            self._counters.answered(time.monotonic() - job.asked)
            job.future.set_result(result)


class _Shared:
    """Encoders by name, made once and shared by the old map and the new."""

    def __init__(self, make: Callable[[str], Encoder | None]) -> None:
        self._make, self._made, self._lock = make, {}, threading.Lock()  # type: ignore[var-annotated]

    def __call__(self, spec: str) -> Encoder | None:
        with self._lock:
            if spec not in self._made:
                self._made[spec] = self._make(spec)
            return self._made[spec]
