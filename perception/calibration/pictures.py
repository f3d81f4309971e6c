"""Input images for calibration, from a folder of photos or a video."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from perception.errors import InputError
from perception.io.photos import SUFFIXES
from perception.io.video import frames

MAX_FRAMES = 240
"""Maximum number of video frames that are read, evenly spaced."""


def read_pictures(source: Path) -> Iterator[tuple[str, np.ndarray]]:
    """(name, grey image [H, W] uint8) of a folder's photos in order of name, or of a video's frames."""
    if source.is_dir():
        files = sorted(path for path in source.iterdir() if path.suffix.lower() in SUFFIXES)
        if not files:
            raise InputError(f"{source}: holds no photos; expected pictures of a calibration board")
        for file in files:
            picture = cv2.imdecode(np.frombuffer(file.read_bytes() or b"\0", np.uint8), cv2.IMREAD_GRAYSCALE)
            if picture is None:
                raise InputError(f"{file}: is not a readable picture")
            yield file.name, np.asarray(picture)
    elif source.is_file():
        yield from _video(source)
    else:
        raise InputError(f"{source}: no such file or folder; give photos of a calibration board, or a video of it")


def _video(source: Path) -> Iterator[tuple[str, np.ndarray]]:
    number = None
    for number, _, frame in frames(source, most=MAX_FRAMES):
        yield f"frame_{number:06d}", cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY)
    if number is None:
        raise InputError(f"{source}: is not a readable video (nor a folder of photos)")
