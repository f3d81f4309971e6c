"""The fused photometric loss against plain torch, written here from the published formula."""

import numpy as np
import pytest
import torch

pytest.importorskip("perception._core")
from perception import _core
from perception.gaussians.losses import photometric
from support.losses import known


def photometric_loss(render, target, beta=0.2, weight=None):
    loss = photometric(render, target, beta, weight)
    return known(loss.value, [loss.gradient], render)


def torch_ssim(x, y):
    """SSIM map [H, W, C] with a dense 11×11 window and zero padding."""
    taps = torch.exp(-0.5 * ((torch.arange(11, dtype=x.dtype) - 5) / 1.5) ** 2)
    window = (taps[:, None] * taps[None, :] / taps.sum() ** 2)[None, None].expand(x.shape[2], 1, 11, 11)

    def blur(image):
        planes = image.permute(2, 0, 1)[None]
        return torch.nn.functional.conv2d(planes, window, padding=5, groups=x.shape[2])[0].permute(1, 2, 0)

    mx, my = blur(x), blur(y)
    vx, vy, vxy = blur(x * x) - mx * mx, blur(y * y) - my * my, blur(x * y) - mx * my
    c1, c2 = 0.01**2, 0.03**2
    return (2 * mx * my + c1) * (2 * vxy + c2) / ((mx * mx + my * my + c1) * (vx + vy + c2))


def torch_loss(x, y, beta, weight=None):
    weight = torch.ones(x.shape[:2], dtype=x.dtype) if weight is None else weight
    per_pixel = (1 - beta) * (x - y).abs() + beta * (1 - torch_ssim(x, y))
    return (per_pixel * weight[..., None]).sum() / (weight.sum() * x.shape[2])


def images(height, width, channels=3, dtype=torch.float64, seed=0):
    random = np.random.default_rng(seed)
    make = lambda: torch.from_numpy(random.random((height, width, channels))).to(dtype)  # noqa: E731
    return make().requires_grad_(), make()


SIZES = [(1, 1), (2, 3), (5, 7), (11, 11), (12, 40), (37, 53), (64, 300), (300, 20)]


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("beta", [0.0, 0.2, 1.0])
def test_float64_matches_torch(size, beta):
    x, y = images(*size)
    ours = photometric_loss(x, y, beta)
    (gradient,) = torch.autograd.grad(ours, x)
    reference = torch_loss(x, y, beta)
    (expected,) = torch.autograd.grad(reference, x)
    assert abs(ours.item() - reference.item()) < 1e-13
    assert (gradient - expected).abs().max() < 1e-12 * max(1e-3, expected.abs().max())


@pytest.mark.parametrize("size", [(37, 53), (64, 300)])
def test_float32_is_close_to_float64(size):
    x, y = images(*size)
    expected = torch.autograd.grad(torch_loss(x, y, 0.2), x)[0]
    loss = photometric(x.detach().float(), y.float(), 0.2)
    assert abs(loss.value - torch_loss(x, y, 0.2).item()) < 1e-6
    assert (loss.gradient - expected).abs().max() < 1e-4 * expected.abs().max()


@pytest.mark.parametrize("channels", [1, 2, 4, 8])
def test_any_number_of_channels(channels):
    x, y = images(23, 150, channels)
    gradient = torch.autograd.grad(photometric_loss(x, y), x)[0]
    expected = torch.autograd.grad(torch_loss(x, y, 0.2), x)[0]
    assert (gradient - expected).abs().max() < 1e-13


@pytest.mark.parametrize("beta", [0.0, 0.2])
def test_weights_are_a_weighted_mean(beta):
    x, y = images(31, 45)
    weight = torch.from_numpy(np.random.default_rng(1).random((31, 45)))
    weight[:, :12] = 0
    ours = photometric_loss(x, y, beta, weight)
    reference = torch_loss(x, y, beta, weight)
    assert abs(ours.item() - reference.item()) < 1e-13
    a, b = torch.autograd.grad(ours, x)[0], torch.autograd.grad(reference, x)[0]
    assert (a - b).abs().max() < 1e-12 * b.abs().max()


