"""Optimises Gaussians against photos and masks: L = L_RGB + λ_inst L_inst2D + λ_var L_var (OpenSplat3D §3.2).

Every schedule is driven by progress in [0, 1], the larger of iterations done and time spent, so a time limit shortens
the whole course instead of cutting its end. Randomness is a function of (seed, iteration): a run resumed from a
checkpoint takes the very steps the interrupted one would have taken.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from perception.config import MapConfig
from perception.gaussians.densify import START, STOP, Statistics, decay_opacities, densify, target_count
from perception.gaussians.economy import TRIAL, Economy
from perception.gaussians.holes import fill_holes
from perception.gaussians.losses import instance_loss, photometric, photometric_loss, variance_loss
from perception.gaussians.model import Gaussians, sigmoid
from perception.gaussians.optimiser import SparseAdam
from perception.gaussians.profile import Profile
from perception.gaussians.rasterize import Rasterization, rasterize
from perception.gaussians.rates import COOLDOWN, learning_rates
from perception.gaussians.record import TrainRecord
from perception.gaussians.views import TrainingView, depth_image, psnr, render_view, scene_extent, visible_in

__all__ = ["TrainRecord", "Trainer", "TrainingView", "depth_image", "psnr", "render_view", "scene_extent"]

COARSE_UNTIL = 0.15
"""Progress until which photos of half the resolution are trained on: cheaper, and large structures come first."""
SSIM_WEIGHT = 0.2
"""β of the photometric loss (eq. 4), as in Kerbl et al. 2023."""
INSTANCE_WEIGHT = 0.1
"""λ_inst2d of eq. 14; w_p = w_n = 1 in eq. 9."""
FILL_EVERY = 5
"""In every so many-th densification, places that the photos show and the map leaves empty get Gaussians."""


class Trainer:
    """Holds all state of one optimisation; `state` and `load` round-trip it through a checkpoint."""

    def __init__(
        self, gaussians: Gaussians, views: list[TrainingView], config: MapConfig, held_out: list[TrainingView]
    ):
        self.config = config
        self.held_out = held_out
        self.extent = scene_extent(views)
        self.record = TrainRecord()
        self.profile = Profile(self.record.profile)
        self.economy = Economy(config, settled=config.train.sh_degree == 0)
        self.iteration = 0
        self._jump = 0.0
        self.initial_count = len(gaussians)
        self.gaussians = gaussians
        self.statistics = Statistics.zeros(len(gaussians))
        self.optimiser = SparseAdam(vars(gaussians), self._rates(0.0))
        self.coarse: list[TrainingView] = []
        self.has_labels = False
        self.show(views)
        self._since: float | None = None  # when the leg that runs began
        self._order: np.ndarray = np.zeros(0, dtype=np.int64)

    def show(self, views: list[TrainingView]) -> None:
        """Trains on `views` from here on: the same photos, whose masks may have come since."""
        self.views = views
        self.has_labels = any(view.labels is not None and bool((view.labels > 0).any()) for view in views)
        self.coarse = [view.halved() for view in views]

    # ------------------------------------------------------------------ state

    def _rates(self, progress: float) -> dict[str, float | torch.Tensor]:
        return learning_rates(progress, self.extent, self.gaussians.sh.shape[1])

    @property
    def elapsed(self) -> float:
        """Seconds of training: those before a resume counted in, those between two legs (masks are made then) not."""
        return self.record.seconds + (0.0 if self._since is None else time.monotonic() - self._since)

    @property
    def progress(self) -> float:
        share = self.iteration / self.config.train.iterations + self._jump
        limit = self.config.train.time_limit
        return min(1.0, share if limit is None else max(share, self.elapsed / limit))

    @property
    def expected_iterations(self) -> int:
        """How many iterations the run will have had, as far as can be told now."""
        share = self.iteration / self.config.train.iterations + self._jump
        if self.progress > share:  # the clock rules
            return max(self.iteration, round(self.iteration / max(self.progress, 1e-6)))
        return round(self.iteration + (1 - self.progress) * self.config.train.iterations)

    def state(self) -> dict[str, Any]:
        """Everything a resumed run needs."""
        return {
            "iteration": self.iteration,
            "initial_count": self.initial_count,
            "optimiser": self.optimiser.state_dict(),
            "statistics": vars(self.statistics),
            "record": dict(vars(self.record), seconds=self.elapsed, iterations=self.iteration),
            "economy": self.economy.state(),
            "jump": self._jump,
        }

    def load(self, state: dict[str, Any]) -> None:
        """Takes up a run from `state()`."""
        self._restart_optimiser(state["optimiser"])
        self.statistics = Statistics(**state["statistics"])
        self.record = TrainRecord(**state["record"])
        self.iteration = state["iteration"]
        self.initial_count = state["initial_count"]
        self.profile = Profile(self.record.profile)
        self.economy.load(state["economy"])
        self._jump = state["jump"]

    def _restart_optimiser(self, state: dict[str, Any]) -> None:
        self.gaussians = Gaussians(**state["params"])
        self.optimiser = SparseAdam(vars(self.gaussians), self._rates(0.0))
        self.optimiser.load_state_dict(state)
        self._sync()

    def _sync(self) -> None:
        """The optimiser owns the tensors; the model is a view of them."""
        self.gaussians = Gaussians(**{name: tensor.detach() for name, tensor in self.optimiser.params.items()})

    # ------------------------------------------------------------------ steps

    def run(self, on_step: Callable[[Trainer, dict[str, float]], None], until: float = 1.0) -> TrainRecord:
        """Trains until progress `until`; `on_step` sees every iteration (progress bars, checkpoints)."""
        self._since = time.monotonic()
        try:
            while self.progress < until:
                figures = self.step()
                if until >= 1.0:  # a leg that something waits for is not cut short
                    self._stop_early()
                on_step(self, figures)
        finally:
            self.record.seconds, self.record.iterations = self.elapsed, self.iteration
            self._since = None
        return self.record

    def step(self) -> dict[str, float]:
        """One iteration: a view, its losses, Adam, and now and then densification or one harmonic more."""
        progress = self.progress
        losses_config = self.config.losses
        with_features = (
            self.has_labels and progress >= losses_config.start and self.iteration % losses_config.every == 0
        )
        coarse = progress < COARSE_UNTIL or (with_features and losses_config.half_resolution)
        view = self._pick(coarse)
        losses = self._descend(view, progress, with_features)
        self.iteration += 1
        every = self.config.densify.every
        if self.iteration % every == 0:
            due = self.progress >= self.economy.due and not self.economy.finished
            # Before densification, which sets the picture back for a while: a score taken then says nothing of growth.
            reached = self.score(limit=8)["psnr"] if due else None
            if START <= progress < STOP:
                self._densify(progress)
            if reached is not None:
                self._end_trial(reached)
        if self.progress >= 1.0:
            self._prune_unseen()
        if self.iteration % (5 * every) == 0 or self.progress >= 1.0:
            self._note(progress)
        return losses

    def _pick(self, coarse: bool) -> TrainingView:
        epoch, place = divmod(self.iteration, len(self.views))
        if place == 0 or len(self._order) == 0:
            self._order = np.random.default_rng([self.config.seed, epoch]).permutation(len(self.views))
        return (self.coarse if coarse else self.views)[self._order[place]]

    def _descend(self, view: TrainingView, progress: float, with_features: bool) -> dict[str, float]:
        params = {name: tensor.detach().requires_grad_() for name, tensor in vars(self.gaussians).items()}
        with self.profile("rasterizer forward"):
            out = self._render(params, view, with_features)
        with self.profile("losses"):
            loss = photometric_loss(out.colors[0], view.photo, SSIM_WEIGHT)
            figures = {"rgb": float(loss.detach())}
            if with_features:
                loss = loss + self._feature_losses(view, out, figures)
            images = [image for image in (out.colors, out.features, out.feature_variance) if image is not None]
            cotangents = torch.autograd.grad(loss, images, allow_unused=True)
        with self.profile("rasterizer backward"):
            used = [(image, grad) for image, grad in zip(images, cotangents, strict=True) if grad is not None]
            torch.autograd.backward([image for image, _ in used], [grad for _, grad in used])
        visible = out.visible[0]
        with self.profile("Adam"):
            gradients = {name: tensor.grad for name, tensor in params.items() if tensor.grad is not None}
            self.optimiser.rates = self._rates(progress)
            self.record.skipped_gradients += sum(self.optimiser.step(visible, gradients).skipped.values())
        if self.economy.growing and progress < STOP and out.stats.mean2d_grad is not None:
            with self.profile("densification"):
                self._watch(view, out)
        self.record.pairs += out.stats.contributing_pairs
        figures["loss"] = float(loss.detach())
        return figures

    def _render(self, params: dict[str, torch.Tensor], view: TrainingView, with_features: bool) -> Rasterization:
        height, width = view.photo.shape[:2]
        colors = np.random.default_rng([self.config.seed, self.iteration, 1]).random(3, dtype=np.float32)
        return rasterize(
            params["means"],
            params["quats"],
            params["log_scales"].exp(),
            sigmoid(params["opacity_logits"]),
            params["sh"],
            view.camera_from_world[None],
            view.K[None],
            width,
            height,
            sh_degree=self.gaussians.sh_degree,
            features=params["features"] if with_features else None,
            background=torch.from_numpy(colors),
            depth=False,
            eps2d=view.eps2d,
        )

    def _watch(self, view: TrainingView, out: Rasterization) -> None:
        assert out.stats.mean2d_grad is not None
        long_side = max(view.photo.shape[:2])
        self.statistics.add(out.stats.mean2d_grad[0], out.stats.radii[0], out.visible[0], long_side)

    def _feature_losses(self, view: TrainingView, out: Any, figures: dict[str, float]) -> torch.Tensor:
        losses = self.config.losses
        variance = variance_loss(out.feature_variance[0])
        figures["var"] = float(variance.detach())
        total = losses.variance_weight * variance
        if view.labels is None:
            return total
        instance = instance_loss(
            out.features[0],
            view.labels,
            margin=losses.margin,
            per_pixel=losses.positive == "per-pixel",
            squared=losses.negative == "squared",
        )
        figures["inst"] = float(instance.value.detach())
        return total + INSTANCE_WEIGHT * instance.value

    # ------------------------------------------------------- size of the model

    def _allowed(self, progress: float) -> int:
        return target_count(progress, self.initial_count, self.config.train.budget)

    def _densify(self, progress: float) -> None:
        """Growth while it pays; holes are filled all the same."""
        config = self.config
        with self.profile("densification"):
            seed = int(np.random.default_rng([config.seed, self.iteration, 2]).integers(2**31))
            if self.economy.growing:
                self._grow(self._allowed(progress), seed)
            turn = round((progress - START) * config.train.iterations / config.densify.every)
            if turn % FILL_EVERY == 0:
                self._fill(seed)
            self.statistics = Statistics.zeros(len(self.gaussians))

    def _grow(self, allowed: int, seed: int) -> None:
        decay_opacities(self.gaussians)
        change = densify(
            self.gaussians, self.statistics, allowed, self.extent, self.config.densify.grad_threshold, seed
        )
        self.optimiser.keep(change.keep)
        self.optimiser.append(vars(change.born))
        self._sync()

    def _fill(self, seed: int) -> None:
        room = self.config.train.budget - len(self.gaussians)
        if room > 0:
            born, empty = fill_holes(self.gaussians, self.coarse, room, seed)
            self.optimiser.append(vars(born))
            self._sync()
            if len(born):
                self._decide(f"holes: {empty:.2%} of the pictures were empty, {len(born)} Gaussians placed there")

    def _prune_unseen(self) -> None:
        """Drops at the end what adds to no photo: no training view's picture changes by it."""
        seen = torch.zeros(len(self.gaussians), dtype=torch.bool)
        with self.profile("evaluation"):
            for view in self.views:
                seen |= visible_in(self.gaussians, view)
        if not bool(seen.all()):
            self._decide(f"pruned: {int((~seen).sum())} Gaussians that no photo sees")
            self.optimiser.keep(torch.nonzero(seen).flatten())
            self._sync()
            self.statistics = Statistics.zeros(len(self.gaussians))

    # ---------------------------------------------------------------- economy

    def _end_trial(self, reached: float) -> None:
        """What the trial gained, now at `reached` dB, decides about growth while there is any, then about harmonics."""
        progress, economy = self.progress, self.economy
        economy.due = progress + TRIAL
        count = len(self.gaussians)
        economy.scores.append(reached)
        economy.counts.append(count)
        if progress < STOP and economy.growing:
            if progress > COARSE_UNTIL + 2 * TRIAL:
                self._decide(economy.growth_pays(self._allowed(progress + TRIAL)))
            return
        if economy.growing:
            economy.growing = False
            self._decide(f"growth: {count} of at most {self.config.train.budget} Gaussians")
        if not economy.settled:
            degree, told = economy.harmonics_step(
                self.gaussians.sh_degree, lambda shown: self.score(limit=8, degree=shown)["psnr"]
            )
            self._decide(told)
            if degree != self.gaussians.sh_degree:
                self._set_degree(degree)

    def _stop_early(self) -> None:
        """Jumps to the cool-down when the target is reached or more time does not pay."""
        economy, progress = self.economy, self.progress
        if economy.finished or self.iteration % self.config.densify.every or not self._may_stop(progress):
            return
        target, reason = self.config.train.stop_psnr, None
        if target is not None and economy.scores and economy.scores[-1] >= target:
            reason = f"stop: held-out PSNR {economy.scores[-1]:.2f} dB, {target:g} were asked"
        elif economy.settled and progress >= STOP:
            reason = economy.plateau(progress)
        if reason is not None:
            economy.finished, economy.growing = True, False
            left = 1.0 - COOLDOWN - progress
            self._jump += left
            self._decide(f"{reason}; {left:.0%} of the course left out")

    def _may_stop(self, progress: float) -> bool:
        """Not when the end is near anyway, nor before the features have had their time."""
        needed = self.config.losses.start + 0.35 if self.has_labels else 0.0
        return needed <= progress < 1.0 - COOLDOWN - TRIAL

    def _decide(self, told: str | None) -> None:
        if told is not None:
            self.record.decisions.append(told)

    def _set_degree(self, degree: int) -> None:
        state = self.optimiser.state_dict()
        count = (degree + 1) ** 2
        for table in ("params", "first", "second"):
            sh = state[table]["sh"]
            more = torch.zeros(len(sh), max(0, count - sh.shape[1]), 3)
            state[table]["sh"] = torch.cat([sh[:, :count], more], dim=1)
        self._restart_optimiser(state)

    # ------------------------------------------------------------------ figures

    def score(self, limit: int | None = None, with_ssim: bool = False, degree: int = 3) -> dict[str, float]:
        """Mean PSNR (and SSIM as trained) over at most `limit` held-out views, training views if there are none.

        degree: of the harmonics that are shown.
        """
        shown = replace(self.gaussians, sh=self.gaussians.sh[:, : (degree + 1) ** 2].contiguous())
        views = self.held_out or self.views
        if limit is not None and len(views) > limit:
            views = [views[i] for i in np.linspace(0, len(views) - 1, limit).round().astype(int)]
        figures = []
        with self.profile("evaluation"):
            for view in views:
                image = render_view(shown, view)
                ssim = [photometric(image, view.photo, beta=1.0).ssim] if with_ssim else []
                figures.append([psnr(image, view.photo), *ssim])
        return dict(zip(("psnr", "ssim"), np.mean(figures, axis=0).tolist(), strict=False))

    @torch.no_grad()
    def depth(self, name: str) -> np.ndarray:
        """[H, W] float32 depth along the optical axis of training view `name` as the map now has it, 0 = nothing."""
        view = next(view for view in self.views if view.name == name)
        return depth_image(self.gaussians, view.camera_from_world, view.K, *view.photo.shape[1::-1]).numpy()

    def _note(self, progress: float) -> None:
        figures = self.score(limit=6, with_ssim=True)
        self.record.curve.append(
            {
                "iteration": self.iteration,
                "seconds": round(self.elapsed, 2),
                "gaussians": len(self.gaussians),
                "psnr": round(figures["psnr"], 3),
                "ssim": round(figures["ssim"], 4),
                "progress": round(progress, 4),
            }
        )
