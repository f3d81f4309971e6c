"""The compiled rasterizer against the naive one: values, gradients, invariances."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import perception
from perception.rasterizer import cpu
from perception.rasterizer.types import Cotangents, Gradients, Settings
from support import reference_rasterizer as reference
from support.rasterizer import IMAGES, cast, every_simd_level, grads_and_images, leaves, loss_of, passed, scene  # noqa: F401


@pytest.mark.parametrize(
    ("dims", "sh_degree", "eps2d"), [(5, None, 0.3), (8, 0, 0.1375), (13, 1, 2.0), (16, 2, 0.3), (21, 3, 0.3)]
)
def test_double_build_equals_the_naive_rasterizer(dims, sh_degree, eps2d):
    inputs = {**scene(dims=dims, sh_degree=sh_degree), "eps2d": eps2d}
    ours_in, theirs_in = leaves(inputs), leaves(inputs)
    ours = perception.rasterize(**ours_in)
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


@pytest.mark.parametrize("sh_degree", [None, 0, 1, 2, 3])
def test_gradcheck_of_the_double_build(sh_degree):
    # Large soft Gaussians away from every threshold, so that finite differences see a smooth function.
    inputs = scene(n=6, width=6, height=5, dims=3, cameras=1, sh_degree=sh_degree, seed=3)
    inputs["means"] = inputs["means"] * 0.2 + torch.tensor([0.0, 0.0, 3.0], dtype=torch.float64)
    inputs["scales"] = inputs["scales"] + 1.0
    inputs["opacities"] = inputs["opacities"] * 0.3 + 0.3
    inputs["Ks"] = torch.tensor([[[5.0, 0, 2.6], [0, 6.0, 2.4], [0, 0, 1]]], dtype=torch.float64)
    if sh_degree is not None:
        inputs["colors"] = inputs["colors"] * 0.1
    names = ["means", "quats", "scales", "opacities", "colors", "features", "viewmats", "background"]
    tensors = [inputs[k].clone().requires_grad_() for k in names]

    def render(*args):
        out = perception.rasterize(**{**inputs, **dict(zip(names, args, strict=True))})
        return tuple(getattr(out, k) for k in IMAGES)

    assert torch.autograd.gradcheck(render, tensors, eps=1e-6, atol=1e-6, rtol=1e-5)


@pytest.mark.parametrize("variance", [True, False])
@pytest.mark.parametrize("dims", [3, 8, 13, 21])
def test_gradients_of_the_features_alone_equal_those_of_the_naive_rasterizer(dims, variance):
    inputs = {**scene(n=80, width=70, height=45, dims=dims), "variance": variance}
    names = ("features", "feature_variance")[: 2 if variance else 1]
    theirs_in = leaves({k: v for k, v in inputs.items() if k != "variance"})
    theirs = reference.rasterize(**theirs_in)
    loss_of([theirs[name] for name in names]).backward()
    expected = theirs_in["features"].grad
    for dtype, relative in ((torch.float64, 1e-10), (torch.float32, 2e-4)):
        ours_in = cast(inputs, dtype)
        ours_in["features"] = ours_in["features"].requires_grad_()
        results = []
        for threads in (1, 2, 7):
            ours = perception.rasterize(**ours_in, threads=threads)
            (gradient,) = torch.autograd.grad(loss_of([getattr(ours, name) for name in names]), ours_in["features"])
            assert ours.stats.mean2d_grad is None
            results.append(gradient)
        assert torch.equal(results[0], results[1]) and torch.equal(results[0], results[2])
        atol = relative * float(expected.abs().max())
        torch.testing.assert_close(results[0].double(), expected, rtol=relative, atol=atol)


@pytest.mark.parametrize("sh_degree", [None, 2])
@pytest.mark.parametrize("dims", [0, 8, 21])
def test_stored_gradients_are_those_of_logarithms_and_logits_in_visible_rows(dims, sh_degree):
    inputs = {**scene(n=80, width=70, height=45, dims=dims, cameras=1, sh_degree=sh_degree)}
    names = ("means", "quats", "scales", "opacities", "colors", "features")
    leaf = {name: inputs[name] for name in names if inputs[name] is not None}
    leaf = {**leaf, "scales": leaf["scales"].log(), "opacities": leaf["opacities"].logit()}
    leaf = {name: tensor.clone().requires_grad_() for name, tensor in leaf.items()}
    activated = {**leaf, "scales": leaf["scales"].exp(), "opacities": leaf["opacities"].sigmoid()}
    images = IMAGES if dims else IMAGES[:3]
    theirs = reference.rasterize(**{**inputs, **activated})
    pulls = torch.autograd.grad(
        loss_of([theirs[name] for name in images]), [theirs[name] for name in images], retain_graph=True
    )
    torch.autograd.backward([theirs[name] for name in images], pulls)

    given = passed({**inputs, **{name: tensor.detach() for name, tensor in activated.items()}})
    settings = Settings(70, 45, -1 if sh_degree is None else sh_degree, threads=2)
    out = cpu.rasterize_forward(given, settings)
    stored = Gradients(**{name: torch.full_like(t, 7.0) for name, t in leaf.items()})
    stored.mean2d = torch.full((1, 80, 2), 7.0).double()
    cotangents = Cotangents(**dict(zip(images, pulls, strict=True)))
    cpu.rasterize_backward(given, settings, out, cotangents, stored, stored=True)
    seen = theirs["visible"][0]
    assert 0 < int(seen.sum()) < 80
    for name, of in leaf.items():
        ours, expected = getattr(stored, name), of.grad
        atol = 1e-9 * float(expected.abs().max())
        torch.testing.assert_close(ours[seen], expected[seen], rtol=1e-8, atol=atol, msg=name)
        assert (ours[~seen] == 7).all()
    assert (stored.mean2d[0][~seen] == 7).all() and (stored.mean2d[0][seen] != 7).any()


def test_label_images_are_the_largest_sums_of_the_naive_rasterizer():
    count, width, height, least = 90, 70, 45, 0.2
    given = scene(n=count, width=width, height=height, dims=0, cameras=1)
    rng = np.random.default_rng(5)
    labels = np.stack([rng.integers(-1, 40, count), rng.integers(-1, 3, count), np.full(count, -1)]).astype(np.int32)
    one_hot = torch.from_numpy(labels[:2, :, None] == np.arange(40)).permute(1, 0, 2).reshape(count, 80).double()
    naive = reference.rasterize(**{**given, "features": one_hot})
    sums = naive["features"][0].reshape(height, width, 2, 40).permute(2, 0, 1, 3)
    best, expected = sums.max(dim=-1)
    expected = torch.where(best > least, expected, -1)
    clear = (best - sums.topk(2, dim=-1).values[..., 1] > 1e-5) | (best < least)  # of sums in other orders too
    clear &= (best - least).abs() > 1e-5
    assert clear.double().mean() > 0.9 and len(torch.unique(expected)) > 20
    images, visible = cpu.label_images(passed(given), labels, least, Settings(width, height))
    assert (images[2] == -1).all() and np.array_equal(visible, naive["visible"][0].numpy())
    assert torch.equal(torch.from_numpy(images[:2]).long()[clear], expected[clear])
    single = passed(cast(given))
    for simd in cpu.simd_levels():
        for threads in (1, 3):
            found, _ = cpu.label_images(single, labels, least, Settings(width, height, threads=threads, simd=simd))
            assert torch.equal(torch.from_numpy(found[:2]).long()[clear], expected[clear]), simd


def test_same_bits_for_any_number_of_threads():
    inputs = scene(n=3000, width=300, height=203, dims=9, dtype=torch.float32)
    one = grads_and_images(inputs, threads=1)
    for threads in (2, 3, 7):
        for a, b in zip(one, grads_and_images(inputs, threads=threads), strict=True):
            assert torch.equal(a, b)


def test_levels_agree():
    inputs = scene(n=2000, width=150, height=110, dims=8, dtype=torch.float32)
    results = [grads_and_images(inputs, simd=level) for level in cpu.simd_levels()]
    for other in results[1:]:
        for a, b in zip(results[0], other, strict=True):
            error = (a.double() - b.double()).abs() / (1e-3 + b.double().abs().mean())
            assert float(error.mean()) < 2e-4
            assert float((error > 1e-2).double().mean()) < 2e-3


def test_float_build_follows_the_double_build():
    inputs = scene(n=2000, width=150, height=110, dims=8)
    exact = grads_and_images(inputs)
    single = grads_and_images({k: v.float() if isinstance(v, torch.Tensor) else v for k, v in inputs.items()})
    names = [
        *IMAGES,
        "visible",
        "radii",
        "mean2d_grad",
        "means",
        "quats",
        "scales",
        "opacities",
        "colors",
        "features",
    ]
    for name, a, b in zip(names, single, exact, strict=False):
        a, b = a.double().flatten(), b.double().flatten()
        error = (a - b).abs() / b.abs().mean()
        # Flips at the 1/255 threshold are the outliers; everything else is rounding.
        assert float(error.mean()) < 1e-3, name
        assert (
            float(error.quantile(0.95) if error.numel() < 1e6 else error.kthvalue(int(0.95 * error.numel()))[0]) < 1e-4
        ), name
        assert float((error > 0.1).double().mean()) < 2e-3, name


def test_equal_depths_keep_the_order_of_their_index():
    inputs = scene(n=40, dims=3, cameras=1)
    inputs["means"][:, 2] = 2.0
    out, expected = perception.rasterize(**inputs), reference.rasterize(**inputs)
    for name in IMAGES:
        torch.testing.assert_close(getattr(out, name), expected[name], rtol=1e-10, atol=1e-11)


def test_cameras_are_independent():
    inputs = scene(n=200, cameras=3)
    together = perception.rasterize(**inputs)
    for c in range(3):
        one = {k: inputs[k][c : c + 1] for k in ("viewmats", "Ks", "background")}
        alone = perception.rasterize(**{**inputs, **one})
        for name in (*IMAGES, "visible"):
            assert torch.equal(getattr(together, name)[c], getattr(alone, name)[0])


def test_depth_and_variance_are_optional_and_change_nothing_else():
    inputs = scene(n=200, dims=8)
    full = perception.rasterize(**inputs)
    lean = perception.rasterize(**inputs, variance=False)
    assert lean.feature_variance is None
    torch.testing.assert_close(lean.features, full.features, rtol=1e-12, atol=1e-12)
    plain = perception.rasterize(**{**inputs, "features": None}, depth=False)
    assert plain.depths is None and plain.features is None
    assert torch.equal(plain.colors, full.colors)


def test_backward_may_run_twice_and_adds_up():
    inputs = leaves(scene(n=50))
    out = perception.rasterize(**inputs)
    loss = loss_of([out.colors])
    loss.backward(retain_graph=True)
    once = inputs["means"].grad.clone()
    loss.backward()
    assert torch.equal(inputs["means"].grad, 2 * once)


@pytest.mark.parametrize("power", [1, 2])
@pytest.mark.parametrize("name", ["means", "scales", "viewmats"])
def test_second_derivatives_are_refused_where_they_are_not_zero(name, power):
    """Alone and beside other terms, by which autograd could leave them out; of Σ image, and of Σ image²."""
    inputs = leaves(scene(n=50))
    loss = perception.rasterize(**inputs).colors.pow(power).sum()
    (first,) = torch.autograd.grad(loss, inputs[name], retain_graph=True)
    (again,) = torch.autograd.grad(loss, inputs[name], create_graph=True)
    assert torch.equal(first, again.detach())
    for second in (again.sum(), again.sum() + inputs[name].square().sum()):
        with pytest.raises(RuntimeError, match="differentiated once only"):
            torch.autograd.grad(second, inputs[name], retain_graph=True, allow_unused=True)


def test_absolute_gradients_are_the_sizes_of_what_each_pixel_adds_to_that_of_the_2d_mean():
    inputs, taps = scene(n=80, width=70, height=45, cameras=1), []
    theirs = reference.rasterize(**leaves(inputs), taps=taps)
    images = [theirs[name] for name in IMAGES]
    pulls = torch.autograd.grad(loss_of(images), images, retain_graph=True)
    torch.autograd.backward(images, pulls)
    index, vectors, conics = taps[0]
    x, y = vectors.grad.unbind(-1)  # [n, P]
    along = (conics[:, 0, 1] / conics[:, 0, 0])[:, None] * x  # the part of y that comes with x
    plain, absolute = torch.zeros(2, 80, 2, dtype=torch.float64)
    plain[index] = torch.stack([x.sum(1), y.sum(1)], 1)
    absolute[index] = torch.stack([x.abs().sum(1), (along.abs() + (y - along).abs()).sum(1)], 1)

    given, settings = passed(inputs), Settings(70, 45)
    found = Gradients.zeros(given, ("mean2d", "absgrad"))
    cotangents = Cotangents(**dict(zip(IMAGES, pulls, strict=True)))
    cpu.rasterize_backward(given, settings, cpu.rasterize_forward(given, settings), cotangents, found)
    for ours, expected in ((found.mean2d, plain), (found.absgrad, absolute)):
        torch.testing.assert_close(ours[0], expected, rtol=1e-8, atol=1e-9 * float(expected.abs().max()))


def test_statistics_are_the_2d_mean_gradient_in_pixels():
    # One tiny Gaussian: moving it by δ px in x is moving its mean by δ z / fx.
    inputs = leaves(scene(n=1, dims=0, cameras=1))
    inputs["means"] = torch.tensor([[0.0, 0.0, 2.0]], dtype=torch.float64).requires_grad_()
    inputs["viewmats"] = torch.eye(4, dtype=torch.float64)[None]
    inputs["scales"] = torch.full((1, 3), 1e-3, dtype=torch.float64)
    out = perception.rasterize(**inputs)
    loss_of([out.colors]).backward()
    gx, gy = (inputs["means"].grad[0, :2] * 2.0 / torch.tensor([30.0, 34.0])).tolist()
    assert float(out.stats.mean2d_grad) == pytest.approx((gx**2 + gy**2) ** 0.5, rel=1e-5)
    assert float(out.stats.radii) == pytest.approx(3 * 0.3**0.5, rel=1e-2)


def test_pairs_are_those_the_naive_rasterizer_blends():
    inputs = scene(n=300, width=70, height=45, dims=21)
    expected = reference.rasterize(**inputs)["pairs"]
    for simd in cpu.simd_levels():
        out = perception.rasterize(**inputs, simd=simd)
        assert out.stats.contributing_pairs == int(expected.sum())
        assert out.stats.contributing_pairs <= out.stats.evaluated_pairs <= 2 * 300 * 80 * 48
        assert set(out.stats.seconds) == {"project", "sort", "bin", "blend", "blend_backward", "reduce"}


def test_pairs_do_not_depend_on_threads():
    inputs = scene(n=3000, width=300, height=203, dtype=torch.float32)
    pairs = [perception.rasterize(**inputs, threads=n).stats for n in (1, 2, 5)]
    assert len({(p.evaluated_pairs, p.contributing_pairs) for p in pairs}) == 1
