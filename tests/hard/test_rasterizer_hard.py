"""Numerical hard cases: against float64, closed forms, or the promise of finite results."""

from __future__ import annotations

import pytest
import torch

import perception
from perception.rasterizer import cpu
from perception.rasterizer.types import Cotangents, Gradients, Settings
from support import reference_rasterizer as reference
from support.rasterizer import EVERY_GRADIENT, IMAGES, every_simd_level, leaves, loss_of, passed, scene  # noqa: F401

DTYPES = [torch.float32, torch.float64]


def cast(inputs, dtype):
    return {k: v.to(dtype) if isinstance(v, torch.Tensor) else v for k, v in inputs.items()}


def assert_finite(inputs):
    inputs = leaves(inputs)
    out = perception.rasterize(**inputs)
    images = [getattr(out, k) for k in IMAGES if getattr(out, k) is not None]
    loss_of(images).backward()
    for t in [*images, *(t.grad for t in inputs.values() if isinstance(t, torch.Tensor) and t.requires_grad)]:
        assert bool(torch.isfinite(t).all())
    assert float(out.alphas.min()) >= 0 and float(out.alphas.max()) <= 1
    return out


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("value", [0.0, 1e-40, 1e-8, 1e4, 1e12, 1e25])
def test_scales_from_zero_to_huge(dtype, value):
    for axes in (slice(0, 3), slice(0, 1), slice(1, 3)):
        inputs = scene(n=40, cameras=1)
        inputs["scales"][:, axes] = value
        assert_finite(cast(inputs, dtype))


