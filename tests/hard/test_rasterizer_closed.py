"""Hard cases that algebra answers exactly: stacks of Gaussians, stops, clamps, norms, far coordinates; and bits."""

from __future__ import annotations

import math
from fractions import Fraction

import pytest
import torch

import perception
from support import reference_rasterizer as reference
from support.hard_scenes import SCENES, U, weights
from support.rasterizer import GIVEN, IMAGES, cast, every_simd_level, grads_and_images, leaves, scene  # noqa: F401

DTYPES = [torch.float32, torch.float64]


def stack(opacities, dtype=torch.float64, size=1e9):
    """Gaussians one behind the other that fill the 8 × 8 picture: alpha is the opacity to one part in (size / 4)²."""
    n = len(opacities)
    return {
        "means": torch.tensor([0.0, 0.0, 2.0], dtype=dtype).repeat(n, 1),
        "quats": torch.tensor([1.0, 0, 0, 0], dtype=dtype).repeat(n, 1),
        "scales": torch.full((n, 3), size, dtype=dtype),
        "opacities": torch.as_tensor(opacities, dtype=dtype),
        "colors": torch.rand((n, 3), generator=torch.Generator().manual_seed(0), dtype=torch.float64).to(dtype),
        "viewmats": torch.eye(4, dtype=dtype)[None],
        "Ks": torch.tensor([[[8.0, 0, 4], [0, 8, 4], [0, 0, 1]]], dtype=dtype),
        "width": 8,
        "height": 8,
    }


def blended(opacities):
    """(weights, how many are blended): exactly, in rationals."""
    left, weights = Fraction(1), []
    for opacity in opacities:
        alpha = min(Fraction(opacity), Fraction(999, 1000))
        if left * (1 - alpha) < Fraction(1, 10_000):
            break
        weights.append(alpha * left)
        left *= 1 - alpha
    return weights, len(weights)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("opacity", [0.3, 1 / 64, 0.8, 1 - 1e-7])
def test_ten_thousand_coincident_gaussians_are_a_geometric_series(dtype, opacity):
    """alpha = 1 − (1 − o)ᵏ, stopped before 1e-4; k roundings of a product of k factors, each within U or 2⁻⁵³."""
    inputs = stack(torch.full((10_000,), opacity, dtype=torch.float64), dtype)
    exact = float(inputs["opacities"][0])
    weights, count = blended([exact] * 1000)
    unit = U if dtype == torch.float32 else 2.0**-53
    out = perception.rasterize(**inputs)
    # The stop itself may turn by one Gaussian where (1 − o)ᵏ is 1e-4 to within k roundings: none of these are.
    assert int(out.visible.sum()) == count
    alpha = float(1 - math.prod([1 - Fraction(exact if exact < 0.999 else Fraction(999, 1000))] * count))
    bound = (8 * count + 32) * unit
    assert float((out.alphas - alpha).abs().max()) <= bound
    colors = sum(float(w) * inputs["colors"][i].double() for i, w in enumerate(weights))
    assert float((out.colors.double() - colors).abs().max()) <= bound


@pytest.mark.parametrize("dtype", DTYPES)
def test_gradients_of_a_stack_are_the_products_of_the_others(dtype):
    """A = 1 − Π (1 − o_j): dA / do_i = Π_{j ≠ i} (1 − o_j) for what is blended, 0 behind the stop."""
    opacities = [0.5, 0.25, 0.125, 0.75, 0.3125, 0.9375, 0.96875, 0.5, 0.984375, 0.5]
    _, count = blended(opacities)
    assert count < len(opacities)
    inputs = leaves(stack(opacities, dtype))
    perception.rasterize(**inputs).alphas[0, 3, 4].backward()
    unit = U if dtype == torch.float32 else 2.0**-53
    for i, gradient in enumerate(inputs["opacities"].grad.tolist()):
        others = [1 - Fraction(o) for j, o in enumerate(opacities[:count]) if j != i]
        expected = float(math.prod(others)) if i < count else 0.0
        # A T carried through `count` divisions by 1 − α loses no more than 1 / (1 − α) of a rounding in each.
        assert abs(gradient - expected) <= 64 * count * unit * max(expected, 1e-3), i


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("total", [100_000, pytest.param(1_000_000, marks=pytest.mark.slow)])  # over 2^16
def test_very_many_gaussians_in_one_tile(dtype, total):
    """Opacities of 1/254: the first 2,334 fill the picture to 1 − 1e-4, the rest add nothing and get nothing."""
    inputs = leaves(stack(torch.full((total,), 1 / 254, dtype=torch.float64), dtype))
    opacity = float(inputs["opacities"][0])
    count = math.floor(math.log(1e-4) / math.log1p(-opacity))
    out = perception.rasterize(**inputs)
    unit = U if dtype == torch.float32 else 2.0**-53
    seen = torch.nonzero(out.visible[0].detach()).flatten()
    slack = math.ceil(count * 8 * count * unit)  # the stop, in Gaussians: T is known to 8 k roundings
    assert abs(len(seen) - count) <= slack and int(seen[-1]) == len(seen) - 1
    alpha = 1 - (1 - opacity) ** len(seen)
    assert float((out.alphas.detach() - alpha).abs().max()) <= 8 * len(seen) * unit
    out.alphas.sum().backward()
    gradient = inputs["opacities"].grad
    expected = 64 * (1 - opacity) ** (len(seen) - 1)
    assert float((gradient[: len(seen)].double() / expected - 1).abs().max()) <= 16 * len(seen) * unit
    assert float(gradient[len(seen) :].abs().max()) == 0


