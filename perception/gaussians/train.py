"""Optimises Gaussians against photos and masks: L = L_RGB + λ_inst L_inst2D + λ_var L_var (OpenSplat3D §3.2).

Every schedule is driven by progress in [0, 1], the larger of iterations done and time spent, so a time limit shortens
the whole course instead of cutting its end. Randomness is a function of (seed, iteration): a run resumed from a
checkpoint takes the very steps the interrupted one would have taken.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch

from perception.config import MapConfig
from perception.gaussians.densify import Statistics, decay_opacities, densify, target_count
from perception.gaussians.losses import instance_loss, photometric_loss, variance_loss
from perception.gaussians.model import Gaussians
from perception.gaussians.optimiser import SparseAdam
from perception.gaussians.rasterize import rasterize


@dataclass(frozen=True)
class TrainingView:
    """One photo ready for training. photo [H, W, 3] uint8; labels [H, W] int32 (0 = unlabelled) or None;
    K [3, 3] and camera_from_world [4, 4] float32."""

    name: str
    photo: torch.Tensor
    labels: torch.Tensor | None
    K: torch.Tensor
    camera_from_world: torch.Tensor

    def halved(self) -> TrainingView:
        """The same view at half the resolution: photo averaged 2 × 2, labels taken at every other pixel."""
        height, width = self.photo.shape[0] // 2, self.photo.shape[1] // 2
        blocks = self.photo[: 2 * height, : 2 * width].reshape(height, 2, width, 2, 3)
        photo = (blocks.to(torch.int16).sum(dim=(1, 3)) + 2).div(4, rounding_mode="floor").to(torch.uint8)
        labels = None if self.labels is None else self.labels[: 2 * height : 2, : 2 * width : 2].contiguous()
        K = self.K.clone()
        K[:2] *= 0.5
        return TrainingView(self.name, photo.contiguous(), labels, K, self.camera_from_world)


@dataclass
class TrainRecord:
    """What training spent and what it bought; JSON-able."""

    curve: list[dict[str, float]] = field(default_factory=list)
    decisions: list[str] = field(default_factory=list)
    seconds: float = 0.0
    iterations: int = 0
    skipped_gradients: int = 0


def scene_extent(views: list[TrainingView]) -> float:
    """1.1 × the largest distance of a camera from the cameras' mean (Kerbl et al. 2023), never 0."""
    poses = torch.stack([view.camera_from_world for view in views])
    centres = -torch.einsum("nji,nj->ni", poses[:, :3, :3], poses[:, :3, 3])
    return max(1.1 * float((centres - centres.mean(dim=0)).norm(dim=1).max()), 1e-3)


