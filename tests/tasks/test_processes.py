"""What is told of tasks in processes of their own."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path

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
