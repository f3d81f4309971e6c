"""The options that all readers of inputs share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np

from perception.progress import QUIET, Progress
from perception.tasks.engine import Engine
from perception.types import Lens

Cloud = tuple[np.ndarray, np.ndarray]
"""points [P, 3] float64 in the input's frame, colors [P, 3] uint8."""
NO_CLOUD: Cloud = (np.empty((0, 3)), np.empty((0, 3), np.uint8))


@dataclass(frozen=True)
class ReadOptions:
    """workdir: caches features and models for later calls. strict: a damaged photo is an InputError, else left out.

    masks: folder of masks of pixels to ignore (see `ignore_masks`), which precede those that the input names. camera:
    ROS camera_info with the intrinsics of all photos, for photos, videos and recordings. frames: folder for the frames
    of a video (None: workdir/frames), which the map needs later. init_points: cloud in the frame of the input's poses,
    used instead of sparse points. poses: "keep", "refine", or "auto": checked where features are matched anyway or
    views have depth, and refined where they are wrong (see posed.pose_refinement). engine: where features are made.
    still: what stays in the picture while the camera moves is ignored (see `photos.still`).
    lens, cloud: what `load_scene` reads from `camera` and `init_points`, if these are given.
    """

    workdir: Path
    seed: int = 0
    progress: Progress = QUIET
    strict: bool = False
    masks: Path | None = None
    camera: Path | None = None
    frames: Path | None = None
    init_points: Path | None = None
    poses: Literal["auto", "keep", "refine"] = "auto"
    engine: Engine = field(default_factory=Engine)
    lens: Lens | None = None
    cloud: Cloud | None = None
    still: bool = True

    def still_folder(self, masks: Sequence[Path | None]) -> Path | None:
        """Folder for masks of what stays in the picture; None where it is used. masks: of all photos; a folder `masks`
        without any of them is refused later."""
        return self.workdir / "still" if self.still and (self.masks is None or any(masks)) else None
