"""Estimates the memory of a mapping run from its photos and settings before it starts, and refuses what cannot fit.

The constants were measured on two cores: fox_480 (50 photos of 270×480) took 1.2 GiB, room_a (86 of 640×480) and
tabletop_a (62 of 640×480) 1.4 GiB. Estimates are accurate to about 20 %.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

from perception.config import MapConfig
from perception.errors import InputError
from perception.evaluate.images import WINDOW
from perception.gaussians.state import sized
from perception.inputs.load import PhotoSizes, photo_sizes
from perception.machine import memory_limit

BASE_BYTES, BYTES_PER_GAUSSIAN, BYTES_PER_PIXEL, DEPTH_BYTES = 900 << 20, 2400, 7, 5
"""Program and libraries; parameters, gradients and moments of a Gaussian; a decoded photo (3), its
labels (2) and both at half the size (2); its depth in all resolutions."""
STEP_BYTES_PER_PIXEL, DECODE_BYTES_PER_PIXEL, READERS = 200, 12, 4
"""Images and gradients of one training step; a photo of full size in one of the threads that read photos."""


def image_memory(config: MapConfig, limit: int | None) -> int:
    """Bytes that the photos, labels and depth of a run may fill: as set, or a quarter of the `limit` of the process.
    8G, 8gb and 8GiB are the same."""
    if (size := config.photos.memory) is not None:
        size = size.upper().rstrip("IB")
        return int(size[:-1]) << {"M": 20, "G": 30}[size[-1]]
    return 1 << 62 if limit is None else limit // 4


def needed_bytes(photos: PhotoSizes, max_side: int, budget: int, memory: int = 1 << 62) -> int:
    """Peak memory of a run in bytes. memory: see `image_memory`."""
    pixels = [w * h * min(1.0, max_side / max(w, h)) ** 2 for w, h in photos.sizes]
    largest = max((w * h for w, h in photos.sizes), default=0)
    per_pixel = BYTES_PER_PIXEL + (DEPTH_BYTES if photos.depth else 0)
    at_once = max(STEP_BYTES_PER_PIXEL * max(pixels, default=0), DECODE_BYTES_PER_PIXEL * READERS * largest)
    return int(BASE_BYTES + budget * BYTES_PER_GAUSSIAN + min(per_pixel * sum(pixels), memory) + at_once)


def largest_budget(limit: int | None) -> int | None:
    """Gaussians that fit into half of what the `limit` of the process in bytes leaves beside the program."""
    return None if limit is None else max(0, limit - BASE_BYTES) // 2 // BYTES_PER_GAUSSIAN


def log_estimate(source: Path, config: MapConfig, log: Callable[[str], None]) -> None:
    """Logs the estimate for the input `source` as one line; InputError if memory is not sufficient, or the photos
    are too small."""
    photos = photo_sizes(source)
    check_size(photos, config.photos.max_side)
    if photos.sizes:
        needed = check_memory(photos, config)
        log(f"{photos.what}, trained at up to {config.photos.max_side} pixels: about {needed / 2**30:.1f} GiB")


def check_size(photos: PhotoSizes, max_side: int) -> None:
    """InputError where most photos would be trained with a side of less than WINDOW pixels, too small to be scored."""
    if not photos.sizes:
        return
    width, height = sorted(photos.sizes, key=lambda size: min(size) * min(1.0, max_side / max(size)))[
        len(photos.sizes) // 2
    ]
    least = math.ceil(WINDOW * max(width, height) / min(width, height))
    if min(width, height) < WINDOW:
        raise InputError(f"{photos.what} of {width}×{height} pixels; a map needs at least {WINDOW} a side")
    if max_side < least:
        found = f"of {width}×{height} pixels would have a side of less than {WINDOW}; give --max-side {least} or more"
        raise InputError(f"{photos.what} {found}")


def check_memory(photos: PhotoSizes, config: MapConfig, limit: int | None = None) -> int:
    """The bytes that the run needs; InputError that suggests smaller settings if they are more than `limit`.

    limit None: the memory available to this process; nothing is checked if that is unknown.
    """
    limit = memory_limit() if limit is None else limit
    count, block = len(photos.sizes), config.train.block_photos  # a block at a time, in a large scene
    budget = sized(config, min(count, block) if block else count, largest_budget(limit)).train.budget
    side = config.photos.max_side
    memory = image_memory(config, limit)
    needed = needed_bytes(photos, side, budget, memory)
    if limit is None or needed <= limit:
        return needed
    smaller = [(max(64, int(side * share)), max(1000, int(budget * share))) for share in (0.75, 0.5, 0.35, 0.2, 0.1)]
    fitting = next((pair for pair in smaller if needed_bytes(photos, *pair, memory) <= limit), None)
    advice = "give fewer or smaller photos, or use a machine with more memory"
    if fitting is not None:
        advice = f"give --max-side {fitting[0]} --budget {fitting[1]}"
    found = f"need about {needed / 2**30:.1f} GiB with --max-side {side} --budget {budget}"
    raise InputError(f"{photos.what} {found}, and there are {limit / 2**30:.1f}; {advice}")
