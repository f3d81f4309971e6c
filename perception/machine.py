"""What this process may use of the machine, in a container less than there is: cores, memory, torch's threads."""

from __future__ import annotations

import contextlib
import ctypes
import math
import os
import resource
import shutil
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextvars import ContextVar
from pathlib import Path
from typing import TypeVar

from perception.errors import FullDisk, InputError

Item = TypeVar("Item")
Result = TypeVar("Result")
MOST_THREADS = 8
"""Photos that are worked on at a time; each takes tens of megabytes, and Python's own steps take turns anyway."""
LEAST_DISK = 256 << 20
"""Least free disk space in bytes, as a small run needs it for features, masks, checkpoint and map."""
_CGROUPS, _OWN = Path("/sys/fs/cgroup"), Path("/proc/self/cgroup")
_blas_lock, _blas_limit, _blas_blocks = threading.Lock(), contextlib.ExitStack(), list[None]()
threads_before: ContextVar[int] = ContextVar("threads_before", default=0)
"""Threads that torch had outside `torch_on_one_thread`; 0 outside of it."""


def refuse_full_disk(folder: Path, needed: int = 0) -> None:
    """FullDisk where the disk that holds a folder has less than LEAST_DISK free, and the `needed` bytes beside it:
    libraries that write there abort the process when it becomes full."""
    least = LEAST_DISK + needed
    if (free := shutil.disk_usage(folder).free) < least:
        found = f"its disk has {free >> 20} MiB free, at least {least >> 20} are needed"
        raise FullDisk(f"{folder}: {found}; free some")


def cores() -> int:
    """CPU cores of this process: those it may be scheduled on, and of its quota, rounded up."""
    quota = min((_cores_of(folder) for folder in _control_groups("cpu")), default=math.inf)
    return max(1, math.ceil(min(_scheduled(), quota)))


def in_threads(work: Callable[[Item], Result], items: Iterable[Item]) -> Iterator[Result]:
    """work(item) of each item, in order, as many at a time as there are `cores`, but at most MOST_THREADS; no more
    results wait than that."""
    most, waiting = min(cores(), MOST_THREADS), deque[Future[Result]]()
    if most == 1:  # a second thread would have a second heap
        yield from map(work, items)
        return
    with ThreadPoolExecutor(most) as pool:
        try:
            for item in items:
                waiting.append(pool.submit(work, item))
                if len(waiting) > most:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            pool.shutdown(cancel_futures=True)


def limit_threads() -> None:
    """Where control groups grant fewer cores than there are, the libraries and the compiled core start no more threads,
    which would all be halted for most of every period of 100 ms. Call it before they are loaded."""
    granted = cores()
    if granted == _scheduled():
        return
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, str(granted))
    from perception import _core

    _core.training.set_threads(granted)


@contextlib.contextmanager
def blas_on_one_thread() -> Iterator[None]:
    """Within it BLAS, as far as it is loaded, uses one thread: the last bits of NumPy's products depend on the number
    of threads. The limit is the process's: it is set when the first block begins, and lifted when the last one ends."""
    from threadpoolctl import threadpool_limits

    with _blas_lock:
        if not _blas_blocks:
            _blas_limit.enter_context(threadpool_limits(1, "blas"))
        _blas_blocks.append(None)
    try:
        yield
    finally:
        with _blas_lock:
            _blas_blocks.pop()
            if not _blas_blocks:
                _blas_limit.close()


@contextlib.contextmanager
def torch_on_one_thread() -> Iterator[None]:
    """Within it torch, if it is loaded, computes on one thread, and the rasterizer by default on as many as torch had.
    Idle workers of torch's OpenMP pool busy-wait on processors that other threads need: with two threads on two busy
    processors, a training step took four times the CPU time."""
    torch = sys.modules.get("torch")
    if torch is None or (before := torch.get_num_threads()) == 1:
        yield
        return
    token = threads_before.set(threads_before.get() or before)
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
        threads_before.reset(token)


