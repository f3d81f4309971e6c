"""The paper's training losses with their gradients, computed by compiled kernels (OpenSplat3D, section 3).

    L = L_RGB + λ_inst2D (w_p L_pos + w_n L_neg) + λ_var L_var

Every function returns a loss with its gradient with respect to the images; nothing is recorded for torch's autograd.
All take tensors of float32 or float64 on one device and sum in float64. On the CPU the kernels use all processors
unless `_core.training.set_threads` limits them, and the result does not depend on the number of threads, bit for bit.
On another device every figure is a tensor of one element.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from perception.errors import InputError
from perception.gaussians.device import training_kernels
from perception.io.memory import Keep

_LARGEST_ID = 2**31 - 1


def _ready(name: str, tensor: Tensor) -> Tensor:
    """`tensor` detached and in C order, as the kernels need it; InputError unless float32 or float64."""
    if tensor.dtype not in (torch.float32, torch.float64):
        raise InputError(f"{name}: found {tensor.dtype}, expected float32 or float64")
    return tensor.detach().contiguous()


# ---------- photometric


@dataclass(frozen=True)
class PhotometricLoss:
    """value: (1 − β) L1 + β (1 − SSIM); gradient [H, W, C]: d value / d render; ssim is NaN (not computed) if β = 0."""

    value: float
    gradient: Tensor
    l1: float
    ssim: float


def photometric(
    render: Tensor, target: Tensor | np.ndarray, beta: float = 0.2, weight: Tensor | None = None
) -> PhotometricLoss:
    """L_RGB = (1 − β) L1 + β (1 − SSIM) (eq. 4), with its parts.

    render: [H, W, C] in [0, 1]. target: same shape, of render's dtype in [0, 1], or uint8 (read as x / 255).
    weight: [H, W] ≥ 0; the loss is the weighted mean over pixels of |x − y| and 1 − SSIM (pixels of weight
    0 still enter their neighbours' windows). All weights 0: loss 0, gradient 0.

    SSIM (Wang et al. 2004): 11 × 11 Gaussian window, σ = 1.5, C1 = .01², C2 = .03², biased moments, zero
    padding to the input's size, mean over pixels and channels, as in 3DGS. With β = 0 SSIM is skipped.
    """
    image = target if isinstance(target, Tensor) else torch.from_numpy(np.ascontiguousarray(target))
    if render.ndim != 3 or render.shape != image.shape:
        found = f"{list(render.shape)} and {list(image.shape)}"
        raise InputError(f"photometric loss: render and target have shapes {found}, expected one shape [H, W, C]")
    if render.numel() == 0 or render.shape[2] > 16:
        raise InputError(f"photometric loss: images are {list(render.shape)}, expected 1 to 16 channels, not empty")
    if not 0 <= beta <= 1:
        raise InputError(f"photometric loss: beta is {beta}, expected 0 to 1")
    render = _ready("render", render)
    if image.dtype != torch.uint8:
        image = _ready("target", image).to(render.dtype)
    if weight is not None:
        if weight.shape != render.shape[:2]:
            raise InputError(f"photometric loss: weight has shape {list(weight.shape)}, expected [H, W]")
        weight = weight.detach().to(render.dtype).contiguous()
    gradient = torch.empty_like(render)
    kernels = training_kernels(render.device)
    value, l1, ssim = kernels.photometric(render, image.contiguous(), weight, gradient, float(beta))
    return PhotometricLoss(value, gradient, l1, ssim)


# ---------- depth

_DEPTH_NOISE = 0.01
"""Relative error of depth below which the loss is quadratic: the noise of a Kinect at 2 m is 0.7 cm."""


def depth_loss(depths: Tensor, alphas: Tensor, measured: Tensor) -> tuple[float, Tensor, Tensor]:
    """L_depth = 1/|M| Σ_{p ∈ M} [α̅ ρ(D / (α d) − 1) + 1 − α], ρ(e) = sqrt(e² + σ²) − σ, over the measured pixels M.

    depths, alphas: [H, W] D = Σ z w and α = Σ w as rendered. measured: [H, W] d, 0 = none, of the same dtype. D / α is
    the expected depth. Charbonnier's ρ of the relative error bounds the pull of wrong measurements. α̅ is α taken as
    constant, so that nearly empty pixels have no large gradients. 1 − α: what a sensor measured is opaque.
    Returns the loss and its gradients with respect to depths and alphas.
    """
    if not depths.shape == alphas.shape == measured.shape or depths.ndim != 2:
        found = ", ".join(str(list(t.shape)) for t in (depths, alphas, measured))
        raise InputError(f"depth loss: found {found}, expected one shape [H, W]")
    depths, alphas, measured = _ready("depths", depths), _ready("alphas", alphas), _ready("measured", measured)
    known = measured > 0
    share = known.to(depths.dtype).div_(max(1, int(known.sum())))  # 1 / |M| at measured pixels
    target = torch.where(known, measured, torch.ones_like(measured))
    expected = depths / alphas.clamp(min=1e-6)
    error = (expected / target).sub_(1)
    length = (error * error).add_(_DEPTH_NOISE**2).sqrt_()
    pull = error.div_(length).div_(target).mul_(share)
    value = length.sub_(_DEPTH_NOISE + 1).mul_(alphas).add_(1).mul_(share)
    return training_kernels(depths.device).sum(value.reshape(-1), False), pull, expected.mul_(pull).add_(share).neg_()


# ---------- instance


@dataclass(frozen=True)
class LabelAssignment:
    """The labels of one photo as the kernels take them; reusable in all iterations.

    ids: [M] int32 ascending, 0 left out. counts: [M] int64 pixels. first: [M] int64 index of one pixel of each label.
    slots: [P] int32, each pixel's index into ids or −1. shape: (H, W).
    """

    ids: Tensor
    counts: Tensor
    first: Tensor
    slots: Tensor
    shape: tuple[int, ...]

    def to(self, device: torch.device) -> LabelAssignment:
        """The same on `device`."""
        ids, counts, first, slots = (t.to(device) for t in (self.ids, self.counts, self.first, self.slots))
        return LabelAssignment(ids, counts, first, slots, self.shape)


def assign_labels(labels: Tensor | np.ndarray, keep: Keep = np.asarray) -> LabelAssignment:
    """Indexes label image `labels` [H, W] of any integer type (0 = unlabelled, ids need not be dense). keep: for slots.

    InputError for other types and ids.
    """
    image = np.asarray(labels)
    if image.dtype.kind not in "iu":
        raise InputError(f"labels: found {image.dtype}, expected integers (0 = unlabelled)")
    if image.size and image.dtype not in (np.uint8, np.uint16, np.int32):
        low, high = int(image.min()), int(image.max())
        if low < 0 or high > _LARGEST_ID:
            raise InputError(f"labels: found ids {low} to {high}, expected 0 to {_LARGEST_ID}")
    flat = torch.from_numpy(np.ascontiguousarray(image, dtype=np.int32).reshape(-1))
    slots = torch.empty_like(flat)
    try:
        ids, counts, first = training_kernels(flat.device).assign(flat, slots)
    except ValueError as error:  # an id below 0
        raise InputError(str(error)) from None
    long = torch.int64
    return LabelAssignment(
        torch.tensor(ids, dtype=torch.int32),
        torch.tensor(counts, dtype=long),
        torch.tensor(first, dtype=long),
        torch.from_numpy(keep(slots.numpy())),
        tuple(image.shape),
    )


@dataclass(frozen=True)
class InstanceLoss:
    """value = w_pos pos + w_neg neg; gradient [H, W, D]: d value / d features.

    prototypes [M, D] float64: z_i. labels: [M] int32 ids of the prototypes, ascending.
    """

    value: float
    gradient: Tensor
    pos: float
    neg: float
    prototypes: Tensor
    labels: Tensor


def instance_loss(
    features: Tensor,
    labels: Tensor | np.ndarray | LabelAssignment,
    *,
    margin: float = 1.0,
    w_pos: float = 1.0,
    w_neg: float = 1.0,
) -> InstanceLoss:
    """L_inst2D = w_p L_pos + w_n L_neg on a rendered feature map, as in the paper.

        z_i   = 1/|M_i| Σ_{p ∈ M_i} F(p)
        L_pos = 1/N Σ_i 1/|M_i| Σ_{p ∈ M_i} ‖F(p) − z_i‖²
        L_neg = 2/(N (N − 1)) Σ_{i<j} ReLU(γ − ‖z_i − z_j‖²)

    features: [H, W, D] F. labels: [H, W] integers, 0 = unlabelled, or the result of `assign_labels`.
    The authors' released code differs: it averages L_pos over all labelled pixels instead of per mask, and takes the
    distance unsquared in L_neg.
    """
    if features.ndim != 3 or features.shape[2] < 1:
        raise InputError(f"instance loss: features are {list(features.shape)}, expected [H, W, D]")
    if not isinstance(labels, LabelAssignment):
        labels = assign_labels(labels)
    if labels.shape != tuple(features.shape[:2]):
        found = f"{list(labels.shape)} and {list(features.shape)}"
        raise InputError(f"instance loss: labels and features have shapes {found}, expected [H, W] and [H, W, D]")
    features = _ready("features", features)
    flat, counts = features.view(-1, features.shape[2]), labels.counts
    kernels = training_kernels(features.device)
    means = features.new_empty(len(counts), flat.shape[1], dtype=torch.float64)
    scatter, apart = means.new_empty(len(counts)), torch.empty_like(means)
    kernels.prototypes(flat, labels.slots, counts, labels.first, means, scatter)
    shares = 1 / (len(counts) * counts.double())
    pos = kernels.sum(shares * scatter, False)
    neg = kernels.separation(means, float(margin), apart)
    # d L_pos / d F(p) = 2 share (F(p) − z): the part through z vanishes, as Σ_p (F(p) − z) = 0.
    gradient = torch.empty_like(features)
    pull, push = 2 * w_pos * shares, w_neg * apart / counts[:, None]
    kernels.spread(flat, labels.slots, means, pull, push, gradient.view(flat.shape))
    return InstanceLoss(w_pos * pos + w_neg * neg, gradient, pos, neg, means, labels.ids)


# ---------- variance


def variance_loss(feature_variance: Tensor, weight: float = 1) -> tuple[float, Tensor]:
    """weight · L_var, L_var = 1/|I| Σ_p ‖Var(F(p))‖² of the rendered per-pixel variance, feature_variance [H, W, D].

    Returns the loss and its gradient [H, W, D]. The authors' released code also averages over the D channels.
    """
    if feature_variance.ndim != 3:
        raise InputError(f"variance loss: found {list(feature_variance.shape)}, expected [H, W, D]")
    variance = _ready("feature_variance", feature_variance)
    height, width, _ = variance.shape
    share = weight / max(1, height * width)
    kernels = training_kernels(variance.device)
    value = share * kernels.sum(variance.view(-1), True)
    gradient = torch.empty_like(variance)
    kernels.scale(variance.view(-1), 2 * share, gradient.view(-1))
    return value, gradient
