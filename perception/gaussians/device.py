"""Which device training runs on, and the kernels for it."""

from __future__ import annotations

from contextlib import suppress
from typing import Any, Literal

import torch

from perception import _core
from perception.errors import InputError

_LEAST_MEMORY = 2 << 30  # free bytes that a GPU must have: a default map takes about half of it


def training_kernels(device: torch.device) -> Any:
    """Losses and Adam for tensors on `device`; the stub of `_core.training` says what they do."""
    if device.type == "cpu":
        return _core.training
    from perception.rasterizer.cuda import training

    return training


def choose_device(wanted: Literal["auto", "cpu", "cuda"]) -> tuple[torch.device, str | None]:
    """The device for `wanted`, and a line for the user: the GPU's name, or why "auto" leaves a GPU alone.

    InputError for "cuda" where no GPU can be used.
    """
    if wanted == "cpu" or (wanted == "auto" and not _has_driver()):
        return torch.device("cpu"), None
    try:
        name = _usable_gpu()
    except (InputError, RuntimeError) as error:
        if wanted == "cuda":
            raise InputError(f"--device cuda: {error}") from None
        return torch.device("cpu"), f"training on the CPU: {error}"
    return torch.device("cuda", torch.cuda.current_device()), f"training on {name}"


def _has_driver() -> bool:
    from perception.rasterizer.cuda.kernels import load_driver

    with suppress(InputError):
        load_driver()
        return True
    return False


def _usable_gpu() -> str:
    """The name of torch's current GPU, on which a small scene was rendered; an error when there is none that works."""
    if torch.version.cuda is None:
        raise InputError("torch was built without CUDA; install it without constraints.txt")
    if not torch.cuda.is_available():
        raise InputError(f"torch {torch.__version__} finds no GPU; check the driver with nvidia-smi")
    name, free = torch.cuda.get_device_name(), torch.cuda.mem_get_info()[0]
    if free < _LEAST_MEMORY:
        raise InputError(f"{name} has {free >> 20} MiB free, expected at least {_LEAST_MEMORY >> 20} MiB")
    from perception.rasterizer.rasterize import rasterize

    def picture(device: torch.device) -> torch.Tensor:
        """Of a red Gaussian two units in front of a camera, and the gradient of its brightness."""
        pose, one = torch.eye(4, device=device)[None], torch.ones(1, 3, device=device)
        red, mean, K = pose[:, 0, :3], (2 * pose[:, 2, :3]).requires_grad_(), 8 * pose[:, :3, :3]
        image = rasterize(mean, pose[:, 0], 0.3 * one, 0.5 * one[:, 0], red, pose, K, 8, 8).colors
        (slope,) = torch.autograd.grad(image.sum(), mean)
        return torch.cat([image.detach().flatten(), slope.flatten()]).cpu()

    gpu = torch.device("cuda", torch.cuda.current_device())
    if not torch.allclose(picture(gpu), picture(torch.device("cpu")), rtol=1e-3, atol=1e-4):
        raise InputError(f"{name} rendered a wrong picture; please report this with the version of its driver")
    return name
