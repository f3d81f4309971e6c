"""How an input with poses is read: what `load_scene` passes on to the readers of every format."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from perception.io.start_points import Cloud
from perception.progress import Progress


def _quiet() -> Progress:
    return Progress(quiet=True)


@dataclass(frozen=True)
class Reading:
    """workdir: caches features and models. strict: a damaged photo is an InputError, else it is left out and reported.

    masks: folder of masks of pixels to ignore, which precede those that the input names. cloud: points and colours used
    instead of the input's. poses: "keep", "refine", or "auto": checked where features are matched anyway or views have
    depth, and refined where they are wrong (see io.pose_refinement).
    """

    workdir: Path
    seed: int = 0
    progress: Progress = field(default_factory=_quiet)
    strict: bool = False
    masks: Path | None = None
    cloud: Cloud | None = None
    poses: Literal["auto", "keep", "refine"] = "auto"
