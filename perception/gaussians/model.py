"""The parameters of 3D Gaussians as stored for training, with properties for their activated values."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from scipy.spatial import cKDTree

from perception.colors import rgb_from_sh, sh_from_rgb
from perception.gaussians.device import training_kernels
from perception.geometry import nearest
from perception.machine import Item, Result, in_threads, torch_on_one_thread
from perception.map.map import Map
from perception.rasterizer.types import Inputs


def exponential(values: torch.Tensor) -> torch.Tensor:
    """exp(x) of each element; the result does not depend on the number of threads, bit for bit.

    torch's depend on it above 32,768 elements: the last elements of each thread's part take another code path.
    """
    return values.exp() if values.device.type != "cpu" else _activated(values, logistic=False)


def sigmoid(logits: torch.Tensor) -> torch.Tensor:
    """Sigmoid 1 / (1 + exp(−x)) of each element, with the bits that `exponential` promises.

    Logits are clamped to ±80, where float32 still holds exp(x). Opacities near 1e-35 need no gradient.
    """
    if logits.device.type != "cpu":
        return torch.sigmoid(logits.clamp(-80, 80))  # two launches, not six
    return _activated(logits, logistic=True)


def _activated(values: torch.Tensor, logistic: bool) -> torch.Tensor:
    values = values.detach().contiguous()
    out = torch.empty_like(values)
    training_kernels(values.device).activate(values.view(-1), logistic, out.view(-1))
    return out


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
        return Gaussians(**{name: tensor.index_select(0, index) for name, tensor in self.named().items()})

    def with_coefficients(self, count: int) -> Gaussians:
        """The same Gaussians with `count` ≥ K spherical-harmonic coefficients, the new ones 0."""
        more = self.sh.new_zeros(len(self), count - self.sh.shape[1], 3)
        return replace(self, sh=torch.cat([self.sh, more], dim=1))

    @staticmethod
    def concatenate(parts: list[Gaussians]) -> Gaussians:
        """All rows of `parts`, in order."""
        return Gaussians(**{name: torch.cat([part.named()[name] for part in parts]) for name in parts[0].named()})

    @property
    def scales(self) -> torch.Tensor:
        return exponential(self.log_scales)

    @property
    def opacities(self) -> torch.Tensor:
        return sigmoid(self.opacity_logits)

    @property
    def sh_degree(self) -> int:
        return min(3, math.isqrt(self.sh.shape[1]) - 1)  # the rasterizer's highest

    @property
    def base_colors(self) -> torch.Tensor:
        """[N, 3] RGB in about [0, 1] as seen without view dependence."""
        return rgb_from_sh(self.sh[:, 0])

    def inputs(
        self,
        camera_from_world: torch.Tensor,
        K: torch.Tensor,
        features: torch.Tensor | None = None,
        *,
        harmonics: bool = False,
        background: torch.Tensor | None = None,
    ) -> Inputs:
        """The inputs of the rasterizer for one camera: camera_from_world [4, 4], K [3, 3] pixels, background [1, 3], on
        any device; features [N, D], where the Gaussians are.

        harmonics: colours depend on the view. False uses the constant term, which is enough for visibility, depth and
        features.
        """
        device = self.means.device
        return Inputs(
            means=self.means,
            quats=self.quats,
            scales=self.scales,
            opacities=self.opacities,
            colors=self.sh if harmonics else self.base_colors,
            viewmats=camera_from_world[None].contiguous().to(device),
            Ks=K[None].contiguous().to(device),
            features=features,
            background=None if background is None else background.to(device),
        )


class HeldGaussians(Gaussians):
    """Gaussians whose geometry and colours stay as they are: their activated values are computed once, not for each
    view. Of millions, a view shows few."""

    @cached_property
    def scales(self) -> torch.Tensor:
        return super().scales

    @cached_property
    def opacities(self) -> torch.Tensor:
        return super().opacities

    @cached_property
    def base_colors(self) -> torch.Tensor:
        return super().base_colors


def as_gaussians(gmap: Map) -> Gaussians:
    """A map's Gaussians as tensors."""
    return Gaussians(**{name: torch.from_numpy(np.ascontiguousarray(getattr(gmap, name))) for name in STORED.values()})