def _torch_in_a_fork() -> None:
    """A forked process has none of the threads that torch's OpenMP would wait for; on one thread it needs none."""
    if (torch := sys.modules.get("torch")) is not None:
        torch.set_num_threads(1)


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_torch_in_a_fork)


def memory_limit() -> int | None:
    """Bytes of memory that this process may ever have: the machine's, or its control groups'; None if unknown."""
    try:
        total = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (ValueError, OSError, AttributeError):
        return None
    return int(min([total, *(_memory_of(folder) for folder in _control_groups("memory"))]))


def require_memory(needed: float, what: str, advice: str) -> None:
    """InputError naming `what` and `advice` when `needed` bytes exceed 90 % of the available memory."""
    free = available_memory()
    if needed > 0.9 * free:
        raise InputError(f"{what}: needs about {needed / 2**30:.1f} GiB, {free / 2**30:.1f} GiB are free; {advice}")


def available_memory() -> float:
    """Bytes that can be allocated without swapping: the Linux kernel's estimate, and what control groups have left."""
    limit = min([memory_limit() or math.inf, *(_left_of(folder) for folder in _control_groups("memory"))])
    with contextlib.suppress(OSError):
        for line in Path("/proc/meminfo").read_text(encoding="ascii").splitlines():
            if line.startswith("MemAvailable:"):
                return min(limit, int(line.split()[1]) * 1024)
    return limit


def return_free_memory() -> None:
    """Returns what was freed to the system, where the C library can (glibc)."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None) if sys.platform == "linux" else None
    if trim is not None:
        trim(0)


def _scheduled() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _control_groups(controller: str) -> Iterator[Path]:
    """Folders of this process's control group and of those above it that limit "cpu" or "memory", versions 1 and 2; in
    a container they may not exist, but for the root."""
    try:
        lines = [line.split(":", 2) for line in _OWN.read_text(encoding="utf-8").splitlines()]
    except OSError:
        return
    for _, controllers, path in lines:
        if controllers and controller not in controllers.split(","):
            continue
        top = _CGROUPS / controller if controllers else _CGROUPS
        group = top / path.lstrip("/")
        yield from (folder for folder in (group, *group.parents) if folder.is_relative_to(top))


def _cores_of(folder: Path) -> float:
    """Cores that one control group grants: cpu.max ("150000 100000", or "max 100000"), or in version 1
    cpu.cfs_quota_us (−1: none) and cpu.cfs_period_us; infinity without a limit."""
    new = folder / "cpu.max"
    old = [folder / f"cpu.cfs_{name}_us" for name in ("quota", "period")]
    try:
        quota, period = " ".join(file.read_text(encoding="ascii") for file in ([new] if new.is_file() else old)).split()
        return int(quota) / int(period) if quota != "max" and int(quota) > 0 else math.inf
    except (OSError, ValueError, ZeroDivisionError):
        return math.inf


def _memory_of(folder: Path) -> float:
    """Bytes that one control group grants: memory.max, or in version 1 memory.limit_in_bytes; infinity without."""
    for name in ("memory.max", "memory.limit_in_bytes"):
        with contextlib.suppress(OSError, ValueError):  # not there, or "max"
            return int((folder / name).read_text(encoding="ascii"))
    return math.inf


def _left_of(folder: Path) -> float:
    """Bytes that one control group has left, with cached files, which the kernel drops; infinity where unknown."""
    for used, prefix in (("memory.current", ""), ("memory.usage_in_bytes", "total_")):
        with contextlib.suppress(OSError, ValueError, KeyError):
            stat = dict(line.split() for line in (folder / "memory.stat").read_text(encoding="ascii").splitlines())
            cached = int(stat[f"{prefix}inactive_file"]) + int(stat[f"{prefix}active_file"])
            return max(_memory_of(folder) - int((folder / used).read_text(encoding="ascii")) + cached, 0)
    return math.inf


def peak_memory_mib() -> float:
    """Largest resident memory of this process so far, MiB."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return round(peak / (1024 * 1024 if sys.platform == "darwin" else 1024), 1)
