"""The CUDA kernels on a GPU, where there is one: against the CPU in float64, and twice the same bits."""

from __future__ import annotations

import pytest
import torch

from perception.gaussians import rasterize as cpu
from perception.gaussians.rasterizer import device as on_device
from support.rasterizer import cast, scene

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="torch sees no CUDA device")
NAMES = ("means", "quats", "scales", "opacities", "colors", "features", "viewmats", "Ks")


def both_passes(inputs, device, dtype):
    """Images, radii, visible and all gradients of fixed cotangents, on the CPU in float64."""
    given = {name: t.to(device, dtype) for name, t in inputs.items() if isinstance(t, torch.Tensor)}
    arguments, background = tuple(given[name] for name in NAMES), given["background"]
    settings = cpu.Settings(inputs["width"], inputs["height"], inputs["sh_degree"])
    module = on_device if device == "cuda" else cpu
    out = module.rasterize_forward(arguments, background, settings)
    images = (out.colors, out.alphas, out.depths, out.features, out.feature_variance)
    waves = [torch.sin(torch.arange(t.numel(), dtype=torch.float64)).view(t.shape).to(t) for t in images]
    *grads, mean2d = module.rasterize_backward(arguments, background, settings, out, tuple(waves), (True,) * 7)
    return [t.cpu() for t in (*images, out.radii, out.visible, *grads, mean2d)]


@pytest.mark.parametrize(("n", "size", "dims", "sh_degree"), [(300, (70, 50), 5, 0), (20_000, (640, 480), 8, 3)])
def test_float32_on_the_device_follows_float64_on_the_cpu(n, size, dims, sh_degree):
    inputs = {**scene(n=n, dims=dims, sh_degree=sh_degree), "width": size[0], "height": size[1]}
    inputs["scales"] *= 0.3
    exact, single = both_passes(inputs, "cpu", torch.float64), both_passes(cast(inputs), "cpu", torch.float32)
    found = both_passes(cast(inputs), "cuda", torch.float32)
    for a, b, true in zip(found, single, exact, strict=True):
        norm = float(true.double().norm()) or 1.0
        error, cpu_error = (float((t.double() - true.double()).norm()) / norm for t in (a, b))
        assert error <= 5 * cpu_error + 1e-5
    for a, b in zip(found, both_passes(cast(inputs), "cuda", torch.float32), strict=True):
        assert torch.equal(a, b)
