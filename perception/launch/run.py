"""Starts the processes of a plan, starts again what dies, and ends them all together."""

from __future__ import annotations

import subprocess
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from perception.errors import InputError
from perception.launch.plan import Job

_BAD_INPUT = 2
_PATIENCE = 15.0
"""Seconds a process has to end in order before it is killed."""


@dataclass
class _Running:
    job: Job
    process: subprocess.Popen[bytes] | None = None
    due: float = 0.0
    starts: int = 0
    ended: int | None = None


def run_plan(
    jobs: Sequence[Job], stop: threading.Event, log: Callable[[str], None], respawn: float = 2.0
) -> dict[str, Any]:
    """Runs jobs until `stop` is set or all that end by themselves have ended and no other is there.

    A job whose map is missing waits for it. One that dies is started again after `respawn` seconds, unless it found
    its input bad (exit code 2) or is to run once: then all are ended, and InputError says which. Returns how each
    ended: {"name": {"starts": n, "exit": code}}.
    """
    all_jobs = [_Running(job) for job in jobs]
    try:
        while not stop.is_set():
            for one in all_jobs:
                _tend(one, all_jobs, log, respawn)
            if all(one.ended is not None for one in all_jobs):
                break
            stop.wait(0.1)
    finally:
        _end(all_jobs, log)
    return {
        one.job.name: {"starts": one.starts, "exit": one.process.returncode if one.process else None}
        for one in all_jobs
    }


def _tend(one: _Running, others: Sequence[_Running], log: Callable[[str], None], respawn: float) -> None:
    """Looks after one job: starts it when it can, notes its end."""
    job = one.job
    if one.ended is not None:
        return
    if one.process is None or one.process.poll() is not None:
        if one.process is not None and one.due == 0.0:
            _ended(one, log, respawn)
        elif _ready(job, others) and time.monotonic() >= one.due:
            log(f"{job.name}: {' '.join(job.command)}")
            one.process, one.due = subprocess.Popen(job.command, start_new_session=True), 0.0
            one.starts += 1


def _ready(job: Job, others: Sequence[_Running]) -> bool:
    if job.needs is None or (job.needs / "map.json").is_file():
        return True
    if not any(other.job.once and other.ended is None for other in others):
        raise InputError(f"{job.name}: {job.needs} is no map, and no mapper is at work on it")
    return False


def _ended(one: _Running, log: Callable[[str], None], respawn: float) -> None:
    code = one.process.returncode if one.process else 0
    name = one.job.name
    if code == _BAD_INPUT or (one.job.once and code != 0):
        one.ended = code
        raise InputError(f"{name}: ended with code {code}; its own message stands above")
    if one.job.once:
        log(f"{name}: done")
        one.ended = code
        return
    log(f"{name}: ended with code {code}, starts again in {respawn:g} s")
    one.due = time.monotonic() + respawn


def _end(jobs: Sequence[_Running], log: Callable[[str], None]) -> None:
    """Asks all to end, waits, kills what does not. Their own children are theirs to end."""
    alive = [one for one in jobs if one.process is not None and one.process.poll() is None]
    for one in alive:
        if one.process is not None:
            one.process.terminate()
    end = time.monotonic() + _PATIENCE
    for one in alive:
        if one.process is None:
            continue
        try:
            one.process.wait(max(0.1, end - time.monotonic()))
        except subprocess.TimeoutExpired:
            log(f"{one.job.name}: does not end, is killed")
            one.process.kill()
            one.process.wait()
