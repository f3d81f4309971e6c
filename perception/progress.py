"""What a person sees of long work: a bar on a terminal, plain log lines elsewhere; all of it on stderr."""

from __future__ import annotations

import sys
import time
from typing import Any


class Progress:
    """Reports stages. `quiet` silences everything (library use)."""

    def __init__(self, quiet: bool = False, stream: Any = None):
        self.stream = stream or sys.stderr
        self.quiet = quiet
        self.terminal = not quiet and hasattr(self.stream, "isatty") and self.stream.isatty()
        self._bar: Any = None
        self._last = 0.0

    def log(self, text: str) -> None:
        """One line, shown at once."""
        if self.quiet:
            return
        if self._bar is not None:
            self._bar.clear()
        print(text, file=self.stream, flush=True)

    def update(self, stage: str, done: int, total: int, **figures: object) -> None:
        """Where a stage stands; elsewhere than on a terminal a line every ten seconds and at the end."""
        if self.quiet:
            return
        if self.terminal:
            self._draw(stage, done, total, figures)
            return
        now = time.monotonic()
        if done >= total or now - self._last >= 10:
            self._last = now
            told = "  ".join(f"{name} {value}" for name, value in figures.items())
            print(f"{stage}: {done}/{total}  {told}".rstrip(), file=self.stream, flush=True)

    def _draw(self, stage: str, done: int, total: int, figures: dict[str, object]) -> None:
        from tqdm import tqdm

        if self._bar is None or self._bar.desc != f"{stage}: ":
            self.close()
            self._bar = tqdm(total=total, desc=stage, file=self.stream, dynamic_ncols=True, leave=True)
        self._bar.total = total
        self._bar.set_postfix(figures, refresh=False)
        self._bar.update(done - self._bar.n)
        if done >= total:
            self.close()

    def close(self) -> None:
        """Ends the bar, if there is one."""
        if self._bar is not None:
            self._bar.close()
            self._bar = None
