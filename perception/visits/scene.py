"""The photos of a visit in the frame of the map: with the poses that they bring, or localised."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from perception.changes.look import Look, correlation
from perception.config import MapConfig, fields, flat, load_config, read_pairs, read_toml
from perception.errors import InputError
from perception.frame.recentre import map_from_input, moved
from perception.geometry import move_points
from perception.inputs.load import load_scene
from perception.inputs.readers import reader_of
from perception.inputs.transforms import in_map_frame, transforms_files
from perception.localise.localiser import Localised, Localiser
from perception.localise.photos import new_photos
from perception.localise.report import rendered_notice
from perception.map.files import read_info
from perception.map.map import Map
from perception.photos.decode import why_left_out
from perception.photos.folder import VIDEO_SUFFIXES
from perception.photos.ignore_masks import mask_of, with_checked_masks
from perception.photos.video import video_frames
from perception.photos.views import make_view
from perception.pipeline.checkpoint import frames_folder
from perception.pipeline.optimise import Run
from perception.sfm.options import ReadOptions
from perception.types import Scene, View
from perception.visits.record import time_taken

POINTS = 1000
"""Of the map, that stand for the sparse cloud of a visit, so that none is triangulated."""
LEAST_MAPPED, LEAST_ALIKE = 0.2, 0.35
"""A photo shows the map where that covers at least this share of it, with at least this correlation of brightness."""
LEAST_SHARE = 0.8
"""Share of the photos that must show the map; a few that do not are left out."""
SAME = 0.02
"""Turn in radians and shift over the median depth, in sum, up to which two photos were taken from one place."""
OF_MAP = ("photos.init_points", "frame.", "splat.")
"""Settings, or groups of them, that an update does not use: it keeps the frame and the unit of its map."""
OF_INPUT = ("photos.camera", "photos.ignore_masks", "photos.held_out", "device", *OF_MAP)
"""Those that belong to the input of a map and not to those of its visits."""
OTHER_UNIT = 1.5
"""Factor between measured depths and the map's from which the visit is in another unit."""


def update_settings(
    path: Path, file: Path | None, pairs: list[str], options: Mapping[str, tuple[Any, str]] | None = None
) -> MapConfig:
    """The settings that the map at `path` was made with, but for those of its own input, overridden by the TOML file,
    KEY=VALUE pairs and options, as of `load_config`. InputError for the first error, for one without effect, and where
    masks have to be given."""
    settings = {} if file is None else {key: f"{file} {key}" for key, _ in flat(read_toml(file))}
    settings |= {key: key for key in read_pairs(pairs)} | {key: where for key, (_, where) in (options or {}).items()}
    if unused := next((where for key, where in settings.items() if key.startswith(OF_MAP)), None):
        what = "has no effect on an update, which keeps the frame and the unit of its map"
        raise InputError(f"{unused}: {what}; leave it out (perception scale changes the unit of a map)")
    known = dict(fields(MapConfig))
    before = dict(flat(read_info(path).get("config", {})))
    own = {key: value for key, value in before.items() if key in known and not key.startswith(OF_INPUT)}
    labels = str(own.get("masks", "")).startswith("labels:")
    given = {key: (value, str(path / "map.json")) for key, value in own.items() if not (labels and key == "masks")}
    config = load_config(file, pairs, given=given, options=options)
    if labels and not config.masks.startswith("labels:"):
        raise InputError(f"--masks: {path} was made with {own['masks']}; give labels:DIR with those of the new photos")
    return config


def visit_scene(run: Run, gmap: Map, output: Path) -> Scene:
    """The views of the visit, in the map's frame, one of each place: a robot that stands still takes many with the same
    errors. InputError where there are none, or most are of another scene."""
    scene = _all_views(run, gmap, output)
    views = without_doubles(scene.views, _some_points(gmap))
    if len(views) == len(scene.views):
        return scene
    note = f"{len(views)} of {len(scene.views)} photos are used, as the others were taken where one of these was"
    return replace(scene, views=views, report={**scene.report, "notes": [*scene.report.get("notes", []), note]})


