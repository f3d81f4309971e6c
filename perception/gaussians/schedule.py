"""Training schedule as a function of progress: learning rates, next view, densification, harmonics, early stopping.

progress   0 ─ .05 ───── .3 ─ .4 ─── .6 ────────── .9 ── 1
photos     half size          │ full size (small photos: from .15)
features                 │      rendered every 3rd step (`losses.start`, `losses.every`)
growth         densified every 100 steps, holes filled
veils          of few photos: removed every 100 steps, of more every second epoch (see `free_space`)
harmonics                            one more degree per trial, then unneeded degrees are removed
rates                                              decrease to a twentieth

A step of Adam is about as long as the rate, so in fewer iterations a parameter can move less far. The rates of means
and rotations make up for that: they are times sqrt(2000 / iterations).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from perception.gaussians.densify import START, STOP, decay_opacities, densify, fill_holes, target_count
from perception.gaussians.early_stopping import TRIAL
from perception.gaussians.losses import photometric
from perception.gaussians.optimiser import Rate
from perception.gaussians.starved import for_starved_masks
from perception.gaussians.state import ITERATIONS, TrainingState
from perception.gaussians.views import TrainingView, psnr, render_view, visible_in
from perception.machine import return_free_memory

COARSE_UNTIL, COARSE_UNTIL_SMALL, LARGE = 0.4, 0.15, 400
"""Progress until which photos of half the resolution are used, the first from a long side of LARGE pixels on: until .15
there takes 28 % more pairs for .1 to .4 dB less. Half of a smaller photo shows too little for the built-in masks."""
JUDGED_FROM = 0.25  # progress from which growth may end
FILL_EVERY = 5  # every FILL_EVERY-th densification also adds Gaussians in image regions that the map leaves empty
FEATURES_NEED = 0.35  # share of training progress for which features are trained before early stopping is allowed
COOLDOWN = 0.1  # final share of training progress, over which all rates decrease to a twentieth
SCORED, NOTED = 8, 6  # most views that are scored at the end of a trial, and for a point of the quality curve

MEANS, MEANS_LAST = 8e-4, 2e-5
"""Rates of the means at the start and at the end, times the scene extent, for ITERATIONS. Kerbl et al. 2023 have 1.6e-4
and 1.6e-6 for 30,000 iterations."""
QUATS = 4e-3  # for ITERATIONS; for 30,000 it is that of Kerbl et al., 1e-3
LARGEST_FACTOR = 2.0  # largest factor of these rates in shorter runs
SCALES = 1e-2  # of log-scales; twice that of Kerbl et al., as COLORS is; HARMONICS is eight times theirs
OPACITIES = 0.05
COLORS, HARMONICS = 5e-3, 1e-3
FEATURES = 2e-2


def learning_rates(progress: float, extent: float, coefficients: int, iterations: int) -> dict[str, Rate]:
    """Learning rates of the tensors of `Gaussians` at `progress` in [0, 1]; of sh one per entry, [coefficients, 3].

    extent: scene size in world units. coefficients: number of spherical-harmonic coefficients of a Gaussian.
    iterations: of all the training.
    """
    cool, factor = cooling(progress), min(LARGEST_FACTOR, (ITERATIONS / iterations) ** 0.5)
    sh = torch.full((coefficients, 3), cool * HARMONICS)
    sh[0] = cool * COLORS
    return {
        "means": cool * factor * MEANS * (MEANS_LAST / MEANS) ** progress * extent,
        "quats": cool * factor * QUATS,
        "log_scales": cool * SCALES,
        "opacity_logits": cool * OPACITIES,
        "sh": sh,
        "features": cool * FEATURES,
    }


def cooling(progress: float) -> float:
    """Factor of all rates at `progress`: 1, then half a cosine from 1 to 0.05 over the last COOLDOWN of training."""
    if progress <= 1 - COOLDOWN:
        return 1.0
    return 0.05 + 0.95 * 0.5 * (1 + float(np.cos(np.pi * (progress - 1 + COOLDOWN) / COOLDOWN)))


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
        if state.iteration // every % max(1, -(-2 * len(state.views) // every)) == 0:
            _clear_cameras(state)
    if state.iteration % (5 * every) == 0 and state.progress < 1.0:
        _add_to_curve(state, progress)
    if state.progress >= STOP and state.has_labels and not (state.placed or state.held):  # `visits` adds in its own way
        state.placed = True
        _place_in_masks(state)
    if due and may_stop:
        _stop_early(state)


def finish(state: TrainingState) -> None:
    """Prunes and records the final quality; called once, when training is complete."""
    _clear_cameras(state)
    _prune(state)
    _add_to_curve(state, state.progress)


def _densify_and_judge(state: TrainingState, progress: float) -> None:
    trial_ends = state.progress >= state.stopping.due and not state.stopping.finished
    # Before densification, which lowers PSNR for a while: after it, most trials of a short run showed no gain.
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
        begun = (state.iteration - 1) / config.train.iterations  # not `progress`, of which a time limit may decide
        turn = round((begun - START) * config.train.iterations / config.densify.every)
        if turn % FILL_EVERY == 0:
            _fill(state, seed)
        state.arrange()


def _grow(state: TrainingState, allowed: int, seed: int) -> None:
    decay_opacities(state.gaussians, state.held)
    threshold = state.config.densify.grad_threshold
    kept, born = densify(
        state.gaussians, state.statistics, allowed, state.extent, threshold, seed, state.box, state.held
    )
    state.keep(kept)
    state.append(born)


def _fill(state: TrainingState, seed: int) -> None:
    room = state.config.train.budget - len(state.gaussians)
    if room > 0:
        born, empty = fill_holes(state.gaussians, state.coarse, room, seed)
        state.append(born)
        if len(born):
            _note(state, f"holes: {empty:.2%} of the images were empty, {len(born)} Gaussians added there")


def _place_in_masks(state: TrainingState) -> None:
    """Adds Gaussians for masks that have too few; above the budget, the faintest make room."""
    with state.record.timed("densification"):
        seed = int(np.random.default_rng([state.config.seed, state.iteration, 3]).integers(2**31))
        return_free_memory()
        born = for_starved_masks(state.gaussians, state.views, seed)
        return_free_memory()  # a depth image of every photo
        surplus = len(state.gaussians) + len(born) - max(state.config.train.budget, len(state.gaussians))
        if len(born):
            if surplus > 0:
                state.keep(torch.argsort(state.gaussians.opacity_logits, stable=True)[surplus:].sort().values)
            state.append(born.to(state.device))
            _note(state, f"masks: {len(born)} Gaussians added in masks that had too few")


def _clear_cameras(state: TrainingState) -> None:
    """Removes Gaussians around the cameras where nothing was measured; with few photos, see `free_space`."""
    if state.free_space is None:
        return
    veils = torch.from_numpy(state.free_space.reached_by(state.gaussians)).to(state.device)
    if bool(veils.any()):
        state.keep(torch.nonzero(~veils).flatten())


def _prune(state: TrainingState) -> None:
    """Removes Gaussians with non-finite values, then those that contribute to no pixel of any training view."""
    columns = [tensor.reshape(len(tensor), -1) for tensor in state.gaussians.named().values()]
    finite = [torch.isfinite(column).all(dim=1) for column in columns]
    _keep(state, torch.stack(finite).all(dim=0), "whose values are not finite")
    seen = torch.zeros_like(state.gaussians.opacity_logits, dtype=torch.bool)
    seen[: state.held] = True
    with state.record.timed("evaluation"):
        for view in state.views:
            seen |= visible_in(state.gaussians, view)
    _keep(state, seen, "that no photo sees")


def _keep(state: TrainingState, wanted: torch.Tensor, which: str) -> None:
    """Keeps the Gaussians where wanted [N] bool is True; `which` describes the others in the record."""
    if not bool(wanted.all()):
        _note(state, f"pruned: {int((~wanted).sum())} Gaussians {which}")
        state.keep(torch.nonzero(wanted).flatten())


def _end_trial(state: TrainingState, reached: float) -> None:
    """Ends a trial at `reached` dB: decides whether growth continues or, after it, on the degree of harmonics."""
    stopping = state.stopping
    progress, count = state.progress, len(state.gaussians)
    stopping.due = progress + TRIAL
    stopping.scores.append(reached)
    stopping.counts.append(count)
    if grows_at(state, progress):
        if progress > JUDGED_FROM:
            _note(state, stopping.growth_pays(_allowed(state, progress + TRIAL)))
        return
    if stopping.growing:
        stopping.growing = False
        _note(state, f"growth: {count} of at most {state.config.train.budget} Gaussians")
    if not stopping.degree_decided:
        degree, decision = stopping.next_degree(
            state.gaussians.sh_degree, state.config.train.sh_degree, lambda d: score(state, SCORED, degree=d)["psnr"]
        )
        _note(state, decision)
        if degree != state.gaussians.sh_degree:
            state.set_degree(degree)
            return_free_memory()


def _stop_early(state: TrainingState) -> None:
    """Skips to the cool-down when more training gains too little; not before features were trained for FEATURES_NEED,
    and not shortly before the cool-down."""
    stopping, progress = state.stopping, state.progress
    needed = max(STOP, state.config.losses.start + FEATURES_NEED if state.has_labels else 0.0)
    if stopping.finished or not stopping.degree_decided or not needed <= progress < 1.0 - COOLDOWN - TRIAL:
        return
    if (reason := stopping.plateau(progress)) is not None:
        stopping.finished, stopping.growing = True, False
        left = 1.0 - COOLDOWN - progress
        state.skipped += left
        _note(state, f"{reason}; {left:.0%} of the training skipped")


def _note(state: TrainingState, decision: str | None) -> None:
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


def _add_to_curve(state: TrainingState, progress: float) -> None:
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
