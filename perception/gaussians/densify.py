"""Adaptive density control: adds Gaussians by screen-space gradient up to a fixed budget, and prunes Gaussians.

Densification: small Gaussians are cloned and large ones split (Kerbl et al. 2023, §5.2), with four changes. Gradients
are absolute (Ye et al. 2024). Candidates are ranked by them, and only as many as the budget allows are used. The
opacities of a clone and its original are corrected to preserve the rendered image (Rota Bulò et al. 2024, eq. 11).
Opacities decay instead of being reset.

Holes: densification only copies existing Gaussians, so regions that the map leaves empty are filled. Each view is
divided into blocks of BLOCK × BLOCK pixels. An empty block gets one Gaussian of the block's size and the photo's mean
colour there, at a depth taken from the nearest covered blocks. Training then moves it to the surface.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial import cKDTree

from perception.gaussians.device import training_kernels
from perception.gaussians.model import Gaussians, isotropic, sigmoid
from perception.gaussians.views import TrainingView, render, unprojected

START, STOP = 0.05, 0.6  # progress at which the number of Gaussians begins and ends to grow
PERCENT_DENSE = 0.01  # of the scene extent: a Gaussian of a larger scale is split, else cloned (Kerbl et al. 2023)
PRUNE_OPACITY = 0.005  # opacity below which a Gaussian is removed (Kerbl et al. 2023)
OPACITY_MARGIN = 1e-6  # opacities are kept this far from 0 and 1, where logits are infinite
OPACITY_DECAY = 1e-2  # share by which every opacity is reduced before each densification
SPLIT_SHRINK = 1.6  # scales of the two halves of a split Gaussian are divided by this (Kerbl et al. 2023)
BEYOND = 0.3  # factor on gradients outside a block's box: what grows there is dropped later, but photos show it

BLOCK = 8  # side of a block in pixels
EMPTY = 0.5  # a block is empty when its mean opacity is below this
NEAREST = 1 / 3  # share of the covered blocks, the nearest in the picture, that give an empty one its depth
FAR = 0.95
"""Quantile of their depths that is used: regions without points are mostly background, and what fills them too near
hangs as a veil before other cameras. With 12 blocks and 0.75 a wall behind a tree was put at the tree's depth."""
MOST_BLOCKS = 2000  # covered blocks that are looked at, evenly: as many pairs with empty ones are held in memory
HOLE_OPACITY = 0.5  # opacity of the Gaussians added


@dataclass
class Statistics:
    """Sums since the last densification, all [N]: norms of the 2D mean's gradients, absolute or plain (in units of half
    the image's long side), and how often a Gaussian was seen."""

    gradient: torch.Tensor
    seen: torch.Tensor

    @staticmethod
    def zeros(count: int, device: torch.device | None = None) -> Statistics:
        return Statistics(torch.zeros(count, device=device), torch.zeros(count, device=device))

    def add(self, gradient_px: torch.Tensor, visible: torch.Tensor, long_side: int) -> None:
        """Adds one view: gradient_px [N, 2] of the 2D mean per pixel, visible [N] uint8, long_side in pixels. Rows that
        are not visible are not read."""
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
    held: int = 0,
) -> tuple[torch.Tensor, Gaussians]:
    """Prunes, then clones or splits the best candidates while there are at most `allowed` Gaussians.

    extent: scene size in world units. grad_threshold: mean gradient (see Statistics) above which a Gaussian is
    cloned or split. box: [2, 3] corners of the part of space that matters, see BEYOND; None: all of it. held: the first
    rows, which are kept as they are. Opacities of cloned Gaussians change in place. Returns the indices [K] int64 of
    the rows to keep, in order, and the Gaussians to append.
    """
    needed = _needed(gaussians, statistics)
    needed[:held] = True
    room = max(0, allowed - int(needed.sum()))
    score = statistics.gradient / statistics.seen.clamp(min=1)
    if box is not None:
        inside = ((gaussians.means >= box[0]) & (gaussians.means < box[1])).all(dim=1)
        score = torch.where(inside, score, BEYOND * score)
    wanted = needed & (score > grad_threshold)
    wanted[:held] = False
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


