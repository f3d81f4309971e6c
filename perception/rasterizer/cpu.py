"""Both passes on the CPU: the torch side of the compiled kernels (csrc/rasterizer). No autograd."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict
from typing import Any

import numpy as np
import torch
from torch import Tensor

from perception import _core
from perception.errors import InputError
from perception.machine import threads_before
from perception.rasterizer.types import Cotangents, Forward, Gradients, Inputs, Settings

simd_levels = _core.simd_levels  # the SIMD levels this processor supports, best first


def _compiled(name: str, tensor: Tensor) -> Any:
    """The compiled function or struct for the tensor's dtype."""
    return getattr(_core, f"{name}_{'f64' if tensor.dtype == torch.float64 else 'f32'}")


def _arrays(of: Any, names: Iterable[str]) -> dict[str, Any]:
    """These tensors of `of` as numpy, without a copy; None stays None."""
    tensors = {name: getattr(of, name) for name in names}
    return {name: None if tensor is None else tensor.detach().numpy() for name, tensor in tensors.items()}


def _inputs(inputs: Inputs, settings: Settings) -> Any:
    numbers = asdict(settings)
    del numbers["simd"]
    numbers["threads"] = settings.threads or threads_before.get() or torch.get_num_threads()
    return _compiled("RasterizerInputs", inputs.means)(**_arrays(inputs, Inputs.NAMES), **numbers)


def rasterize_forward(inputs: Inputs, settings: Settings) -> Forward:
    """One forward pass. InputError names a value that is not finite."""
    out = Forward.empty(inputs, settings)
    images = _compiled("RasterizerImages", out.colors)(**_arrays(out, Forward.IMAGES))
    run, more = _compiled("rasterize_forward", out.colors), _arrays(out, ("visible", "radii"))
    try:
        out.frames = run(_inputs(inputs, settings), images, **more, simd=settings.simd)
    except ValueError as error:
        raise InputError(f"rasterize: {error}") from None
    return out


def rasterize_backward(
    inputs: Inputs,
    settings: Settings,
    forward: Forward,
    cotangents: Cotangents,
    gradients: Gradients,
    stored: bool = False,
) -> None:
    """One backward pass: adds to `gradients`, where they are wanted. That of features alone takes less time.

    stored: for one camera, `gradients` are written instead, for visible Gaussians only. Those of scales and opacities
    are then with respect to their logarithms and logits.
    """
    means = inputs.means
    images = _compiled("RasterizerImages", means)(**_arrays(forward, Forward.IMAGES))
    by_image = _compiled("RasterizerCotangents", means)(**_arrays(cotangents, Forward.IMAGES))
    by_input = _compiled("RasterizerGradients", means)(**_arrays(gradients, Gradients.NAMES))
    run = _compiled("rasterize_backward", means)
    run(_inputs(inputs, settings), forward.frames, images, by_image, by_input, stored)


def label_images(inputs: Inputs, labels: np.ndarray, least: float, settings: Settings) -> tuple[np.ndarray, np.ndarray]:
    """For each of up to 8 labellings, the label with the largest weight in every pixel of one camera (C = 1).

    labels [L, N] int32, −1 = none, < 2^24. A label's weight in a pixel is the sum of alpha · transmittance over its
    Gaussians. Of equal weights the smaller label wins. Returns images [L, H, W] int32, −1 where no weight exceeds
    `least`, and [N] bool: whether each Gaussian contributes to some pixel.
    """
    images = np.empty((len(labels), settings.height, settings.width), np.int32)
    visible = np.zeros(len(inputs.means), np.uint8)
    run = _compiled("rasterize_labels", inputs.means)
    try:
        run(_inputs(inputs, settings), np.ascontiguousarray(labels), least, images, visible, settings.simd)
    except ValueError as error:
        raise InputError(f"rasterize: {error}") from None
    return images, visible.view(bool)
