"""Cores, and checks of available memory before large allocations, to avoid swapping and the out-of-memory killer."""

from __future__ import annotations

import os
from pathlib import Path

from perception.errors import InputError


def available_memory() -> int:
    """Bytes that can be allocated without swapping (Linux kernel's estimate); on other systems the total memory."""
    try:
        for line in Path("/proc/meminfo").read_text(encoding="ascii").splitlines():
            if line.startswith("MemAvailable:"):
                return int(line.split()[1]) * 1024
    except OSError:
        pass
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")


def cores() -> int:
    """Number of CPU cores available to this process."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def require_memory(needed: float, what: str, advice: str) -> None:
    """InputError naming `what` and `advice` when `needed` bytes exceed 90 % of the available memory."""
    free = available_memory()
    if needed > 0.9 * free:
        raise InputError(f"{what}: needs about {needed / 2**30:.1f} GiB, {free / 2**30:.1f} GiB are free; {advice}")
