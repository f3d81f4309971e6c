"""The parameters of 3D Gaussians as stored for training, with properties for their activated values."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch

from perception.colors import rgb_from_sh, sh_from_rgb
from perception.rasterizer.types import Inputs


def sigmoid(logits: torch.Tensor) -> torch.Tensor:
    """Sigmoid 1 / (1 + exp(−x)) of each element; the result does not depend on the number of threads, bit for bit.

    torch.sigmoid depends on it above 32,768 elements: the last elements of each thread's part take another code path.
    Logits are clamped to ±80, where float32 still holds exp(x). Opacities near 1e-35 need no gradient.
    """
    return 1 / (1 + torch.exp(-logits.clamp(-80, 80)))


STORED = {
    "means": "means",
    "quats": "quats",
    "scales": "log_scales",
    "opacities": "opacity_logits",
    "colors": "sh",
    "features": "features",
}
"""The tensors of the rasterizer's inputs -> those of `Gaussians` that they are made of."""


@dataclass
class Gaussians:
    """N Gaussians in the world frame, float32.

    means [N, 3]; quats [N, 4] wxyz, any norm; log_scales [N, 3]; opacity_logits [N]; sh [N, K, 3] spherical-harmonic
    coefficients (K = (degree + 1)², constant term first); features [N, D] instance features.
    """

    means: torch.Tensor
    quats: torch.Tensor
    log_scales: torch.Tensor
    opacity_logits: torch.Tensor
    sh: torch.Tensor
    features: torch.Tensor

    def __len__(self) -> int:
        return int(self.means.shape[0])

    def named(self) -> dict[str, torch.Tensor]:
        """The tensors by name: what is optimised, and what a checkpoint holds."""
        return {name: getattr(self, name) for name in STORED.values()}

    def to(self, device: torch.device | str) -> Gaussians:
        """The same Gaussians on `device`; tensors that are there already are not copied."""
        return Gaussians(**{name: tensor.to(device) for name, tensor in self.named().items()})

    def rows(self, index: torch.Tensor) -> Gaussians:
        """Copies of the rows `index` [M] int64 selects, in its order."""
        return Gaussians(**{name: tensor[index].clone() for name, tensor in self.named().items()})

    @staticmethod
    def concatenate(parts: list[Gaussians]) -> Gaussians:
        """All rows of `parts`, in order."""
        return Gaussians(**{name: torch.cat([part.named()[name] for part in parts]) for name in parts[0].named()})

    @property
    def scales(self) -> torch.Tensor:
        return self.log_scales.exp()

    @property
    def opacities(self) -> torch.Tensor:
        return sigmoid(self.opacity_logits)

    @property
    def sh_degree(self) -> int:
        return math.isqrt(self.sh.shape[1]) - 1

    @property
    def base_colors(self) -> torch.Tensor:
        """[N, 3] RGB in about [0, 1] as seen without view dependence."""
        return rgb_from_sh(self.sh[:, 0])

    def inputs(self, camera_from_world: torch.Tensor, K: torch.Tensor, features: torch.Tensor | None = None) -> Inputs:
        """The inputs of the rasterizer for one camera, with colours that do not depend on the view.
        camera_from_world [4, 4], K [3, 3] pixels, on any device; features [N, D], where the Gaussians are."""
        device = self.means.device
        return Inputs(
            means=self.means,
            quats=self.quats,
            scales=self.scales,
            opacities=self.opacities,
            colors=self.base_colors,
            viewmats=camera_from_world[None].contiguous().to(device),
            Ks=K[None].contiguous().to(device),
            features=features,
        )


def from_points(
    points: np.ndarray, colors: np.ndarray, *, feature_dim: int, seed: int, opacity: float = 0.1
) -> Gaussians:
    """One isotropic Gaussian per point, its scale the RMS distance to the 3 nearest points (Kerbl et al. 2023, §5.1).

    points [P, 3] float; colors [P, 3] uint8. Coincident points get the median scale; all are clipped relative to it.
    """
    from scipy.spatial import cKDTree

    points = np.ascontiguousarray(points, dtype=np.float64)
    neighbours = min(4, len(points))
    if neighbours > 1:
        distances, _ = cKDTree(points).query(points, k=neighbours, workers=-1)
        spacing = np.sqrt(np.mean(distances[:, 1:] ** 2, axis=1))
    else:
        spacing = np.ones(len(points))
    positive = spacing[spacing > 0]
    typical = float(np.median(positive)) if len(positive) else 1.0
    spacing = np.clip(np.where(spacing > 0, spacing, typical), 1e-3 * typical, 10 * typical)

    generator = torch.Generator().manual_seed(seed)
    count = len(points)
    quats = torch.zeros(count, 4)
    quats[:, 0] = 1.0
    return Gaussians(
        means=torch.from_numpy(points.astype(np.float32)),
        quats=quats,
        log_scales=torch.from_numpy(np.log(spacing).astype(np.float32))[:, None].repeat(1, 3),
        opacity_logits=torch.full((count,), math.log(opacity / (1 - opacity))),
        sh=sh_from_rgb(torch.from_numpy(np.ascontiguousarray(colors)).float() / 255)[:, None, :],
        features=torch.rand(count, feature_dim, generator=generator) - 0.5,
    )
