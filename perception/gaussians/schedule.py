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

import numpy as np
import torch

from perception.gaussians.densify import START, STOP, decay_opacities, densify, target_count
from perception.gaussians.early_stopping import TRIAL
from perception.gaussians.holes import fill_holes
from perception.gaussians.losses import photometric
from perception.gaussians.rates import COOLDOWN
from perception.gaussians.state import TrainingState
from perception.gaussians.views import TrainingView, psnr, render_view, visible_in

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


def next_view(state: TrainingState, progress: float) -> tuple[TrainingView, bool]:
    """The view of the next step, and whether its features are rendered. Each epoch has a new random order."""
    losses = state.config.losses
    with_features = state.has_labels and progress >= losses.start and state.iteration % losses.every == 0
    coarse = losses.half_resolution and (with_features or progress < coarse_until(state))
    epoch, turn = divmod(state.iteration, len(state.views))
    order = np.random.default_rng([state.config.seed, epoch]).permutation(len(state.views))
    return (state.coarse if coarse else state.views)[order[turn]], with_features


def coarse_until(state: TrainingState) -> float:
    """Progress until which photos of half the resolution are used."""
    return COARSE_UNTIL if state.long_side >= LARGE else COARSE_UNTIL_SMALL


def grows_at(state: TrainingState, progress: float) -> bool:
    """Whether the gradient statistics of a step are still collected for densification."""
    return state.stopping.growing and progress < STOP


def after_step(state: TrainingState, progress: float, may_stop: bool) -> None:
    """Runs what is due after the step that began at `progress`. may_stop: early stopping is allowed in this run."""
    every = state.config.densify.every
    due = state.iteration % every == 0
    if due:
        _densify_and_judge(state, progress)
    if state.iteration % (5 * every) == 0 and state.progress < 1.0:
        _note(state, progress)
    if due and may_stop:
        _stop_early(state)


def finish(state: TrainingState) -> None:
    """Prunes and records the final quality; called once, when training is complete."""
    _prune(state)
    _note(state, state.progress)


def _densify_and_judge(state: TrainingState, progress: float) -> None:
    trial_ends = state.progress >= state.stopping.due and not state.stopping.finished
    # PSNR is measured before densification, which lowers it for a while. Measured after it, most trials of a short
    # run showed no gain, and growth ended 0.6 dB too early (tabletop_a).
    reached = score(state, SCORED)["psnr"] if trial_ends else None
    if START <= progress < STOP:
        _densify(state, progress)
    if reached is not None:
        _end_trial(state, reached)


def _allowed(state: TrainingState, progress: float) -> int:
    return target_count(progress, state.initial_count, state.config.train.budget)


def _densify(state: TrainingState, progress: float) -> None:
    """Clones, splits and prunes while growth is on. Holes are filled also after growth has ended."""
    config = state.config
    with state.record.timed("densification"):
        seed = int(np.random.default_rng([config.seed, state.iteration, 2]).integers(2**31))
        if state.stopping.growing:
            _grow(state, _allowed(state, progress), seed)
        turn = round((progress - START) * config.train.iterations / config.densify.every)
        if turn % FILL_EVERY == 0:
            _fill(state, seed)
        state.reset_statistics()


def _grow(state: TrainingState, allowed: int, seed: int) -> None:
    decay_opacities(state.gaussians)
    threshold = state.config.densify.grad_threshold
    change = densify(state.gaussians, state.statistics, allowed, state.extent, threshold, seed, state.box)
    state.keep(change.keep)
    state.append(change.born)


def _fill(state: TrainingState, seed: int) -> None:
    room = state.config.train.budget - len(state.gaussians)
    if room > 0:
        born, empty = fill_holes(state.gaussians, state.coarse, room, seed)
        state.append(born)
        if len(born):
            _tell(state, f"holes: {empty:.2%} of the pictures were empty, {len(born)} Gaussians placed there")


