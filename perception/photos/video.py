"""Keyframe selection for a bag, recording or video: the sharpest frame of each segment in which the view moves by
`spacing`; video input, whose chosen frames are written as photos.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

from perception.errors import InputError
from perception.io.atomic import atomic_directory
from perception.io.documents import read_json, refusing
from perception.photos.decode import check_size
from perception.progress import Progress

THUMBNAIL = 320  # long side in pixels at which motion and sharpness are measured
_MIN_TRACKS, SHARP_SHARE = 20, 0.3
_UNREADABLE = "not a readable video; expected .mp4, .mov or another that OpenCV's FFmpeg decodes"


@dataclass
class Chooser:
    """Selects keyframes: pass all frames in order to `show`, then call `chosen`.
    spacing: motion between kept frames as a share of the image width (median motion of tracked corners, summed over
    frames). A segment is left out if its sharpest frame is below SHARP_SHARE of the median sharpness."""

    spacing: float = 0.08
    motion: list[float] = field(default_factory=list)
    sharpness: list[float] = field(default_factory=list)
    _last: np.ndarray | None = None

    def show(self, picture: np.ndarray, motion: float | None = None) -> None:
        """Adds the next frame [H, W, 3] uint8 BGR. motion: since the frame before; None measures it."""
        scale = THUMBNAIL / max(picture.shape[:2])
        small = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA) if scale < 1 else picture
        grey = np.asarray(cv2.cvtColor(small, cv2.COLOR_BGR2GRAY))
        self.sharpness.append(float(cv2.Laplacian(grey, cv2.CV_64F).var()))
        if motion is None:
            motion = 0.0 if self._last is None else motion_between(self._last, grey)
        self.motion.append(motion)
        self._last = grey

    def chosen(self, most: int) -> list[int]:
        """Numbers of the frames to keep, at most `most`, in order."""
        if not self.motion:
            return []
        way = np.cumsum(np.minimum(self.motion, self.spacing))  # a jump counts as one step
        spacing = max(self.spacing, float(way[-1]) / max(most - 1, 1))
        stretch = np.floor(way / spacing + 1e-9).astype(int)
        sharpness = np.array(self.sharpness)
        least = SHARP_SHARE * float(np.median(sharpness))
        order = np.lexsort((-sharpness, stretch))  # the sharpest first in each stretch
        best = order[np.unique(stretch[order], return_index=True)[1]]
        return [int(number) for number in best[sharpness[best] >= least][:most]]


def motion_between(before: np.ndarray, after: np.ndarray) -> float:
    """Median motion of tracked corners as a share of the image width; 1 if tracking fails."""
    if before.shape != after.shape:
        return 1.0
    corners = cv2.goodFeaturesToTrack(before, 200, 0.01, 6)
    if corners is None or len(corners) < _MIN_TRACKS:  # too little texture; equal brightness counts as no motion
        return float(abs(float(before.mean()) - float(after.mean())) >= 8)
    there, found, _ = cv2.calcOpticalFlowPyrLK(before, after, corners, None)  # type: ignore[call-overload]
    good = found.ravel() == 1
    moved = np.linalg.norm((there - corners).reshape(-1, 2)[good], axis=1)
    return float(np.median(moved)) / before.shape[1] if len(moved) >= _MIN_TRACKS else 1.0


FRAMES_RECORD = "frames.json"
"""Name of the record file in a folder of frames taken from a video."""
MOST_FRAMES = 200
LOOKS_PER_SECOND = 15.0
"""Frames per second that are examined; at 30 per second neighbouring frames hardly differ."""
JPEG_QUALITY = 95


def video_frames(video: Path, folder: Path, progress: Progress) -> dict[str, object]:
    """Writes the chosen frames of `video` to the new `folder` as JPEG, upright, named by frame number.

    Frames are chosen as `perception frames` does, at most MOST_FRAMES. The rotation stored in the file is applied. A
    folder that holds the frames of the same file is reused. Returns its record: video, bytes, mtime_ns, frames, chosen.
    InputError for an unreadable video, or if `folder` holds anything else.
    """
    stat = video.stat()
    record: dict[str, object] = {"video": video.name, "bytes": stat.st_size, "mtime_ns": stat.st_mtime_ns}
    if folder.exists():
        listed = folder / FRAMES_RECORD
        known = read_json(listed) if listed.is_file() else None
        if isinstance(known, dict) and {key: known.get(key) for key in record} == record:
            return known
        raise InputError(f"{folder}: exists already, and holds no frames of {video}; remove or rename it")
    chooser, numbers = Chooser(), []
    for number, share, frame in frames(video):
        chooser.show(frame)
        numbers.append(number)
        progress.update("poses: choosing frames", round(100 * share), 100)
    chosen = [numbers[index] for index in chooser.chosen(MOST_FRAMES)]
    if not chosen:
        raise InputError(f"{video}: {_UNREADABLE}")
    record |= {"frames": numbers[-1] + 1, "chosen": len(chosen)}
    with atomic_directory(folder, fresh=True) as aside:
        for number, share, frame in frames(video, set(chosen)):
            data = cv2.imencode(".jpg", frame, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1].tobytes()
            (aside / f"{number:06d}.jpg").write_bytes(data)
            progress.update("poses: writing frames", round(100 * share), 100)
        (aside / FRAMES_RECORD).write_text(json.dumps(record), encoding="utf-8")
    return record


def frames(
    video: Path, wanted: set[int] | None = None, most: int | None = None
) -> Iterator[tuple[int, float, np.ndarray]]:
    """(number, share of the way, BGR [h, w, 3] uint8) of the `wanted` frames, upright.
    Without `wanted`, every n-th frame: LOOKS_PER_SECOND, or about `most` in all. None where the video is unreadable."""
    if os.fsencode(video) != str(video).encode(errors="replace"):  # OpenCV would crash
        raise InputError(f"{video}: the path holds bytes that are no UTF-8; rename the video")
    capture = _capture(video)
    try:
        with refusing(f"{video}: {_UNREADABLE}"):
            width, height = (int(capture.get(key)) for key in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
            check_size(video, (width, height), None, 0)
            capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 1)
            rate, total = capture.get(cv2.CAP_PROP_FPS), capture.get(cv2.CAP_PROP_FRAME_COUNT)
            if wanted is not None:
                total = max(wanted) + 1
            elif not total >= 1:  # browsers record without stating it
                total = _counted(video)
            step = max(1, round(rate / LOOKS_PER_SECOND)) if np.isfinite(rate) else 1
            step = step if most is None else max(1, int(total) // most)
            number = 0
            while (wanted is None or number < total) and capture.grab():
                if number in wanted if wanted is not None else number % step == 0:
                    good, frame = capture.retrieve()
                    if good:
                        yield number, min(1.0, (number + 1) / total), frame
                number += 1
    finally:
        capture.release()


def _capture(video: Path) -> cv2.VideoCapture:
    return cv2.VideoCapture(str(video.absolute()))  # FFmpeg takes "12:30.mp4" for an address of a protocol "12"


def _counted(video: Path) -> int:
    """The number of frames, by decoding all."""
    capture = _capture(video)
    try:
        return sum(1 for _ in iter(capture.grab, False))
    finally:
        capture.release()


def frame_size(video: Path) -> tuple[int, int]:
    """(width, height) of the video's frames, upright. InputError where there are none."""
    for _, _, frame in frames(video, {0}):
        return frame.shape[1], frame.shape[0]
    raise InputError(f"{video}: {_UNREADABLE}")
