"""Differentiable rasterization of 3D Gaussians.

Follows the 3DGS equations: 2D covariance Σ' = J R Σ Rᵀ Jᵀ + 0.3 px² I, alpha = min(0.999, o·exp(−½ dᵀ Σ'⁻¹ d)), weight
w = alpha · T. Σ: covariance of the Gaussian in the world, R: rotation of the camera, J: derivative of the projection,
o: opacity, d: pixel minus projected mean, T: transmittance, the product of 1 − alpha over the Gaussians in front.
Contributions under 1/255 are skipped, front to back by depth (equal depths by index), stop before T falls under 1e-4.
rasterizer/cpu.py computes both passes on the CPU, rasterizer/device.py on a GPU.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from types import ModuleType
from typing import Any

import torch
from torch import Tensor

from perception.errors import InputError
from perception.rasterizer import cpu
from perception.rasterizer.types import Cotangents, Forward, Gradients, Inputs, Settings


@dataclass
class RasterizationStats:
    """Per-Gaussian values for densification, in pixels, and the cost of the call.

    radii: [C, N] three standard deviations along the long axis of the 2D Gaussian, 0 where it is not in view.
    mean2d_grad: [C, N] norm of the gradient of the 2D mean, of the newest backward pass; None until one has run, and
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


_DEVICES, _SIDES = ("cpu", "cuda"), range(1, (1 << 20) + 1)


def rasterizer_for(device: torch.device) -> ModuleType:
    """The module of `rasterize_forward`, `rasterize_backward` and `label_images` for tensors on `device`."""
    if device.type == "cpu":
        return cpu
    from perception.rasterizer import device as on_device

    return on_device


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, settings: Settings, stats: RasterizationStats, *tensors: Tensor | None) -> Any:
        """tensors: those of `Inputs.NAMES`, in that order, as autograd takes no names."""
        contiguous = [None if t is None else t.detach().contiguous() for t in tensors]
        inputs = Inputs(**dict(zip(Inputs.NAMES, contiguous, strict=True)))  # type: ignore[arg-type]
        out = rasterizer_for(inputs.means.device).rasterize_forward(inputs, settings)
        stats.radii = out.radii
        stats.evaluated_pairs, stats.contributing_pairs = out.frames.evaluated, out.frames.contributing
        stats.seconds = out.frames.seconds
        images = [getattr(out, name) for name in Forward.IMAGES]
        ctx.settings, ctx.stats = settings, stats
        if any(ctx.needs_input_grad):
            ctx.frames = out.frames
            ctx.save_for_backward(*tensors, *images)
        ctx.set_materialize_grads(False)
        visible = out.visible.view(torch.bool)
        ctx.mark_non_differentiable(visible)
        return (*images, visible)

    @staticmethod
    def backward(ctx: Any, *cotangents: Tensor | None) -> Any:
        gradients = _Rasterize.gradients(ctx, *cotangents)
        if torch.is_grad_enabled():  # with create_graph=True
            gradients = _Once.apply(*gradients, *ctx.saved_tensors, *cotangents)
        return None, None, *gradients

    @staticmethod
    @torch.no_grad()
    def gradients(ctx: Any, *cotangents: Tensor | None) -> tuple[Tensor | None, ...]:
        """Those of the tensors of `Inputs.NAMES`, in that order; None where not needed."""
        saved: list[Any] = [None if t is None else t.contiguous() for t in ctx.saved_tensors]
        inputs = Inputs(**dict(zip(Inputs.NAMES, saved[: len(Inputs.NAMES)], strict=True)))
        images = dict(zip(Forward.IMAGES, saved[len(Inputs.NAMES) :], strict=True))
        none = inputs.means.new_empty(0)
        state = Forward(**images, visible=none, radii=none, frames=ctx.frames)
        contiguous = [None if g is None else g.contiguous() for g in cotangents[: len(Forward.IMAGES)]]
        by_image = Cotangents(**dict(zip(Forward.IMAGES, contiguous, strict=True)))
        needed = {name for name, needs in zip(Inputs.NAMES, ctx.needs_input_grad[2:], strict=True) if needs}
        wanted = needed - {"background", "Ks"}
        gradients = Gradients.zeros(inputs, wanted if wanted == {"features"} else wanted | {"mean2d"})
        rasterizer_for(inputs.means.device).rasterize_backward(inputs, ctx.settings, state, by_image, gradients)
        ctx.stats.mean2d_grad = None if gradients.mean2d is None else gradients.mean2d.norm(dim=-1)
        ctx.stats.seconds = ctx.frames.seconds
        by_input = {name: getattr(gradients, name) for name in wanted}
        if "background" in needed and by_image.colors is not None:
            by_input["background"] = (by_image.colors * (1 - state.alphas)[..., None]).sum(dim=(1, 2))
        return tuple(by_input.get(name) for name in Inputs.NAMES)