def _prune(state: TrainingState) -> None:
    """Removes Gaussians with non-finite values, then those that contribute to no pixel of any training view."""
    columns = [tensor.reshape(len(tensor), -1) for tensor in state.gaussians.named().values()]
    _keep(state, torch.isfinite(torch.cat(columns, dim=1)).all(dim=1), "whose values are not finite")
    seen = torch.zeros_like(state.gaussians.opacity_logits, dtype=torch.bool)
    with state.record.timed("evaluation"):
        for view in state.views:
            seen |= visible_in(state.gaussians, view)
    _keep(state, seen, "that no photo sees")


def _keep(state: TrainingState, wanted: torch.Tensor, which: str) -> None:
    """Keeps the Gaussians where wanted [N] bool is True; `which` describes the others in the record."""
    if not bool(wanted.all()):
        _tell(state, f"pruned: {int((~wanted).sum())} Gaussians {which}")
        state.keep(torch.nonzero(wanted).flatten())
        state.reset_statistics()


def _end_trial(state: TrainingState, reached: float) -> None:
    """Ends a trial at `reached` dB: decides whether growth continues or, after it, on the degree of harmonics."""
    stopping = state.stopping
    progress, count = state.progress, len(state.gaussians)
    stopping.due = progress + TRIAL
    stopping.scores.append(reached)
    stopping.counts.append(count)
    if grows_at(state, progress):
        if progress > JUDGED_FROM:
            _tell(state, stopping.growth_pays(_allowed(state, progress + TRIAL)))
        return
    if stopping.growing:
        stopping.growing = False
        _tell(state, f"growth: {count} of at most {state.config.train.budget} Gaussians")
    if not stopping.degree_decided:
        degree, told = stopping.next_degree(
            state.gaussians.sh_degree, state.config.train.sh_degree, lambda d: score(state, SCORED, degree=d)["psnr"]
        )
        _tell(state, told)
        if degree != state.gaussians.sh_degree:
            state.set_degree(degree)


def _stop_early(state: TrainingState) -> None:
    """Skips to the cool-down when more training gains too little."""
    stopping, progress = state.stopping, state.progress
    if stopping.finished or not stopping.degree_decided or progress < STOP or not _may_stop(state, progress):
        return
    if (reason := stopping.plateau(progress)) is not None:
        stopping.finished, stopping.growing = True, False
        left = 1.0 - COOLDOWN - progress
        state.skipped += left
        _tell(state, f"{reason}; {left:.0%} of the course left out")


def _may_stop(state: TrainingState, progress: float) -> bool:
    """Whether early stopping is allowed: features were trained for FEATURES_NEED, and the cool-down is not near."""
    needed = state.config.losses.start + FEATURES_NEED if state.has_labels else 0.0
    return needed <= progress < 1.0 - COOLDOWN - TRIAL


def _tell(state: TrainingState, decision: str | None) -> None:
    if decision is not None:
        state.record.decisions.append(decision)


def score(state: TrainingState, limit: int, with_ssim: bool = False, degree: int = 3) -> dict[str, float]:
    """Mean PSNR (and SSIM as trained) over at most `limit` held-out views, training views if there are none.

    degree: highest degree of the spherical harmonics that are rendered.
    """
    shown = replace(state.gaussians, sh=state.gaussians.sh[:, : (degree + 1) ** 2].contiguous())
    views = state.held_out or state.views
    if len(views) > limit:
        views = [views[i] for i in np.linspace(0, len(views) - 1, limit).round().astype(int)]
    figures = []
    with state.record.timed("evaluation"):
        for view in views:
            image = render_view(shown, view)
            ssim = [photometric(image, view.photo, 1.0, view.weight).ssim] if with_ssim else []
            figures.append([psnr(image, view.photo, view.weight), *ssim])
    return dict(zip(("psnr", "ssim"), np.mean(figures, axis=0).tolist(), strict=False))


def _note(state: TrainingState, progress: float) -> None:
    """Appends one point to the quality curve of the record."""
    figures = score(state, NOTED, with_ssim=True)
    state.record.curve.append(
        {
            "iteration": state.iteration,
            "seconds": round(state.elapsed, 2),
            "gaussians": len(state.gaussians),
            "psnr": round(figures["psnr"], 3),
            "ssim": round(figures["ssim"], 4),
            "progress": round(progress, 4),
        }
    )
