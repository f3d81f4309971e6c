"""Differentiable rasterization of 3D Gaussians: the torch side of the compiled kernels of the CPU.

Follows the 3DGS equations: 2D covariance J R Σ Rᵀ Jᵀ + 0.3 px² I, alpha = min(0.999, o·exp(−½ dᵀ Σ⁻¹ d)),
contributions under 1/255 skipped, front to back by depth (equal depths by index), stop before the
transmittance falls under 1e-4. Tensors on a CUDA device go to perception/gaussians/cuda.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from torch import Tensor

from perception import _core
from perception.errors import InputError


@dataclass
class RasterizationStats:
    """Per-Gaussian values for densification, in pixels, and the cost of the call.

    radii: [C, N] three standard deviations along the long axis of the 2D Gaussian, 0 where it is not in view.
    mean2d_grad: [C, N] norm of the loss's gradient with respect to the 2D mean; None until backward has run, and
        if it ran for the features alone.
    evaluated_pairs, contributing_pairs: (Gaussian, pixel) pairs over all cameras: those evaluated in SIMD
    registers (more on wider registers), and those that contributed colour. Speed is reported in the latter. CUDA: 0.
    seconds: wall clock by stage: project, sort, bin, blend, and from the backward pass blend_backward, reduce.
    """

    radii: Tensor
    mean2d_grad: Tensor | None = None
    evaluated_pairs: int = 0
    contributing_pairs: int = 0
    seconds: dict[str, float] = field(default_factory=dict)


@dataclass
class Rasterization:
    """What `rasterize` returns; images are channels last."""

    colors: Tensor  # [C, H, W, 3]
    alphas: Tensor  # [C, H, W]
    depths: Tensor  # [C, H, W] expected z-depth, alpha-weighted (not divided by alpha)
    features: Tensor | None  # [C, H, W, D] Σ f w
    feature_variance: Tensor | None  # [C, H, W, D] Σ f² w − (Σ f w)²
    visible: Tensor  # [C, N] bool: contributed to some pixel
    stats: RasterizationStats


@dataclass(frozen=True)
class Settings:
    """Rasterization settings. simd: "auto", "avx512", "avx2" or "baseline"; threads: 0 for torch's number.

    max_records: most gradient records (one per Gaussian and 64 × 64-pixel tile, 4 (16 + D) bytes in float32) held at
    once. The backward pass processes larger images in parts. 0: four per visible Gaussian, at least 2**20. On a GPU
    tiles have 16 × 16 pixels, and 0 means 2**24.
    """

    width: int
    height: int
    sh_degree: int = -1
    near_plane: float = 0.01
    eps2d: float = 0.3
    variance: bool = True
    depth: bool = True
    threads: int = 0
    simd: str = "auto"
    max_records: int = 0


_DEVICES = ("cpu", "cuda")
simd_levels = _core.simd_levels
"""The SIMD levels this processor supports, best first."""


_threads: ContextVar[int] = ContextVar("threads", default=0)


@contextmanager
def torch_on_one_thread() -> Iterator[None]:
    """Within it torch computes on one thread, and the rasterizer by default on as many as torch had before.

    Idle workers of torch's OpenMP pool busy-wait for milliseconds, on processors that the rasterizer's threads need.
    With two threads on two processors that others use as well, a training step took four times the CPU time.
    """
    before = torch.get_num_threads()
    token = _threads.set(_threads.get() or before)
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
        _threads.reset(token)


def _core_function(name: str, tensor: Tensor) -> Any:
    return getattr(_core, f"{name}_{'f64' if tensor.dtype == torch.float64 else 'f32'}")


def _numpy(tensor: Tensor | None) -> Any:
    """The tensor's memory as numpy, without a copy; None stays None."""
    return None if tensor is None else tensor.detach().numpy()


