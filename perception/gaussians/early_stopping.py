"""Early stopping of growth, of spherical harmonics and of training, by the PSNR gained per training time.

Training progress is divided into trials of 5 %. At the end of each trial PSNR is measured on held-out views, or on
training views if there are none. Time is counted in iterations, so that runs are repeatable. `train.exchange_db` is the
gain in dB required of 10 % more time.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

TRIAL = 0.05  # length of a trial, as a share of training progress
CEILING = 45.0  # dB of PSNR up to which gains count: an RMS error of 1.4 of 255, below a photo's noise
COST_EXPONENT = 0.6  # the time of an iteration grows with the number of Gaussians to this power (tools/speed/fronts.py)
HARMONICS_GAIN = 0.05  # least gain in held-out PSNR, in dB, for which the highest degree of harmonics is kept


@dataclass
class EarlyStopping:
    """Measurements and decisions so far. All fields are plain values and are stored in the checkpoint.

    required_db: gain in dB required of 10 % more time. scores, counts: PSNR in dB and number of Gaussians at the end of
    each trial. growing: Gaussians may be added. degree_decided: the degree of harmonics is final. finished: only the
    cool-down is left. due: progress at which the next trial ends.
    """

    required_db: float
    scores: list[float] = field(default_factory=list)
    counts: list[int] = field(default_factory=list)
    growing: bool = True
    degree_decided: bool = False
    finished: bool = False
    due: float = TRIAL

    def gain(self) -> float | None:
        """Gain of the best PSNR over the last two trials in dB, counted up to CEILING; None before three trials."""
        if len(self.scores) < 3:
            return None
        return min(max(self.scores), CEILING) - min(max(self.scores[:-2]), CEILING)

    def growth_pays(self, allowed: int) -> str | None:
        """None while growth is worthwhile, else the reason it ends. allowed: most Gaussians after the next trial.

        The PSNR gain of the last two trials includes that of training alone, so it is an upper bound for that of
        growth. Growth ends when the bound is below the gain required for the next trial's extra time. The next trial
        is assumed to add as many Gaussians as the last one, which can be far fewer than allowed.
        """
        gain = self.gain()
        if gain is None:
            return None
        before, gaussians = self.counts[-2:]
        next_count = min(allowed, 2 * gaussians - before)
        if next_count <= gaussians:
            return None
        tenths = ((next_count / gaussians) ** COST_EXPONENT - 1) / 0.1
        required = self.required_db * tenths
        if gain / 2 >= required:
            return None
        self.growing = False
        return f"growth: ended at {gaussians} Gaussians, a trial gains {gain / 2:.3f} of {required:.3f} dB required"

    def plateau(self, progress: float) -> str | None:
        """Why training should end early, after a few steps at falling rates; None while it still gains enough."""
        gain = self.gain()
        if gain is None:
            return None
        tenths = 2 * TRIAL / (0.1 * progress)
        if gain >= self.required_db * tenths:
            return None
        return f"stop: 10 % more time gains {gain / tenths:.3f} of {self.required_db:g} dB required"

    def next_degree(self, degree: int, highest: int, score: Callable[[int], float]) -> tuple[int, str | None]:
        """The degree of spherical harmonics after a trial, and the decision as text, or None.

        Each trial adds one degree up to `highest`. One trial after the last, `score` gives the held-out PSNR with the
        colours truncated to a degree. The highest degree is removed while it gains less than HARMONICS_GAIN. The gain
        in a degree's first trial is not used: harmonics converge slowly, and the lower degrees still adapt to them.
        """
        if degree < highest:
            return degree + 1, None
        self.degree_decided = True
        worth = [score(d) for d in range(degree + 1)]
        kept = degree
        while kept and worth[kept] - worth[kept - 1] < HARMONICS_GAIN:
            kept -= 1
        figures = ", ".join(f"{psnr:.2f}" for psnr in worth)
        return kept, f"harmonics: degree {kept} kept; cut to 0 to {degree}, held-out PSNR is {figures} dB"
