"""The tensors and settings of one call of the rasterizer, by name."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor


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


@dataclass(frozen=True)
class Inputs:
    """N Gaussians and C cameras, as `perception.rasterize` takes them; contiguous, of one dtype, on one device."""

    NAMES: ClassVar = ("means", "quats", "scales", "opacities", "colors", "viewmats", "Ks", "features", "background")

    means: Tensor  # [N, 3]
    quats: Tensor  # [N, 4]
    scales: Tensor  # [N, 3]
    opacities: Tensor  # [N]
    colors: Tensor  # [N, 3], or [N, K, 3] harmonics where `Settings.sh_degree` is 0 or more
    viewmats: Tensor  # [C, 4, 4]
    Ks: Tensor  # [C, 3, 3]
    features: Tensor | None = None  # [N, D]
    background: Tensor | None = None  # [C, 3]


@dataclass
class Forward:
    """What a forward pass returns: images as in `Rasterization`, and what the backward pass needs (frames)."""

    IMAGES: ClassVar = ("colors", "alphas", "depths", "features", "feature_variance")

    colors: Tensor
    alphas: Tensor
    depths: Tensor | None
    features: Tensor | None
    feature_variance: Tensor | None
    visible: Tensor  # [C, N] uint8
    radii: Tensor  # [C, N]
    frames: Any = None

    @classmethod
    def empty(cls, inputs: Inputs, settings: Settings) -> Forward:
        """Images to be written; Gaussians not visible, with radius 0."""
        features, new = inputs.features, inputs.means.new_empty
        count, n = len(inputs.viewmats), len(inputs.means)
        image = (count, settings.height, settings.width)
        dims = 0 if features is None else features.shape[1]
        return cls(
            colors=new((*image, 3)),
            alphas=new(image),
            depths=new(image) if settings.depth else None,
            features=None if features is None else new((*image, dims)),
            feature_variance=new((*image, dims)) if features is not None and settings.variance else None,
            visible=inputs.means.new_zeros((count, n), dtype=torch.uint8),
            radii=inputs.means.new_zeros((count, n)),
        )


@dataclass(frozen=True)
class Cotangents:
    """dL/d(image) for each image of `Forward`, contiguous; None means zero."""

    colors: Tensor | None = None
    alphas: Tensor | None = None
    depths: Tensor | None = None
    features: Tensor | None = None
    feature_variance: Tensor | None = None


@dataclass
class Gradients:
    """dL/d(input) for each tensor of `Inputs` that has one, and for the 2D means in pixels; None: not wanted.

    absgrad: Σ over the pixels of the size of what each adds to mean2d (AbsGS, Ye et al. 2024). Slices of the feature
    channels, 16 at once on a CPU and 8 on a GPU, are taken by their sizes too."""

    NAMES: ClassVar = ("means", "quats", "scales", "opacities", "colors", "viewmats", "features", "mean2d", "absgrad")

    means: Tensor | None = None
    quats: Tensor | None = None
    scales: Tensor | None = None
    opacities: Tensor | None = None
    colors: Tensor | None = None
    viewmats: Tensor | None = None
    features: Tensor | None = None
    mean2d: Tensor | None = None  # [C, N, 2]
    absgrad: Tensor | None = None  # [C, N, 2]

    @classmethod
    def zeros(cls, inputs: Inputs, wanted: Collection[str]) -> Gradients:
        """Zeros for the tensors named in `wanted`."""

        def zero(name: str) -> Tensor:
            if name in ("mean2d", "absgrad"):
                return inputs.means.new_zeros((len(inputs.viewmats), len(inputs.means), 2))
            return torch.zeros_like(getattr(inputs, name), memory_format=torch.contiguous_format)

        return cls(**{name: zero(name) for name in wanted})