@dataclass
class Forward:
    """Result of `rasterize_forward`: images, and what `rasterize_backward` needs (frames)."""

    colors: Tensor
    alphas: Tensor
    depths: Tensor | None
    features: Tensor | None
    feature_variance: Tensor | None
    visible: Tensor
    radii: Tensor
    frames: Any

    @classmethod
    def empty(cls, inputs: tuple[Tensor | None, ...], settings: Settings) -> Forward:
        """Images to be written; Gaussians not visible, with radius 0."""
        means, features, viewmats = inputs[0], inputs[5], inputs[6]
        assert means is not None and viewmats is not None  # for the type checker
        count, n = viewmats.shape[0], means.shape[0]
        image = (count, settings.height, settings.width)
        new = means.new_empty
        dims = 0 if features is None else features.shape[1]
        return cls(
            colors=new((*image, 3)),
            alphas=new(image),
            depths=new(image) if settings.depth else None,
            features=None if features is None else new((*image, dims)),
            feature_variance=new((*image, dims)) if features is not None and settings.variance else None,
            visible=means.new_zeros((count, n), dtype=torch.uint8),
            radii=means.new_zeros((count, n)),
            frames=None,
        )


def _core_inputs(inputs: tuple[Tensor | None, ...], background: Tensor | None, settings: Settings) -> Any:
    means, quats, scales, opacities, colors, features, viewmats, ks = inputs
    assert means is not None  # for the type checker
    arrays = [_numpy(t) for t in (means, quats, scales, opacities, colors, features, viewmats, ks, background)]
    return _core_function("RasterizerInputs", means)(
        *arrays,
        settings.width,
        settings.height,
        settings.sh_degree,
        settings.near_plane,
        settings.eps2d,
        settings.threads or _threads.get() or torch.get_num_threads(),
        settings.depth,
        settings.variance,
        settings.max_records,
    )


def rasterize_forward(inputs: tuple[Tensor | None, ...], background: Tensor | None, settings: Settings) -> Forward:
    """One forward pass, no autograd.

    inputs: means [N,3], quats [N,4], scales [N,3], opacities [N], colors [N,3] or [N,K,3], features [N,D] or
    None, viewmats [C,4,4], Ks [C,3,3]: contiguous CPU tensors of one dtype. background: [C,3] or None.
    """
    out = Forward.empty(inputs, settings)
    images = (out.colors, out.alphas, out.depths, out.features, out.feature_variance, out.visible, out.radii)
    try:
        out.frames = _core_function("rasterize_forward", out.colors)(
            _core_inputs(inputs, background, settings), *(_numpy(t) for t in images), settings.simd
        )
    except ValueError as error:
        raise InputError(f"rasterize: {error}") from None
    return out


def label_images(
    inputs: tuple[Tensor | None, ...], labels: np.ndarray, least: float, settings: Settings
) -> tuple[np.ndarray, np.ndarray]:
    """For each of up to 8 labellings, the label with the largest weight in every pixel of one camera (C = 1).

    inputs: as for `rasterize_forward`. labels [L, N] int32, −1 = none, < 2^24. A label's weight in a pixel is the sum
    of alpha · transmittance over its Gaussians. Of equal weights the smaller label wins. Returns images [L, H, W]
    int32, −1 where no weight exceeds `least`, and [N] bool: whether each Gaussian contributes to some pixel.
    """
    means = inputs[0]
    assert means is not None  # for the type checker
    if means.device.type != "cpu":
        from perception.gaussians.rasterizer import device as on_device

        return on_device.label_images(inputs, labels, least, settings)
    images = np.empty((len(labels), settings.height, settings.width), np.int32)
    visible = np.zeros(len(means), np.uint8)
    core = _core_function("rasterize_labels", means)
    try:
        core(_core_inputs(inputs, None, settings), np.ascontiguousarray(labels), least, images, visible, settings.simd)
    except ValueError as error:
        raise InputError(f"rasterize: {error}") from None
    return images, visible.view(bool)


