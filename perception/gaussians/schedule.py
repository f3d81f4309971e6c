"""Training schedule as a function of progress: next view, densification, spherical harmonics, early stopping.

progress   0 ─ .05 ───── .3 ─ .4 ─── .6 ────────── .9 ── 1
photos     half size          │ full size (small photos: from .15)
features                 │      rendered every 3rd step (`losses.start`, `losses.every`)
growth         densified every 100 steps, holes filled
harmonics                            one more degree per trial, then unneeded degrees are removed
rates                                              cool down
"""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import torch

from perception.gaussians.densify import START, STOP, Statistics, decay_opacities, densify, target_count
from perception.gaussians.early_stopping import TRIAL, EarlyStopping
from perception.gaussians.holes import fill_holes
from perception.gaussians.losses import photometric
from perception.gaussians.rates import COOLDOWN
from perception.gaussians.views import TrainingView, psnr, render_view, visible_in

if TYPE_CHECKING:
    from perception.gaussians.train import Trainer

COARSE_UNTIL, COARSE_UNTIL_SMALL, LARGE = 0.4, 0.15, 400
"""Progress until which photos of half the resolution are used: steps are cheaper, and large structures are fitted.
The first for photos with a long side of LARGE pixels or more: there, until .15 instead takes 28 % more (Gaussian,
pixel) pairs for .1 to .4 dB less. Half of a smaller photo shows too little to start the built-in masks from."""
JUDGED_FROM = 0.25
"""Progress from which growth may end."""
FILL_EVERY = 5
"""Every FILL_EVERY-th densification also adds Gaussians in image regions that the map leaves empty."""
FEATURES_NEED = 0.35
"""Share of training progress for which features are trained before early stopping is allowed."""
SCORED, NOTED = 8, 6
"""Maximum number of held-out views scored at the end of a trial, and for one point of the quality curve."""


