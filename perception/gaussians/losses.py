"""The paper's training losses with their gradients, computed by compiled kernels (OpenSplat3D, section 3).

    L = L_RGB + λ_inst2D (w_p L_pos + w_n L_neg) + λ_var L_var

Every function returns a loss with its gradient with respect to the images; nothing is recorded for torch's autograd.
All take tensors of float32 or float64 on one device and sum in float64. On the CPU the kernels use all processors
unless `_core.training.set_threads` limits them, and the result does not depend on the number of threads, bit for bit.
On another device every figure is a tensor of one element. The kernels refuse tensors of wrong shapes (ValueError).
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
import torch
from torch import Tensor

from perception.gaussians.device import training_kernels
from perception.io.memory import Keep


@dataclass(frozen=True)
class PhotometricLoss:
    """value: (1 − β) L1 + β (1 − SSIM); gradient [H, W, C]: d value / d render; ssim is NaN (not computed) if β = 0."""

    value: float
    gradient: Tensor
    l1: float
    ssim: float


def photometric(render: Tensor, target: Tensor, beta: float, weight: Tensor | None = None) -> PhotometricLoss:
    """L_RGB = (1 − β) L1 + β (1 − SSIM) (eq. 4), with its parts.

    render: [H, W, C] in [0, 1]. target: same shape, of render's dtype in [0, 1], or uint8 (read as x / 255).
    weight: [H, W] ≥ 0; the loss is the weighted mean over pixels of |x − y| and 1 − SSIM (pixels of weight
    0 still enter their neighbours' windows). All weights 0: loss 0, gradient 0.

    SSIM (Wang et al. 2004): 11 × 11 Gaussian window, σ = 1.5, C1 = .01², C2 = .03², biased moments, zero
    padding to the input's size, mean over pixels and channels, as in 3DGS. With β = 0 SSIM is skipped.
    """
    render = render.detach().contiguous()
    weight = None if weight is None else weight.to(render.dtype).contiguous()
    gradient = torch.empty_like(render)
    kernels = training_kernels(render.device)
    value, l1, ssim = kernels.photometric(render, target.contiguous(), weight, gradient, beta)
    return PhotometricLoss(value, gradient, l1, ssim)


_DEPTH_NOISE = 0.01  # σ, the relative error up to which the loss is quadratic: a Kinect's noise at 2 m is 0.7 cm


def depth_loss(depths: Tensor, alphas: Tensor, measured: Tensor) -> tuple[float, Tensor, Tensor]:
    """L_depth = 1/|M| Σ_{p ∈ M} [α̅ ρ(D / (α d) − 1) + 1 − α], ρ(e) = sqrt(e² + σ²) − σ, over the measured pixels M.

    depths, alphas: [H, W] D = Σ z w and α = Σ w as rendered, with z the depth of a Gaussian and w its weight in the
    pixel, so D / α is the expected depth. measured: [H, W] d, 0 = none, of the same dtype. e: the relative error, whose
    Charbonnier norm ρ bounds the pull of wrong measurements. α̅ is α taken as constant, so that nearly empty pixels have
    no large gradients. 1 − α: what a sensor measured is opaque. Returns the loss and its gradients with respect to
    depths and alphas.
    """
    known = measured > 0
    share = known.to(depths.dtype).div_(max(1, int(known.sum())))  # 1 / |M| at measured pixels
    target = torch.where(known, measured, torch.ones_like(measured))
    expected = depths / alphas.clamp(min=1e-6)
    error = (expected / target).sub_(1)
    length = (error * error).add_(_DEPTH_NOISE**2).sqrt_()
    pull = error.div_(length).div_(target).mul_(share)
    value = length.sub_(_DEPTH_NOISE + 1).mul_(alphas).add_(1).mul_(share)
    return training_kernels(depths.device).sum(value.reshape(-1), False), pull, expected.mul_(pull).add_(share).neg_()


@dataclass(frozen=True)
class LabelAssignment:
    """The M labels of one photo of P pixels as the kernels take them; reusable in all iterations.

    ids: [M] int32 ascending, 0 left out. counts: [M] int64 pixels. first: [M] int64 index of one pixel of each label.
    slots: [P] int32, each pixel's index into ids or −1.
    """

    ids: Tensor
    counts: Tensor
    first: Tensor
    slots: Tensor

    def to(self, device: torch.device) -> LabelAssignment:
        """The same on `device`."""
        return LabelAssignment(**{field.name: getattr(self, field.name).to(device) for field in fields(self)})


def assign_labels(labels: Tensor, keep: Keep = np.asarray) -> LabelAssignment:
    """Indexes label image `labels` [H, W] of any integer type on the CPU: 0 = unlabelled, ids below 2³¹ that need not
    be dense. keep: for slots. ValueError for an id below 0."""
    flat = labels.reshape(-1).to(torch.int32)
    slots = torch.empty_like(flat)
    ids, counts, first = training_kernels(flat.device).assign(flat, slots)
    return LabelAssignment(
        ids=torch.tensor(ids, dtype=torch.int32),
        counts=torch.tensor(counts, dtype=torch.int64),
        first=torch.tensor(first, dtype=torch.int64),
        slots=torch.from_numpy(keep(slots.numpy())),
    )


@dataclass(frozen=True)
class InstanceLoss:
    """value = w_pos pos + w_neg neg; gradient [H, W, D]: d value / d features; prototypes [M, D] float64: z_i."""

    value: float
    gradient: Tensor
    pos: float
    neg: float
    prototypes: Tensor


def instance_loss(
    features: Tensor, labels: LabelAssignment, *, margin: float, w_pos: float, w_neg: float
) -> InstanceLoss:
    """L_inst2D = w_p L_pos + w_n L_neg on a rendered feature map, as in the paper.

        z_i   = 1/|M_i| Σ_{p ∈ M_i} F(p)
        L_pos = 1/N Σ_i 1/|M_i| Σ_{p ∈ M_i} ‖F(p) − z_i‖²
        L_neg = 2/(N (N − 1)) Σ_{i<j} ReLU(γ − ‖z_i − z_j‖²)

    features: [H, W, D] F. labels: masks M_i, i = 1 … N, as `assign_labels` gives them. z_i: the prototype of a mask.
    margin: γ. The authors' released code differs: it averages L_pos over all labelled pixels instead of per mask, and
    takes the distance unsquared in L_neg.
    """
    features = features.detach().contiguous()
    flat, counts = features.view(-1, features.shape[2]), labels.counts
    kernels = training_kernels(features.device)
    means = features.new_empty(len(counts), flat.shape[1], dtype=torch.float64)
    scatter, apart = means.new_empty(len(counts)), torch.empty_like(means)
    kernels.prototypes(flat, labels.slots, counts, labels.first, means, scatter)
    shares = 1 / (len(counts) * counts.double())
    pos = kernels.sum(shares * scatter, False)
    neg = kernels.separation(means, margin, apart)
    # d L_pos / d F(p) = 2 share (F(p) − z): the part through z vanishes, as Σ_p (F(p) − z) = 0.
    gradient = torch.empty_like(features)
    pull, push = 2 * w_pos * shares, w_neg * apart / counts[:, None]
    kernels.spread(flat, labels.slots, means, pull, push, gradient.view(flat.shape))
    return InstanceLoss(w_pos * pos + w_neg * neg, gradient, pos, neg, means)


def variance_loss(variance: Tensor, weight: float) -> tuple[float, Tensor]:
    """weight · L_var, L_var = 1/|I| Σ_p ‖Var(F(p))‖² of `variance` [H, W, D], Var(F(p)) as rendered.

    |I|: pixels of the image. Returns the loss and its gradient [H, W, D]. The authors' released code also averages over
    the D channels.
    """
    variance = variance.detach().contiguous()
    share = weight / (variance.shape[0] * variance.shape[1])
    kernels = training_kernels(variance.device)
    value = share * kernels.sum(variance.view(-1), True)
    gradient = torch.empty_like(variance)
    kernels.scale(variance.view(-1), 2 * share, gradient.view(-1))
    return value, gradient