class _Once(torch.autograd.Function):
    """Passes on gradients, the first of `tensors`, which depend on all of them; their own cannot be computed."""

    @staticmethod
    def forward(_: Any, *tensors: Tensor | None) -> Any:
        return tensors[: len(Inputs.NAMES)]

    @staticmethod
    def backward(*_: Any) -> Any:
        raise RuntimeError("rasterize: can be differentiated once only; use its gradients without create_graph=True")


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
    """Renders Gaussians into C cameras; differentiable, once, in everything but Ks.

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

    >>> means = torch.tensor([[0.0, 0.0, 2.0]], requires_grad=True)
    >>> quats, scales = torch.tensor([[1.0, 0, 0, 0]]), torch.full((1, 3), 0.1)
    >>> K = torch.tensor([[64.0, 0, 32], [0, 64, 32], [0, 0, 1]])
    >>> out = rasterize(means, quats, scales, torch.ones(1), torch.rand(1, 3), torch.eye(4)[None], K[None], 64, 64)
    >>> out.colors.shape, out.depths.shape, out.visible.tolist()
    (torch.Size([1, 64, 64, 3]), torch.Size([1, 64, 64]), [[True]])
    >>> out.alphas[0, 34, 34].backward()
    >>> bool((means.grad[0, :2] > 0).all())  # alpha grows there as the Gaussian comes nearer
    True
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
    tensors["background"] = background
    out = _Rasterize.apply(settings, stats, *(tensors[name] for name in Inputs.NAMES))
    return Rasterization(*out, stats=stats)  # type: ignore[misc]


def _check(
    tensors: dict[str, Tensor | None], width: int, height: int, sh_degree: int | None, near_plane: float, eps2d: float
) -> None:
    """Raises InputError for the first invalid argument."""
    means: Any = tensors["means"]  # the first to be checked
    for name, t in tensors.items():
        if t is None and name in ("features", "background"):
            continue
        if not isinstance(t, torch.Tensor):
            raise InputError(f"rasterize: {name} is {type(t).__name__}, expected a torch.Tensor")
        if t.device.type not in _DEVICES or t.device != means.device:
            expected = "cpu or cuda" if t is means else f"{means.device}, where means are"
            raise InputError(f"rasterize: {name} is on {t.device}, expected {expected}")
        if t.dtype not in (torch.float32, torch.float64) or t.dtype != means.dtype:
            wanted = "float32 or float64" if t is means else means.dtype
            raise InputError(f"rasterize: {name} is {t.dtype}, expected {wanted}")
    _check_shapes(tensors, sh_degree)
    _check_cameras(tensors["viewmats"], tensors["Ks"])
    if width not in _SIDES or height not in _SIDES:
        raise InputError(f"rasterize: image size {width} × {height}, expected 1 to {_SIDES[-1]} whole pixels a side")
    if not (near_plane >= 0 and near_plane < float("inf")):
        raise InputError(f"rasterize: near_plane is {near_plane}, expected a finite number ≥ 0")
    if not 0.01 <= eps2d <= 1e4:
        raise InputError(f"rasterize: eps2d is {eps2d}, expected 0.01 to 10000 px²")


def _check_cameras(viewmats: Any, Ks: Any) -> None:
    """InputError for a camera with entries that would not be used: those of a transposed pose, or of skew."""
    pose = "the last row [0, 0, 0, 1]; 3DGS and its descendants keep this matrix transposed"
    for name, fixed, expected in (
        ("viewmats", viewmats.detach()[:, 3], pose),
        ("Ks", Ks.detach()[:, (0, 1, 2, 2, 2), (1, 0, 0, 1, 2)], "[[fx, 0, cx], [0, fy, cy], [0, 0, 1]]"),
    ):
        wanted = torch.zeros_like(fixed)
        wanted[:, -1] = 1
        wrong = (fixed.isfinite() & ((fixed - wanted).abs() > 1e-4)).any(dim=1).nonzero()[:, 0].tolist()
        if wrong:
            found = (viewmats if name == "viewmats" else Ks)[wrong[0]].tolist()
            raise InputError(f"rasterize: {name}[{wrong[0]}] is {found}, expected {expected}")


def _check_shapes(tensors: dict[str, Any], sh_degree: int | None) -> None:
    n, c = tensors["means"].shape[:1], tensors["viewmats"].shape[:1]
    colors = tensors["colors"]
    color_shape: tuple[int, ...] = (*n, 3)
    if sh_degree is not None:
        if sh_degree not in range(4):
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
