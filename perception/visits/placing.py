"""Given poses of a visit, checked against the map: where they are off by centimetres, things seem to have changed.

The map's render is compared with each photo at its given pose by the motion of corners between both. Where that is too
large in the median, the photos are localised in the map, and these poses are used if they fit better.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
import torch

from perception.changes.look import compared
from perception.gaussians.model import as_gaussians
from perception.gaussians.views import TrainingView, rgb_image
from perception.geometry import camera_centres
from perception.localise.localiser import Localised, Localiser, NewPhoto
from perception.map.map import Map
from perception.photos.video import motion_between
from perception.photos.views import view_lens
from perception.pipeline.optimise import Photos, Run
from perception.types import View

OFF = 0.0025
"""Median motion of corners between photo and render, as a share of the width, above which poses are wrong: of true
poses of made visits up to .0017; of a real kitchen, whose poses drift by 3 cm, .0124, and .001 once localised."""
COMPARED = 12
"""Photos that are compared with the map."""
LEAST_PLACED = 0.5
"""Share of the photos that must be found in the map for their poses there to be used."""


def checked_poses(run: Run, gmap: Map, photos: Photos) -> Photos:
    """The photos with the poses that fit the map; as they are with `photos.poses` = "keep"."""
    if run.config.photos.poses == "keep":
        return photos
    before = misplaced(gmap, photos.views)
    if before <= OFF and run.config.photos.poses == "auto":
        return photos
    given = sorted([*photos.training, *photos.held_out], key=lambda view: view.name)
    placed = placed_in_map(gmap, given, run)
    if placed is None:
        return photos
    moved = with_poses(photos, placed)
    after = misplaced(gmap, moved.views)
    if after >= before:
        return photos
    poses = [placed[view.name] for view in given], [view.camera_from_world for view in given]
    shifts = np.linalg.norm(np.subtract(*(camera_centres(np.stack(each)) for each in poses)), axis=1)
    unit, width = "m" if gmap.metric else "units", photos.training[0].width
    off = f"off by {np.median(shifts):.2g} {unit}, so that its render is {before * width:.1f} pixels off the photos"
    run.progress.log(f"the given poses do not fit the map ({off}): localised in it, {after * width:.1f} pixels")
    return moved


def misplaced(gmap: Map, views: Sequence[TrainingView]) -> float:
    """Median motion of corners between photos and renders, as a share of the width; 0 without photos."""
    model, moved = as_gaussians(gmap), []
    for view in map(compared, views[:: -(-len(views) // COMPARED)]):
        height, width = view.photo.shape[:2]
        render = rgb_image(model, view.camera_from_world, view.K, width, height)
        photo, shown = (cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in (view.photo.numpy(), render))
        brightness = (shown.astype(np.float32) - shown.mean()) / max(float(shown.std()), 1.0)
        shown = np.clip(brightness * photo.std() + photo.mean(), 0, 255).astype(np.uint8)
        moved.append(motion_between(photo, shown))
    return float(np.median(moved)) if moved else 0.0


def placed_in_map(gmap: Map, views: Sequence[View], run: Run) -> dict[str, np.ndarray] | None:
    """The pose of each of the views, which are in order of time, by name: as localised, else corrected as that of the
    nearest view that was. None where few were."""
    photos = [NewPhoto(v.name, v.photo, view_lens(v), v.depth, v.mask, v.as_stored) for v in views]
    answers = Localiser(gmap, progress=run.progress).answers(photos)
    poses = [answer.camera_from_map if isinstance(answer, Localised) else None for answer in answers]
    known = [n for n, pose in enumerate(poses) if pose is not None]
    if len(known) < LEAST_PLACED * len(views):
        return None
    placed = {}
    for n, view in enumerate(views):
        near = min(known, key=lambda other: abs(other - n))
        correction = np.linalg.inv(views[near].camera_from_world) @ poses[near]
        placed[view.name] = view.camera_from_world @ correction
    return placed


def with_poses(photos: Photos, placed: dict[str, np.ndarray]) -> Photos:
    """The photos with the poses `placed` by name."""
    training, held_out = (
        [replace(view, camera_from_world=placed[view.name]) for view in part]
        for part in (photos.training, photos.held_out)
    )
    tensors = {name: torch.from_numpy(pose.astype(np.float32)) for name, pose in placed.items()}
    views, held = (
        [replace(view, camera_from_world=tensors[view.name]) for view in part] for part in (photos.views, photos.held)
    )
    return Photos(training, held_out, views, held)
