"""Memory of a process, read from /proc on Linux."""

from __future__ import annotations

import ctypes
import sys
from contextlib import suppress
from pathlib import Path


def fresh_peak() -> None:
    """Resets the peak resident memory of this process, so that one benchmark case does not affect the next.

    Frees memory kept for reuse, then resets VmHWM. Unsupported steps are skipped (all need Linux with glibc).
    """
    core = sys.modules.get("perception._core")
    if core is not None:
        core.rasterizer_release_memory()
    with suppress(OSError, AttributeError, TypeError):  # malloc_trim exists only in glibc; CDLL(None) fails on Windows
        ctypes.CDLL(None).malloc_trim(0)
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")  # proc(5)


def status_mib(key: str, process: int | str = "self") -> float:
    """A value of /proc/PROCESS/status (VmRSS, VmHWM) in MiB; NaN where it is not available."""
    try:
        for line in Path(f"/proc/{process}/status").read_text(encoding="ascii").splitlines():
            if line.startswith(f"{key}:"):
                return int(line.split()[1]) / 1024
    except OSError:
        pass
    return float("nan")
