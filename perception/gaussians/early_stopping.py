"""Early stopping: growth, harmonics and iterations end when what they gain no longer pays for their time.

The course of training is cut into trials of 5 %. At the end of each the held-out PSNR is taken (of training views where
nothing is held out). Time is counted in iterations, so that a run repeats. `train.exchange_db` is the dB that 10 % more
time must gain.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

TRIAL = 0.05
"""Length of a trial, as a share of the whole course."""
CEILING = 45.0
"""dB beyond which nothing is gained: errors of 1.4 grey levels of 255, less than a photo's own noise."""
COST_EXPONENT = 0.6
"""An iteration's time grows like the number of Gaussians to this power (`perception bench scaling`)."""
HARMONICS_GAIN = 0.05
"""dB of held-out PSNR that the highest degree of harmonics must be worth to stay."""


@dataclass
class EarlyStopping:
    """What was measured and decided so far; its fields are plain values and go into a checkpoint as they are.

    asked_db: dB that 10 % more time must gain. scores, counts: PSNR in dB and number of Gaussians at the end of each
    trial. growing: Gaussians may be added. degree_decided: the degree of harmonics is final. finished: only the
    cool-down is left. due: progress at which the next trial ends.
    """

    asked_db: float
    scores: list[float] = field(default_factory=list)
    counts: list[int] = field(default_factory=list)
    growing: bool = True
    degree_decided: bool = False
    finished: bool = False
    due: float = TRIAL

    def gain(self) -> float | None:
        """dB that the best PSNR gained over the last two trials, up to CEILING; None before there are three."""
        if len(self.scores) < 3:
            return None
        return min(max(self.scores), CEILING) - min(max(self.scores[:-2]), CEILING)

    def growth_pays(self, allowed: int) -> str | None:
        """None while growth pays; else why it ends. allowed: Gaussians at the end of the next trial, at most.

        All that two trials gained, by growth and by training alone, bounds what growth gained in them; when even that
        is less than the next trial's growth costs, growth does not pay. The next trial is taken to add as many as the
        last: where little wants to grow, far fewer than are allowed.
        """
        gain = self.gain()
        if gain is None:
            return None
        before, gaussians = self.counts[-2:]
        next_count = min(allowed, 2 * gaussians - before)
        if next_count <= gaussians:
            return None
        tenths = ((next_count / gaussians) ** COST_EXPONENT - 1) / 0.1
        asked = self.asked_db * tenths
        if gain / 2 >= asked:
            return None
        self.growing = False
        return f"growth: ended at {gaussians} Gaussians, a trial gains {gain / 2:.3f} dB and {asked:.3f} are asked"

    def plateau(self, progress: float) -> str | None:
        """Why training may cool down now; None while it still pays."""
        gain = self.gain()
        if gain is None:
            return None
        tenths = 2 * TRIAL / (0.1 * progress)
        if gain >= self.asked_db * tenths:
            return None
        return f"stop: 10 % more time gains {gain / tenths:.3f} dB, {self.asked_db:g} are asked"

    def next_degree(self, degree: int, highest: int, score: Callable[[int], float]) -> tuple[int, str | None]:
        """The degree of harmonics to go on with after a trial, and what was decided, if anything.

        A trial adds a degree up to `highest`. One trial after the last, `score` gives the held-out PSNR with the
        colours cut to a degree, and the highest degree goes while it is worth less than HARMONICS_GAIN. What a degree
        gains in its own first trial says little: harmonics learn slowly, and the others make room.
        """
        if degree < highest:
            return degree + 1, None
        self.degree_decided = True
        worth = [score(d) for d in range(degree + 1)]
        kept = degree
        while kept and worth[kept] - worth[kept - 1] < HARMONICS_GAIN:
            kept -= 1
        told = ", ".join(f"{psnr:.2f}" for psnr in worth)
        return kept, f"harmonics: degree {kept} kept; cut to 0 to {degree}, held-out PSNR is {told} dB"
