"""Learned borders of objects: a small convolutional network sees the colours, normals, steps and creases of a photo.

It separates borders of things from shadows and from print by what is around them. `python tools training.masks` makes
its packaged weights from rendered worlds alone, see docs/masks.md.
"""

from __future__ import annotations

import functools
from pathlib import Path

import numpy as np
import torch
from torch.nn.functional import conv2d, interpolate, relu

from perception.machine import torch_on_one_thread
from perception.masks.cues import DepthCues, PhotoCues

Layers = list[tuple[torch.Tensor, torch.Tensor]]  # weights [out, in, k, k] and offsets [out]
WEIGHTS = Path(__file__).with_name("boundary_weights.npz")
REACH = 4  # pixels: whether the pixels this far to either side are of different things is what the network predicts
INPUTS, OUTPUTS = 11, 3
WIDTHS = (24, 32, 48, 64)  # channels at 1/2, 1/4, 1/8 and 1/16 of the resolution
_STEP = 0.06  # largest step, relative to depth


def boundaries(photo: PhotoCues, depth: DepthCues, layers: Layers) -> np.ndarray:
    """[3, h, w] float32 log odds: that the pixels REACH left and right of a pixel are of different things, that those
    above and below are, and that the pixel is of a thing and not of a floor, a wall or a table."""
    inputs = scaled(torch.from_numpy(inputs_of(photo, depth))[None])
    with torch_on_one_thread(), torch.inference_mode():  # with more, the last bits of convolutions differ
        odds = forward(layers, inputs)[0].numpy()
    for image in (odds[0], odds[1].T):  # beyond the photo nothing is known
        edge = min(REACH, (image.shape[1] - 1) // 2)
        image[:, :edge], image[:, image.shape[1] - edge :] = image[:, edge, None], image[:, -edge - 1, None]
    return odds


def inputs_of(photo: PhotoCues, depth: DepthCues) -> np.ndarray:
    """[11, h, w] uint8: Lab, normals, steps and creases along both axes, logarithm of the depth over its median."""
    z = depth.points[..., 2]
    maps = [photo.lab.transpose(2, 0, 1), 127.5 + 127.5 * depth.normals.transpose(2, 0, 1)]
    maps += [255 * np.minimum(depth.step / _STEP, 1), 127.5 + 127.5 * np.clip(depth.bend, -1, 1)]
    maps.append(127.5 + 64 * np.log(z / np.median(z))[None])
    return np.concatenate(maps).clip(0, 255).astype(np.uint8)


def scaled(inputs: torch.Tensor) -> torch.Tensor:
    """uint8 inputs as float32 in ± 1."""
    return inputs.float() / 127.5 - 1


def shapes() -> list[tuple[int, int, int]]:
    """Outputs, inputs and side of the kernel of each layer, in the order of `forward`."""
    down = [(b, a if k else b, 3) for a, b in zip((INPUTS, *WIDTHS), WIDTHS, strict=False) for k in (1, 0)]
    up = [(a, a + b if k else a, 3) for a, b in zip(WIDTHS[-2::-1], WIDTHS[:0:-1], strict=True) for k in (1, 0)]
    return [*down, *up, (OUTPUTS, WIDTHS[0], 1)]


def forward(layers: Layers, inputs: torch.Tensor) -> torch.Tensor:
    """[B, 11, h, w] scaled inputs -> [B, 3, h, w] log odds. A U-Net (Ronneberger et al. 2015) from half the resolution
    on, enlarged to the resolution of the inputs."""
    layer = iter(layers)

    def two_layers(x: torch.Tensor, stride: int) -> torch.Tensor:
        x = relu(conv2d(x, *next(layer), stride=stride, padding=1))
        return relu(conv2d(x, *next(layer), padding=1))

    skips = [inputs]
    for _ in WIDTHS:
        skips.append(two_layers(skips[-1], 2))
    x = skips.pop()
    for skip in skips[:0:-1]:
        x = interpolate(x, skip.shape[2:], mode="bilinear", align_corners=False)
        x = two_layers(torch.cat([x, skip], dim=1), 1)
    return interpolate(conv2d(x, *next(layer)), inputs.shape[2:], mode="bilinear", align_corners=False)


@functools.cache
def read_layers(file: Path = WEIGHTS) -> Layers:
    """The layers of the package, or of another file of `tools/training`."""
    with np.load(file) as stored:
        parts = [torch.from_numpy(stored[f"arr_{k}"].astype(np.float32)) for k in range(len(stored.files))]
    return list(zip(parts[::2], parts[1::2], strict=True))
