"""Training on a device, without a GPU: its kernels against the compiled ones in double, and whole trainings on a
pretended device whose rasterizer is the emulator."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from perception import _core
from perception.config import load_config
from perception.errors import InputError
from perception.gaussians import device as devices
from perception.gaussians import schedule
from perception.gaussians.losses import assign_labels, instance_loss
from perception.gaussians.model import Nearby, from_points
from perception.gaussians.train import Trainer
from perception.gaussians.views import TrainingView, surface_depth
from perception.instances.votes import mask_votes
from perception.rasterizer import cpu
from perception.rasterizer import device as on_device
from perception.rasterizer import rasterize as public
from perception.rasterizer.cuda import training
from perception.rasterizer.types import Settings
from support import pretend_device
from support.cuda_emulator import emulated
from support.pretend_device import pretended_device

compiled: Any = _core.training
CLOSE = {"rtol": 1e-11, "atol": 1e-13}  # some hundred roundings of double; sums over 10^4 pixels in another order


def random(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.rand(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


@pytest.fixture
def kernels_of_the_emulator(monkeypatch):
    monkeypatch.setattr(on_device, "device_kernels", emulated())


@pytest.mark.usefixtures("kernels_of_the_emulator")
@pytest.mark.parametrize("beta", [0.0, 0.2, 1.0])
@pytest.mark.parametrize("weights", [None, "some", "none count"])
@pytest.mark.parametrize("size", [(40, 57), (3, 4)])
def test_photometric_loss_and_gradient(beta, weights, size):
    x, y = random(*size, 3), random(*size, 3, seed=1)
    y[:2] = x[:2]  # |x - y| has no slope there
    weight = None if weights is None else (random(*size, seed=2) * (weights == "some")).round(decimals=1)
    for target in (y, (255 * y).round().to(torch.uint8)):
        gradients = torch.empty_like(x), torch.empty_like(x)
        expected = compiled.photometric(x, target, weight, gradients[0], beta)
        found = training.photometric(x, target, weight, gradients[1], beta)
        torch.testing.assert_close([float(f) for f in found], list(expected), equal_nan=True, **CLOSE)
        torch.testing.assert_close(gradients[1], gradients[0], **CLOSE)


@pytest.mark.usefixtures("kernels_of_the_emulator")
@pytest.mark.parametrize(("labels", "dims"), [(0, 4), (1, 4), (7, 4), (40, 11)])
def test_instance_loss_and_gradient(labels, dims, monkeypatch):
    features = 5 + 0.3 * random(31, 70, dims)  # far from 0
    image = (random(31, 70, seed=3) * (labels + 1)).int()
    assigned = assign_labels(image)
    expected = instance_loss(features, assigned, margin=1.0, w_pos=0.3, w_neg=0.7)
    monkeypatch.setattr("perception.gaussians.losses.training_kernels", lambda _: training)
    found = instance_loss(features, assigned, margin=1.0, w_pos=0.3, w_neg=0.7)
    for name in ("value", "pos", "neg", "gradient", "prototypes"):
        a, b = (torch.as_tensor(getattr(of, name), dtype=torch.float64) for of in (found, expected))
        torch.testing.assert_close(a, b, **CLOSE)
    assert len(expected.prototypes) == labels


def test_sums_and_scaled_values():
    values = random(5000) - 0.5
    for squared in (False, True):
        assert float(training.sum(values, squared)) == pytest.approx(compiled.sum(values, squared), rel=1e-12)
    out = torch.empty_like(values)
    training.scale(values, -3.0, out)
    assert torch.equal(out, -3 * values)


@pytest.mark.usefixtures("kernels_of_the_emulator")
@pytest.mark.parametrize("rates", [np.linspace(0.01, 0.1, 5), np.full(5, 0.02)], ids=["by column", "one"])
@pytest.mark.parametrize("masked", [False, True])
def test_adam(masked, rates):
    count = 300
    tables = [random(count, 5, seed=s) for s in range(3)]
    both = [[table.clone() for table in tables] for _ in range(2)]
    for step in range(1, 6):
        gradient = random(count, 5, seed=10 + step) - 0.5
        gradient[step] = torch.nan
        visible = (random(count, seed=20 + step) > 0.4).to(torch.uint8) if masked else None
        reports = []
        for kernels, (param, first, second) in zip((compiled, training), both, strict=True):
            reports.append(kernels.adam(param, gradient, first, second, visible, rates, step, 0.9, 0.999, 1e-15))
        assert int(reports[1]) == reports[0]
    for a, b in zip(*both, strict=True):
        torch.testing.assert_close(b, a, **CLOSE)


def test_statistics_of_growth():
    mean2d = random(200, 2).float()
    visible = (random(200, seed=2) > 0.5).to(torch.uint8)
    mean2d[visible == 0] = torch.nan  # not looked at
    both = [[random(200, seed=s).float() for s in (3, 4)] for _ in range(2)]
    for kernels, sums in zip((compiled, training), both, strict=True):
        kernels.add_statistics(mean2d, visible, *sums, 32.0)
    for a, b in zip(*both, strict=True):
        torch.testing.assert_close(b, a, rtol=1e-6, atol=0)


def painted_wall(shift: float, labelled: bool = True) -> TrainingView:
    """A wall two units away, painted in four squares with a label each, with depth and one corner ignored."""
    height, width, focal = 32, 40, 32.0
    x = (np.arange(width) + 0.5 - width / 2) * 2 / focal + shift
    y = (np.arange(height) + 0.5 - height / 2) * 2 / focal
    square = 1 + (x > 0)[None] + 2 * (y > 0)[:, None]
    colors = np.array([[0, 0, 0], [200, 60, 40], [40, 180, 70], [50, 60, 210], [200, 190, 60]], np.uint8)[square]
    pose = torch.eye(4)
    pose[0, 3] = -shift
    K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    weight = torch.ones(height, width)
    weight[:6, :6] = 0
    labels = torch.from_numpy(square.astype(np.int32)) if labelled else None
    depth = torch.full((height, width), 2.0)
    return TrainingView(f"{shift}", torch.from_numpy(colors), labels, K, pose, weight=weight, depth=depth)


def trainer(device: torch.device | None, *more: str) -> Trainer:
    rng = np.random.default_rng(0)
    points = np.stack([rng.uniform(-1.2, 1.2, 60), rng.uniform(-0.9, 0.9, 60), np.full(60, 2.0)], axis=1)
    start = from_points(points, np.full((60, 3), 120, np.uint8), feature_dim=3, seed=0)
    start.log_scales += torch.tensor([0.3, 0.0, -0.3])  # the turn of a ball has no gradient but rounding
    start.quats += torch.from_numpy(rng.normal(0, 0.3, (60, 4)).astype(np.float32))
    views = [painted_wall(shift) for shift in (-0.3, 0.0, 0.3)]
    pairs = ["train.exchange_db=0", "train.budget=200", "losses.start=0.2", *more]
    return Trainer(start, views, load_config(None, pairs), [painted_wall(0.15)], device)


@pytest.fixture
def pretended(monkeypatch):
    """The pretended device, with the emulator as its rasterizer."""
    monkeypatch.setattr(on_device, "device_kernels", emulated())
    monkeypatch.setattr(public, "_DEVICES", ("cpu", pretend_device.NAME))
    with pretended_device() as device:
        yield device


@pytest.mark.slow
def test_the_pretended_device_refuses_what_a_gpu_refuses(pretended):
    there = torch.ones(3, device=pretended)
    assert there.device == pretended and float((there + 1).sum()) == 6 and torch.equal(there.cpu(), torch.ones(3))
    with pytest.raises(RuntimeError, match="same device, found pretend and cpu"):
        there + torch.ones(3)
    with pytest.raises(TypeError, match=r"use .cpu\(\) first"):
        there.numpy()


@pytest.mark.slow
def test_the_first_steps_are_those_of_the_cpu(pretended):
    """Until rounding matters: Adam turns gradients of rounding size into whole steps."""
    here, there = trainer(None, "train.iterations=1000"), trainer(pretended, "train.iterations=1000")
    for step in range(6):
        progress = 0.3 if step % 2 else 0.0  # with features, and without
        losses = [of.step(progress) for of in (here, there)]
        assert losses[1] == pytest.approx(losses[0], rel=1e-4)
    for name, tensor in here.gaussians.named().items():
        found = getattr(there.gaussians, name)
        assert found.device == pretended
        difference = (found.cpu() - tensor).abs()
        assert float(difference.quantile(0.95)) < 1e-4 * float(tensor.abs().max()), name


@pytest.mark.slow
def test_a_whole_training_runs_there_and_resumes_with_the_same_bits(pretended):
    """Growth, holes, harmonics, scoring, pruning and checkpoints included."""
    # With seed 0 two Gaussians come so close in the ranking for growth that rounding decides between them.
    pairs = ("seed=1", "train.iterations=48", "train.sh_degree=1", "densify.every=4")
    whole = trainer(pretended, *pairs)
    record = whole.run()
    assert len(whole.gaussians) > 60 and record.curve and record.skipped_gradients == 0
    expected = trainer(None, *pairs)
    expected.run()
    ours, theirs = (schedule.score(of, 8)["psnr"] for of in (whole, expected))
    assert ours > 10 and ours == pytest.approx(theirs, abs=0.1)  # two runs of other rounding
    first = trainer(pretended, *pairs)
    first.run(until=0.5)
    state = first.state()
    assert all(tensor.device.type == "cpu" for tensor in state["optimiser"]["params"].values())
    second = trainer(pretended, *pairs)
    second.load(state)
    second.run()
    for name, tensor in whole.gaussians.named().items():
        assert torch.equal(tensor.cpu(), getattr(second.gaussians, name).cpu()), name
    assert surface_depth(whole.gaussians, whole.views[0]).shape == (32, 40)


@pytest.mark.slow
def test_labels_and_votes_of_a_photo_are_those_of_the_cpu(pretended, monkeypatch):
    monkeypatch.setattr(on_device, "_AT_ONCE", 2)  # several times
    of, view = trainer(None), painted_wall(0.0)
    g = of.gaussians
    settings = Settings(40, 32, depth=False)
    labels = np.stack([np.arange(60) % 7 - 1, np.full(60, -1), np.zeros(60)]).astype(np.int32)
    for least in (0.0, 0.1):
        (expected, seen), (found, seen_there) = (
            module.label_images(where.inputs(view.camera_from_world, view.K), labels, least, settings)
            for module, where in ((cpu, g), (on_device, g.to(pretended)))
        )
        np.testing.assert_array_equal(seen_there, seen)
        assert found.dtype == expected.dtype and (found != expected).mean() < 0.002  # single precision at near ties
        assert len(np.unique(expected[0])) > 4 and (expected[1] == -1).all()
    here, there = (mask_votes(Nearby(where), [view], half_resolution=False) for where in (g, g.to(pretended)))
    np.testing.assert_allclose(there.pixels.toarray(), here.pixels.toarray(), atol=2e-2)  # FAINTEST is dropped
    assert here.pixels.nnz > 20


@pytest.mark.slow
def test_a_full_memory_is_met_with_fewer_records_then_refused(pretended, monkeypatch):
    of, limits = trainer(pretended, "train.iterations=1000"), []
    backward = on_device.rasterize_backward

    def full(inputs, settings, *rest, **more):
        limits.append(settings.max_records)
        if len(limits) < 3:
            raise torch.OutOfMemoryError("CUDA out of memory")
        return backward(inputs, settings, *rest, **more)

    monkeypatch.setattr(torch.cuda, "empty_cache", lambda: None)
    monkeypatch.setattr(on_device, "rasterize_backward", full)
    of.run(until=(of.iteration + 1) / 1000)
    assert limits == [0, 1 << 22, 1 << 20] and of.iteration == 1 and len(of.record.decisions) == 2

    def always_full(*_: object, **__: object) -> None:
        raise torch.OutOfMemoryError("CUDA out of memory")

    monkeypatch.setattr(on_device, "rasterize_backward", always_full)
    before = of.gaussians.means.cpu()
    with pytest.raises(InputError, match="memory is full with 60 Gaussians; use a smaller --budget"):
        of.run(until=(of.iteration + 1) / 1000)
    assert of.iteration == 1 and torch.equal(before, of.gaussians.means.cpu())

    def gone(*_: object, **__: object) -> None:
        raise RuntimeError("CUDA error: device-side assert\nmore lines")

    monkeypatch.setattr(on_device, "rasterize_backward", gone)
    with pytest.raises(InputError, match=r"failed at iteration 1 \(CUDA error: device-side assert\); continue from"):
        of.run(until=(of.iteration + 1) / 1000)


def test_which_device_is_chosen(monkeypatch):
    monkeypatch.setattr(devices, "_has_driver", lambda: False)
    for build in ("12.8", None):
        monkeypatch.setattr(torch.version, "cuda", build)
        assert devices.choose_device("auto") == devices.choose_device("cpu") == (torch.device("cpu"), None)
    with pytest.raises(InputError, match="--device cuda: torch was built without CUDA; install it without constraints"):
        devices.choose_device("cuda")
    monkeypatch.setattr(devices, "_has_driver", lambda: True)
    device, told = devices.choose_device("auto")
    assert device.type == "cpu" and told is not None and told.startswith("training on the CPU: torch was built without")
    monkeypatch.setattr(torch.version, "cuda", "12.8")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(InputError, match="finds no GPU; check the driver with nvidia-smi"):
        devices.choose_device("cuda")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda: "GeForce")
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda: (500 << 20, 8 << 30))
    with pytest.raises(InputError, match="GeForce has 500 MiB free, expected at least 2048 MiB"):
        devices.choose_device("cuda")
