"""What a person at a terminal sees of a run, and what Ctrl-C leaves, on a pseudo-terminal; streams that end."""

from __future__ import annotations

import contextlib
import os
import re
import shlex
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from perception.interrupts import ends_as_ctrl_c
from support.processes import hears_ctrl_c

pty = pytest.importorskip("pty")  # not on Windows

COLUMNS = 80
LINE = re.compile(r"train: +\d+%, loss \d+\.\d+, (\d+\.\d|-) dB, [\d.]+k Gaussians, [\d.]+ it/s, \d+ s left, \d+ MiB")


class Terminal:
    """A command on a pseudo-terminal of 80 columns."""

    def __init__(self, words: list[str], cwd: Path):
        import fcntl
        import struct
        import termios

        self.master, slave = pty.openpty()
        fcntl.ioctl(slave, termios.TIOCSWINSZ, struct.pack("HHHH", 24, COLUMNS, 0, 0))
        self.process = subprocess.Popen(
            [sys.executable, "-m", "perception.cli", *words],
            cwd=cwd,
            stdin=slave,
            stdout=slave,
            stderr=slave,
            start_new_session=True,
            preexec_fn=hears_ctrl_c,
        )
        os.close(slave)
        self.text = ""

    def until(self, pattern: str | None, seconds: float = 120) -> None:
        """Reads until `pattern` was written, or with None until the end."""
        end = time.monotonic() + seconds
        while pattern is None or not re.search(pattern, self.text):
            assert time.monotonic() < end, self.text[-2000:]
            try:
                block = os.read(self.master, 4096)
            except OSError:  # Linux: the other side is closed
                block = b""
            if not block:
                assert pattern is None, self.text[-2000:]
                self.process.wait(30)
                return
            self.text += block.decode(errors="replace")

    def close(self) -> None:
        with contextlib.suppress(ProcessLookupError):
            self.process.kill()
        self.process.wait()
        os.close(self.master)


@pytest.mark.slow
def test_a_live_line_then_ctrl_c_then_the_printed_command_goes_on(small_scene: Path, tmp_path: Path) -> None:
    words = ["map", str(small_scene / "transforms.json"), "-o", "k.gsmap", "--masks", f"labels:{small_scene}/labels"]
    words += ["--iterations", "2000", "--budget", "1500"]  # several draws, each half a second, on any machine
    words += ["--set", "language.encoder=none", "--set", "train.exchange_db=0"]
    first = Terminal(words, tmp_path)
    try:
        first.until(r"train: +[1-9]\d?%, .*\d MiB")
        first.process.send_signal(signal.SIGINT)
        first.until(None)
        assert first.process.returncode == 130
    finally:
        first.close()
    shown = [part for line in first.text.split("\n") for part in line.split("\r")]
    live = [line for line in shown if line.startswith("train:")]
    assert sum(bool(LINE.match(line)) for line in live) >= 1, live[-3:]
    assert max(len(line.rstrip()) for line in live) <= COLUMNS
    drawn = [[part for part in line.split("\r") if "%" in part] for line in first.text.split("\n")]
    stages = [parts[-1].split(":")[0] for parts in drawn if parts]
    assert stages.count("train") == 1, stages  # it draws on one line, again and again
    assert "Traceback" not in first.text
    told = re.search(r"interrupted; what was done is kept, go on with: perception (.*--resume)", first.text)
    assert told is not None, first.text[-500:]

    again = Terminal(shlex.split(told[1]), tmp_path)
    try:
        again.until(None)
        assert again.process.returncode == 0, again.text[-1000:]
    finally:
        again.close()
    resumed = re.search(r"resuming at iteration (\d+)", again.text)
    assert resumed is not None and 0 < int(resumed[1]) < 2000
    assert (tmp_path / "k.gsmap" / "map.json").is_file()


def test_elsewhere_than_on_a_terminal_whole_lines(capsys: pytest.CaptureFixture[str]) -> None:
    from perception.progress import Progress

    progress = Progress()
    for done in range(3):
        progress.update("masks", done, 2, "a", "b")
    assert capsys.readouterr().err.splitlines()[-1] == "masks: 2/2  a  b"


@pytest.mark.parametrize("terminal", [True, False])
def test_work_goes_on_when_nobody_reads_what_it_says(terminal: bool) -> None:
    code = (
        "import sys; from perception.progress import Progress, say\n"
        "with Progress() as progress:\n"
        "    print(progress.terminal, flush=True); sys.stdin.readline()\n"
        "    progress.log('a'); progress.update('b', 1, 2); progress.update('b', 2, 2); progress.log('c')\n"
        "say('d'); print('done')\n"
    )
    reader, writer = pty.openpty() if terminal else os.pipe()
    streams: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": writer, "text": True}
    work = subprocess.Popen([sys.executable, "-c", code], **streams)
    os.close(writer)
    assert work.stdout is not None
    assert work.stdout.readline() == f"{terminal}\n"
    os.close(reader)
    assert (work.communicate("\n", 60)[0], work.returncode) == ("done\n", 0)


def test_closed_streams_are_not_written_to_files(tmp_path: Path) -> None:
    code = (
        "import os, sys; from perception.cli import main\n"
        "code = main(['info', 'nothing']); file = open('file', 'wb')\n"
        "os.write(2, b'of a library'); print(code, file.fileno() > 2)\n"
    )
    closed = ["sh", "-c", 'exec "$@" 2>&-', "sh", sys.executable, "-c", code]
    done = subprocess.run(closed, cwd=tmp_path, capture_output=True, text=True, timeout=60, check=True)
    assert (done.stdout, (tmp_path / "file").read_bytes()) == ("2 True\n", b"")


@pytest.mark.parametrize("nohup", [True, False])
def test_a_closed_terminal_is_ctrl_c_but_under_nohup(nohup: bool) -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN if nohup else signal.SIG_DFL)
    try:
        with contextlib.nullcontext() if nohup else pytest.raises(KeyboardInterrupt), ends_as_ctrl_c():
            signal.raise_signal(signal.SIGHUP)
    finally:
        signal.signal(signal.SIGHUP, before)