def from_points(
    points: np.ndarray, colors: np.ndarray, *, feature_dim: int, seed: int, opacity: float = 0.1
) -> Gaussians:
    """One isotropic Gaussian per point, its scale the RMS distance to the 3 nearest points (Kerbl et al. 2023, §5.1).

    points [P, 3] float; colors [P, 3] uint8. Coincident points get the median scale; all are clipped relative to it.
    """
    points = np.ascontiguousarray(points, dtype=np.float64)
    neighbours = min(4, len(points))
    if neighbours > 1:
        distances, _ = nearest(cKDTree(points), points, range(2, neighbours + 1))
        spacing = np.sqrt(np.mean(distances**2, axis=1))
    else:
        spacing = np.ones(len(points))
    positive = spacing[spacing > 0]
    typical = float(np.median(positive)) if len(positive) else 1.0
    spacing = np.clip(np.where(spacing > 0, spacing, typical), 1e-3 * typical, 10 * typical)

    generator = torch.Generator().manual_seed(seed)
    rgb = torch.from_numpy(np.ascontiguousarray(colors)).float() / 255
    log_scales = torch.from_numpy(np.log(spacing).astype(np.float32))
    return isotropic(points, log_scales, rgb, opacity, feature_dim, generator)


def isotropic(
    points: np.ndarray,
    log_scales: torch.Tensor,
    rgb: torch.Tensor,
    opacity: float,
    feature_dim: int,
    generator: torch.Generator,
) -> Gaussians:
    """Balls of one opacity at points [P, 3], log_scales [P], rgb [P, 3] in [0, 1], with random features."""
    quats = torch.zeros(len(points), 4)
    quats[:, 0] = 1.0
    return Gaussians(
        means=torch.from_numpy(points.astype(np.float32)),
        quats=quats,
        log_scales=log_scales[:, None].repeat(1, 3),
        opacity_logits=torch.full((len(points),), math.log(opacity / (1 - opacity))),
        sh=sh_from_rgb(rgb)[:, None],
        features=torch.rand(len(points), feature_dim, generator=generator) - 0.5,
    )


class Nearby:
    """A model on the device that is to render it; of a scene trained in blocks, a photo is shown only those around it.

    rows: by photo, those of the Gaussians it may show, int64 arrays to be joined, in one list for all photos that show
    the same ones. A photo that is not listed may show all Gaussians.
    """

    def __init__(self, gaussians: Gaussians, rows: Mapping[str, Sequence[np.ndarray]] | None = None) -> None:
        self.gaussians, self._rows = gaussians, rows or {}
        self._all = [np.arange(len(gaussians))]
        self._last: tuple[Sequence[np.ndarray], Gaussians, np.ndarray] = self._all, gaussians, self._all[0]

    def of(self, photo: str) -> tuple[Gaussians, np.ndarray]:
        """The Gaussians near a photo, and their rows in the model."""
        parts, found = self._rows.get(photo, self._all), self._last
        if parts is not found[0]:
            rows = np.concatenate(parts)
            chosen = torch.from_numpy(rows).to(self.gaussians.means.device)
            found = parts, self.gaussians if parts is self._all else self.gaussians.rows(chosen), rows
            self._last = found
        return found[1:]

    def each(self, work: Callable[[Item], Result], views: Iterable[Item]) -> Iterator[Result]:
        """work(view) of each view, in order, which renders this model. On the CPU each core works on one view at a
        time, with the same results; of a scene trained in blocks that would be as many copies of parts of the model."""
        if self._rows or self.gaussians.means.device.type != "cpu":
            yield from map(work, views)
            return
        with torch_on_one_thread():
            yield from in_threads(work, views)

    def parts(self, photos: Sequence[str]) -> tuple[list[np.ndarray], list[list[int]]]:
        """The rows of each part of the model that one of the photos may show, and of each photo the parts' numbers."""
        of_photo = [self._rows.get(photo, self._all) for photo in photos]
        known = {id(rows): rows for parts in of_photo for rows in parts}
        number = {key: n for n, key in enumerate(known)}
        return list(known.values()), [[number[id(rows)] for rows in parts] for parts in of_photo]