@pytest.mark.parametrize("dtype", DTYPES)
def test_the_clamp_and_nothing_have_no_slope(dtype):
    """Above 0.999 alpha is constant; under 1/255 it is 0."""
    for opacity, alpha in ((1.0, 0.999), (1 - 1e-7, 0.999), (0.0, 0.0), (1 / 256, 0.0)):
        inputs = leaves(stack([opacity], dtype))
        out = perception.rasterize(**inputs)
        assert float((out.alphas.detach() - alpha).abs().max()) <= 2 * U
        out.alphas.sum().backward()
        for name in ("opacities", "means", "scales", "quats"):
            assert float(inputs[name].grad.abs().max()) == 0, name


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("factor", [2.0**-20, 2.0**-7, 2.0**9, 2.0**30])
def test_the_gradient_of_a_scaled_quaternion_is_the_gradient_divided(dtype, factor, monkeypatch):
    """f(s q) = f(q), so ∇f(s q) = ∇f(q) / s: exact in powers of two; and it is perpendicular to q.

    ∇f(q) = (g − h (h·g)) / |q|, h = q / |q| and g the gradient of the rotation's polynomial at h, whose part along h
    may be far larger than what is left of it. So q·∇f(q) = h·t with t = g − h (h·g) is bounded by |g|, not by |t|.
    With u the unit roundoff, to first order: h is off by 5 u in each component (a sum of four squares, its root, the
    inverse, a product), so 1 − |h|² is at most 10 u; h·g errs by 4 u |g|; the product with h, the difference and the
    product with 1 / |q| by u |g| each; and this test's own sum by 4 u |g|, its exact q by 5 u |g|: 26 u |g| in all.
    """
    inputs = cast(scene(n=40, cameras=1), dtype)
    grads = []
    for scale in (1.0, factor):
        given = leaves({**inputs, "quats": inputs["quats"] * scale})
        perception.rasterize(**given).colors.square().sum().backward()
        grads.append(given["quats"].grad * scale)
    assert torch.equal(grads[0], grads[1])
    along = (grads[0] * inputs["quats"]).sum(dim=1).abs()
    unit = {name: value.double() if isinstance(value, torch.Tensor) else value for name, value in inputs.items()}
    given = leaves({**unit, "quats": unit["quats"] / unit["quats"].norm(dim=1, keepdim=True)})
    monkeypatch.setattr(reference, "rotation_matrices", reference.rotation_polynomial)
    reference.rasterize(**given)["colors"].square().sum().backward()
    size = given["quats"].grad.norm(dim=1)  # |g|; 32 instead of 26 leaves room for its own error in float32
    assert bool((along <= 32 * (U if dtype == torch.float32 else 2.0**-53) * size).all())


def test_a_denormal_quaternion_has_a_finite_gradient():
    inputs = leaves(cast(scene(n=40, cameras=1)))
    with torch.no_grad():
        inputs["quats"].mul_(1e-41)
    perception.rasterize(**inputs).colors.sum().backward()
    assert bool(torch.isfinite(inputs["quats"].grad).all())


@pytest.mark.parametrize("offset", [1e6, -3e6])
def test_far_coordinates_lose_no_more_than_their_own_rounding(offset):
    """1e6 m from the origin float32 knows places to 1/16 m: the picture is that of the rounded places, in float64."""
    inputs = scene(n=60, cameras=1)
    inputs["viewmats"][0] = torch.eye(4)
    inputs["means"][:, 2] = inputs["means"][:, 2].abs() + 1
    shift = torch.tensor([offset, offset, 0.0], dtype=torch.float64)
    inputs["means"] = (inputs["means"] + shift).float().double()
    inputs["viewmats"][0, :3, 3] = -shift
    exact, single = perception.rasterize(**inputs), perception.rasterize(**cast(inputs))
    near = {**inputs, "means": inputs["means"] - shift, "viewmats": torch.eye(4, dtype=torch.float64)[None]}
    torch.testing.assert_close(exact.colors, perception.rasterize(**near).colors, rtol=1e-8, atol=1e-8)
    assert bool(torch.isfinite(single.colors).all())
    # m + t is exact here: both lie within a factor of two of each other (Sterbenz), x, y and z apart.
    same = perception.rasterize(**cast(near))
    torch.testing.assert_close(single.colors, same.colors, rtol=0, atol=4 * U)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_a_background_that_is_not_finite_is_named(value):
    inputs = scene(n=5, cameras=2)
    inputs["background"][1, 2] = value
    with pytest.raises(perception.InputError, match=r"background\[1\] is not finite"):
        perception.rasterize(**inputs)


