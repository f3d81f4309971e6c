"""The training kernels of `perception._core.training` for tensors on a device: the same arguments, made of torch's own.

Results are those of the compiled kernels up to rounding. Figures come back as tensors of one element, so that no call
waits for the device. No sum is made by atomic additions, so equal input gives equal bits on one device.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

_C1, _C2 = 0.01**2, 0.03**2  # Wang et al. 2004, dynamic range 1
_RADIUS, _SIGMA = 5, 1.5
_PIECE = 1024
"""Pixels whose features are summed in float32; these sums are added in float64."""


def photometric(
    render: Tensor, target: Tensor, weight: Tensor | None, gradient: Tensor, beta: float
) -> tuple[Tensor, Tensor, Tensor]:
    """(loss, l1, ssim) of images [H, W, C] and d loss / d render into gradient. Derivation: kernels/photometric.h.

    With E[·] the mean under the window: mx = E[x], my = E[y], square = E[x² + y²], product = E[x y],
    ssim = a1 a2 / (b1 b2), a1 = 2 mx my + C1, a2 = 2 (product − mx my) + C2, b1 = mx² + my² + C1,
    b2 = square − mx² − my² + C2. share: weight of an element of the image in the mean. by_…: d ssim / d each mean.
    """
    x, y = render, target.to(render.dtype) / 255 if target.dtype == torch.uint8 else target
    weight = torch.ones_like(x[..., 0]) if weight is None else weight
    share = weight[..., None] / (weight.double().sum() * x.shape[2]).clamp(min=1e-30).to(x.dtype)
    difference = x - y
    l1 = (difference.abs() * share).double().sum()
    gradient.copy_(difference.sign() * share * (1 - beta))
    if beta == 0:
        return l1, l1, torch.full_like(l1, torch.nan)
    mx, my, square, product = _blurred(x, y, x * x + y * y, x * y)
    a1, a2 = 2 * mx * my + _C1, 2 * (product - mx * my) + _C2
    b1 = mx * mx + my * my + _C1
    b2 = square + _C1 + _C2 - b1
    below = 1 / (b1 * b2)
    ssim = a1 * a2 * below
    by_mean = 2 * (my * (a2 - a1) * below - mx * ssim * (1 / b1 - 1 / b2))
    by_mean, by_square, by_product = _blurred(share * by_mean, -share * ssim / b2, 2 * share * a1 * below)
    gradient.add_(by_mean + 2 * x * by_square + y * by_product, alpha=-beta)
    mean = (ssim * share).double().sum()
    return (1 - beta) * l1 + beta * ((1 - ssim) * share).double().sum(), l1, mean


def _blurred(*images: Tensor) -> tuple[Tensor, ...]:
    """Each image [H, W, C] under SSIM's Gaussian window, zeros outside."""
    taps = torch.exp(-0.5 * (torch.arange(-_RADIUS, _RADIUS + 1, dtype=torch.float64) / _SIGMA) ** 2)
    window = (taps / taps.sum()).to(images[0]).view(1, 1, -1, 1)
    planes = torch.cat(images, dim=2).permute(2, 0, 1)[:, None]
    with torch.backends.cudnn.flags(enabled=False):  # which may round to TF32, and choose algorithms by their speed
        down = torch.nn.functional.conv2d(planes, window, padding=(_RADIUS, 0))
        both = torch.nn.functional.conv2d(down, window.transpose(2, 3), padding=(0, _RADIUS))
    return both[:, 0].permute(1, 2, 0).split(images[0].shape[2], dim=2)


def prototypes(features: Tensor, slots: Tensor, counts: Tensor, first: Tensor, means: Tensor, scatter: Tensor) -> None:
    """Mean feature per slot [M, D] and sum of squared distances to it [M]; features [P, D], slots [P], −1 = none."""
    if len(counts) == 0:
        return
    # Sums are taken about a pixel of the label itself, so that features far from zero do not cancel.
    reference = features[first]
    offset = features - reference[slots.long().clamp(min=0)]
    values = torch.cat([offset, offset.square()], dim=1)
    missing = -len(slots) % _PIECE
    values = torch.nn.functional.pad(values, (0, 0, 0, missing)).view(-1, _PIECE, values.shape[1])
    padded = torch.nn.functional.pad(slots, (0, missing), value=-1).view(-1, 1, _PIECE)
    members = padded == torch.arange(len(counts), device=slots.device)[:, None]  # [pieces, M, _PIECE]
    sums, squares = torch.bmm(members.to(values.dtype), values).double().sum(dim=0).chunk(2, dim=1)
    mean = sums / counts[:, None]
    means.copy_(reference.double() + mean)
    scatter.copy_((squares - sums * mean).clamp(min=0).sum(dim=1))


def separation(points: Tensor, margin: float, gradient: Tensor) -> Tensor:
    """Mean relu(margin - squared distance) over the pairs of points [M, D] float64, and its gradient."""
    gradient.zero_()
    count = len(points)
    if count < 2:
        return points.new_zeros(())
    difference = points[:, None] - points[None]
    near = margin - difference.square().sum(dim=2)
    pairs, active = 0.5 * count * (count - 1), (near > 0).to(points.dtype).fill_diagonal_(0)
    gradient.add_((difference * active[..., None]).sum(dim=1), alpha=-2 / pairs)
    return 0.5 * (near * active).sum() / pairs


def spread(features: Tensor, slots: Tensor, means: Tensor, pull: Tensor, push: Tensor, out: Tensor) -> None:
    """out = pull[slot] (F - means[slot]) + push[slot], 0 without a slot."""
    if len(means) == 0:
        out.zero_()
        return
    index = slots.long().clamp(min=0)
    pull, push, means = (table.to(features.dtype)[index] for table in (pull, push, means))
    out.copy_(torch.where(slots[:, None] >= 0, pull[:, None] * (features - means) + push, 0.0))


def sum(values: Tensor, squared: bool) -> Tensor:
    """Sum of the values or of their squares, float64."""
    wide = values.double()
    return (wide.square() if squared else wide).sum()


def scale(values: Tensor, factor: float, out: Tensor) -> None:
    """out = factor * values."""
    out.copy_(values * factor)


def adam(
    param: Tensor, grad: Tensor, first: Tensor, second: Tensor, visible: Tensor | None, rate: np.ndarray,
    step: int, beta1: float, beta2: float, eps: float,
) -> Tensor:  # fmt: skip
    """One Adam step in place on the visible rows of [N, W]; the number of rows skipped for a non-finite gradient."""
    finite = grad.isfinite().all(dim=1)
    wanted = torch.ones_like(finite) if visible is None else visible > 0
    rows = (finite & wanted)[:, None]
    first.copy_(torch.where(rows, beta1 * first + (1 - beta1) * grad, first))
    second.copy_(torch.where(rows, beta2 * second + (1 - beta2) * grad * grad, second))
    rates = torch.from_numpy(rate / (1 - beta1**step)).to(param)
    length = second.sqrt() / (1 - beta2**step) ** 0.5 + eps
    param.sub_(torch.where(rows, rates * first / length, 0.0))
    return (wanted & ~finite).sum()


def add_statistics(mean2d: Tensor, visible: Tensor, gradient: Tensor, seen: Tensor, scale: float) -> None:
    """Adds one view, where visible: scale |mean2d| to gradient, 1 to seen."""
    here = visible > 0
    gradient.add_(torch.where(here, scale * mean2d.norm(dim=1), 0.0))
    seen.add_(here.to(seen.dtype))
