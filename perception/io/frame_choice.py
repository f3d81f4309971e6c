"""The frames of a bag or video to keep: the sharpest of every stretch over which the view moves by `spacing`."""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np

THUMBNAIL = 320  # pixels, long side: motion and sharpness are measured at one size
_MIN_TRACKS = 20


@dataclass
class Chooser:
    """Frames are shown in order; `chosen` are the numbers to keep.

    spacing: motion between kept frames, as share of the picture's width (median motion of tracked corners, summed over
    frames). sharp_share: a stretch whose sharpest frame has less than this share of the median sharpness is left out.
    """

    spacing: float = 0.08
    sharp_share: float = 0.3
    motion: list[float] = field(default_factory=list)
    sharpness: list[float] = field(default_factory=list)
    _last: np.ndarray | None = None

    def show(self, picture: np.ndarray) -> None:
        """The next frame [H, W, 3] uint8 BGR."""
        scale = THUMBNAIL / max(picture.shape[:2])
        small = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA) if scale < 1 else picture
        grey = np.asarray(cv2.cvtColor(small, cv2.COLOR_BGR2GRAY))
        self.sharpness.append(float(cv2.Laplacian(grey, cv2.CV_64F).var()))
        self.motion.append(0.0 if self._last is None else motion_between(self._last, grey))
        self._last = grey

    def chosen(self, most: int) -> list[int]:
        """Numbers of the frames to keep, at most `most`, in order."""
        if not self.motion:
            return []
        way = np.cumsum(np.minimum(self.motion, self.spacing))  # a jump is one step, not many
        spacing = max(self.spacing, float(way[-1]) / max(most - 1, 1))
        stretch = np.floor(way / spacing + 1e-9).astype(int)
        sharpness = np.array(self.sharpness)
        least = self.sharp_share * float(np.median(sharpness))
        kept = []
        for number in np.unique(stretch):
            rows = np.flatnonzero(stretch == number)
            best = int(rows[sharpness[rows].argmax()])
            if sharpness[best] >= least:
                kept.append(best)
        return kept[:most]


def motion_between(before: np.ndarray, after: np.ndarray) -> float:
    """Median motion of tracked corners as share of the width; 1 where the tracks are lost."""
    corners = cv2.goodFeaturesToTrack(before, 200, 0.01, 6)
    if corners is None or len(corners) < _MIN_TRACKS or before.shape != after.shape:
        same = before.shape == after.shape and abs(float(before.mean()) - float(after.mean())) < 8
        return 0.0 if same else 1.0  # too little texture to track; equal brightness counts as no motion
    there, found, _ = cv2.calcOpticalFlowPyrLK(before, after, corners, None)  # type: ignore[call-overload]
    good = found.ravel() == 1
    if good.sum() < _MIN_TRACKS:
        return 1.0
    return float(np.median(np.linalg.norm((there - corners).reshape(-1, 2)[good], axis=1))) / before.shape[1]