class Trainer:
    """Holds all state of one optimisation; `state` and `load` round-trip it through a checkpoint."""

    def __init__(
        self, gaussians: Gaussians, views: list[TrainingView], config: MapConfig, held_out: list[TrainingView]
    ):
        self.config = config
        self.held_out = held_out
        self.extent = scene_extent(views)
        self.record = TrainRecord()
        self.iteration = 0
        self.initial_count = len(gaussians)
        self.gaussians = gaussians
        self.statistics = Statistics.zeros(len(gaussians))
        self.optimiser = SparseAdam(vars(gaussians), self._rates(0.0))
        self.coarse: list[TrainingView] = []
        self.has_labels = False
        self.show(views)
        self._trials: list[float] = []
        self._sh_settled = config.train.sh_degree == 0
        self._started = time.monotonic()
        self._order: np.ndarray = np.zeros(0, dtype=np.int64)

    def show(self, views: list[TrainingView]) -> None:
        """Trains on `views` from here on: the same photos, whose masks may have come since."""
        self.views = views
        self.has_labels = any(view.labels is not None and bool((view.labels > 0).any()) for view in views)
        halves = self.config.train.coarse_until > 0 or (self.has_labels and self.config.losses.half_resolution)
        self.coarse = [view.halved() for view in views] if halves else []

    # ------------------------------------------------------------------ state

    def _rates(self, progress: float) -> dict[str, float | torch.Tensor]:
        train = self.config.train
        decay = (train.lr_means_final / train.lr_means) ** progress
        sh = torch.full((self.gaussians.sh.shape[1], 3), train.lr_colors / 20)
        sh[0] = train.lr_colors
        return {
            "means": train.lr_means * decay * self.extent,
            "quats": train.lr_quats,
            "log_scales": train.lr_scales,
            "opacity_logits": train.lr_opacities,
            "sh": sh,
            "features": train.lr_features,
        }

    @property
    def elapsed(self) -> float:
        """Seconds of training, those before a resume counted in."""
        return self.record.seconds + time.monotonic() - self._started

    @property
    def progress(self) -> float:
        share = self.iteration / self.config.train.iterations
        limit = self.config.train.time_limit
        return min(1.0, share if limit is None else max(share, self.elapsed / limit))

    def state(self) -> dict[str, Any]:
        """Everything a resumed run needs."""
        return {
            "iteration": self.iteration,
            "initial_count": self.initial_count,
            "optimiser": self.optimiser.state_dict(),
            "statistics": vars(self.statistics),
            "record": dict(vars(self.record), seconds=self.elapsed, iterations=self.iteration),
            "harmonics": (self._trials, self._sh_settled),
        }

    def load(self, state: dict[str, Any]) -> None:
        """Takes up a run from `state()`."""
        self._restart_optimiser(state["optimiser"])
        self.statistics = Statistics(**state["statistics"])
        self.record = TrainRecord(**state["record"])
        self.iteration = state["iteration"]
        self.initial_count = state["initial_count"]
        self._trials, self._sh_settled = state["harmonics"]
        self._started = time.monotonic()

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
        while self.progress < until:
            figures = self.step()
            on_step(self, figures)
        self.record.seconds, self.record.iterations = self.elapsed, self.iteration
        self._started = time.monotonic()
        return self.record

    def step(self) -> dict[str, float]:
        """One iteration: a view, its losses, Adam, and now and then densification or one harmonic more."""
        progress = self.progress
        losses_config = self.config.losses
        with_features = (
            self.has_labels and progress >= losses_config.start and self.iteration % losses_config.every == 0
        )
        coarse = progress < self.config.train.coarse_until or (with_features and losses_config.half_resolution)
        view = self._pick(coarse)
        losses = self._descend(view, progress, with_features)
        self.iteration += 1
        every = self.config.densify.every
        if self.iteration % every == 0:
            if self.config.densify.start <= progress < self.config.densify.stop:
                self._densify(progress)
            elif progress >= self.config.densify.stop:
                self._settle_harmonics(progress)
        if self.iteration % (5 * every) == 0 or self.progress >= 1.0:
            self._note(progress)
        return losses

    def _pick(self, coarse: bool) -> TrainingView:
        epoch, place = divmod(self.iteration, len(self.views))
        if place == 0 or len(self._order) == 0:
            self._order = np.random.default_rng([self.config.seed, epoch]).permutation(len(self.views))
        return (self.coarse if coarse else self.views)[self._order[place]]

    def _descend(self, view: TrainingView, progress: float, with_features: bool) -> dict[str, float]:
        config = self.config
        params = {name: tensor.detach().requires_grad_() for name, tensor in vars(self.gaussians).items()}
        height, width = view.photo.shape[:2]
        background = None
        if config.train.random_background:
            colors = np.random.default_rng([config.seed, self.iteration, 1]).random(3, dtype=np.float32)
            background = torch.from_numpy(colors)
        out = rasterize(
            params["means"],
            params["quats"],
            params["log_scales"].exp(),
            params["opacity_logits"].sigmoid(),
            params["sh"],
            view.camera_from_world[None],
            view.K[None],
            width,
            height,
            sh_degree=self.gaussians.sh_degree,
            features=params["features"] if with_features else None,
            background=background,
            depth=False,
        )
        loss = photometric_loss(out.colors[0], view.photo, config.train.ssim_weight)
        figures = {"rgb": float(loss.detach())}
        if with_features:
            loss = loss + self._feature_losses(view, out, figures)
        loss.backward()
        visible = out.visible[0]
        gradients = {name: tensor.grad for name, tensor in params.items() if tensor.grad is not None}
        self.optimiser.rates = self._rates(progress)
        self.record.skipped_gradients += sum(self.optimiser.step(visible, gradients).skipped.values())
        if progress < config.densify.stop and out.stats.mean2d_grad is not None:
            self.statistics.add(out.stats.mean2d_grad[0], out.stats.radii[0], visible, max(height, width))
        figures["loss"] = float(loss.detach())
        return figures

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
            w_pos=losses.positive_weight,
            w_neg=losses.negative_weight,
            per_pixel=losses.positive == "per-pixel",
            squared=losses.negative == "squared",
        )
        figures["inst"] = float(instance.value.detach())
        return total + losses.instance_weight * instance.value

    # ------------------------------------------------------- size of the model

    def _densify(self, progress: float) -> None:
        config = self.config
        decay_opacities(self.gaussians, config.densify.opacity_decay)
        allowed = target_count(progress, self.initial_count, config.train.budget, config.densify)
        seed = int(np.random.default_rng([config.seed, self.iteration, 2]).integers(2**31))
        change = densify(self.gaussians, self.statistics, allowed, self.extent, config.densify, seed)
        self.optimiser.keep(change.keep)
        self.optimiser.append(vars(change.born))
        self._sync()
        self.statistics = Statistics.zeros(len(self.gaussians))

    def _settle_harmonics(self, progress: float) -> None:
        """Raises the spherical-harmonic degree by one, and takes the raise back if it did not pay.

        After growth has stopped the run is cut into trials of 5 % each. The first raises nothing and tells what a
        trial gains by itself; a raise pays when its trial gains `sh_min_gain_db` more than that. Gains are of the
        held-out PSNR (of the training PSNR where nothing is held out).
        """
        if self._sh_settled or progress < self.config.densify.stop + 0.05 * len(self._trials):
            return
        degree, limit = self.gaussians.sh_degree, self.config.train.sh_degree
        self._trials.append(self.score(limit=8)["psnr"])
        if len(self._trials) == 1:
            return
        gains = np.diff(self._trials)
        if len(gains) > 1:
            extra = float(gains[-1] - gains[0])
            paid = extra >= self.config.train.sh_min_gain_db
            self.record.decisions.append(
                f"harmonics: degree {degree} gained {extra:+.2f} dB, {'kept' if paid else 'taken back'}"
            )
            if not paid:
                self._set_degree(degree - 1)
            self._sh_settled = not paid or degree == limit
        if not self._sh_settled:
            self._set_degree(degree + 1)

    def _set_degree(self, degree: int) -> None:
        state = self.optimiser.state_dict()
        count = (degree + 1) ** 2
        for table in ("params", "first", "second"):
            sh = state[table]["sh"]
            more = torch.zeros(len(sh), max(0, count - sh.shape[1]), 3)
            state[table]["sh"] = torch.cat([sh[:, :count], more], dim=1)
        self._restart_optimiser(state)

    # ------------------------------------------------------------------ figures

    def score(self, limit: int | None = None) -> dict[str, float]:
        """Mean PSNR over held-out views (training views if there are none), at most `limit` of them."""
        views = self.held_out or self.views
        if limit is not None and len(views) > limit:
            views = [views[i] for i in np.linspace(0, len(views) - 1, limit).round().astype(int)]
        return {"psnr": float(np.mean([psnr(render_view(self.gaussians, view), view.photo) for view in views]))}

    @torch.no_grad()
    def depth(self, name: str) -> np.ndarray:
        """[H, W] float32 depth along the optical axis of training view `name` as the map now has it, 0 = nothing."""
        view = next(view for view in self.views if view.name == name)
        return depth_image(self.gaussians, view.camera_from_world, view.K, *view.photo.shape[1::-1]).numpy()

    def _note(self, progress: float) -> None:
        self.record.curve.append(
            {
                "iteration": self.iteration,
                "seconds": round(self.elapsed, 2),
                "gaussians": len(self.gaussians),
                "psnr": round(self.score(limit=6)["psnr"], 3),
                "progress": round(progress, 4),
            }
        )


