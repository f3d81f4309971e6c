"""Small videos written for tests, and the rotation entry of MP4 and MOV files."""

from __future__ import annotations

import struct
from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np


def write_video(path: Path, frames: Iterable[np.ndarray], rate: float = 30.0) -> Path:
    """An MPEG-4 video of RGB frames [h, w, 3] uint8."""
    writer = None
    for frame in frames:
        if writer is None:
            fourcc = cv2.VideoWriter_fourcc(*"mp4v")  # type: ignore[attr-defined]
            writer = cv2.VideoWriter(str(path), fourcc, rate, (frame.shape[1], frame.shape[0]))
        writer.write(np.ascontiguousarray(frame[..., ::-1]))
    assert writer is not None
    writer.release()
    return path


def turn_video(path: Path, stored_height: int) -> None:
    """Says in the track header that players turn the video by 90° clockwise, as phones held upright do.

    The matrix of the 'tkhd' box (ISO/IEC 14496-12, 8.3.2), version 0: 40 bytes after the box's type.
    """
    data = bytearray(path.read_bytes())
    start = data.index(b"tkhd") + 44
    data[start : start + 36] = struct.pack(">9i", 0, 1 << 16, 0, -1 << 16, 0, 0, stored_height << 16, 0, 1 << 30)
    path.write_bytes(data)
