"""`perception update`: a map of today from a map and a new visit."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from perception.config import MapConfig, settings_from
from perception.errors import InputError
from perception.frame.recentre import map_from_input, moved
from perception.gaussians.device import choose_device
from perception.gaussians.model import Gaussians, Nearby
from perception.gaussians.photos import split_scene
from perception.inputs.load import load_scene
from perception.instances.votes import mask_votes
from perception.map.map import GAUSSIANS
from perception.map.write import Map, read_map
from perception.masks.sources import make_source
from perception.pipeline.optimise import Photos, Run, label_photos
from perception.progress import QUIET, Progress
from perception.sfm.options import ReadOptions
from perception.types import Scene
from perception.visits.evidence import Signs, seen_rows, signs_of
from perception.visits.growth import SHARE, grouped, joined_instances, new_surface, trained, update_config
from perception.visits.look import compared, depth_at, in_light, look, stereo_of, with_exposure

TENSORS = ("means", "quats", "log_scales", "opacity_logits", "sh", "features")


def gaussians_of(gmap: Map) -> Gaussians:
    return Gaussians(**{name: torch.from_numpy(np.ascontiguousarray(getattr(gmap, name))) for name in TENSORS})


@dataclass
class Visit:
    """The photos of a visit against the map. gaussians: of the map, in the light of the visit; photos: exposed and
    labelled, of the visit; looks: of its training photos."""

    run: Run
    gmap: Map
    gaussians: Gaussians
    photos: Photos
    stereo: list[Any]
    light: np.ndarray
    masks: dict[str, Any] = field(default_factory=dict)

    def looks(self, gaussians: Gaussians, ids: np.ndarray) -> list[Any]:
        found = []
        for view, stereo in zip(self.photos.views, self.stereo, strict=True):
            small = compared(view)
            found.append(look(gaussians, ids, small, depth_at(stereo, small.photo.shape)))
        return found


def visit_scene(run: Run, gmap: Map) -> Scene:
    assert gmap.path is not None
    options = ReadOptions(run.work / "sfm", run.config.seed, run.progress)
    scene = load_scene(run.source, options)
    b_from_a = map_from_input(gmap.path, gmap.info)
    return replace(scene, views=[moved(view, b_from_a) for view in scene.views])


def open_visit(run: Run, gmap: Map, scene: Scene, source: Any) -> Visit:
    scene, training, held_out = split_scene(scene, run.config.photos)
    photos = Photos.load(run, training, held_out)
    old = gaussians_of(gmap)
    views, light = with_exposure(old, photos.views)
    photos = replace(photos, views=views)
    with run.stage("stereo"):
        stereo = stereo_of(old, training, photos.views, run.progress)
    by_name = {view.name: s for view, s in zip(training, stereo, strict=True)}
    photos, masks = label_photos(
        run, photos, source, lambda view: depth_at(by_name[view.name], view.photo.shape, confirmed=False)
    )
    return Visit(run, gmap, in_light(old, light), photos, stereo, light, masks)
