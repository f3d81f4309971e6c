"""Memory of a process as Linux tells it."""

from __future__ import annotations

import ctypes
import sys
from contextlib import suppress
from pathlib import Path


def fresh_peak() -> None:
    """Gives back what is kept for reuse, and starts the kernel's mark of the highest resident memory anew: what one
    case leaves behind must not count for the next. Does what the system allows (Linux with glibc: all of it).
    """
    core = sys.modules.get("perception._core")
    if core is not None:
        core.rasterizer_release_memory()
    with suppress(OSError, AttributeError, TypeError):  # only glibc has it; Windows knows no CDLL(None)
        ctypes.CDLL(None).malloc_trim(0)
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")  # proc(5)


def status_mib(key: str, process: int | str = "self") -> float:
    """A figure of /proc/PROCESS/status (VmRSS, VmHWM) in MiB; NaN where the system does not tell."""
    try:
        for line in Path(f"/proc/{process}/status").read_text(encoding="ascii").splitlines():
            if line.startswith(f"{key}:"):
                return int(line.split()[1]) / 1024
    except OSError:
        pass
    return float("nan")
