"""The CUDA kernels on a GPU, where there is one: against the CPU in float64, and twice the same bits."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from perception import _core
from perception.gaussians.losses import assign_labels, instance_loss
from perception.rasterizer import cpu
from perception.rasterizer import device as on_device
from perception.rasterizer.cuda import training
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
    wanted = (*EVERY_GRADIENT, "absgrad")
    gradients = Gradients.zeros(given, wanted)
    cotangents = Cotangents(**dict(zip(IMAGES, waves, strict=True)))
    module.rasterize_backward(given, settings, out, cotangents, gradients)
    grads = [getattr(gradients, name) for name in wanted]
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


def random(*shape, seed=0):
    return torch.rand(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("size", [(40, 57), (480, 640)])
def test_the_photometric_loss_in_float32_follows_float64(size):
    x, y, weight = random(*size, 3), random(*size, 3, seed=1), random(*size, seed=2).round(decimals=1)
    exact = torch.empty_like(x)
    wanted = _core.training.photometric(x, (255 * y).round().to(torch.uint8), weight, exact, 0.2)
    on_gpu = [t.float().cuda() for t in (x, weight)]
    found = [torch.empty_like(on_gpu[0]) for _ in range(2)]
    for gradient in found:
        values = training.photometric(on_gpu[0], (255 * y).round().to(torch.uint8).cuda(), on_gpu[1], gradient, 0.2)
    assert [float(v) for v in values] == pytest.approx(list(wanted), rel=1e-5)
    assert float((found[0].cpu() - exact).norm()) <= 1e-4 * float(exact.norm())
    assert torch.equal(*found)


@pytest.mark.parametrize("width", [1, 3, 48])
def test_adam_in_float32_follows_float64(width):
    exact = [random(5000, width, seed=s) for s in range(3)]
    single, found = [t.float() for t in exact], [t.float().cuda() for t in exact]
    rates, visible = np.linspace(0.01, 0.1, width), (random(5000, seed=9) > 0.4).to(torch.uint8)
    for step in range(1, 6):
        gradient = random(5000, width, seed=10 + step) - 0.5
        gradient[step] = torch.nan
        skipped = []
        for kernels, (param, first, second) in ((_core.training, exact), (_core.training, single), (training, found)):
            g, seen = gradient.to(param), visible.to(param.device)
            skipped.append(int(kernels.adam(param, g, first, second, seen, rates, step, 0.9, 0.999, 1e-15)))
        assert len(set(skipped)) == 1
    for a, b, true in zip(found, single, exact, strict=True):
        error, cpu_error = (float((t.double().cpu() - true).norm()) for t in (a, b))
        assert error <= 3 * cpu_error + 1e-7 * float(true.norm())


def test_the_instance_loss_in_float32_follows_float64():
    features, image = 5 + 0.3 * random(240, 320, 11), (20 * random(240, 320, seed=3)).int()
    assigned = assign_labels(image)
    exact = instance_loss(features, assigned, margin=1.0, w_pos=0.3, w_neg=0.7)
    there = assigned.to(torch.device("cuda"))
    first, again = (instance_loss(features.float().cuda(), there, margin=1.0, w_pos=0.3, w_neg=0.7) for _ in range(2))
    assert float(first.value) == pytest.approx(exact.value, rel=1e-5)
    assert float((first.gradient.cpu() - exact.gradient).norm()) <= 1e-4 * float(exact.gradient.norm())
    assert torch.equal(first.gradient, again.gradient) and torch.equal(first.prototypes, again.prototypes)
