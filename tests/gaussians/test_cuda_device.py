"""The CUDA kernels on a GPU, where there is one: against the CPU in float64, and twice the same bits."""

from __future__ import annotations

import pytest
import torch

from perception.rasterizer import cpu
from perception.rasterizer import device as on_device
from perception.rasterizer.types import Cotangents, Gradients, Settings
from support.rasterizer import EVERY_GRADIENT, IMAGES, cast, passed, scene

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="torch sees no CUDA device")


def both_passes(inputs, device, dtype):
    """Images, radii, visible and all gradients of fixed cotangents, on the CPU in float64."""
    given = passed({name: t.to(device, dtype) for name, t in inputs.items() if isinstance(t, torch.Tensor)})
    settings = Settings(inputs["width"], inputs["height"], inputs["sh_degree"])
    module = on_device if device == "cuda" else cpu
    out = module.rasterize_forward(given, settings)
    images = [getattr(out, name) for name in IMAGES]
    waves = [torch.sin(torch.arange(t.numel(), dtype=torch.float64)).view(t.shape).to(t) for t in images]
    gradients = Gradients.zeros(given, EVERY_GRADIENT)
    cotangents = Cotangents(**dict(zip(IMAGES, waves, strict=True)))
    module.rasterize_backward(given, settings, out, cotangents, gradients)
    grads = [getattr(gradients, name) for name in EVERY_GRADIENT]
    return [t.cpu() for t in (*images, out.radii, out.visible, *grads)]


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
