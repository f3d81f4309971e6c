"""Keyframe selection for a bag or video: the sharpest frame of each segment in which the view moves by `spacing`."""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np

THUMBNAIL = 320  # long side in pixels at which motion and sharpness are measured
_MIN_TRACKS = 20


@dataclass
class Chooser:
    """Selects keyframes: pass all frames in order to `show`, then call `chosen`.

    spacing: motion between kept frames as a share of the image width (median motion of tracked corners, summed over
    frames). sharp_share: a segment is left out if its sharpest frame is below this share of the median sharpness.
    """

    spacing: float = 0.08
    sharp_share: float = 0.3
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
        least = self.sharp_share * float(np.median(sharpness))
        kept = []
        for number in np.unique(stretch):
            rows = np.flatnonzero(stretch == number)
            best = int(rows[sharpness[rows].argmax()])
            if sharpness[best] >= least:
                kept.append(best)
        return kept[:most]


def motion_between(before: np.ndarray, after: np.ndarray) -> float:
    """Median motion of tracked corners as a share of the image width; 1 if tracking fails."""
    corners = cv2.goodFeaturesToTrack(before, 200, 0.01, 6)
    if corners is None or len(corners) < _MIN_TRACKS or before.shape != after.shape:
        same = before.shape == after.shape and abs(float(before.mean()) - float(after.mean())) < 8
        return 0.0 if same else 1.0  # too little texture to track; equal brightness counts as no motion
    there, found, _ = cv2.calcOpticalFlowPyrLK(before, after, corners, None)  # type: ignore[call-overload]
    good = found.ravel() == 1
    if good.sum() < _MIN_TRACKS:
        return 1.0
    return float(np.median(np.linalg.norm((there - corners).reshape(-1, 2)[good], axis=1))) / before.shape[1]
