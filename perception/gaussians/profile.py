"""Seconds of training by what they were spent on."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager


class Profile:
    """Wall-clock seconds by part; `seconds` is the dictionary given, so that a record holds it."""

    def __init__(self, seconds: dict[str, float]) -> None:
        self.seconds = seconds

    @contextmanager
    def __call__(self, part: str) -> Iterator[None]:
        """Adds the time of its block to `part`. A block inside another belongs to both: do not nest."""
        start = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[part] = self.seconds.get(part, 0.0) + time.perf_counter() - start
