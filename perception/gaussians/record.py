"""Record of a training run: quality curve, decisions of the schedule, seconds by part."""

from __future__ import annotations

from contextlib import AbstractContextManager
from dataclasses import dataclass, field

from perception.progress import timed


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

    def timed(self, part: str) -> AbstractContextManager[None]:
        """Adds the wall-clock seconds of its block to `part` of the profile. A nested block counts in both parts."""
        return timed(self.profile, part)