def _some_points(gmap: Map) -> np.ndarray:
    """[P, 3] float64 points of the map, about POINTS."""
    return gmap.means[:: max(1, len(gmap) // POINTS)].astype(np.float64)


def without_doubles(views: Sequence[View], points: np.ndarray) -> list[View]:
    """The views but those from the place of an earlier one. points [P, 3]: of the scene."""
    kept: list[View] = []
    poses = np.zeros((0, 4, 4))
    for view in views:
        pose = view.camera_from_world
        seen = move_points(pose, points)
        z = seen[(seen[:, 2] > 0) & (np.abs(seen[:, 0]) < seen[:, 2]), 2]
        depth = float(np.median(z)) if len(z) else np.inf
        between = pose @ np.linalg.inv(poses)
        turns = np.arccos(np.clip((np.trace(between[:, :3, :3], axis1=1, axis2=2) - 1) / 2, -1, 1))
        if (turns + np.linalg.norm(between[:, :3, 3], axis=1) / depth > SAME).all():
            kept, poses = [*kept, view], np.concatenate([poses, pose[None]])
    return kept


def _all_views(run: Run, gmap: Map, output: Path) -> Scene:
    assert gmap.path is not None
    photos, source = run.config.photos, run.source
    camera, masks = (Path(file) if file else None for file in (photos.camera, photos.ignore_masks))
    map_from_source = map_from_input(gmap.path, gmap.info)
    some = move_points(np.linalg.inv(map_from_source), _some_points(gmap))
    folder, frames, seed = run.work / "sfm", frames_folder(output), run.config.seed
    options = ReadOptions(folder, seed, run.progress, photos.strict, masks, camera, frames, poses="keep")
    options = replace(options, cloud=(some, np.zeros((len(some), 3), np.uint8)), still=photos.ignore_still)
    if not reader_of(source).poses:
        if source.suffix.lower() in VIDEO_SUFFIXES and source.is_file():
            video_frames(source, frames, run.progress)
            source = frames
        return with_checked_masks(_localised(run, gmap, source, options), masks)
    scene = load_scene(source, options)
    if not scene.views:
        raise InputError(f"{source}: holds no posed photo; give photos of a new visit")
    listed = transforms_files(source) if scene.report.get("input") == "transforms" else []
    if listed and in_map_frame(listed[0], gmap.info, gmap.views):
        return scene
    return replace(scene, views=[moved(view, map_from_source) for view in scene.views])


def _localised(run: Run, gmap: Map, source: Path, options: ReadOptions) -> Scene:
    found = new_photos([source], options.camera, options.workdir, run.progress)
    found = [replace(photo, mask=mask_of(options.masks, photo.name)) for photo in found]
    for photo in found if run.config.photos.strict else ():
        why_left_out(photo.photo, strict=True)
    localiser = Localiser(gmap, progress=run.progress)
    if localiser.rendered:
        run.progress.log(rendered_notice(gmap, localiser.rendered))
    answers = localiser.answers(found, options.still_folder([photo.mask for photo in found]))
    here = [answer for answer in answers if isinstance(answer, Localised)]
    if len(here) < LEAST_SHARE * len(answers):
        lost = next(answer for answer in answers if not isinstance(answer, Localised))
        first = f"first: {lost.name}: {lost.why}"
        many = f"{len(answers) - len(here)} of {len(answers)} photos are not in {gmap.path} ({first})"
        raise InputError(f"{run.source}: {many}; give photos of the mapped scene, or map this one anew")
    views = [replace(make_view(a.name, a.photo, a.lens, a.camera_from_map, a.photo), mask=a.mask) for a in here]
    left = [{"name": a.name, "why": a.why} for a in answers if not isinstance(a, Localised)]
    none, report = np.zeros((0, 3)), {"input": "photos", "left_out": left}
    return Scene(sorted(views, key=lambda v: v.name), none, none.astype(np.uint8), gmap.metric, gmap.frame, report)


def refuse_older(gmap: Map, views: Sequence[View]) -> None:
    """InputError where the photos were taken before the newest of the map's, by EXIF, which a visit may lack."""
    before = [view.photo for view in gmap.located_views()]
    map_time, time = time_taken([photo for photo in before if photo != Path()]), time_taken([v.photo for v in views])
    if map_time is not None and time is not None and time < map_time:
        when = f"its photos were taken until {time}, those of {gmap.path} until {map_time}"
        raise InputError(f"{views[0].photo.parent}: is older than the map: {when}; update the older map with this one")


def foreign_photos(source: Path, gmap: Map, looks: Sequence[Look]) -> list[str]:
    """Names of the photos that do not show the map. InputError where those are many, or depth has another unit."""
    ratios = [
        np.median(shown.view.depth.numpy()[both] / shown.mapped[both])
        for shown in looks
        if shown.view.depth is not None and (both := (shown.view.depth.numpy() > 0) & (shown.mapped > 0)).any()
    ]
    if ratios and not 1 / OTHER_UNIT < (ratio := float(np.median(ratios))) < OTHER_UNIT:
        what = f"its depth images measure {ratio:.3g} times the depth of {gmap.path}"
        raise InputError(f"{source}: is in another unit: {what}; give depth and poses in the map's unit")
    foreign = []
    for shown in looks:
        counts = shown.counts
        mapped = (shown.mapped > 0) & counts
        sums = [float(image[mapped].sum()) for image in (shown.product, shown.rendered, shown.shown)]
        if mapped.sum() < LEAST_MAPPED * counts.sum() or correlation(*sums) < LEAST_ALIKE:
            foreign.append(shown.view.name)
    if len(foreign) > (1 - LEAST_SHARE) * len(looks):
        many = f"{len(foreign)} of {len(looks)} photos do not show what {gmap.path} holds there (first: {foreign[0]})"
        raise InputError(f"{source}: {many}; its poses have another frame or unit, or it is another scene: map it anew")
    return foreign
