"""The stages of `map` for a finished splat: its Gaussians are taken as they are, and only their features trained."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from perception.config import MapConfig
from perception.errors import InputError
from perception.gaussians.model import Gaussians, HeldGaussians, Nearby
from perception.gaussians.views import surface_depth
from perception.inputs.readers import is_splat
from perception.machine import require_memory, return_free_memory
from perception.masks import MaskSource
from perception.pipeline.checkpoint import FeatureCheckpoints, frames_folder
from perception.pipeline.estimate import image_memory
from perception.pipeline.optimise import Optimised, Photos, Run, label_photos
from perception.sfm.options import ReadOptions
from perception.splats.features import new_features, train_features
from perception.splats.gravity import direction
from perception.splats.read import Splat, read_splat
from perception.splats.scene import drawn, splat_scene
from perception.splats.surface import floaters
from perception.types import Scene, View

BASE_BYTES, BYTES_PER_GAUSSIAN = 3 << 29, 900
"""Of a run: program, views and votes; all tables of a Gaussian with harmonics of degree 3."""
LESS = "crop the scene, or use a machine with more memory"
REFUSED = {
    "frame.known_length": "--known-length",
    "frame.tag_size": "--tag-size",
    "frame.board": "--board",
    "photos.camera": "--camera",
    "photos.ignore_masks": "--ignore-masks",
    "photos.init_points": "--init-points",
    "photos.held_out": "photos.held_out",
    "train.time_limit": "--time-limit",
}
"""Settings that a splat has no use for."""


@dataclass(frozen=True)
class SplatInput:
    """A splat as the input of a run. gaussians: as they are drawn, on the CPU; hidden [N] bool: rows that are not."""

    splat: Splat
    hidden: np.ndarray
    gaussians: Gaussians

    def scene(self, run: Run, output: Path) -> Scene:
        """The posed scene (see `splats.scene`); its renders lie beside the map."""
        options = ReadOptions(run.work / "sfm", run.config.seed, run.progress, run.config.photos.strict)
        drawn = self.splat, self._on(run.device), self.hidden
        return splat_scene(*drawn, frames_folder(output), run.config, options)

    def optimise(self, run: Run, training: list[View], held_out: list[View], source: MaskSource) -> Optimised:
        """Masks of the views, and features trained on them."""
        photos, gaussians = Photos.load(run, training, held_out), self._on(run.device)
        photos, report = label_photos(run, photos, source, partial(surface_depth, gaussians))
        return_free_memory()
        with run.stage("train"):
            kept = FeatureCheckpoints(run.work, run.mark, source.identity)
            record = train_features(gaussians, photos.views, run.config, run.progress, kept)
        return_free_memory()
        return Optimised(Nearby(gaussians), photos, record, report)

    def _on(self, device: torch.device) -> Gaussians:
        return HeldGaussians(**self.gaussians.to(device).named())


def open_splat(source: Path, config: MapConfig) -> SplatInput | None:
    """The splat that `source` is, None for another input. InputError for settings that do not go with the input, and
    for more Gaussians than `photos.memory`, or the memory of the machine, is enough for."""
    given = config.splat
    if not is_splat(source):
        for name in ("cameras", "up", "unit"):
            if getattr(given, name) is not None:
                raise InputError(f"--{name}: goes with a finished splat (.ply or .spz), and {source} is none")
        return None
    for key, option in REFUSED.items():
        group, name = key.split(".")
        if getattr(getattr(config, group), name) is not None:
            todo = "give the scale with --unit metre, or to the map with `perception scale`" if group == "frame" else ""
            raise InputError(f"{option}: does not go with a finished splat; {todo or 'leave it out'}")
    if given.up is not None:
        direction(given.up)
    splat = read_splat(source, partial(_check_memory, source, config))
    hidden = floaters(splat)
    return SplatInput(splat, hidden, drawn(splat, hidden, new_features(len(splat), config)))


def _check_memory(source: Path, config: MapConfig, count: int) -> None:
    needed, what, given = BASE_BYTES + count * BYTES_PER_GAUSSIAN, f"{source}: {count} Gaussians", config.photos.memory
    if needed > image_memory(config, None):
        raise InputError(f"{what}: need about {needed / 2**30:.1f} GiB, --memory is {given}; give more, or {LESS}")
    require_memory(needed, what, LESS)


def unchanged(splat: SplatInput | None, arrays: dict[str, Any]) -> dict[str, Any]:
    """The arrays of a map: those of the splat as they were read; of another input with rotations of length 1."""
    if splat is not None:
        return {**arrays, **splat.splat.arrays()}
    length = np.linalg.norm(arrays["quats"], axis=1, keepdims=True)
    return {**arrays, "quats": arrays["quats"] / np.maximum(length, 1e-12)}
