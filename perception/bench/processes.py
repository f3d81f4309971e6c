"""Subprocesses of a benchmark, which import this package whatever the current directory is, and memory of processes."""

from __future__ import annotations

import ctypes
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import perception


def _options(threads: int | None = None) -> dict[str, Any]:
    """cwd and env for subprocess. Started in a repository root, Python would import the sources without _core."""
    paths = [str(Path(perception.__file__).resolve().parents[1]), *(path for path in sys.path if path)]
    env = {**os.environ, "PYTHONPATH": os.pathsep.join(dict.fromkeys(paths))}
    if threads is not None:
        env["OMP_NUM_THREADS"] = str(threads)
    return {"cwd": tempfile.gettempdir(), "env": env, "text": True}


def run_python(*arguments: str, threads: int | None = None) -> str:
    """Standard output of `python ARGUMENTS`. RuntimeError with its standard error when it fails."""
    done = subprocess.run([sys.executable, *arguments], capture_output=True, check=False, **_options(threads))
    if done.returncode:
        raise RuntimeError(f"python {' '.join(arguments)[:80]} ended with {done.returncode}: {done.stderr.strip()}")
    return done.stdout


@contextmanager
def served(*arguments: str) -> Iterator[tuple[str, int]]:
    """Runs `perception ARGUMENTS` while the context is open. Yields its first line ("serving ...") and its pid."""
    command = [sys.executable, "-m", "perception.cli", *arguments]
    server = subprocess.Popen(command, stderr=subprocess.PIPE, **_options())
    try:
        assert server.stderr is not None
        line = server.stderr.readline()
        if not line.startswith("serving "):
            raise RuntimeError(f"perception {arguments[0]} did not start: {line}{server.stderr.read()}")
        yield line, server.pid
    finally:
        server.terminate()
        server.wait()


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