def test_weights_all_zero_give_zero():
    x, y = images(9, 9)
    loss = photometric_loss(x, y, 0.2, torch.zeros(9, 9))
    assert loss.item() == 0
    assert torch.autograd.grad(loss, x)[0].abs().max() == 0


def test_gradcheck():
    x, y = images(13, 6, 2)
    assert torch.autograd.gradcheck(lambda r: photometric_loss(r, y, 0.7), (x,), eps=1e-6, atol=1e-8)


def test_uint8_target_is_read_as_255ths():
    x, _ = images(20, 33, dtype=torch.float32)
    photo = torch.from_numpy(np.random.default_rng(2).integers(0, 256, (20, 33, 3), dtype=np.uint8))
    as_bytes = photometric_loss(x, photo)
    as_float = photometric_loss(x, photo.float() / 255)
    assert abs(as_bytes.item() - as_float.item()) < 1e-6


def test_equal_and_constant_images():
    x, _ = images(30, 30)
    same = photometric(x, x.detach().clone(), 0.2)
    assert abs(same.value) < 1e-12 and abs(same.ssim - 1) < 1e-12
    flat = torch.full((30, 30, 3), 0.5, requires_grad=True)
    loss = photometric_loss(flat, torch.full((30, 30, 3), 0.25))
    assert torch.isfinite(torch.autograd.grad(loss, flat)[0]).all()
    black = photometric(torch.zeros(8, 8, 3), torch.zeros(8, 8, 3), 0.2)
    assert black.value == 0 and black.ssim == 1


def test_parts_add_up_and_ssim_is_left_out_at_beta_zero():
    x, y = images(25, 40)
    loss = photometric(x, y, 0.3)
    assert abs(loss.value - (0.7 * loss.l1 + 0.3 * (1 - loss.ssim))) < 1e-14
    assert abs(loss.ssim - torch_ssim(x, y).mean().item()) < 1e-13
    assert np.isnan(photometric(x, y, 0.0).ssim)


def run_kernel(x, y, threads, level, beta=0.2):
    gradient = torch.empty_like(x)
    parts = _core.training.photometric(x, y, None, gradient, beta, threads, level)
    return parts, gradient


@pytest.mark.parametrize("beta", [0.0, 0.2])
@pytest.mark.parametrize("level", _core.simd_levels())
def test_same_bits_for_any_thread_count(level, beta):
    x, y = (t.detach() for t in images(203, 555, dtype=torch.float32))
    parts, gradient = run_kernel(x, y, 1, level, beta)
    for threads in (2, 3, 5, 16):
        other_parts, other = run_kernel(x, y, threads, level, beta)
        assert other_parts[:2] == parts[:2] and torch.equal(other, gradient)


def test_instruction_sets_agree():
    x, y = (t.detach() for t in images(70, 311, dtype=torch.float32))
    parts, gradient = run_kernel(x, y, 1, "baseline")
    for level in _core.simd_levels():
        other_parts, other = run_kernel(x, y, 1, level)
        assert abs(parts[0] - other_parts[0]) < 2e-7
        assert (gradient - other).abs().max() < 2e-5 * gradient.abs().max()


def test_bad_input_is_refused():
    x, y = images(10, 12)
    with pytest.raises(ValueError, match="target: expected the shape of render"):
        photometric_loss(x, y[:5])
    for size in ((4, 4, 17), (0, 4, 3)):
        with pytest.raises(ValueError, match="1 <= C <= 16"):
            photometric_loss(torch.zeros(size), torch.zeros(size))
    with pytest.raises(ValueError, match="weight"):
        photometric_loss(x, y, 0.2, torch.ones(3, 3))
    with pytest.raises(ValueError, match="expected auto"):
        run_kernel(x.detach(), y, 1, "avx99")
