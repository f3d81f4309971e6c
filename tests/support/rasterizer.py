"""Random scenes for the rasterizer, and what its tests do with them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import pytest
import torch

import perception
from perception.rasterizer import cpu
from perception.rasterizer.cpu import simd_levels
from perception.rasterizer.types import Inputs
from support import reference_rasterizer as reference

IMAGES = ("colors", "alphas", "depths", "features", "feature_variance")
EVERY_GRADIENT = ("means", "quats", "scales", "opacities", "colors", "features", "viewmats", "mean2d")
GIVEN = ("means", "quats", "scales", "opacities", "colors", "features", "viewmats", "background")


LEVELS = [pytest.param(level, marks=[pytest.mark.slow] * (level != simd_levels()[0])) for level in simd_levels()]


@pytest.fixture(params=LEVELS, autouse=True)
def every_simd_level(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """Where it is imported, every test of the file runs once at each level that the processor has.

    The quick part of the suite runs the first, which is the widest.
    """
    forward = cpu.rasterize_forward

    def at_level(inputs, settings):
        return forward(inputs, replace(settings, simd=request.param) if settings.simd == "auto" else settings)

    monkeypatch.setattr(cpu, "rasterize_forward", at_level)
    yield request.param


def scene(n=60, width=37, height=29, dims=5, cameras=2, sh_degree=None, dtype=torch.float64, seed=0):
    """Random Gaussians before cameras with an off-centre principal point; some behind, some off screen."""
    g = torch.Generator().manual_seed(seed)

    def rand(*shape):
        return torch.rand(shape, generator=g, dtype=torch.float64)

    means = (rand(n, 3) - 0.5) * torch.tensor([4.0, 3.0, 4.0]) + torch.tensor([0.0, 0.0, 2.2])
    viewmats = torch.eye(4, dtype=torch.float64).repeat(cameras, 1, 1)
    for c in range(cameras):
        q = torch.tensor([[1.0, 0.05 * c, -0.1 * c, 0.08 * c]], dtype=torch.float64)
        viewmats[c, :3, :3] = reference.rotation_matrices(q)[0]
        viewmats[c, :3, 3] = torch.tensor([0.1 * c, -0.05, 0.2 * c])
    k = torch.tensor([[30.0, 0, 16.0], [0, 34.0, 17.0], [0, 0, 1]], dtype=torch.float64).repeat(cameras, 1, 1)
    color_shape = (n, 3) if sh_degree is None else (n, (sh_degree + 1) ** 2, 3)
    inputs = {
        "means": means,
        "quats": rand(n, 4) * 2 - 1,
        "scales": torch.exp(rand(n, 3) * 2.5 - 3.5),
        "opacities": rand(n) * 0.98 + 0.01,
        "colors": rand(*color_shape) - (0.0 if sh_degree is None else 0.3),
        "features": (rand(n, dims) - 0.5) if dims else None,
        "viewmats": viewmats,
        "Ks": k,
        "background": rand(cameras, 3),
    }
    inputs = {name: None if t is None else t.to(dtype) for name, t in inputs.items()}
    return {**inputs, "width": width, "height": height, "sh_degree": sh_degree}


def passed(inputs):
    """A scene as both passes take it."""
    return Inputs(**{name: inputs.get(name) for name in (*GIVEN, "Ks")})


def leaves(inputs, skip=("Ks",)):
    """The same scene with every differentiable input a leaf of its own."""
    return {
        k: v.clone().requires_grad_() if isinstance(v, torch.Tensor) and k not in skip else v for k, v in inputs.items()
    }


def loss_of(images, seed=1):
    g = torch.Generator().manual_seed(seed)
    total = torch.zeros((), dtype=torch.float64)
    for t in images:
        total = total + (t.double() * (torch.rand(t.shape, generator=g, dtype=torch.float64) - 0.4)).sum()
    return total


def grads_and_images(inputs, **options):
    inputs = leaves(inputs)
    out = perception.rasterize(**inputs, **options)
    images = [getattr(out, k) for k in IMAGES if getattr(out, k) is not None]
    loss_of(images).backward()
    grads = [t.grad for t in inputs.values() if isinstance(t, torch.Tensor) and t.requires_grad]
    images = [t.detach() for t in images]
    return [*images, out.visible, out.stats.radii, out.stats.mean2d_grad, *grads]


def cast(inputs, dtype=torch.float32):
    return {k: v.to(dtype) if isinstance(v, torch.Tensor) else v for k, v in inputs.items()}
