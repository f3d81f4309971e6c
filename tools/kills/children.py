"""Processes to kill: forked from one that has everything imported, so that a hundred of them cost no imports.

Forking is sound here because the parent runs no parallel region: torch's OpenMP pool and autograd's threads begin in
the child, and OpenBLAS, the one library that starts threads when it is imported, stops them around a fork by itself.
The harness checks it too: a fresh interpreter must end with the very map that a forked child ends with.
"""

from __future__ import annotations

import contextlib
import os
import pickle
import select
import signal
import sys
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

WRITES = ("os.rename", "os.remove", "os.rmdir", "os.mkdir", "os.truncate", "os.symlink", "os.link", "shutil.rmtree")
DEADLINE = 600.0
"""Seconds after which a child that should have ended is told to hang."""


@dataclass(frozen=True)
class Moment:
    """When to kill: `seconds` after the start, or `seconds` after the `write`-th change to the file system."""

    seconds: float
    write: int | None = None
    signal: int = signal.SIGKILL


@dataclass(frozen=True)
class End:
    """How a child ended: killed by us, or with an exit code; what it wrote to stderr; seconds it lived."""

    killed: bool
    code: int
    said: str
    seconds: float


def run(work: Callable[[], Any], folder: Path, moment: Moment | None = None) -> End:
    """Runs `work` in a process group of its own; with a `moment`, its signal falls then, unless it ended before.

    Killed is what ended by it, or with 130, as a command does that treats SIGTERM like Ctrl-C. The return value of
    `work` is its exit code. `folder`: changes below it are counted; its sibling log keeps stderr.
    """
    log = folder.with_suffix(".log")
    log.touch()  # a kill may come before the child has opened it
    reading, writing = os.pipe()
    started = time.monotonic()
    child = os.fork()
    if child == 0:
        os.close(reading)
        _become(work, folder, log, moment, writing)
    os.close(writing)
    _set_group(child)
    limit = started + DEADLINE
    if moment is not None and moment.write is None:
        limit = started + moment.seconds
    elif moment is not None and select.select([reading], [], [], DEADLINE)[0] and os.read(reading, 1):
        limit = time.monotonic() + moment.seconds
    killed, status = _wait_until(child, limit, signal.SIGKILL if moment is None else moment.signal)
    os.close(reading)
    seconds = time.monotonic() - started
    said = log.read_text(encoding="utf-8", errors="replace")
    log.unlink()
    if killed and moment is None:
        raise AssertionError(f"a child did not end within {DEADLINE:.0f} s: {said}")
    return End(killed, os.waitstatus_to_exitcode(status), said, seconds)


def ask(work: Callable[[], Any]) -> Any:
    """What `work` returns in a child; its exception, with the child's traceback, is raised here."""
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(reading)
        try:
            answer: tuple[bool, Any] = (True, work())
        except BaseException:
            answer = (False, traceback.format_exc())
        with os.fdopen(writing, "wb") as pipe:
            pickle.dump(answer, pipe)
        os._exit(0)
    os.close(writing)
    with os.fdopen(reading, "rb") as pipe:
        raw = pipe.read()
    os.waitpid(child, 0)
    good, value = pickle.loads(raw)
    if not good:
        raise AssertionError(value)
    return value


def watch(work: Callable[[], Any], folder: Path) -> tuple[float, list[str]]:
    """Seconds that `work` takes, and the changes it makes below `folder`, as "event path": what Moment.write counts."""

    def watched() -> tuple[float, list[str]]:
        seen: list[str] = []
        _on_write(folder, seen.append)
        started = time.monotonic()
        code = work()
        assert code == 0, f"exit code {code}"
        return time.monotonic() - started, seen

    return ask(lambda: _quiet(watched))


def _become(work: Callable[[], Any], folder: Path, log: Path, moment: Moment | None, pipe: int) -> None:
    """The child's life; never returns."""
    code = 1
    try:
        os.setpgid(0, 0)
        _redirect(log)
        if moment is not None and moment.write is not None:
            _on_write(folder, _Trap(moment, pipe))
        code = int(work() or 0)
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stderr.flush()
        os._exit(code)


class _Trap:
    """Kills its own process at the chosen change, or asks the parent to, a little later."""

    def __init__(self, moment: Moment, pipe: int):
        self.moment, self.pipe, self.left = moment, pipe, moment.write

    def __call__(self, what: str) -> None:
        assert self.left is not None
        self.left -= 1
        if self.left == 0:
            if self.moment.seconds == 0:
                os.kill(os.getpid(), self.moment.signal)
            os.write(self.pipe, b"!")


def _on_write(folder: Path, tell: Callable[[str], Any]) -> None:
    """Calls `tell` just before every change that Python makes below `folder` (compiled libraries are not seen)."""
    root, me = str(folder), os.getpid()

    def hook(event: str, arguments: tuple[Any, ...]) -> None:
        if event == "ctypes.dlsym" and arguments[1] == "renameat2":
            tell("exchange")
        elif event in WRITES or (event == "open" and _writes(arguments)):
            path = arguments[0]
            if isinstance(path, (str, os.PathLike)) and os.fspath(path).startswith(root) and os.getpid() == me:
                tell(f"{event} {os.fspath(path)[len(root) :]}")

    sys.addaudithook(hook)


def _writes(arguments: tuple[Any, ...]) -> bool:
    mode, flags = arguments[1], arguments[2]
    return any(letter in mode for letter in "wax+") if mode else bool(flags & (os.O_WRONLY | os.O_RDWR))


def _quiet(work: Callable[[], Any]) -> Any:
    _redirect(Path(os.devnull))
    return work()


def _redirect(log: Path) -> None:
    with log.open("wb") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)


def _set_group(child: int) -> None:
    with contextlib.suppress(ProcessLookupError, PermissionError):
        os.setpgid(child, child)  # here too: whoever comes first


def _wait_until(child: int, limit: float, number: int) -> tuple[bool, int]:
    """(whether a signal ended it, wait status). `number` is sent when it has not ended at `limit`."""
    handle = os.pidfd_open(child)
    try:
        if not _ended(handle, limit):
            os.killpg(child, number)
            if not _ended(handle, time.monotonic() + DEADLINE):
                os.killpg(child, signal.SIGKILL)
                raise AssertionError(f"a child went on for {DEADLINE:.0f} s after signal {number}")
    finally:
        os.close(handle)
    _, status = os.waitpid(child, 0)
    return os.waitstatus_to_exitcode(status) in (-number, 130), status


def _ended(handle: int, limit: float) -> bool:
    return bool(select.select([handle], [], [], max(0.0, limit - time.monotonic()))[0])
