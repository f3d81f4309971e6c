"""Colours of instances from their ids, and colours of Gaussians from spherical harmonics."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, TypeVar

import numpy as np

if TYPE_CHECKING:
    import torch

    Array = TypeVar("Array", np.ndarray, torch.Tensor)

GREY = np.array([128, 128, 128], np.uint8)
"""Colour of points and pixels without an instance."""
SH_C0 = 0.28209479177387814
"""Zeroth real spherical harmonic, 1 / (2 √π)."""
_GOLDEN = 0.6180339887498949


def instance_palette(ids: int | np.ndarray | Sequence[int]) -> np.ndarray:
    """Colours [N, 3] uint8 of instance ids [N] (or of 0..n−1): the same id always has the same colour, −1 is grey.

    The hue advances by the golden ratio per id, so that consecutive ids have very different hues; saturation and
    value change every 8 ids.
    """
    wanted = np.arange(ids) if isinstance(ids, int | np.integer) else np.asarray(ids, np.int64).ravel()
    k = np.maximum(wanted, 0)
    hue = (0.02 + k * _GOLDEN) % 1.0
    saturation = np.array([0.80, 0.55, 0.95])[(k // 8) % 3]
    value = np.array([0.95, 0.78, 0.62])[(k // 8 + k // 24) % 3]
    # HSV to RGB: channel n is v − v s clip(min(m, 4 − m), 0, 1) with m = (n + 6 h) mod 6 and n = 5, 3, 1.
    m = (np.array([5, 3, 1]) + 6 * hue[:, None]) % 6
    rgb = value[:, None] * (1 - saturation[:, None] * np.clip(np.minimum(m, 4 - m), 0, 1))
    colors = np.round(255 * rgb).astype(np.uint8)
    colors[wanted < 0] = GREY
    return colors


def rgb_from_sh(constant: Array) -> Array:
    """RGB [..., 3] in about [0, 1] of constant spherical-harmonic coefficients [..., 3], without view dependence."""
    return constant * SH_C0 + 0.5


def sh_from_rgb(rgb: Array) -> Array:
    """Constant spherical-harmonic coefficients [..., 3] of RGB [..., 3] in [0, 1]; the inverse of `rgb_from_sh`."""
    return (rgb - 0.5) / SH_C0


def rgb8_from_sh(constant: np.ndarray) -> np.ndarray:
    """RGB [..., 3] uint8 of constant spherical-harmonic coefficients [..., 3], rounded and clipped."""
    return np.clip(rgb_from_sh(constant) * 255 + 0.5, 0, 255).astype(np.uint8)