@torch.no_grad()
def render_view(gaussians: Gaussians, view: TrainingView) -> torch.Tensor:
    """The photo as the map sees it, [H, W, 3] float32 in [0, 1], black where nothing is."""
    height, width = view.photo.shape[:2]
    out = rasterize(
        gaussians.means,
        gaussians.quats,
        gaussians.scales,
        gaussians.opacities,
        gaussians.sh,
        view.camera_from_world[None],
        view.K[None],
        width,
        height,
        sh_degree=gaussians.sh_degree,
        depth=False,
    )
    return out.colors[0].clamp(0, 1)


@torch.no_grad()
def depth_image(
    gaussians: Gaussians, camera_from_world: torch.Tensor, K: torch.Tensor, width: int, height: int
) -> torch.Tensor:
    """Expected depth [H, W] along the optical axis where the map is more than half opaque, 0 elsewhere."""
    out = rasterize(
        gaussians.means,
        gaussians.quats,
        gaussians.scales,
        gaussians.opacities,
        gaussians.base_colors,
        camera_from_world[None],
        K[None],
        width,
        height,
    )
    alpha = out.alphas[0]
    return torch.where(alpha > 0.5, out.depths[0] / alpha.clamp(min=1e-6), torch.zeros_like(alpha))


def psnr(image: torch.Tensor, photo: torch.Tensor) -> float:
    """Peak signal-to-noise ratio in dB of image [H, W, 3] in [0, 1] against photo uint8."""
    error = float((image.double() - photo.double() / 255).square().mean())
    return float("inf") if error == 0 else -10 * float(np.log10(error))
