"""Input images for calibration, from a folder of photos or a video; and images that show the detections."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from perception.calibration.board import Detection
from perception.calibration.solve import Solution
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


def draw_detection(picture: np.ndarray, view: Detection, residuals: np.ndarray, magnify: float = 50) -> np.ndarray:
    """An image [H, W, 3] BGR with the detected corners (green) and their residuals, `magnify` times enlarged (red)."""
    out = cv2.cvtColor(picture, cv2.COLOR_GRAY2BGR)
    size = max(picture.shape[1] // 320, 2)
    for (x, y), (dx, dy) in zip(view.pixels.tolist(), residuals.tolist(), strict=True):
        start, end = (round(x), round(y)), (round(x + magnify * dx), round(y + magnify * dy))
        cv2.circle(out, start, size, (60, 200, 60), 1, cv2.LINE_AA)
        cv2.line(out, start, end, (50, 50, 255), 1, cv2.LINE_AA)
    return np.asarray(out)


def draw_coverage(solution: Solution, magnify: float = 100) -> np.ndarray:
    """Corners of all views on white [H, W, 3] BGR, residuals `magnify` times enlarged. Shows uncovered image areas."""
    width, height = solution.size
    out = np.full((height, width, 3), 255, np.uint8)
    for view, residuals in zip(solution.views, solution.residuals, strict=True):
        for (x, y), (dx, dy) in zip(view.pixels.tolist(), residuals.tolist(), strict=True):
            cv2.circle(out, (round(x), round(y)), 2, (200, 140, 60), -1, cv2.LINE_AA)
            cv2.line(out, (round(x), round(y)), (round(x + magnify * dx), round(y + magnify * dy)), (40, 40, 220), 1)
    return out
