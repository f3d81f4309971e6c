"""Estimates memory and time of a mapping run from its photos and settings, before it starts.

The constants were measured on two cores of an AMD EPYC (AVX2): fox_480 (50 photos of 270×480, given cameras, built-in
masks) took 268 s and 1.2 GiB, room_a (86 of 640×480, given cameras, given masks) 222 s and 1.4 GiB, tabletop_a (62 of
640×480) 1.4 GiB; a step of training takes 1.9 times as long at four times the pixels, and 46, 51, 53 and 73 ms at 25,
50, 100 and 200 thousand Gaussians. Structure from motion took 96 s for fox_480 and 64 s
for tabletop_a on a loaded machine. Estimates are accurate to about 20 % for memory and to a factor of 2 for time.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from perception.config import MapConfig
from perception.errors import InputError
from perception.io.inputs import PhotoSizes, photo_sizes

BASE_BYTES, BYTES_PER_GAUSSIAN, BYTES_PER_PIXEL = 900 << 20, 2400, 7
"""Program and libraries; parameters, gradients and moments of a Gaussian; a decoded photo (3) and its labels (4)."""
STEP_BYTES_PER_PIXEL, DECODE_BYTES_PER_PIXEL, READERS = 200, 12, 4
"""Images and gradients of one training step; a photo of full size in one of the threads that read photos."""
POSED_SECONDS, PHOTO_SECONDS, MASK_SECONDS_PER_PIXEL = 30.0, 0.1, 3e-6
STEP_SECONDS, STEP_SECONDS_PER_PIXEL, USUAL_BUDGET = 0.04, 1.3e-7, 100_000
SFM_SECONDS_PER_PIXEL, SFM_MOST_PIXELS, SFM_SECONDS_PER_PAIR, SFM_SECONDS_PER_PHOTO = 4e-7, 1600 * 1200, 0.055, 0.65
"""Feature extraction per pixel, up to a maximum of pixels per photo; matching per pair; other time per photo."""
SFM_PARTNERS = 12
"""Matched pairs per photo of a large set; measured: 19 in fox_480, 8 in tabletop_a."""


@dataclass(frozen=True)
class Estimate:
    """Peak memory in bytes and time in seconds of one run; side: long side in pixels of the largest training photo."""

    what: str
    side: int
    memory: int
    poses_seconds: float
    training_seconds: float

    def text(self) -> str:
        """One line for the user."""
        minutes = (self.poses_seconds + self.training_seconds) / 60
        poses = f", poses {_minutes(self.poses_seconds / 60)} of them" if self.poses_seconds else ""
        return (
            f"{self.what}, trained at up to {self.side} pixels: about {self.memory / 2**30:.1f} GiB and "
            f"{_minutes(minutes)} on two cores{poses}"
        )


def _minutes(minutes: float) -> str:
    return f"{max(1, round(minutes))} min" if minutes < 90 else f"{minutes / 60:.1f} h"


def estimate(photos: PhotoSizes, config: MapConfig) -> Estimate:
    """The estimate for photos of these sizes, including structure from motion if the input has no poses."""
    count = len(photos.sizes)
    scales = [min(1.0, config.photos.max_side / max(size)) for size in photos.sizes]
    pixels = [w * h * scale**2 for (w, h), scale in zip(photos.sizes, scales, strict=True)]
    largest = max((w * h for w, h in photos.sizes), default=0)
    memory = BASE_BYTES + config.train.budget * BYTES_PER_GAUSSIAN + BYTES_PER_PIXEL * sum(pixels)
    memory += max(STEP_BYTES_PER_PIXEL * max(pixels, default=0), DECODE_BYTES_PER_PIXEL * READERS * largest)
    growth = 0.8 + 0.2 * config.train.budget / USUAL_BUDGET
    step = (STEP_SECONDS + STEP_SECONDS_PER_PIXEL * sum(pixels) / max(count, 1)) * growth
    training = min(step * config.train.iterations, config.train.time_limit or float("inf"))
    masks = 0.0 if config.masks.startswith("labels:") else MASK_SECONDS_PER_PIXEL * sum(pixels)
    rest = POSED_SECONDS + PHOTO_SECONDS * count + masks
    side = max((round(max(size) * scale) for size, scale in zip(photos.sizes, scales, strict=True)), default=0)
    return Estimate(
        photos.what, side, int(memory), 0.0 if photos.posed else _sfm_seconds(photos.sizes), training + rest
    )


def _sfm_seconds(sizes: list[tuple[int, int]]) -> float:
    count = len(sizes)
    features = SFM_SECONDS_PER_PIXEL * sum(min(w * h, SFM_MOST_PIXELS) for w, h in sizes)
    pairs = min(count * (count - 1) / 2, SFM_PARTNERS * count)
    return features + pairs * SFM_SECONDS_PER_PAIR + count * SFM_SECONDS_PER_PHOTO


def log_estimate(source: Path, config: MapConfig, log: Callable[[str], None]) -> None:
    """Passes the estimate for the input `source` to `log` as one line; InputError if memory is not sufficient."""
    photos = photo_sizes(source)
    if photos.sizes:
        check_memory(photos, config)
        log(estimate(photos, config).text())


def check_memory(photos: PhotoSizes, config: MapConfig, limit: int | None = None) -> None:
    """InputError that suggests smaller settings if the run needs more than `limit` bytes.

    limit None: the memory available to this process; nothing is checked if that is unknown.
    """
    limit = memory_limit() if limit is None else limit
    needed = estimate(photos, config)
    if limit is None or needed.memory <= limit:
        return
    raise InputError(
        f"{photos.what} need about {needed.memory / 2**30:.1f} GiB with --max-side {config.photos.max_side} --budget "
        f"{config.train.budget}, and there are {limit / 2**30:.1f}; {_advice(photos, config, limit)}"
    )


def _advice(photos: PhotoSizes, config: MapConfig, limit: int) -> str:
    """The largest settings that fit; the budget is not reduced by a larger factor than the photos."""
    for share in (0.75, 0.5, 0.35, 0.25, 0.15, 0.1):
        side, budget = max(64, int(config.photos.max_side * share)), max(1000, int(config.train.budget * share))
        for changes in ({"max_side": side}, {"budget": budget}, {"max_side": side, "budget": budget}):
            changed = config.model_copy(
                update={
                    "photos": config.photos.model_copy(update={k: v for k, v in changes.items() if k == "max_side"}),
                    "train": config.train.model_copy(update={k: v for k, v in changes.items() if k == "budget"}),
                }
            )
            if estimate(photos, changed).memory <= limit:
                return "give " + " ".join(f"--{key.replace('_', '-')} {value}" for key, value in changes.items())
    return "give fewer or smaller photos, or use a machine with more memory"


def memory_limit() -> int | None:
    """Bytes of memory available to this process: that of the machine, or the limit of its control group."""
    try:
        limit = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (ValueError, OSError, AttributeError):
        return None
    for file in ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes"):
        try:
            limit = min(limit, int(Path(file).read_text()))
        except (OSError, ValueError):  # no control group, or "max"
            continue
    return limit
