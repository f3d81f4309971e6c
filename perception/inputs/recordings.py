"""RGB-D recordings: thousands of posed frames with depth, of which sharp, well-spaced ones become a Scene in metres."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from perception.errors import InputError
from perception.geometry import inverse_se3
from perception.io.documents import safe_name
from perception.photos.decode import read_picture
from perception.photos.depth import read_depth
from perception.photos.ignore_masks import mask_of
from perception.photos.video import MOST_FRAMES, Chooser
from perception.photos.views import first_of, leaving_out, posed_view, rigid_pose, without_far
from perception.posed.triangulate import posed_scene
from perception.progress import Progress
from perception.sfm.options import NO_CLOUD, ReadOptions
from perception.types import DepthImage, Lens, Scene, View

LOOKED_AT = 10
"""Depth images from which the median depth of a recording is estimated."""
NEAREST, FARTHEST = 0.1, 50.0
"""Range in metres of a plausible median depth; outside of it the unit must be another."""


@dataclass(frozen=True)
class Frame:
    """One photo of a recording with its pose world_from_camera [4, 4] in metres; depth None where none was taken."""

    name: str
    photo: Path
    depth: Path | None
    world_from_camera: np.ndarray


@dataclass(frozen=True)
class Recording:
    """kind: for messages. frames: in order of time. lens: of all photos, None when the folder has no intrinsics, an
    error when they cannot be used.
    metre: stored units of depth per metre. depth_lens: of the depth camera, at the photo's pose; None when depth shows
    what the photo shows. notes, warnings: one line each."""

    source: Path
    kind: str
    frames: list[Frame]
    lens: Lens | InputError | None
    metre: float = 1000.0
    depth_lens: Lens | None = None
    notes: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)


def recorded_scene(recording: Recording, options: ReadOptions) -> Scene:
    """The chosen frames of a recording as a Scene in its own world, whose unit is the metre.
    Frames with a pose that is not rigid or far from all others, and with a photo that is damaged or does not fit the
    lens, are left out. InputError for a missing lens, and for depth whose unit cannot be right."""
    source, kind, lens = recording.source, recording.kind, options.lens or recording.lens
    if not recording.frames:
        raise InputError(f"{source}: a recording as of {kind}, but no frame has both photo and pose")
    if isinstance(lens, InputError):
        raise lens
    if lens is None:
        raise InputError(f"{source}: a recording as of {kind} without the intrinsics of its photos; give --camera FILE")
    recording, wrong = _with_poses(recording, options.strict)
    chosen, damaged = choose_frames(recording, lens, options.progress, options.strict)
    views, unfit = list[View](), list[dict[str, str]]()
    for frame in chosen:
        with leaving_out(unfit, frame.name, options.strict):
            views.append(_view(recording, frame, lens, options.masks))
    if not views:
        raise InputError(f"{source}: none of the {len(chosen)} chosen photos can be used{first_of(unfit)}")
    cloud = options.cloud or NO_CLOUD
    views, far = without_far(views, cloud[0], set(), options.strict, source)
    taken = f"{len(chosen)} of {len(recording.frames)} frames chosen, sharp and well spaced"
    facts: dict[str, Any] = {
        "input": kind,
        "left_out": [*wrong, *damaged, *unfit, *far],
        "notes": [f"{source}: {kind}, {taken}", *recording.notes],
        "warnings": recording.warnings,
        "mean_reprojection_error_px": None,
        "scale": {"source": f"poses and depth of {kind}, in metres by definition"},
    }
    views.sort(key=lambda view: view.name)
    return replace(posed_scene(views, cloud, facts, options, least=1), metric=True)


def _with_poses(recording: Recording, strict: bool) -> tuple[Recording, list[dict[str, str]]]:
    """The recording without the frames whose pose is not rigid, and these as left out; InputError if none is left."""
    good, wrong = list[Frame](), list[dict[str, str]]()
    for frame in recording.frames:
        with leaving_out(wrong, frame.name, strict):
            rigid_pose(frame.world_from_camera, f"{recording.source}: the pose of {frame.name}")
            good.append(frame)
    if not good:
        raise InputError(f"{recording.source}: none of the {len(wrong)} photos has a usable pose{first_of(wrong)}")
    return replace(recording, frames=good), wrong


def choose_frames(
    recording: Recording, lens: Lens, progress: Progress, strict: bool
) -> tuple[list[Frame], list[dict[str, str]]]:
    """At most MOST_FRAMES frames: the sharpest of each stretch of motion (see `Chooser`); those that are unreadable.
    The motion between frames, as a share of the width, is that of their poses: f / width (angle + distance / depth)."""
    share, depth = lens.params[0] / lens.width, median_depth(recording)
    chooser, shown, damaged = Chooser(), list[Frame](), list[dict[str, str]]()
    for done, frame in enumerate(recording.frames, start=1):
        picture, what = None, "photo; replace or remove it"
        with leaving_out(damaged, frame.name, strict):
            picture = read_picture(frame.photo, frame.photo, what, cv2.IMREAD_REDUCED_COLOR_2)
        if picture is None:
            continue
        motion = 0.0
        if shown:
            step = inverse_se3(shown[-1].world_from_camera) @ frame.world_from_camera
            angle = np.arccos(np.clip((np.trace(step[:3, :3]) - 1) / 2, -1, 1))
            motion = float(share * (angle + np.linalg.norm(step[:3, 3]) / depth))
        chooser.show(picture, motion)
        shown.append(frame)
        progress.update("poses: choosing frames", done, len(recording.frames))
    if not shown:
        raise InputError(f"{recording.source}: none of the {len(recording.frames)} photos can be read")
    return [shown[index] for index in chooser.chosen(MOST_FRAMES)], damaged


def median_depth(recording: Recording) -> float:
    """Median in metres over some depth images of the recording that can be read. InputError when none can, and when
    nothing or nonsense was measured."""
    paths = [frame.depth for frame in recording.frames if frame.depth is not None]
    if not paths:
        raise InputError(f"{recording.source}: a recording as of {recording.kind}, but no photo has a depth image")
    some = [paths[i] for i in np.unique(np.linspace(0, len(paths) - 1, LOOKED_AT).round().astype(int))]
    found, damaged = list[float](), list[InputError]()
    for path in some:
        try:
            depth = read_depth(path)
        except InputError as error:
            damaged.append(error)
            continue
        if (depth > 0).any():
            found.append(float(np.median(depth[depth > 0])) / recording.metre)
    if len(damaged) == len(some):
        raise damaged[0]
    if not found:
        raise InputError(f"{some[0]}: this and {len(some) - 1} other depth images hold nothing measured")
    typical = float(np.median(found))
    if not NEAREST <= typical <= FARTHEST:
        raise InputError(
            f"{some[0]}: the median depth is {typical:.3g} m if {recording.metre:g} stored units are a metre, as for "
            f"{recording.kind}; expected {NEAREST:g} to {FARTHEST:g} m"
        )
    return typical


def _view(recording: Recording, frame: Frame, lens: Lens, masks: Path | None) -> View:
    name = safe_name(frame.name, recording.source)
    view, _ = posed_view(name, frame.photo, lens, inverse_se3(frame.world_from_camera), recording.source)
    depth = None if frame.depth is None else DepthImage(frame.depth, 1 / recording.metre, recording.depth_lens)
    return replace(view, depth=depth, mask=mask_of(masks, name))
