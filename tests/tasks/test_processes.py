"""What is told of tasks in processes of their own."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest

from perception.errors import InputError
from perception.progress import QUIET
from perception.tasks.engine import run_in_processes

TASKS = """
import os, signal, sys

def task(item):
    print("a warning of a library", file=sys.stderr, flush=True)
    if item == "killed":
        os.kill(os.getpid(), signal.SIGKILL)
    if item == "full":
        print("terminate called\\n  what():  [a.cc:1] SQLite error: database or disk is full", file=sys.stderr)
        sys.stderr.flush()
        os.abort()
    if item == "refused":
        from perception.errors import InputError
        raise InputError("a.jpg: is damaged")
    if item.startswith("long"):
        import pathlib, time
        pathlib.Path(item[5:]).write_text(str(os.getpid()))
        time.sleep(600)
    print("Traceback of an exception that Python ignored", file=sys.stderr)
"""


@pytest.mark.parametrize(
    ("item", "told"),
    [
        ("killed", "ended with code -9; is memory short"),
        ("full", r"code -6 \(\[a\.cc:1\] SQLite error: database or disk is full\)$"),
        ("refused", r"^a\.jpg: is damaged$"),
    ],
)
def test_warnings_of_libraries_hide_no_error(
    item: str, told: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "told_tasks.py").write_text(TASKS)
    monkeypatch.syspath_prepend(tmp_path)
    task = import_module("told_tasks").task
    with pytest.raises(InputError, match=told):
        run_in_processes(task, [item], "matching", QUIET)
    run_in_processes(task, ["done"], "matching", QUIET)


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="asks Linux which processes run")
def test_no_process_outlives_one_that_is_killed(tmp_path: Path) -> None:
    (tmp_path / "told_tasks.py").write_text(TASKS)
    run = (
        "from perception.progress import QUIET; from perception.tasks.engine import run_in_processes; import told_tasks"
    )
    run += f"; run_in_processes(told_tasks.task, ['long {tmp_path / 'pid'}'], 'matching', QUIET)"
    path = os.pathsep.join([str(tmp_path), *sys.path])
    parent = subprocess.Popen([sys.executable, "-c", run], env={**os.environ, "PYTHONPATH": path})
    child = _until(lambda: (tmp_path / "pid").is_file() and (tmp_path / "pid").read_text())
    parent.send_signal(signal.SIGKILL)
    parent.wait()
    _until(lambda: not _runs(int(child)))


def _until(found: Callable[[], Any]) -> Any:
    for _ in range(600):
        if value := found():
            return value
        time.sleep(0.1)
    raise AssertionError("not within a minute")


def _runs(process: int) -> bool:
    try:
        return ") Z " not in Path(f"/proc/{process}/stat").read_text()  # ended, and not yet waited for
    except FileNotFoundError:
        return False