class Schedule:
    """Modifies a `Trainer` between its steps; measurements and decisions are kept in `stopping`."""

    def __init__(self, trainer: Trainer):
        self.trainer, self.config = trainer, trainer.config
        self.stopping = EarlyStopping(self.config.train.exchange_db, degree_decided=self.config.train.sh_degree == 0)
        self._order: np.ndarray = np.zeros(0, dtype=np.int64)

    @cached_property
    def _coarse_until(self) -> float:
        long_side = max(max(view.photo.shape[:2]) for view in self.trainer.views)
        return COARSE_UNTIL if long_side >= LARGE else COARSE_UNTIL_SMALL

    def next_view(self, progress: float) -> tuple[TrainingView, bool]:
        """The view of the next step, and whether its features are rendered. Each epoch has a new random order."""
        trainer, losses = self.trainer, self.config.losses
        with_features = trainer.has_labels and progress >= losses.start and trainer.iteration % losses.every == 0
        coarse = losses.half_resolution and (with_features or progress < self._coarse_until)
        epoch, place = divmod(trainer.iteration, len(trainer.views))
        if place == 0 or len(self._order) == 0:
            self._order = np.random.default_rng([self.config.seed, epoch]).permutation(len(trainer.views))
        return (trainer.coarse if coarse else trainer.views)[self._order[place]], with_features

    def grows_at(self, progress: float) -> bool:
        """Whether the gradient statistics of a step are still collected for densification."""
        return self.stopping.growing and progress < STOP

    def after_step(self, progress: float, may_stop: bool) -> None:
        """Runs what is due after the step that began at `progress`. may_stop: early stopping is allowed in this run."""
        trainer, every = self.trainer, self.config.densify.every
        due = trainer.iteration % every == 0
        if due:
            self._densify_and_judge(progress)
        if trainer.iteration % (5 * every) == 0 and trainer.progress < 1.0:
            self._note(progress)
        if due and may_stop:
            self._stop_early()

    def finish(self) -> None:
        """Prunes and records the final quality; called once, when training is complete."""
        self._prune()
        self._note(self.trainer.progress)

    # ------------------------------------------------------- size of the model

    def _densify_and_judge(self, progress: float) -> None:
        trial_ends = self.trainer.progress >= self.stopping.due and not self.stopping.finished
        # PSNR is measured before densification, which lowers it for a while. Measured after it, most trials of a short
        # run showed no gain, and growth ended 0.6 dB too early (tabletop_a).
        reached = self.score(SCORED)["psnr"] if trial_ends else None
        if START <= progress < STOP:
            self._densify(progress)
        if reached is not None:
            self._end_trial(reached)

    def _allowed(self, progress: float) -> int:
        return target_count(progress, self.trainer.initial_count, self.config.train.budget)

    def _densify(self, progress: float) -> None:
        """Clones, splits and prunes while growth is on. Holes are filled also after growth has ended."""
        trainer, config = self.trainer, self.config
        with trainer.record.timed("densification"):
            seed = int(np.random.default_rng([config.seed, trainer.iteration, 2]).integers(2**31))
            if self.stopping.growing:
                self._grow(self._allowed(progress), seed)
            turn = round((progress - START) * config.train.iterations / config.densify.every)
            if turn % FILL_EVERY == 0:
                self._fill(seed)
            trainer.statistics = Statistics.zeros(len(trainer.gaussians), trainer.device)

    def _grow(self, allowed: int, seed: int) -> None:
        trainer = self.trainer
        decay_opacities(trainer.gaussians)
        threshold = self.config.densify.grad_threshold
        change = densify(trainer.gaussians, trainer.statistics, allowed, trainer.extent, threshold, seed, trainer.box)
        trainer.keep(change.keep)
        trainer.append(change.born)

    def _fill(self, seed: int) -> None:
        trainer = self.trainer
        room = self.config.train.budget - len(trainer.gaussians)
        if room > 0:
            born, empty = fill_holes(trainer.gaussians, trainer.coarse, room, seed)
            trainer.append(born)
            if len(born):
                self._tell(f"holes: {empty:.2%} of the pictures were empty, {len(born)} Gaussians placed there")

    def _prune(self) -> None:
        """Removes Gaussians with non-finite values, then those that contribute to no pixel of any training view."""
        trainer = self.trainer
        columns = [tensor.reshape(len(tensor), -1) for tensor in vars(trainer.gaussians).values()]
        self._keep(torch.isfinite(torch.cat(columns, dim=1)).all(dim=1), "whose values are not finite")
        seen = torch.zeros_like(trainer.gaussians.opacity_logits, dtype=torch.bool)
        with trainer.record.timed("evaluation"):
            for view in trainer.views:
                seen |= visible_in(trainer.gaussians, view)
        self._keep(seen, "that no photo sees")

    def _keep(self, wanted: torch.Tensor, which: str) -> None:
        """Keeps the Gaussians where wanted [N] bool is True; `which` describes the others in the record."""
        if not bool(wanted.all()):
            self._tell(f"pruned: {int((~wanted).sum())} Gaussians {which}")
            self.trainer.keep(torch.nonzero(wanted).flatten())
            self.trainer.statistics = Statistics.zeros(len(self.trainer.gaussians), self.trainer.device)

    # ----------------------------------------------------------- early stopping

    def _end_trial(self, reached: float) -> None:
        """Ends a trial at `reached` dB: decides whether growth continues or, after it, on the degree of harmonics."""
        trainer, stopping = self.trainer, self.stopping
        progress, count = trainer.progress, len(trainer.gaussians)
        stopping.due = progress + TRIAL
        stopping.scores.append(reached)
        stopping.counts.append(count)
        if self.grows_at(progress):
            if progress > JUDGED_FROM:
                self._tell(stopping.growth_pays(self._allowed(progress + TRIAL)))
            return
        if stopping.growing:
            stopping.growing = False
            self._tell(f"growth: {count} of at most {self.config.train.budget} Gaussians")
        if not stopping.degree_decided:
            degree, told = stopping.next_degree(
                trainer.gaussians.sh_degree, self.config.train.sh_degree, lambda d: self.score(SCORED, degree=d)["psnr"]
            )
            self._tell(told)
            if degree != trainer.gaussians.sh_degree:
                trainer.set_degree(degree)

    def _stop_early(self) -> None:
        """Skips to the cool-down when more training gains too little."""
        trainer, stopping, progress = self.trainer, self.stopping, self.trainer.progress
        if stopping.finished or not stopping.degree_decided or progress < STOP or not self._may_stop(progress):
            return
        if (reason := stopping.plateau(progress)) is not None:
            stopping.finished, stopping.growing = True, False
            left = 1.0 - COOLDOWN - progress
            trainer.skipped += left
            self._tell(f"{reason}; {left:.0%} of the course left out")

    def _may_stop(self, progress: float) -> bool:
        """Whether early stopping is allowed: features were trained for FEATURES_NEED, and the cool-down is not near."""
        needed = self.config.losses.start + FEATURES_NEED if self.trainer.has_labels else 0.0
        return needed <= progress < 1.0 - COOLDOWN - TRIAL

    def _tell(self, decision: str | None) -> None:
        if decision is not None:
            self.trainer.record.decisions.append(decision)

    # ------------------------------------------------------------------ figures

    def score(self, limit: int, with_ssim: bool = False, degree: int = 3) -> dict[str, float]:
        """Mean PSNR (and SSIM as trained) over at most `limit` held-out views, training views if there are none.

        degree: highest degree of the spherical harmonics that are rendered.
        """
        trainer = self.trainer
        shown = replace(trainer.gaussians, sh=trainer.gaussians.sh[:, : (degree + 1) ** 2].contiguous())
        views = trainer.held_out or trainer.views
        if len(views) > limit:
            views = [views[i] for i in np.linspace(0, len(views) - 1, limit).round().astype(int)]
        figures = []
        with trainer.record.timed("evaluation"):
            for view in views:
                image = render_view(shown, view)
                ssim = [photometric(image, view.photo, 1.0, view.weight).ssim] if with_ssim else []
                figures.append([psnr(image, view.photo, view.weight), *ssim])
        return dict(zip(("psnr", "ssim"), np.mean(figures, axis=0).tolist(), strict=False))

    def _note(self, progress: float) -> None:
        """Appends one point to the quality curve of the record."""
        trainer, figures = self.trainer, self.score(NOTED, with_ssim=True)
        trainer.record.curve.append(
            {
                "iteration": trainer.iteration,
                "seconds": round(trainer.elapsed, 2),
                "gaussians": len(trainer.gaussians),
                "psnr": round(figures["psnr"], 3),
                "ssim": round(figures["ssim"], 4),
                "progress": round(progress, 4),
            }
        )
