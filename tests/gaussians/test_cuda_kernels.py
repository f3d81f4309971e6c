"""The CUDA kernels, run on the CPU by the emulator of thread blocks, against the CPU rasterizer in float64."""

from __future__ import annotations

import ctypes
from contextlib import nullcontext

import pytest
import torch

import perception
from perception.rasterizer import cpu
from perception.rasterizer import device as on_device
from perception.rasterizer.cuda import training
from perception.rasterizer.cuda.kernels import KernelOptions, Kernels
from perception.rasterizer.types import Cotangents, Gradients, Settings
from support.cuda_emulator import REVERSED, build, emulate, emulated, find_compiler, on_emulator, wide_scene, worst
from support.hard_scenes import SCENES
from support.rasterizer import EVERY_GRADIENT, cast, grads_and_images, leaves, loss_of, passed, scene

BOUND = 1e-12
"""Of the largest value of each image and gradient."""
# One rounding of the inputs moves the CPU's gradients of this scene by more than BOUND: see the test of it below.
ILL_CONDITIONED = {"needle": 1e-11}


@pytest.fixture(scope="module", autouse=True)
def compiler() -> str:
    return find_compiler()


@pytest.mark.parametrize(("dims", "sh_degree", "options"), [
    (5, 2, {}), (5, 3, {"near_plane": 1.5}),
    pytest.param(13, 1, {"eps2d": 2.0}, marks=pytest.mark.slow),
    pytest.param(5, None, {}, marks=pytest.mark.slow),
    pytest.param(0, 0, {}, marks=pytest.mark.slow),
    pytest.param(8, 2, {"variance": False}, marks=pytest.mark.slow),
    pytest.param(0, None, {"depth": False}, marks=pytest.mark.slow),
])  # fmt: skip
def test_random_scenes(dims, sh_degree, options):
    inputs = scene(n=200, dims=dims, sh_degree=sh_degree)
    assert worst(emulate(inputs, **options), grads_and_images(inputs, **options)) <= BOUND


def test_features_in_slices(monkeypatch):
    """Eight channels five at a time, as 13 are eight at a time: the kernels know no largest number."""
    monkeypatch.setattr(on_device, "MAX_FEATURES", 5)
    inputs = scene(n=200, dims=8, sh_degree=1)
    assert worst(emulate(inputs, eps2d=2.0), grads_and_images(inputs, eps2d=2.0)) <= BOUND


def test_absolute_gradients():
    inputs = passed(scene(n=200, dims=5))
    settings, pull = Settings(37, 29), torch.Generator().manual_seed(1)

    def found() -> torch.Tensor:
        out = cpu.rasterize_forward(inputs, settings)
        cotangents = Cotangents(torch.randn(out.colors.shape, generator=pull.manual_seed(1)).to(out.colors))
        gradients = Gradients.zeros(inputs, ("absgrad",))
        cpu.rasterize_backward(inputs, settings, out, cotangents, gradients)
        assert gradients.absgrad is not None
        return gradients.absgrad

    here = found()
    with on_emulator(emulated()):
        assert worst([found()], [here]) <= BOUND


def test_gaussians_over_the_whole_image():
    inputs = wide_scene()
    assert worst(emulate(inputs), grads_and_images(inputs)) <= BOUND


@pytest.mark.slow
def test_sixty_four_channels():
    inputs = scene(n=100, dims=64)
    assert worst(emulate(inputs), grads_and_images(inputs)) <= BOUND


@pytest.mark.parametrize("name", SCENES)
def test_hard_scenes(name):
    inputs = SCENES[name]()
    assert worst(emulate(inputs), grads_and_images(inputs)) <= ILL_CONDITIONED.get(name, BOUND)


@pytest.mark.parametrize("name", ILL_CONDITIONED)
def test_ill_conditioned_scenes_are(name):
    inputs = SCENES[name]()
    moved = {**inputs, "scales": inputs["scales"] * (1 + 2.0**-52)}
    assert worst(grads_and_images(moved), grads_and_images(inputs)) > BOUND


@pytest.mark.parametrize("lanes", [REVERSED, 5, 6])
def test_the_order_of_the_lanes_changes_no_bit(lanes):
    inputs = scene(n=300, width=45, height=37, cameras=1)
    for a, b in zip(emulate(inputs, lanes), emulate(inputs), strict=True):
        assert torch.equal(a, b)


@pytest.mark.slow
def test_the_float_build_follows_the_double_build():
    inputs = wide_scene(dtype=torch.float32)
    exact = grads_and_images(cast(inputs, torch.float64))
    for found, single, true in zip(emulate(inputs), grads_and_images(inputs), exact, strict=True):
        norm = float(true.double().norm())
        error, cpu_error = (float((t.double() - true.double()).norm()) / (norm or 1) for t in (found, single))
        assert error <= 3 * cpu_error + 1e-5  # flips at the 1/255 threshold are in both


