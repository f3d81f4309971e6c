"""Every hard scene: values and gradients against the naive rasterizer, float32 within a derived bound of float64."""

from __future__ import annotations

import math

import pytest
import reference_rasterizer as reference
import torch
from hard_scenes import SCENES, U, relative_bound, weights
from test_rasterizer import IMAGES, leaves, loss_of

import perception

GIVEN = ("means", "quats", "scales", "opacities", "colors", "features", "viewmats", "background")


def cast(inputs, dtype=torch.float32):
    return {k: v.to(dtype) if isinstance(v, torch.Tensor) else v for k, v in inputs.items()}


def gradients(rasterize, inputs):
    """Gradients of a fixed mixture of all images, by name."""
    inputs = leaves(inputs)
    out = rasterize(**inputs)
    loss_of([out[name] if isinstance(out, dict) else getattr(out, name) for name in IMAGES]).backward()
    return {name: inputs[name].grad for name in GIVEN}


@pytest.mark.parametrize("name", SCENES)
def test_float64_is_the_naive_rasterizer(name):
    """Values to 1e-9 of the largest; gradients to 1e-7 of each argument's largest."""
    inputs = SCENES[name]()
    out, expected = perception.rasterize(**inputs), reference.rasterize(**inputs)
    for image in IMAGES:
        scale = float(expected[image].abs().max())
        torch.testing.assert_close(getattr(out, image), expected[image], rtol=1e-9, atol=1e-9 * scale, msg=image)
    assert torch.equal(out.visible, expected["visible"])
    ours, theirs = gradients(perception.rasterize, inputs), gradients(reference.rasterize, inputs)
    for argument in GIVEN:
        scale = float(theirs[argument].abs().max())
        assert math.isfinite(scale), argument
        torch.testing.assert_close(ours[argument], theirs[argument], rtol=1e-7, atol=1e-7 * scale, msg=argument)


@pytest.mark.parametrize("name", SCENES)
def test_float32_weights_keep_their_bound(name):
    """What each Gaussian adds to each pixel, off the thresholds where one rounding decides between all and nothing."""
    inputs = {k: v.float().double() if isinstance(v, torch.Tensor) else v for k, v in SCENES[name]().items()}
    bound, away = relative_bound(inputs)
    exact, single = weights(reference.rasterize, inputs), weights(perception.rasterize, cast(inputs))
    assert bool(torch.isfinite(single).all())
    error = ((single - exact).abs() - 4 * U)[away] / exact[away].clamp(min=1e-300)
    assert bool((error <= bound[away]).all()), float((error / bound[away]).max())
