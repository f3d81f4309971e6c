"""The compiled rasterizer against the naive one: values, gradients, invariances."""

from __future__ import annotations

import pytest
import reference_rasterizer as reference
import torch

import perception

IMAGES = ("colors", "alphas", "depths", "features", "feature_variance")


def scene(n=60, width=37, height=29, dims=5, cameras=2, sh_degree=None, dtype=torch.float64, seed=0):
    """Random Gaussians in front of cameras with an off-centre principal point; some behind, some off screen."""
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


def leaves(inputs, skip=("Ks",)):
    """The same scene with every differentiable input a leaf of its own."""
    return {
        k: v.clone().requires_grad_() if isinstance(v, torch.Tensor) and k not in skip else v
        for k, v in inputs.items()
    }


def loss_of(images, seed=1):
    g = torch.Generator().manual_seed(seed)
    total = torch.zeros((), dtype=torch.float64)
    for t in images:
        total = total + (t.double() * (torch.rand(t.shape, generator=g, dtype=torch.float64) - 0.4)).sum()
    return total


@pytest.mark.parametrize("simd", ["avx512", "avx2", "baseline"])
@pytest.mark.parametrize(("dims", "sh_degree"), [(5, None), (8, 0), (13, 1), (16, 2), (21, 3)])
def test_double_build_equals_the_naive_rasterizer(simd, dims, sh_degree):
    from perception.gaussians.rasterize import simd_levels

    if simd not in simd_levels():
        pytest.skip(f"this processor has no {simd}")
    inputs = scene(dims=dims, sh_degree=sh_degree)
    ours_in, theirs_in = leaves(inputs), leaves(inputs)
    ours = perception.rasterize(**ours_in, simd=simd)
    theirs = reference.rasterize(**theirs_in)
    for name in IMAGES:
        torch.testing.assert_close(getattr(ours, name), theirs[name], rtol=1e-10, atol=1e-11)
    assert torch.equal(ours.visible, theirs["visible"])
    loss_of([getattr(ours, name) for name in IMAGES]).backward()
    loss_of([theirs[name] for name in IMAGES]).backward()
    for name, t in ours_in.items():
        if isinstance(t, torch.Tensor) and t.requires_grad:
            expected = theirs_in[name].grad
            torch.testing.assert_close(t.grad, expected, rtol=1e-8, atol=1e-9 * float(expected.abs().max()), msg=name)