@pytest.mark.slow
def test_memory_is_bounded_by_strips(monkeypatch):
    monkeypatch.setattr(on_device, "device_kernels", emulated())
    inputs = wide_scene()
    settings = [Settings(200, 150, max_records=limit) for limit in (0, 1, 600)]
    given = passed(inputs)
    results = []
    for setting in settings:
        out = on_device.rasterize_forward(given, setting)
        cotangents = Cotangents(torch.sin(out.colors * 40), out.alphas, out.depths, torch.cos(out.features * 30))
        gradients = Gradients.zeros(given, EVERY_GRADIENT)
        on_device.rasterize_backward(given, setting, out, cotangents, gradients)
        grads = [getattr(gradients, name) for name in EVERY_GRADIENT]
        strips = [strip.range for strip in out.frames.views[0]]
        results.append([len(strips), out.colors, out.features, out.feature_variance, *grads])
        assert [s.first_row for s in strips[1:]] == [s.end_row for s in strips[:-1]] and strips[-1].end_row == 10
    assert [r[0] for r in results][:2] == [1, 10] and 1 < results[2][0] < 10
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0][1:4], other[1:4], strict=True))
        assert worst(other[4:], results[0][4:]) <= BOUND


def test_backward_may_run_twice_and_unused_images_have_no_gradient():
    inputs = leaves(scene(n=50))
    with on_emulator(emulated()):
        out = perception.rasterize(**inputs)
        loss = loss_of([out.colors])
        loss.backward(retain_graph=True)
        once = inputs["means"].grad.clone()
        loss.backward()
    assert torch.equal(inputs["means"].grad, 2 * once)
    assert float(inputs["features"].grad.abs().max()) == 0


def test_nothing_to_draw_is_the_background():
    inputs = scene(n=0)
    colors, alphas, *_ = emulate(inputs)
    assert torch.equal(colors, inputs["background"][:, None, None, :].expand_as(colors))
    assert float(alphas.abs().max()) == 0
    none = {**inputs, "viewmats": inputs["viewmats"][:0], "Ks": inputs["Ks"][:0], "background": None}
    assert emulate(none)[0].shape == (0, 29, 37, 3)


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
@pytest.mark.parametrize("name", ["means", "quats", "scales", "opacities", "colors", "features", "viewmats", "Ks"])
def test_non_finite_input_is_named(name, value):
    inputs = scene(n=500, cameras=2)
    inputs[name].view(-1)[inputs[name].numel() // 2] = value
    index = (inputs[name].numel() // 2) // inputs[name][0].numel()
    with pytest.raises(perception.InputError, match=rf"{name}\[{index}\] is not finite"), on_emulator(emulated()):
        perception.rasterize(**inputs)


def test_structs_are_those_of_the_kernels():
    library = build(KernelOptions(5, True, True, double=True))
    ours = (on_device.SCENES[torch.float64], on_device.PROJECTION, on_device.STRIP, on_device.LISTS, on_device.IMAGES)
    more = (
        on_device.COTANGENTS,
        on_device.GRADIENTS,
        training.ADAM_ROWS[torch.float64],
        training.PHOTOS[torch.float64],
        training.MASKS,
        training.PAIRS,
    )
    for i, structure in enumerate((*ours, *more)):
        assert library.emulator_struct_size(i) == ctypes.sizeof(structure)


def test_the_drivers_errors_are_told():
    driver = build(KernelOptions(5, True, True, double=True))
    with pytest.raises(RuntimeError, match="CUDA error 200 in loading the kernels: device kernel image is invalid"):
        Kernels(driver, b"PTX", lambda: nullcontext(0))
    with pytest.raises(RuntimeError, match="CUDA error 500 in looking up no_kernel: not found"):
        Kernels(driver, b"\x7fELF", lambda: nullcontext(0)).launch("no_kernel", 1)


def test_the_cpu_rasterizer_is_in_place_again():
    with on_emulator(emulated()):
        assert cpu.rasterize_backward is on_device.rasterize_backward
    assert cpu.rasterize_backward is not on_device.rasterize_backward


@pytest.mark.slow
def test_fifty_steps_of_training_end_where_the_cpu_ends():
    target = perception.rasterize(**scene(n=40, dims=5, cameras=1, seed=2)).colors

    def trained():
        inputs = leaves(scene(n=40, dims=5, cameras=1))
        names = ("means", "quats", "colors", "features", "viewmats")
        optimiser = torch.optim.Adam([inputs[name] for name in names], lr=1e-3)
        for _ in range(50):
            optimiser.zero_grad()
            out = perception.rasterize(**inputs)
            loss = (out.colors - target).abs().mean() + out.feature_variance.square().sum(-1).mean()
            loss.backward()
            optimiser.step()
        return [loss.detach(), *(inputs[name].detach() for name in names)]

    with on_emulator(emulated()):
        found = trained()
    assert worst(found, trained()) <= 1e-9