def rasterize_backward(
    inputs: tuple[Tensor | None, ...],
    background: Tensor | None,
    settings: Settings,
    forward: Forward,
    cotangents: tuple[Tensor | None, ...],
    wanted: tuple[bool, ...],
    stored: list[Tensor | None] | None = None,
) -> list[Tensor | None]:
    """One backward pass, no autograd.

    cotangents: dL/d colors, alphas, depths, features, feature_variance; None means zero. wanted: which of the
    first seven inputs want a gradient. Returns those gradients and dL/d(2D mean) [C, N, 2] in pixels, None if `wanted`
    names the features alone: this takes less time.
    stored: such a list that the gradients of one camera are written to, for visible Gaussians only. Those of scales and
    opacities are then with respect to their logarithms and logits.
    """
    means, viewmats = inputs[0], inputs[6]
    assert means is not None and viewmats is not None  # for the type checker
    grads = stored or [
        torch.zeros_like(t, memory_format=torch.contiguous_format) if t is not None and w else None
        for t, w in zip(inputs[:7], wanted, strict=True)
    ]
    if stored is None:
        alone = [index for index, w in enumerate(wanted) if w] == [5]
        grads.append(None if alone else means.new_zeros((viewmats.shape[0], means.shape[0], 2)))
    images = (forward.colors, forward.alphas, forward.depths, forward.features, forward.feature_variance)
    contiguous = [None if g is None else g.contiguous() for g in cotangents]
    _core_function("rasterize_backward", means)(
        _core_inputs(inputs, background, settings),
        forward.frames,
        *(_numpy(t) for t in (*images, *contiguous, *grads)),
        stored is not None,
    )
    return grads


def passes(device: torch.device) -> tuple[Callable[..., Forward], Callable[..., Any]]:
    """The forward and the backward pass for tensors on `device`."""
    if device.type == "cpu":
        return rasterize_forward, rasterize_backward
    from perception.gaussians.rasterizer import device as on_device

    return on_device.rasterize_forward, on_device.rasterize_backward


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, background: Tensor | None, settings: Settings, stats: RasterizationStats, *inputs: Any
    ) -> Any:
        contiguous = tuple(None if t is None else t.detach().contiguous() for t in inputs)
        shade = None if background is None else background.detach().contiguous()
        run, _ = passes(contiguous[0].device)  # type: ignore[union-attr]
        out = run(contiguous, shade, settings)
        stats.radii = out.radii
        stats.evaluated_pairs, stats.contributing_pairs = out.frames.evaluated, out.frames.contributing
        stats.seconds = out.frames.seconds
        images = (out.colors, out.alphas, out.depths, out.features, out.feature_variance)
        ctx.settings, ctx.stats = settings, stats
        if any(ctx.needs_input_grad):
            ctx.frames = out.frames
            ctx.save_for_backward(*contiguous, shade, *images)
        ctx.set_materialize_grads(False)
        visible = out.visible.view(torch.bool)
        ctx.mark_non_differentiable(visible)
        return (*images, visible)

    @staticmethod
    def backward(ctx: Any, *cotangents: Tensor | None) -> Any:
        saved = ctx.saved_tensors
        inputs, background, images = saved[:8], saved[8], saved[9:]
        wanted = tuple(ctx.needs_input_grad[3:10])
        none = images[0].new_empty(0)
        state = Forward(*images, visible=none, radii=none, frames=ctx.frames)  # type: ignore[misc]
        _, run = passes(images[0].device)
        *grads, mean2d = run(inputs, background, ctx.settings, state, cotangents[:5], wanted)
        ctx.stats.mean2d_grad = None if mean2d is None else mean2d.norm(dim=-1)
        ctx.stats.seconds = ctx.frames.seconds
        shade = None
        if ctx.needs_input_grad[0] and cotangents[0] is not None:
            shade = (cotangents[0] * (1 - state.alphas)[..., None]).sum(dim=(1, 2))
        return (shade, None, None, *grads, None)


