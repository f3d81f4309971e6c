"""What is said on stderr: progress of long computations, a bar on a terminal, log lines elsewhere; seconds by part."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, TextIO

LINE = "{desc}{percentage:3.0f}%{postfix}  {bar}"
"""Format of tqdm's line. tqdm's own rate and remaining time are omitted, as they are wrong for a resumed run."""


def say(text: str) -> None:
    """Prints one line on stderr at once."""
    with outlasting(sys.stderr):
        print(text, file=sys.stderr, flush=True)


@contextmanager
def outlasting(stream: TextIO) -> Iterator[None]:
    """Lets the work go on if output within it fails, as its terminal or pipe is closed, or its disk full: this and all
    later output of the stream is dropped."""
    try:
        yield
    except OSError:
        mute(stream)


def mute(stream: TextIO) -> None:
    """Sends what is written to a standard stream to the null device, also what waits there for Python's end."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, stream.fileno())
    os.close(nowhere)


@contextmanager
def timed(seconds: dict[str, float], part: str) -> Iterator[None]:
    """Adds the wall-clock seconds of its block to `part` of `seconds`."""
    start = time.perf_counter()
    try:
        yield
    finally:
        seconds[part] = seconds.get(part, 0.0) + time.perf_counter() - start


class Progress:
    """Displays the progress of stages. quiet: no output, for use as a library."""

    def __init__(self, quiet: bool = False):
        self.stream, self.quiet = sys.stderr, quiet
        self.terminal = not quiet and hasattr(self.stream, "isatty") and self.stream.isatty()
        self._bar: Any = None
        self._last = 0.0

    def __enter__(self) -> Progress:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()  # so that the next output, for example after Ctrl-C, starts on a new line

    def log(self, text: str) -> None:
        """Prints one line at once."""
        if self.quiet:
            return
        with outlasting(self.stream):
            if self._bar is not None:
                self._bar.clear()
            print(text, file=self.stream, flush=True)

    def update(self, stage: str, done: int, total: int, *figures: str) -> None:
        """Shows the state of a stage; without a terminal, prints a line every ten seconds and at the end."""
        if self.terminal:
            with outlasting(self.stream):
                self._draw(stage, done, total, figures)
        elif not self.quiet and (done >= total or time.monotonic() - self._last >= 10):
            self._last = time.monotonic()
            self.log("  ".join([f"{stage}: {done}/{total}", *figures]))

    def _draw(self, stage: str, done: int, total: int, figures: tuple[str, ...]) -> None:
        from tqdm import tqdm

        starts = self._bar is None or self._bar.desc != f"{stage}: "
        if starts:
            self.close()
            self._bar = tqdm(total=total, desc=f"{stage}: ", file=self.stream, dynamic_ncols=True, bar_format=LINE)
        self._bar.total = total
        self._bar.set_postfix_str(", ".join(figures or (f"{done}/{total}",)), refresh=False)
        self._bar.update(done - self._bar.n)
        if starts or done >= total:  # tqdm itself draws nothing in a bar's first tenth of a second
            self._bar.refresh()
        if done >= total:
            self.close()

    def close(self) -> None:
        """Ends the bar, if there is one."""
        if self._bar is not None:
            with outlasting(self.stream):
                self._bar.close()
            self._bar = None


QUIET = Progress(quiet=True)