def decay_opacities(gaussians: Gaussians, held: int = 0) -> None:
    """Multiplies every opacity by 1 − OPACITY_DECAY in place, but for the first `held`. Gaussians
    that no photo supports fade and are pruned."""
    gaussians.opacity_logits[held:] = _logit(gaussians.opacities * (1 - OPACITY_DECAY))[held:]


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


@torch.no_grad()
def fill_holes(gaussians: Gaussians, views: list[TrainingView], room: int, seed: int) -> tuple[Gaussians, float]:
    """At most `room` new Gaussians for the empty blocks of `views`, and the share of all blocks that was empty.

    Each view is rendered with the Gaussians added for the views before it, so a hole seen in several is filled once.
    """
    generator = torch.Generator().manual_seed(seed)
    born, empty, blocks = gaussians.rows(torch.zeros(0, dtype=torch.long)), 0, 0
    shown = gaussians
    for view in views:
        alphas, depths = _blocks(shown, view)
        holes = alphas < EMPTY
        covered = ~holes
        if view.weight is not None:
            holes &= _block_mean(view.weight[None])[0].numpy() > 0.999  # no colour of an ignored pixel
        empty, blocks = empty + int(holes.sum()), blocks + alphas.size
        if not holes.any() or not covered.any() or len(born) >= room:
            continue
        new = _in_holes(view, holes, covered, depths, gaussians, generator).to(gaussians.means.device)
        born = Gaussians.concatenate([born, new.rows(torch.arange(min(len(new), room - len(born))))])
        shown = Gaussians.concatenate([gaussians, born])
    return born, empty / max(1, blocks)


def _blocks(gaussians: Gaussians, view: TrainingView) -> tuple[np.ndarray, np.ndarray]:
    """Mean opacity of each block [h, w], and its opacity-weighted mean depth [h, w], 0 where the opacity is 0."""
    height, width = view.photo.shape[:2]
    out = render(gaussians, view.camera_from_world, view.K, width, height, eps2d=view.eps2d)
    assert out.depths is not None  # for the type checker
    alpha, depth = _block_mean(torch.stack([out.alphas[0], out.depths[0]])).cpu().numpy()
    return alpha, np.where(alpha > 0, depth / np.maximum(alpha, 1e-6), 0)


def _block_mean(images: torch.Tensor) -> torch.Tensor:
    return torch.nn.functional.avg_pool2d(images[None], BLOCK, ceil_mode=True)[0]


def _in_holes(
    view: TrainingView,
    holes: np.ndarray,
    covered: np.ndarray,
    depths: np.ndarray,
    like: Gaussians,
    generator: torch.Generator,
) -> Gaussians:
    """One Gaussian for each True block of holes [h, w], by depths of the `covered` ones; tensors like `like`."""
    known, empty = np.argwhere(covered), np.argwhere(holes)
    known = known[:: max(1, -(-len(known) // MOST_BLOCKS))]
    count = int(np.ceil(NEAREST * len(known)))
    _, near = cKDTree(known).query(empty, k=count)
    around = depths[tuple(known.T)][near.reshape(len(empty), count)]
    depth = np.quantile(around, FAR, axis=1).astype(np.float32)

    height, width = view.photo.shape[:2]
    low = empty * BLOCK
    high = np.minimum(low + BLOCK, [height, width])
    rows, columns = ((low + high) / 2).T
    means = unprojected(view.K.numpy(), view.camera[1], columns, rows, depth)
    colors = _block_mean(view.photo.float().permute(2, 0, 1))
    rgb = colors[:, torch.from_numpy(holes)].T / 255
    scales = torch.from_numpy(depth) * (0.5 * BLOCK / float(view.K[0, 0]))
    log_scales = scales.clamp(min=1e-9).log()
    balls = isotropic(means, log_scales, rgb, HOLE_OPACITY, like.features.shape[1], generator)
    return balls.with_coefficients(like.sh.shape[1])