def test_scale_extremes_equal_the_naive_rasterizer():
    for value in (0.0, 1e-8, 1e4):
        inputs = scene(n=40, cameras=1)
        inputs["scales"][::2, 0] = value
        out, expected = perception.rasterize(**inputs), reference.rasterize(**inputs)
        torch.testing.assert_close(out.colors, expected["colors"], rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("dtype", DTYPES)
def test_quaternions_of_any_norm(dtype):
    inputs = scene(n=40, cameras=1, seed=5)
    expected = perception.rasterize(**cast(inputs, dtype)).colors
    for scale in (1e-30, 1e-6, 1e6, 1e30):
        out = assert_finite(cast({**inputs, "quats": inputs["quats"] * scale}, dtype))
        tolerance = 1e-4 if dtype == torch.float32 else 1e-12
        assert float((out.colors - expected).abs().mean()) < tolerance
    zero = {**inputs, "quats": torch.zeros_like(inputs["quats"])}
    identity = torch.zeros_like(inputs["quats"])
    identity[:, 0] = 1
    same = perception.rasterize(**cast({**inputs, "quats": identity}, dtype))
    assert torch.equal(assert_finite(cast(zero, dtype)).colors, same.colors)
    assert_finite(cast({**inputs, "quats": inputs["quats"] * 1e-42}, dtype))


@pytest.mark.parametrize("dtype", DTYPES)
def test_near_plane_and_behind(dtype):
    inputs = scene(n=200, cameras=1)
    inputs["viewmats"][0] = torch.eye(4)
    inputs["means"][:, 2] = torch.linspace(-0.5, 0.5, 200)
    inputs["means"][100, 2] = 0.01  # exactly on the plane: not drawn
    out = assert_finite(cast(inputs, dtype))
    assert not bool(out.visible[0, :101].any())
    exact, expected = perception.rasterize(**inputs), reference.rasterize(**inputs)
    torch.testing.assert_close(exact.colors, expected["colors"], rtol=1e-8, atol=1e-9)


@pytest.mark.parametrize("dtype", DTYPES)
def test_a_large_gaussian_beside_the_camera_is_no_haze_before_the_picture(dtype):
    """A wall before the camera, and a long Gaussian on each side along the line of sight: they enter the field of view
    at twice the wall's distance, so the picture is that of the wall alone. By their means they lie before it."""
    inputs = cast(scene(n=3, cameras=1), dtype)
    inputs["viewmats"][0] = torch.eye(4)
    inputs["means"][:] = torch.tensor([[0.0, 0.0, 4.0], [5.5, 0.0, 0.6], [0.0, -5.5, 0.6]])
    inputs["scales"][:] = torch.tensor([[50.0, 50.0, 0.01], [0.3, 0.3, 4.0], [0.3, 0.3, 4.0]])
    inputs["quats"][:] = torch.tensor([1.0, 0.0, 0.0, 0.0])
    inputs["opacities"][:] = 0.9
    out = perception.rasterize(**inputs)
    wall = {name: inputs[name][:1] for name in ("means", "quats", "scales", "opacities", "colors", "features")}
    torch.testing.assert_close(out.colors, perception.rasterize(**{**inputs, **wall}).colors, rtol=0, atol=0)
    assert out.visible[0].tolist() == [True, False, False]
    inputs["Ks"][0, 0, 0] = inputs["Ks"][0, 1, 1] = 1.0  # all means are in the picture of a camera that sees this wide
    assert perception.rasterize(**inputs).visible[0].tolist() == [True, True, True]


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize(
    ("focal", "cx", "cy"), [(1.0, 16.0, 17.0), (1e5, 16.0, 17.0), (30.0, -200.0, 17.0), (30.0, 16.0, 900.0)]
)
def test_odd_cameras(dtype, focal, cx, cy):
    inputs = scene(n=60, cameras=1)
    inputs["Ks"] = torch.tensor([[[focal, 0, cx], [0, focal, cy], [0, 0, 1]]], dtype=torch.float64)
    assert_finite(cast(inputs, dtype))
    out, expected = perception.rasterize(**inputs), reference.rasterize(**inputs)
    torch.testing.assert_close(out.colors, expected["colors"], rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize(("width", "height"), [(1, 1), (1, 4096), (4096, 1), (63, 65), (17, 5)])
def test_image_shapes(width, height):
    inputs = {**scene(n=20, cameras=1), "width": width, "height": height}
    out, expected = perception.rasterize(**inputs), reference.rasterize(**inputs)
    for name in IMAGES:
        torch.testing.assert_close(getattr(out, name), expected[name], rtol=1e-9, atol=1e-10)
    assert_finite(cast(inputs, torch.float32))


def test_nothing_to_draw_is_the_background():
    inputs = scene(n=0)
    out = assert_finite(inputs)
    assert torch.equal(out.colors, inputs["background"][:, None, None, :].expand_as(out.colors))
    assert float(out.alphas.abs().max()) == 0 and out.visible.shape == (2, 0)
    none = {**inputs, "viewmats": inputs["viewmats"][:0], "Ks": inputs["Ks"][:0], "background": None}
    assert perception.rasterize(**none).colors.shape == (0, 29, 37, 3)


def test_opacity_ends_and_the_clamp():
    inputs = scene(n=2, cameras=1)
    inputs["means"][:] = torch.tensor([0.0, 0.0, 2.0])
    inputs["viewmats"][0] = torch.eye(4)
    inputs["scales"][:] = 1e3
    inputs["opacities"][:] = torch.tensor([0.0, 1 - 1e-7])
    out = assert_finite(cast(inputs, torch.float32))
    assert out.visible[0].tolist() == [False, True]
    torch.testing.assert_close(out.alphas, torch.full_like(out.alphas, 0.999))


def test_ten_thousand_coincident_gaussians():
    inputs = scene(n=1, cameras=1, dims=2)
    inputs["means"][:] = torch.tensor([0.0, 0.0, 2.0])
    inputs["opacities"][:] = 0.3
    per_gaussian = ("means", "quats", "scales", "opacities", "colors", "features")
    many = {**inputs, **{k: inputs[k].repeat(10000, *[1] * (inputs[k].ndim - 1)) for k in per_gaussian}}
    out = assert_finite(cast(many, torch.float32))
    exact = perception.rasterize(**many)
    assert float((out.colors - exact.colors).abs().mean()) < 1e-5
    # transmittance never falls under the stop
    assert float(exact.alphas.max()) <= 1 - 1e-4


def test_variance_does_not_cancel():
    # Features of 1e4 ± 1e-2: the textbook E[f²] − E[f]² has no correct digit left in float32.
    inputs = scene(n=400, cameras=1, dims=8)
    inputs["opacities"] = inputs["opacities"] * 0.2 + 0.75
    g = torch.Generator().manual_seed(2)
    noise = torch.randn((400, 8), generator=g, dtype=torch.float64) * 1e-2
    for offset in (1e4, -1e4, 1.0, 0.0):
        inputs["features"] = (noise + offset).float().double()
        out, exact = perception.rasterize(**cast(inputs, torch.float32)), perception.rasterize(**inputs)
        a = exact.alphas[..., None]
        mean = exact.features / a.clamp(min=1e-9)
        spread = exact.feature_variance - a * (1 - a) * mean**2  # M2
        transparent = a * (out.alphas.double() - exact.alphas)[..., None].abs() * mean**2
        error = (out.feature_variance - exact.feature_variance).abs()
        # What is left is the rounding of alpha itself, times m², and a relative 1e-4 of either term.
        bound = 1e-3 * spread.clamp(min=0) + 2 * transparent + 1e-5 * exact.feature_variance + 1e-9
        assert float((error > bound).double().mean()) < 5e-3
        assert float(out.feature_variance.min()) >= 0


def test_tiny_features_keep_their_digits():
    inputs = scene(n=100, cameras=1)
    expected = perception.rasterize(**cast(inputs, torch.float32))
    out = perception.rasterize(**cast({**inputs, "features": inputs["features"] * 2.0**-30}, torch.float32))
    assert torch.equal(out.features * 2.0**30, expected.features)
    torch.testing.assert_close(out.feature_variance * 2.0**60, expected.feature_variance, rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
@pytest.mark.parametrize("name", ["means", "quats", "scales", "opacities", "colors", "features", "viewmats", "Ks"])
def test_non_finite_input_is_named(name, value):
    inputs = scene(n=500, cameras=1)
    inputs[name].view(-1)[inputs[name].numel() // 2] = value
    index = (inputs[name].numel() // 2) // inputs[name][0].numel()
    with pytest.raises(perception.InputError, match=rf"{name}\[{index}\] is not finite"):
        perception.rasterize(**inputs)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"means": torch.zeros(60, 2, dtype=torch.float64)},
            r"means has shape \[60, 2\], expected \[60, 3\]",
        ),
        (
            {"quats": torch.zeros(59, 4, dtype=torch.float64)},
            r"quats has shape \[59, 4\], expected \[60, 4\]",
        ),
        ({"opacities": torch.zeros(60)}, r"opacities is torch.float32, expected torch.float64"),
        ({"colors": [1, 2]}, r"colors is list, expected a torch.Tensor"),
        ({"features": torch.zeros(60, dtype=torch.float64)}, r"features has shape \[60\]"),
        (
            {"background": torch.zeros(5, 3, dtype=torch.float64)},
            r"background has shape \[5, 3\], expected \[2, 3\]",
        ),
        ({"viewmats": scene()["viewmats"].transpose(1, 2)}, r"viewmats\[0\] is .*, expected the last row \[0, 0"),
        ({"Ks": scene()["Ks"] + torch.eye(3).roll(1, 1)}, r"Ks\[0\] is .*, expected \[\[fx, 0, cx\]"),
        ({"Ks": scene()["Ks"] * 2}, r"Ks\[0\] is .*, expected \[\[fx, 0, cx\]"),
        ({"width": 0}, r"image size 0"),
        ({"width": 16.5}, r"image size 16.5"),
        ({"sh_degree": 1.5}, r"sh_degree is 1.5, expected 0 to 3"),
        ({"sh_degree": 4}, r"sh_degree is 4, expected 0 to 3"),
        ({"near_plane": float("nan")}, r"near_plane is nan"),
        ({"eps2d": 0.0}, r"eps2d is 0.0, expected 0.01 to 10000 px²"),
        ({"eps2d": float("nan")}, r"eps2d is nan"),
        ({"simd": "sse9"}, r"simd: 'sse9'"),
    ],
)
def test_bad_arguments_are_named(change, message):
    with pytest.raises(perception.InputError, match=message):
        perception.rasterize(**{**scene(), **change})


def test_non_contiguous_input_is_accepted():
    inputs = scene()
    strided = {
        k: v.transpose(0, -1).contiguous().transpose(0, -1) if isinstance(v, torch.Tensor) else v
        for k, v in inputs.items()
    }
    assert torch.equal(perception.rasterize(**strided).colors, perception.rasterize(**inputs).colors)


def huge_gaussians(n, width, height):
    """Faint Gaussians that each cover the whole picture."""
    g = torch.Generator().manual_seed(4)
    uniform = lambda *shape: torch.rand(shape, generator=g, dtype=torch.float64)  # noqa: E731
    means = (uniform(n, 3) - 0.5) * 0.5 + torch.tensor([0.0, 0.0, 4.0], dtype=torch.float64)
    k = torch.tensor([[[width, 0, width / 2], [0, width, height / 2], [0, 0, 1]]], dtype=torch.float64)
    view = torch.eye(4, dtype=torch.float64)[None]
    return {
        "means": means,
        "quats": uniform(n, 4) - 0.5,
        "scales": 3 + uniform(n, 3),
        "opacities": 0.01 * uniform(n) + 0.01,
        "colors": uniform(n, 3),
        "features": uniform(n, 3),
        "viewmats": view,
        "Ks": k,
    }


def test_gradients_do_not_depend_on_the_records_held_at_once():
    inputs, results = passed(huge_gaussians(90, 300, 200)), []
    for max_records in (0, 1, 100, 700):  # 20 tiles × 90 Gaussians: in one part, a tile a part, several
        settings = Settings(300, 200, threads=2, max_records=max_records)
        out = cpu.rasterize_forward(inputs, settings)
        cotangents = Cotangents(
            colors=torch.sin(out.colors * 40),
            features=torch.cos(out.features * 30),
            feature_variance=out.feature_variance,
        )
        gradients = Gradients.zeros(inputs, EVERY_GRADIENT)
        cpu.rasterize_backward(inputs, settings, out, cotangents, gradients)
        results.append([getattr(gradients, name) for name in EVERY_GRADIENT])
    for other in results[1:]:
        for a, b in zip(results[0], other, strict=True):
            torch.testing.assert_close(a, b, rtol=1e-10, atol=1e-10 * float(a.abs().max()))


def test_more_tiles_than_the_lists_hold_are_refused_before_they_take_memory():
    inputs = cast({**huge_gaussians(20_000, 1 << 14, 1 << 14), "features": None}, torch.float32)
    with pytest.raises(
        perception.InputError, match=r"20000 Gaussians in view touch 1310720000 tiles .* at most 536870912"
    ):
        perception.rasterize(**inputs, width=1 << 14, height=1 << 14, depth=False)
