"""Child processes of tests."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any


def hears_ctrl_c() -> None:
    """For `preexec_fn`: a suite that runs in the background ignores SIGINT, and so would its children."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


SERVER = (
    "import sys; from pathlib import Path; from support.query_maps import encoders\n"
    "from perception.serve.requests import ServeSettings; from perception.serve.server import serve\n"
    "serve(Path(sys.argv[1]), ServeSettings(port=int(sys.argv[2]), timeout=5), encoders=encoders)\n"
)


@contextmanager
def server(command: list[str], folder: Path) -> Iterator[tuple[subprocess.Popen[str], int]]:
    """A started server and its port; killed in the end."""
    environment = {**os.environ, "PYTHONUNBUFFERED": "1"}
    process = subprocess.Popen(
        [sys.executable, *command],
        stderr=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env=environment,
        cwd=folder,
        preexec_fn=hears_ctrl_c,
    )
    try:
        assert process.stderr is not None
        line = process.stderr.readline()
        assert line.startswith("serving "), line + process.stderr.read()
        yield process, int(line.split("://127.0.0.1:")[1].split()[0].partition("/")[0])
    finally:
        process.kill()
        process.communicate()


def served(path: Path, port: int = 0) -> Any:
    return server(["-c", SERVER, str(path), str(port)], path.parent)
