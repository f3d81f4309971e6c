"""What a training run tells of itself."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass
class TrainRecord:
    """What training spent and what it bought; JSON-able.

    profile: seconds by part. pairs: contributing (Gaussian, pixel) pairs of all training renders.
    """

    curve: list[dict[str, float]] = field(default_factory=list)
    decisions: list[str] = field(default_factory=list)
    profile: dict[str, float] = field(default_factory=dict)
    pairs: int = 0
    seconds: float = 0.0
    iterations: int = 0
    skipped_gradients: int = 0
