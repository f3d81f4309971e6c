"""What a report shows, as plain data. Everything but the title may be missing; what is missing is left out.

Pictures are [H, W, 3] uint8 RGB.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np


@dataclass(frozen=True)
class ViewRow:
    """A held-out view. photo, render: pictures of one size; psnr in dB, ssim in [0, 1]; note: why it is shown."""

    name: str
    psnr: float | None = None
    ssim: float | None = None
    photo: np.ndarray | None = None
    render: np.ndarray | None = None
    note: str = ""


@dataclass(frozen=True)
class InstanceRow:
    """An instance: best crop, the user's label or the likeliest names, score in [0, 1], box sides in map
    units."""

    id: int
    crop: np.ndarray | None = None
    label: str | None = None
    names: Sequence[str] = ()
    score: float | None = None
    extent: Sequence[float] | None = None
    num_gaussians: int | None = None


@dataclass(frozen=True)
class QueryRow:
    """A text query and its hits, best first: (instance id, score). picture: the best hit outlined in a photo.

    expected: the ids that are right where the truth is known.
    """

    text: str
    present: bool
    hits: Sequence[tuple[int, float]] = ()
    picture: np.ndarray | None = None
    expected: Sequence[int] | None = None


@dataclass(frozen=True)
class ReportData:
    """All of a report.

    figures: name -> value as it should read, for the header ({"PSNR held-out": "28.4 dB"}). seconds: by stage, in
    order. psnr_curve: (iteration, dB); ssim_curve: (iteration, SSIM as trained, zero-padded); gaussians_curve:
    (iteration, count). views: held-out views; those with pictures are shown, worst first, all with figures appear in
    the bars. overview: title -> picture (instances from above, feature colours). metric: whether extents are metres.
    settings: name -> value. rerun: the command that makes this map again.
    """

    title: str
    subtitle: str = ""
    figures: Mapping[str, str] = field(default_factory=dict)
    seconds: Mapping[str, float] = field(default_factory=dict)
    psnr_curve: Sequence[tuple[float, float]] = ()
    ssim_curve: Sequence[tuple[float, float]] = ()
    gaussians_curve: Sequence[tuple[float, float]] = ()
    views: Sequence[ViewRow] = ()
    overview: Mapping[str, np.ndarray] = field(default_factory=dict)
    instances: Sequence[InstanceRow] = ()
    metric: bool = False
    queries: Sequence[QueryRow] = ()
    warnings: Sequence[str] = ()
    settings: Mapping[str, object] = field(default_factory=dict)
    rerun: str = ""