def rasterize(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    sh_degree: int | None = None,
    features: Tensor | None = None,
    background: Tensor | None = None,
    near_plane: float = 0.01,
    *,
    eps2d: float = 0.3,
    variance: bool = True,
    depth: bool = True,
    threads: int = 0,
    simd: str = "auto",
) -> Rasterization:
    """Renders Gaussians into C cameras; differentiable in everything but Ks.

    means [N,3] world, quats [N,4] wxyz of any norm, scales [N,3] > 0, opacities [N] in [0,1] (activated
    values), colors [N,3] RGB, or [N,K,3] spherical-harmonic coefficients of degree `sh_degree` (0 to 3,
    K ≥ (sh_degree+1)²; 0.5 added, clamped at 0),
    viewmats [C,4,4] camera_from_world, Ks [C,3,3] pixels (pixel centres at +0.5, no skew), features [N,D],
    background [3] or [C,3]. float32 or float64 on the CPU, float32 on CUDA. Gradients flow to all of them except Ks.

    Not drawn are Gaussians behind the near plane, and those outside the guard band (Kerbl et al. 2023, §6): their mean
    is outside 1.3 times the field of view, and over 5 times as far from the optical axis as from the camera's plane.

    eps2d: px² added to the diagonal of every 2D covariance, the variance of the pixel's blur (named as in gsplat).
    variance=False and depth=False save time: `feature_variance` and `depths` are not computed (None).
    threads: 0 takes torch.get_num_threads(). The result is the same, bit for bit, for any number of threads.
    Finite inputs up to 1e15 in magnitude give finite images and gradients. InputError names a non-finite input.
    """
    tensors = {
        "means": means, "quats": quats, "scales": scales, "opacities": opacities, "colors": colors,
        "features": features, "viewmats": viewmats, "Ks": Ks, "background": background,
    }  # fmt: skip
    _check(tensors, width, height, sh_degree, near_plane, eps2d)
    if background is not None and background.ndim == 1:
        background = background.expand(viewmats.shape[0], 3)
    settings = Settings(
        int(width), int(height), -1 if sh_degree is None else int(sh_degree), float(near_plane), float(eps2d),
        variance and features is not None, depth, threads, simd,
    )  # fmt: skip
    stats = RasterizationStats(radii=means.new_zeros((0,)))
    out = _Rasterize.apply(background, settings, stats, means, quats, scales, opacities, colors, features, viewmats, Ks)
    return Rasterization(*out, stats=stats)  # type: ignore[misc]


def _check(
    tensors: dict[str, Tensor | None], width: int, height: int, sh_degree: int | None, near_plane: float, eps2d: float
) -> None:
    """Raises InputError for the first invalid argument."""
    means = tensors["means"]
    for name, t in tensors.items():
        if t is None and name in ("features", "background"):
            continue
        if not isinstance(t, torch.Tensor):
            raise InputError(f"rasterize: {name} is {type(t).__name__}, expected a torch.Tensor")
        if t.device.type not in _DEVICES or (means is not None and t.device != means.device):
            place = "cpu or cuda" if means is None or t is means else f"{means.device}, where means are"
            raise InputError(f"rasterize: {name} is on {t.device}, expected {place}")
        if t.dtype not in (torch.float32, torch.float64) or (means is not None and t.dtype != means.dtype):
            wanted = "float32 or float64" if means is None or t is means else means.dtype
            raise InputError(f"rasterize: {name} is {t.dtype}, expected {wanted}")
    _check_shapes(tensors, sh_degree)
    if not (1 <= width <= 1 << 20 and 1 <= height <= 1 << 20):
        raise InputError(f"rasterize: image size {width} × {height}, expected 1 to 1048576 pixels a side")
    if not (near_plane >= 0 and near_plane < float("inf")):
        raise InputError(f"rasterize: near_plane is {near_plane}, expected a finite number ≥ 0")
    if not 0.01 <= eps2d <= 1e4:
        raise InputError(f"rasterize: eps2d is {eps2d}, expected 0.01 to 10000 px²")


def _check_shapes(tensors: dict[str, Any], sh_degree: int | None) -> None:
    n, c = tensors["means"].shape[:1], tensors["viewmats"].shape[:1]
    colors = tensors["colors"]
    color_shape: tuple[int, ...] = (*n, 3)
    if sh_degree is not None:
        if not 0 <= sh_degree <= 3:
            raise InputError(f"rasterize: sh_degree is {sh_degree}, expected 0 to 3")
        k = colors.shape[1] if colors.ndim == 3 else 0
        color_shape = (*n, max(k, (sh_degree + 1) ** 2), 3)
    expected: dict[str, tuple[int, ...]] = {
        "means": (*n, 3), "quats": (*n, 4), "scales": (*n, 3), "opacities": (*n,), "colors": color_shape,
        "viewmats": (*c, 4, 4), "Ks": (*c, 3, 3),
    }  # fmt: skip
    features, background = tensors["features"], tensors["background"]
    if features is not None:
        expected["features"] = (*n, features.shape[1] if features.ndim == 2 else 0)
    if background is not None:
        expected["background"] = (3,) if background.ndim == 1 else (*c, 3)
    for name, shape in expected.items():
        if tuple(tensors[name].shape) != shape:
            raise InputError(f"rasterize: {name} has shape {list(tensors[name].shape)}, expected {list(shape)}")
