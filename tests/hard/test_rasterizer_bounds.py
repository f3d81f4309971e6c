"""Every hard scene: values and gradients against the naive rasterizer, float32 within a derived bound of float64."""

from __future__ import annotations

import math
from functools import cache

import pytest
import torch

import perception
from support import reference_rasterizer as reference
from support.hard_scenes import SCENES, U, relative_bound, weights
from support.rasterizer import GIVEN, IMAGES, cast, every_simd_level, leaves, loss_of  # noqa: F401


def gradients(rasterize, inputs):
    """Gradients of a fixed mixture of all images, by name."""
    inputs = leaves(inputs)
    out = rasterize(**inputs)
    loss_of([out[name] if isinstance(out, dict) else getattr(out, name) for name in IMAGES]).backward()
    return {name: inputs[name].grad for name in GIVEN}


@cache
def naive(name):
    """(images, gradients) of a scene by the naive rasterizer, computed once for all SIMD levels."""
    inputs = SCENES[name]()
    return reference.rasterize(**inputs), gradients(reference.rasterize, inputs)


@cache
def bounded(name):
    """(inputs of float32 values in float64, `relative_bound`, pixels away from thresholds, naive weights), likewise."""
    inputs = {k: v.float().double() if isinstance(v, torch.Tensor) else v for k, v in SCENES[name]().items()}
    return inputs, *relative_bound(inputs), weights(reference.rasterize, inputs)


@pytest.mark.parametrize("name", SCENES)
def test_float64_is_the_naive_rasterizer(name):
    """Values to 1e-9 of the largest; gradients to 1e-7 of each argument's largest."""
    inputs, (expected, theirs) = SCENES[name](), naive(name)
    out, ours = perception.rasterize(**inputs), gradients(perception.rasterize, inputs)
    for image in IMAGES:
        scale = float(expected[image].abs().max())
        torch.testing.assert_close(getattr(out, image), expected[image], rtol=1e-9, atol=1e-9 * scale, msg=image)
    assert torch.equal(out.visible, expected["visible"])
    for argument in GIVEN:
        scale = float(theirs[argument].abs().max())
        assert math.isfinite(scale), argument
        torch.testing.assert_close(ours[argument], theirs[argument], rtol=1e-7, atol=1e-7 * scale, msg=argument)


@pytest.mark.parametrize("name", SCENES)
def test_float32_weights_keep_their_bound(name):
    """What each Gaussian adds to each pixel, off the thresholds where one rounding decides between all and nothing."""
    inputs, bound, away, exact = bounded(name)
    single = weights(perception.rasterize, cast(inputs))
    assert bool(torch.isfinite(single).all())
    error = ((single - exact).abs() - 4 * U)[away] / exact[away].clamp(min=1e-300)
    assert bool((error <= bound[away]).all()), float((error / bound[away]).max())


@pytest.mark.parametrize("name", SCENES)
def test_float32_gradients_of_colours_and_opacities_keep_their_bound(name):
    """L = Σ_p g_p C_p with b_p the largest bound on a weight's relative error in pixel p.

    dL/dc_i = Σ g w_i errs by Σ |g| w_i b. dL/do_i = Σ g G_i T_i (c_i − R_i), R_i the colour behind, a weighted mean:
    all three factors are products of weights, |c_i − R_i| ≤ 2 max |c|, so it errs by Σ |g| (w_i / o_i) 2 max |c| 3 b.
    Sums over P pixels add P U of the sum of magnitudes. Pixels on a threshold may be off by all that they hold.
    """
    inputs, bound, away, w = bounded(name)
    inputs = {**inputs, "background": None}
    found = weights(perception.rasterize, cast(inputs))
    opacity = inputs["opacities"].clamp(min=1e-300)
    steep = (w / w.new_tensor(1).sub(_before(inputs, w)).clamp(min=1e-9)) > 0.99  # near the clamp of alpha
    away = away & ~steep.any(dim=-1)
    worst = torch.where(away, bound.amax(dim=-1), torch.ones_like(bound[..., 0]))
    g = torch.rand(away.shape, generator=torch.Generator().manual_seed(3), dtype=torch.float64) - 0.4
    grads = []
    for given in (leaves(inputs), leaves(cast(inputs))):
        image = perception.rasterize(**given).colors[0]
        (image * g[..., None].to(image.dtype)).sum().backward()
        grads.append((given["colors"].grad.double(), given["opacities"].grad.double()))
    (color, opaque), (color32, opaque32) = grads
    held = g.abs()[..., None] * torch.maximum(w, found)
    slack = worst[..., None] + away.numel() * U
    limit = (held * slack).sum(dim=(0, 1))
    assert bool(((color32 - color).abs() <= limit[:, None] + 4 * U * g.abs().sum()).all())
    # The slope of a threshold pixel is at most 1 / (1 − α) ≤ 1000 times what it holds.
    slope = torch.where(away, 6 * worst, torch.full_like(worst, 2000.0))[..., None] + 2 * away.numel() * U
    limit = (held * slope).sum(dim=(0, 1)) / opacity * inputs["colors"].abs().max()
    assert bool(((opaque32 - opaque).abs() <= limit + 1e-5 * g.abs().sum()).all())


def _before(inputs, w):
    """[H, W, N] Σ of the weights in front of each Gaussian."""
    z = inputs["means"] @ inputs["viewmats"][0, 2, :3] + inputs["viewmats"][0, 2, 3]
    order = torch.argsort(z, stable=True)
    before = torch.empty_like(w)
    before[..., order] = torch.cumsum(w[..., order], dim=-1) - w[..., order]
    return before


@pytest.mark.parametrize("name", SCENES)
def test_float32_gradients_are_finite_and_near_those_of_float64(name):
    """Every argument. No bound is derived for sums that cancel: within 2 % of the largest component, except where a
    pixel lies on a threshold in some Gaussian; needles and far cameras magnify roundings and are held to be finite."""
    inputs, bound, away, w = bounded(name)
    exact, single = gradients(perception.rasterize, inputs), gradients(perception.rasterize, cast(inputs))
    known = bool(away.all()) and float(bound[w > 0].max()) < 1e-2
    for argument in GIVEN:
        assert bool(torch.isfinite(single[argument]).all()), argument
        if known:
            scale = float(exact[argument].abs().max())
            error = float((single[argument].double() - exact[argument]).abs().max())
            assert error <= 0.02 * scale + 1e-6, argument