@pytest.mark.parametrize("factor", [1e-30, 1e-15, 1e15])
@pytest.mark.parametrize("name", ["means", "scales", "colors", "features", "background", "viewmats", "Ks"])
def test_float32_holds_whatever_lies_within_1e15(name, factor):
    """Images and gradients of finite inputs are finite; beyond, squares of gradients' factors may overflow."""
    inputs = scene(n=60, cameras=1)
    inputs[name] = inputs[name] * factor
    if name in ("Ks", "viewmats"):
        inputs[name][:, -1, -1] = 1
    given = leaves(cast(inputs))
    out = perception.rasterize(**given)
    sum(getattr(out, image).sum() for image in IMAGES).backward()
    assert all(bool(torch.isfinite(getattr(out, image)).all()) for image in IMAGES)
    for argument in GIVEN:
        assert bool(torch.isfinite(given[argument].grad).all()), argument


def test_a_cotangent_that_is_not_finite_reaches_only_what_its_tile_shows():
    """What a loss sends into one pixel is nobody's concern elsewhere; Adam skips and counts what is not finite."""
    inputs = leaves(cast(scene(n=200, cameras=1)))
    out = perception.rasterize(**inputs)
    row, column = 14, 18
    picks = torch.zeros_like(out.colors)
    picks[0, row, column] = float("nan")
    out.colors.backward(picks)
    seen = weights(perception.rasterize, cast(scene(n=200, cameras=1))) > 0
    pixel, tile = seen[row, column], seen[:16, 16:32].flatten(0, 1).any(dim=0)
    assert 0 < int(pixel.sum()) <= int(tile.sum()) < 200
    for name in ("means", "opacities", "colors", "scales"):
        spoilt = ~torch.isfinite(inputs[name].grad.reshape(200, -1)).all(dim=1)
        assert bool((pixel <= spoilt).all()) and bool((spoilt <= tile).all()), name


# ------------------------------------------------------------------------ bits


@pytest.mark.parametrize("name", SCENES)
def test_hard_scenes_have_the_same_bits_for_any_number_of_threads(name):
    inputs = cast(SCENES[name]())
    one = grads_and_images(inputs, threads=1)
    for threads in (2, 3):
        for a, b in zip(one, grads_and_images(inputs, threads=threads), strict=True):
            assert torch.equal(a, b)


@pytest.mark.parametrize("threads", [1, 2, 3])
def test_cameras_in_a_batch_have_the_bits_they_have_alone(threads):
    """Images and what is each camera's own gradient; gradients of what cameras share add up in the order given."""
    inputs = scene(n=300, cameras=3, dtype=torch.float32)
    batch = leaves(inputs)
    together = perception.rasterize(**batch, threads=threads)
    sum(getattr(together, name).square().sum() for name in IMAGES).backward()
    shared = {name: torch.zeros_like(inputs[name]) for name in ("means", "quats", "scales", "opacities", "colors")}
    for c in range(3):
        own = {k: inputs[k][c : c + 1].clone() for k in ("viewmats", "Ks", "background")}
        alone = leaves({**inputs, **own})
        out = perception.rasterize(**alone, threads=threads)
        sum(getattr(out, name).square().sum() for name in IMAGES).backward()
        for name in (*IMAGES, "visible"):
            assert torch.equal(getattr(together, name)[c], getattr(out, name)[0])
        for name in ("viewmats", "background"):
            assert torch.equal(batch[name].grad[c], alone[name].grad[0])
        for name, total in shared.items():
            total += alone[name].grad
    for name, total in shared.items():
        scale = float(total.abs().max())
        torch.testing.assert_close(batch[name].grad, total, rtol=0, atol=8 * U * scale, msg=name)


@pytest.mark.parametrize("threads", [1, 2, 3])
def test_ties_are_blended_in_the_order_given_whatever_it_is(threads):
    """Equal depths from equal z: every order of the inputs is its own picture, the one a loop over that order gives."""
    inputs = SCENES["depth ties"]()
    for seed in range(3):
        order = torch.randperm(40, generator=torch.Generator().manual_seed(seed))
        turned = {k: v[order] if isinstance(v, torch.Tensor) and len(v) == 40 else v for k, v in inputs.items()}
        one_by_one = turned["means"].clone()
        one_by_one[:, 2] += torch.arange(40, dtype=torch.float64) * 1e-13
        out = perception.rasterize(**turned, threads=threads)
        expected = perception.rasterize(**{**turned, "means": one_by_one}, threads=1)
        torch.testing.assert_close(out.colors, expected.colors, rtol=1e-9, atol=1e-10)
