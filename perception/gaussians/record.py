"""Record of a training run: quality curve, decisions of the schedule, seconds by part."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field


@dataclass
class TrainRecord:
    """JSON-able. profile: wall-clock seconds by part.

    pairs, evaluated_pairs: (Gaussian, pixel) pairs of all training steps that contributed, that were computed.
    """

    curve: list[dict[str, float]] = field(default_factory=list)
    decisions: list[str] = field(default_factory=list)
    profile: dict[str, float] = field(default_factory=dict)
    pairs: int = 0
    evaluated_pairs: int = 0
    seconds: float = 0.0
    iterations: int = 0
    skipped_gradients: int = 0

    @contextmanager
    def timed(self, part: str) -> Iterator[None]:
        """Adds the wall-clock seconds of its block to `part` of the profile. A nested block counts in both parts."""
        start = time.perf_counter()
        try:
            yield
        finally:
            self.profile[part] = self.profile.get(part, 0.0) + time.perf_counter() - start
