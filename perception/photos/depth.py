"""Reads depth images and samples them at the pixels of a view's pinhole camera."""

from __future__ import annotations

import os
from pathlib import Path

import cv2
import numpy as np

from perception.errors import InputError
from perception.io.arrays import map_npy
from perception.io.documents import refusing
from perception.photos.decode import read_picture, warped
from perception.photos.lens import rescale_lens, same_aspect
from perception.photos.views import view_lens
from perception.types import View

SATURATED = 65535
"""Value of 16-bit depth images that means "too far to measure"."""
_EDGE = 0.05
"""Relative step of depth between neighbouring pixels that belong to two surfaces."""


def read_depth(path: Path) -> np.ndarray:
    """The image [h, w] as stored, float32, 0 = nothing `measured`.
    InputError when the file is missing, damaged, empty, not of one channel, or of 8 bits: a picture of depth."""
    if not os.path.isfile(path):  # noqa: PTH113 - Path.is_file raises for a name that is too long
        raise InputError(f"{path}: no such depth image; add the file, or remove what lists it")
    what = "depth image; expected PNG or TIFF of one channel, or .npy"
    with refusing(f"{path}: not a readable {what}"):
        image = map_npy(path) if path.suffix.lower() == ".npy" else read_picture(path, path, what)
    if image.ndim != 2 or image.size == 0 or image.dtype.kind not in "uif":
        raise InputError(f"{path}: found {image.dtype} {list(image.shape)}, expected a depth image of one channel")
    if image.dtype.itemsize == 1:
        raise InputError(f"{path}: holds 8 bits a pixel, a picture of depth; expected 16 bits or floating point")
    return measured(image)


def measured(image: np.ndarray) -> np.ndarray:
    """A depth image as float32, 0 where nothing was measured (0, negative, NaN, infinite, saturated)."""
    depth = image.astype(np.float32)
    unknown = ~np.isfinite(depth) | (depth < 0)
    depth[unknown | (image == SATURATED) if image.dtype == np.uint16 else unknown] = 0
    return depth


def load_depth(view: View, width: int, height: int) -> np.ndarray:
    """Depth [height, width] float32 along the optical axis of the view's pinhole, in scene units; 0 = none.
    A view without depth has zeros. InputError for a depth image of another aspect ratio than its camera."""
    if view.depth is None:
        return np.zeros((height, width), np.float32)
    image, lens = read_depth(view.depth.path), view.depth.lens or view_lens(view)
    size = image.shape[::-1]
    if not same_aspect(size, (lens.width, lens.height)):
        found = f"the depth image is {size[0]}×{size[1]}, its camera {lens.width}×{lens.height}"
        raise InputError(f"{view.depth.path}: {found}; expected the same field of view at any resolution")
    lens = rescale_lens(lens, *size)
    depth = warped(image, view, lens, width, height)
    if not depth.any() and image.any():  # a grid of points, all of which lie between the pixels that are sampled
        more = -(-max(size) // max(width, height))
        blocks = warped(image, view, lens, more * width, more * height).reshape(height, more, width, more)
        depth = blocks.max(axis=(1, 3))
    return depth * np.float32(view.depth.scale)


def without_edges(depth: np.ndarray) -> np.ndarray:
    """depth [h, w], 0 = none, with 0 at every pixel that has a depth edge in its 3 × 3 neighbourhood.
    At edges sensors measure mixtures of both surfaces, and the shift between colour and depth camera is not exact."""
    kernel = np.ones((3, 3), np.uint8)
    near = cv2.erode(np.where(depth > 0, depth, np.float32(np.inf)), kernel)
    return np.where(cv2.dilate(depth, kernel) - near <= _EDGE * depth, depth, np.float32(0))
