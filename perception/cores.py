"""Number of CPU cores that this process may use, which in a container is less than the machine has."""

from __future__ import annotations

import math
import os
import resource
import sys
from pathlib import Path

_CGROUPS, _OWN = Path("/sys/fs/cgroup"), Path("/proc/self/cgroup")


def cores() -> int:
    """CPU cores of this process: those it may be scheduled on, and of its quota, rounded up."""
    return max(1, math.ceil(min(_scheduled(), _quota(_CGROUPS, _OWN))))


def limit_threads() -> None:
    """Where control groups grant fewer cores than there are, the libraries and the compiled core start no more threads.

    Call it before they are loaded. Threads beyond the quota would all be halted for most of every period of 100 ms.
    """
    granted = cores()
    if granted == _scheduled():
        return
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, str(granted))
    from perception import _core

    _core.training.set_threads(granted)


def _scheduled() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _quota(root: Path, own: Path) -> float:
    """Least CPU quota in cores of this process's control group and those above it; infinity without one.

    Version 2 has cpu.max ("150000 100000", or "max 100000"), version 1 cpu/cpu.cfs_quota_us (−1: none) and
    cpu.cfs_period_us. In a container the group's own path does not exist, and its folder is `root`.
    """
    try:
        lines = [line.split(":", 2) for line in own.read_text(encoding="utf-8").splitlines()]
    except OSError:
        return math.inf
    granted = math.inf
    for _, controllers, path in lines:
        if controllers and "cpu" not in controllers.split(","):
            continue
        top = root / "cpu" if controllers else root
        group = top / path.lstrip("/")
        for folder in (group, *group.parents):
            if folder == top.parent:
                break
            granted = min(granted, _granted(folder))
    return granted


def _granted(folder: Path) -> float:
    """Cores that one control group grants."""
    try:
        if (folder / "cpu.max").is_file():
            quota, period = (folder / "cpu.max").read_text(encoding="ascii").split()
        else:
            quota, period = (
                (folder / f"cpu.cfs_{name}_us").read_text(encoding="ascii") for name in ("quota", "period")
            )
        return int(quota) / int(period) if quota.strip() != "max" and int(quota) > 0 else math.inf
    except (OSError, ValueError, ZeroDivisionError):
        return math.inf


def peak_memory_mib() -> float:
    """Largest resident memory of this process so far, MiB."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return round(peak / (1024 * 1024 if sys.platform == "darwin" else 1024), 1)
