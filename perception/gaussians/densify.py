"""Adaptive density control: adds Gaussians by screen-space gradient up to a fixed budget, and prunes Gaussians.

Small Gaussians are cloned and large ones split (Kerbl et al. 2023, §5.2), with three changes. Candidates are ranked by
gradient, and only as many as the budget allows are used. The opacities of a clone and its original are corrected to
preserve the rendered image (Rota Bulò et al. 2024, eq. 11). Opacities decay a little instead of being reset.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch

from perception.gaussians.device import training_kernels
from perception.gaussians.model import Gaussians, sigmoid

START, STOP = 0.05, 0.6
"""Progress at which the number of Gaussians begins and ends to grow."""
PERCENT_DENSE = 0.01
"""A Gaussian is split if its largest scale exceeds this share of the scene extent, else cloned (Kerbl et al. 2023)."""
PRUNE_OPACITY = 0.005
"""Opacity below which a Gaussian is removed (Kerbl et al. 2023)."""
OPACITY_MARGIN = 1e-6
"""Opacities are kept this far from 0 and 1, where logits are infinite."""
OPACITY_DECAY = 1e-2
"""Share by which every opacity is reduced before each densification."""
SPLIT_SHRINK = 1.6
"""Scales of the two halves of a split Gaussian are divided by this (Kerbl et al. 2023)."""
BEYOND = 0.3
"""Factor on the gradient of a Gaussian beyond the box for which a block of a large scene is trained: it will be dropped
later, and is needed only for what photos show behind or beside the box."""


@dataclass
class Statistics:
    """Sums since the last densification, all [N]: gradient norms of the 2D mean (in units of half the image's long
    side), and how often a Gaussian was seen."""

    gradient: torch.Tensor
    seen: torch.Tensor

    @staticmethod
    def zeros(count: int, device: torch.device | None = None) -> Statistics:
        return Statistics(torch.zeros(count, device=device), torch.zeros(count, device=device))

    def add(self, gradient_px: torch.Tensor, visible: torch.Tensor, long_side: int) -> None:
        """Adds one view: gradient_px [N, 2] of the 2D mean per pixel, visible [N] uint8, long_side in pixels. Rows that
        are not visible are not looked at."""
        add_statistics = training_kernels(visible.device).add_statistics
        add_statistics(gradient_px, visible, self.gradient, self.seen, 0.5 * long_side)


def target_count(progress: float, initial: int, budget: int) -> int:
    """Gaussians allowed at `progress` in [0, 1]: a straight ramp from the initial count to the budget."""
    share = (progress - START) / (STOP - START)
    return int(initial + (budget - initial) * min(1.0, max(0.0, share)))


def densify(
    gaussians: Gaussians,
    statistics: Statistics,
    allowed: int,
    extent: float,
    grad_threshold: float,
    seed: int,
    box: torch.Tensor | None = None,
) -> tuple[torch.Tensor, Gaussians]:
    """Prunes, then clones or splits the best candidates while there are at most `allowed` Gaussians.

    extent: scene size in world units. grad_threshold: mean gradient (see Statistics) above which a Gaussian is
    cloned or split. box: [2, 3] corners of the part of space that matters, see BEYOND; None: all of it. Opacities of
    cloned Gaussians change in place. Returns the indices [K] int64 of the rows to keep, in order, and the Gaussians to
    append.
    """
    needed = _needed(gaussians, statistics)
    room = max(0, allowed - int(needed.sum()))
    score = statistics.gradient / statistics.seen.clamp(min=1)
    if box is not None:
        inside = ((gaussians.means >= box[0]) & (gaussians.means < box[1])).all(dim=1)
        score = torch.where(inside, score, BEYOND * score)
    wanted = needed & (score > grad_threshold)
    candidates = torch.nonzero(wanted).flatten()
    if len(candidates) > room:
        best = torch.argsort(score[candidates], descending=True, stable=True)[:room]
        candidates = candidates[best].sort().values
    large = gaussians.log_scales[candidates].max(dim=1).values.exp() > PERCENT_DENSE * extent
    split, clone = candidates[large], candidates[~large]

    # Rota Bulò et al. 2024, eq. 11: clone and original get o' = 1 − sqrt(1 − o); both together have opacity o.
    opacities = sigmoid(gaussians.opacity_logits[clone]).clamp(max=1 - OPACITY_MARGIN)
    gaussians.opacity_logits[clone] = _logit(1 - torch.sqrt(1 - opacities))
    needed[split] = False
    generator = torch.Generator().manual_seed(seed)
    born = Gaussians.concatenate([gaussians.rows(clone), *_halves(gaussians, split, generator)])
    return torch.nonzero(needed).flatten(), born


def decay_opacities(gaussians: Gaussians) -> None:
    """Multiplies every opacity by 1 − OPACITY_DECAY in place. Gaussians that no photo supports fade and are pruned."""
    gaussians.opacity_logits.copy_(_logit(gaussians.opacities * (1 - OPACITY_DECAY)))


def _logit(opacities: torch.Tensor) -> torch.Tensor:
    return torch.logit(opacities.clamp(OPACITY_MARGIN, 1 - OPACITY_MARGIN))


def _needed(gaussians: Gaussians, statistics: Statistics) -> torch.Tensor:
    unseen = statistics.seen == 0
    if bool(unseen.all()):  # no statistics yet
        unseen = torch.zeros_like(unseen)
    finite = torch.isfinite(gaussians.means).all(dim=1) & torch.isfinite(gaussians.log_scales).all(dim=1)
    return (gaussians.opacities >= PRUNE_OPACITY) & ~unseen & finite


def _halves(gaussians: Gaussians, index: torch.Tensor, generator: torch.Generator) -> list[Gaussians]:
    """Two children of each Gaussian in `index`: means sampled from it, scales divided by SPLIT_SHRINK."""
    rotations = rotation_matrices(gaussians.quats[index])
    children = []
    for _ in range(2):
        child = gaussians.rows(index)
        offset = torch.randn(len(index), 3, generator=generator).to(child.scales) * child.scales
        child.means += torch.einsum("nij,nj->ni", rotations, offset)
        child.log_scales -= torch.log(torch.tensor(SPLIT_SHRINK))
        children.append(child)
    return children


def rotation_matrices(quats: torch.Tensor) -> torch.Tensor:
    """[N, 4] wxyz of any norm -> [N, 3, 3]; a zero quaternion gives the identity."""
    norm = quats.norm(dim=1, keepdim=True)
    identity = torch.tensor([1.0, 0, 0, 0]).to(quats)
    w, x, y, z = torch.where(norm > 0, quats / norm.clamp(min=1e-30), identity).unbind(1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, dim=1).reshape(-1, 3, 3)
