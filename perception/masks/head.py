"""Learned borders on the feature maps of a network that has seen photos of the world (EfficientNet-Lite2, ImageNet).

The network is frozen; its maps, and the same inputs as those of `boundaries`, go into a small head. It tells what
`boundaries` tells, and borders between neighbouring pixels. `python tools training.heads` makes the packaged weights
from rendered worlds alone, see docs/masks.md.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from perception.errors import CLASSIFIER, packaged_file
from perception.machine import torch_on_one_thread
from perception.masks.boundaries import INPUTS, WIDTHS, inputs_of, scaled
from perception.masks.cues import DepthCues, PhotoCues

if TYPE_CHECKING:
    import torch

    from perception.efficientnet_lite2 import EfficientNetLite2
    from perception.masks.boundaries import Layers

WEIGHTS = Path(__file__).with_name("head_weights.npz")
THING, DIRECT = 2, slice(3, 5)  # outputs
OFFSETS = {0: (4, 0), 1: (0, 4), 5: (3, 3), 6: (3, -3), 7: (12, 0), 8: (0, 12), 9: (8, 8), 10: (8, -8)}
"""Output -> (x, y): whether the pixels this far to either side are of different things."""
OUTPUTS = 11
MAP_CHANNELS = (16, 24, 48, 120, 352)  # of the network's maps, at strides 2 to 32
PROJECTED = (16, 24, 24, 24, 24)  # channels that each of them is reduced to


def borders(rgb: np.ndarray, photo: PhotoCues, depth: DepthCues, layers: Layers) -> np.ndarray:
    """[11, h, w] float32 log odds. THING: that a pixel is of a thing and not of a floor, a wall or a table. DIRECT:
    that a pixel and its right neighbour, its lower one, are of different things. The rest: see OFFSETS. rgb: [h, w, 3]
    uint8."""
    return predicted(rgb, inputs_of(photo, depth), layers)


def predicted(rgb: np.ndarray, inputs: np.ndarray, layers: Layers) -> np.ndarray:
    """`borders`, from inputs [11, h, w] uint8; those of geometry may be 127, unknown."""
    import torch

    with torch_on_one_thread(), torch.inference_mode():  # with more, the last bits of convolutions differ
        maps = backbone().maps(torch.from_numpy(np.ascontiguousarray(rgb))[None])
        shown = scaled(torch.from_numpy(inputs)[None])
        return enlarged(forward(layers, shown, maps), shown)[0].numpy()


@functools.cache
def backbone() -> EfficientNetLite2:
    """The network of the extra `demo`. InputError if it is not installed."""
    from perception.efficientnet_lite2 import load_backbone

    return load_backbone(packaged_file(*CLASSIFIER))


def shapes() -> list[tuple[int, int, int]]:
    """Outputs, inputs and side of the kernel of each layer, in the order of `forward`."""
    down = [(b, a if k else b, 3) for a, b in zip((INPUTS, *WIDTHS), WIDTHS, strict=False) for k in (1, 0)]
    reduced = [(b, a, 1) for a, b in zip(MAP_CHANNELS, PROJECTED, strict=True)]
    levels = [a + b for a, b in zip(WIDTHS, PROJECTED, strict=False)]
    below, up = levels[-1] + PROJECTED[-1], []
    for width, level in zip(WIDTHS[-2::-1], levels[-2::-1], strict=True):
        up += [(width, below + level, 3), (width, width, 3)]
        below = width
    return [*down, *reduced, *up, (OUTPUTS, WIDTHS[0], 1)]


def forward(layers: Layers, inputs: torch.Tensor, maps: Sequence[torch.Tensor]) -> torch.Tensor:
    """[B, 11, h, w] scaled inputs, and the network's maps -> [B, 11, h / 2, w / 2] log odds, rounded up. As
    `boundaries.forward`, but each level also sees the network's map of its stride, and the lowest that of half its
    resolution."""
    import torch
    from torch.nn.functional import conv2d, relu

    layer = iter(layers)

    def two_layers(x: torch.Tensor, stride: int) -> torch.Tensor:
        x = relu(conv2d(x, *next(layer), stride=stride, padding=1))
        return relu(conv2d(x, *next(layer), padding=1))

    levels, x = [], inputs
    for _ in WIDTHS:
        x = two_layers(x, 2)
        levels.append(x)
    *reduced, lowest = [relu(conv2d(image, *next(layer))) for image in maps]
    levels = [torch.cat(pair, dim=1) for pair in zip(levels, reduced, strict=True)]
    x = torch.cat([levels.pop(), enlarged(lowest, reduced[-1])], dim=1)
    for level in reversed(levels):
        x = two_layers(torch.cat([enlarged(x, level), level], dim=1), 1)
    return conv2d(x, *next(layer))


def enlarged(x: torch.Tensor, like: torch.Tensor) -> torch.Tensor:
    """x [B, C, h', w'] at the resolution of `like`."""
    from torch.nn.functional import interpolate

    return interpolate(x, like.shape[2:], mode="bilinear", align_corners=False)
