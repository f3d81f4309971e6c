"""The training kernels of `perception._core.training` for tensors on a device: the same arguments.

Adam and the photometric loss are kernels of csrc/cuda/training.h; the rest is made of torch's operations. Results are
those of the compiled kernels up to rounding. Figures come back as tensors of one element, so that no call waits for the
device. No floating-point sum is made by atomic additions, so equal input gives equal bits on one device.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from perception.rasterizer import device
from perception.rasterizer.cuda.kernels import THREADS, KernelOptions, Kernels

_TAPS = np.exp(-0.5 * (np.arange(-5, 6) / 1.5) ** 2)
_WINDOW = {f"tap{i}": tap for i, tap in enumerate(_TAPS / _TAPS.sum())}
"""Of SSIM (Wang et al. 2004): 11 pixels, σ = 1.5."""
ADAM_ROWS = device.structures(
    "AdamRows", "param first second grad rates visible skipped", "rows width", "rate beta1 beta2 eps root"
)
PHOTOS = device.structures(
    "Photo",
    "render target bytes weight total slopes gradient sums",
    "width height channels tiles_x",
    "beta " + " ".join(_WINDOW),
)
_PIECE = 1024
"""Pixels whose features are summed in float32; these sums are added in float64."""


def _kernels(of: Tensor) -> Kernels:
    return device.device_kernels(KernelOptions(0, False, False, of.dtype == torch.float64), of.device)


def photometric(
    render: Tensor, target: Tensor, weight: Tensor | None, gradient: Tensor, beta: float
) -> tuple[Tensor, Tensor, Tensor]:
    """(loss, l1, ssim) of images [H, W, C] and d loss / d render into gradient."""
    height, width, channels = render.shape
    if weight is None:
        total = torch.full((), float(render.numel()), dtype=torch.float64, device=render.device)
    else:
        total = (weight.double().sum() * channels).clamp(min=1e-30)
    tiles_x, tiles_y = ((size + device.TILE - 1) // device.TILE for size in (width, height))
    sums, slopes = total.new_empty((tiles_x * tiles_y, 3)), render.new_empty((3, *render.shape))
    whole = target.dtype == torch.uint8
    photo = device.filled(
        PHOTOS[render.dtype],
        render=render,
        target=None if whole else target,
        bytes=target if whole else None,
        weight=weight,
        total=total,
        slopes=slopes,
        gradient=gradient,
        sums=sums,
        width=width,
        height=height,
        channels=channels,
        tiles_x=tiles_x,
        beta=beta,
        **_WINDOW,
    )
    for name in ("ssim_kernel", "photometric_kernel"):
        _kernels(render).launch(name, len(sums), photo)
    l1, ssim, unlike = sums.sum(dim=0)
    return (1 - beta) * l1 + beta * unlike, l1, ssim if beta else torch.full_like(l1, torch.nan)


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
    rate = rate / (1 - beta1**step)
    rates = None if (rate == rate[0]).all() else torch.from_numpy(rate).to(param)
    skipped = torch.zeros((), dtype=torch.int32, device=param.device)
    rows = device.filled(
        ADAM_ROWS[param.dtype],
        param=param,
        first=first,
        second=second,
        grad=grad,
        rates=rates,
        visible=visible,
        skipped=skipped,
        rows=param.shape[0],
        width=param.shape[1],
        rate=rate[0],
        beta1=beta1,
        beta2=beta2,
        eps=eps,
        root=(1 - beta2**step) ** -0.5,
    )
    _kernels(param).launch("adam_kernel", (param.numel() + THREADS - 1) // THREADS, rows)
    return skipped


def add_statistics(mean2d: Tensor, visible: Tensor, gradient: Tensor, seen: Tensor, scale: float) -> None:
    """Adds one view, where visible: scale |mean2d| to gradient, 1 to seen."""
    here = visible > 0
    gradient.add_(torch.where(here, scale * mean2d.norm(dim=1), 0.0))
    seen.add_(here.to(seen.dtype))
