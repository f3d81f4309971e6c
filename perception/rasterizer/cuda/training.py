"""The training kernels of `perception._core.training` for tensors on a device: the same arguments.

Adam, the photometric and the instance loss are kernels of csrc/cuda; the rest is made of torch's operations. Results
are those of the compiled kernels up to rounding. Figures come back as tensors of one element, so that no call waits for
the device. No floating-point sum is made by atomic additions, so equal input gives equal bits on one device.
"""

from __future__ import annotations

import ctypes
import functools
from typing import Any

import numpy as np
import torch
from torch import Tensor

from perception.rasterizer import device
from perception.rasterizer.cuda.kernels import THREADS, KernelOptions, Kernels

_TAPS = np.exp(-0.5 * (np.arange(-5, 6) / 1.5) ** 2)
_WINDOW = {f"tap{i}": tap for i, tap in enumerate(_TAPS / _TAPS.sum())}
"""Of SSIM (Wang et al. 2004): 11 pixels, σ = 1.5."""
ADAM_ROWS = device.structures(
    "AdamRows", "param first second grad shares visible skipped", "rows width", "rate beta1 beta2 eps root"
)
PHOTOS = device.structures(
    "Photo",
    "render target bytes weight total slopes gradient sums",
    "width height channels tiles_x",
    "beta " + " ".join(_WINDOW),
)
MASKS = device.structure(
    "Masks", "features slots counts first parts means scatter pull push spread", "pixels masks dims"
)
PAIRS = device.structure("Pairs", "points gradient value", "count dims", "margin", ctypes.c_double)
_PIECES = 32  # as kPieces of instances.h


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
    masks, dims = means.shape
    values = {"counts": counts, "first": first, "parts": means.new_empty((masks, _PIECES, dims, 2))}
    of = _masks(features, slots, means, scatter=scatter, **values)
    _kernels(features).launch("prototype_parts_kernel", masks * _PIECES, of)
    _kernels(features).launch("prototype_kernel", (masks + THREADS - 1) // THREADS, of)


def _masks(features: Tensor, slots: Tensor, means: Tensor, **more: Tensor) -> Any:
    sizes = {"pixels": len(slots), "masks": len(means), "dims": features.shape[1]}
    return device.filled(MASKS, features=features, slots=slots, means=means, **more, **sizes)


def separation(points: Tensor, margin: float, gradient: Tensor) -> Tensor:
    """Mean relu(margin - squared distance) over the pairs of points [M, D] float64, and its gradient."""
    count, dims = points.shape
    if count < 2:
        gradient.zero_()
        return points.new_zeros(())
    value = points.new_empty(())
    pairs = device.filled(PAIRS, points=points, gradient=gradient, value=value, count=count, dims=dims, margin=margin)
    single = KernelOptions(0, False, False)  # the points are float64 beside any features
    device.device_kernels(single, points.device).launch("separation_kernel", 1, pairs)
    return value


def spread(features: Tensor, slots: Tensor, means: Tensor, pull: Tensor, push: Tensor, out: Tensor) -> None:
    """out = pull[slot] (F - means[slot]) + push[slot], 0 without a slot."""
    of = _masks(features, slots, means, pull=pull, push=push, spread=out)
    _kernels(features).launch("spread_kernel", (features.numel() + THREADS - 1) // THREADS, of)


def sum(values: Tensor, squared: bool) -> Tensor:
    """Sum of the values or of their squares, float64."""
    wide = values.double()
    return (wide.square() if squared else wide).sum()


def scale(values: Tensor, factor: float, out: Tensor) -> None:
    """out = factor * values."""
    out.copy_(values * factor)


def adam(
    param: Tensor, grad: Tensor, first: Tensor, second: Tensor, visible: Tensor | None, rate: np.ndarray,
    step: int, beta1: float, beta2: float, eps: float, skipped: Tensor | None = None,
) -> Tensor:  # fmt: skip
    """One Adam step in place on the visible rows of [N, W]; the number of rows skipped for a non-finite gradient, added
    to `skipped` where one is given."""
    alike = bool((rate == rate[0]).all())
    shares = None if alike else _on_device((rate / rate.max()).tobytes(), param.dtype, param.device)
    if skipped is None:
        skipped = torch.zeros((), dtype=torch.int32, device=param.device)
    rows = device.filled(
        ADAM_ROWS[param.dtype],
        param=param,
        first=first,
        second=second,
        grad=grad,
        shares=shares,
        visible=visible,
        skipped=skipped,
        rows=param.shape[0],
        width=param.shape[1],
        rate=rate.max() / (1 - beta1**step),
        beta1=beta1,
        beta2=beta2,
        eps=eps,
        root=(1 - beta2**step) ** -0.5,
    )
    _kernels(param).launch("adam_kernel", (param.numel() + THREADS - 1) // THREADS, rows)
    return skipped


@functools.lru_cache(maxsize=16)
def _on_device(numbers: bytes, dtype: torch.dtype, device: torch.device) -> Tensor:
    """float64 `numbers` as a tensor; the harmonics' rates keep their shares of the largest through a training."""
    return torch.from_numpy(np.frombuffer(numbers).copy()).to(device, dtype)


def add_statistics(mean2d: Tensor, visible: Tensor, gradient: Tensor, seen: Tensor, scale: float) -> None:
    """Adds one view, where visible: scale |mean2d| to gradient, 1 to seen."""
    size = mean2d.norm(dim=1)
    gradient.add_(size.masked_fill_(visible == 0, 0), alpha=scale)
    seen.add_(visible)
