"""Colours of things and of photos: in another light, without hues, and what they say of whether two things are one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch

from perception.changes.registration import Points
from perception.colors import rgb_from_sh, sh_from_rgb
from perception.gaussians.model import Gaussians
from perception.gaussians.views import TrainingView

LUMA = np.array([0.299, 0.587, 0.114], np.float32)
"""Shares of red, green and blue in brightness (ITU-R BT.601), as in grey photos of Pillow and OpenCV."""
COLOURLESS = 2.0
"""Mean difference of a pixel's channels, in grey levels, below which a photo has no colours."""
BINS = 6
"""Of each colour in the histograms of things."""
LOOKS = 8.0, 0.45
"""Log-odds of being one thing per unit of what two histograms have in common, and where that says nothing: of one thing
in two visits .5 to .75, of others up to .5."""
HUES = -35.0, 0.07
"""Log-odds of being one thing per unit of difference between the shares of red, green and blue in its colours and in
the photos', and where that says nothing: positive for 134 of 142 right pairs of made scenes and 4 of 88 wrong ones."""
GREY = -1.5
"""The same without colours, where histograms say nothing: 16 of 26 right pairs and 2 of 27 wrong ones are above."""


def in_light(gaussians: Gaussians, light: np.ndarray) -> Gaussians:
    """The Gaussians with their colours times light [3]: colour = ½ + C₀ sh₀ + …"""
    gain = torch.from_numpy(light.astype(np.float32))
    sh = gaussians.sh * gain
    sh[:, 0] = sh_from_rgb(rgb_from_sh(gaussians.sh[:, 0]) * gain)
    return replace(gaussians, sh=sh)


def in_grey(gaussians: Gaussians) -> Gaussians:
    """The Gaussians as a camera without colours sees them. Brightness is linear in the harmonics, as colours are."""
    return replace(gaussians, sh=(gaussians.sh @ torch.from_numpy(LUMA))[..., None].repeat(1, 1, 3))


def grey_photo(view: TrainingView) -> TrainingView:
    """The view as a camera without colours sees it."""
    grey = (view.photo.float() @ torch.from_numpy(LUMA) + 0.5).to(torch.uint8)
    return replace(view, photo=grey[..., None].repeat(1, 1, 3))


def without_colours(old: Gaussians, views: Sequence[TrainingView]) -> bool:
    """Whether the photos have no colours, or the Gaussians have none."""
    photos = max((float(np.ptp(view.photo.numpy(), axis=2).mean()) for view in views), default=COLOURLESS)
    mapped = 255 * float(np.ptp(rgb_from_sh(old.sh[:, 0].numpy()), axis=1).mean()) if len(old) else COLOURLESS
    return min(photos, mapped) < COLOURLESS


def looks_alike(old: Gaussians, new: Gaussians) -> float:
    """Share in [0, 1] that the histograms of the colours of two things have in common."""
    histograms = []
    for each in (old, new):
        colors = Points.of(each).colors
        counts = np.histogramdd(colors, bins=BINS, range=[(0, 1)] * 3)[0]
        histograms.append(counts / max(counts.sum(), 1))
    return float(np.minimum(*histograms).sum())


def colour_odds(old: Gaussians, alike: float, sums: np.ndarray) -> float:
    """Log-odds that an old thing is the one that photos show, by what the histograms of their colours have in common,
    `alike`, and by their hues, without brightness, which light changes. sums [2, 3]: of the colours of the thing and of
    the photos over its pixels."""
    if (old.sh == old.sh[..., :1]).all():
        return GREY
    odds, totals = LOOKS[0] * (alike - LOOKS[1]), sums.sum(axis=1, keepdims=True)
    return odds + (HUES[0] * (float(np.abs(np.subtract(*(sums / totals))).sum()) - HUES[1]) if totals.all() else 0.0)
