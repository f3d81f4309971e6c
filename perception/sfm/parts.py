"""Bundle adjustment of very many photos in parts, each a task of the engine.

A part is the photos of one submodel and those around them. Each is adjusted alone; then similarities bring all
together at all their overlaps at once, so that loops close. Last, each part triangulates its points at these poses. So
the driver's work and memory are what the poses and points themselves need.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterable, Iterator, Sequence
from copy import copy
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from perception.photos.lens import load_pycolmap
from perception.progress import Progress
from perception.sfm.alignment import Poses, moved_pose, pose_of, similarities
from perception.sfm.database import FeatureStore
from perception.sfm.feature_tasks import write_part
from perception.sfm.incremental import pipeline_options, write_model
from perception.sfm.merge import refined, triangulated
from perception.sfm.options import ReadOptions
from perception.sfm.partition import LARGEST, Matches
from perception.tasks.folder import has_task, leaves_result, run_tasks, write_task

WHOLE = 10_000
"""Photos up to which one bundle adjustment goes over all: 17 minutes and .6 GB of the driver."""
HOPS = 2
"""A part has the photos of a submodel, those matched with them, and those matched with these."""
MODEL, FOLDER = "model", "parts"


@dataclass(frozen=True)
class Part:
    """Image ids: of a submodel, and of the photos around them, nearer ones first."""

    own: list[int]
    around: list[int]


def parts_of(submodels: Sequence[list[int]], matches: Matches) -> list[Part]:
    """The part of each submodel: LARGEST photos around its own at most, those that are fewer matches away first, then
    those with most matches with nearer ones."""
    linked: dict[int, dict[int, int]] = {}
    for (i, j), count in matches.items():
        linked.setdefault(i, {})[j] = linked.setdefault(j, {})[i] = count
    return [Part(own, _around(own, linked)) for own in submodels]


def _around(own: list[int], linked: dict[int, dict[int, int]]) -> list[int]:
    edge, found = own, dict.fromkeys(own)
    for _ in range(HOPS):
        counts: dict[int, int] = {}
        for known in edge:
            for image, count in linked.get(known, {}).items():
                if image not in found:
                    counts[image] = counts.get(image, 0) + count
        edge = sorted(counts, key=lambda image: (-counts[image], image))
        found |= dict.fromkeys(edge)
    return list(found)[len(own) :][:LARGEST]


def adjusted_in_parts(model: Any, store: FeatureStore, parts: Sequence[Part], options: ReadOptions) -> Any:
    """`model`, a pycolmap reconstruction whose intrinsics stay, with new poses and points."""
    start = {image: pose_of(model.images[image]) for image in sorted(model.reg_image_ids())}
    parts = [part for part in parts if any(image in start for image in part.own)]
    found = _run(model, start, store, parts, options, "adjusting")
    had = [{image: pose_of(each.images[image]) for image in sorted(each.reg_image_ids())} for each in found]
    poses = joined(had, parts, start, options.seed)
    found = _run(model, poses, store, parts, options, "points")
    with load_pycolmap().Database.open(store.database) as db:
        model = with_points(_posed(model, poses, db), found)
    shutil.rmtree(store.folder / FOLDER)
    return model


def joined(had: Sequence[Poses], parts: Sequence[Part], start: Poses, seed: int) -> Poses:
    """The pose of each photo in the part that it is an own one of; `had` of all parts are moved together. start: poses
    of all photos."""
    own = [set(part.own) & poses.keys() for part, poses in zip(parts, had, strict=True)]
    moves = similarities(had, own, start, seed)
    return {i: moved_pose(move, of[i]) for move, of, mine in zip(moves, had, own, strict=True) for i in sorted(mine)}


def with_points(model: Any, found: Iterable[Any]) -> Any:
    """`model` with the points of parts of it: of each those that share no feature with one of a part before."""
    pycolmap, used = load_pycolmap(), set[tuple[int, int]]()
    for part in found:
        for _, point in sorted(part.points3D.items()):
            track = [(each.image_id, each.point2D_idx) for each in point.track.elements]
            free = [each for each in track if each not in used]
            if len(free) > 1:
                used.update(free)
                elements = [pycolmap.TrackElement(*each) for each in free]
                model.add_point3D(point.xyz, pycolmap.Track(elements), point.color)
    model.update_point_3d_errors()
    return model


def _posed(model: Any, poses: Poses, db: Any | None = None) -> Any:
    """The photos of `model` that have `poses`, with these, and without points. db: and with their features."""
    pycolmap = load_pycolmap()
    new = pycolmap.Reconstruction()
    for number in sorted({model.images[image].camera_id for image in poses}):
        new.add_camera_with_trivial_rig(copy(model.cameras[number]))
    for image, pose in sorted(poses.items()):
        old, points = model.images[image], np.empty((0, 2)) if db is None else db.read_keypoints(image)[:, :2]
        plain = pycolmap.Image(old.name, keypoints=np.float64(points), camera_id=old.camera_id, image_id=image)
        new.add_image_with_trivial_frame(plain, pycolmap.Rigid3d(pose))
    return new


def _run(
    model: Any, poses: Poses, store: FeatureStore, parts: Sequence[Part], options: ReadOptions, what: str
) -> Iterator[Any]:
    """The models that the tasks of one stage, "adjusting" or "points", make of each part of `model` at these poses, one
    in memory at a time."""
    folder, folders = store.folder / FOLDER, []
    for number, part in enumerate(parts):
        folders.append(folder / what / str(number))
        database = folder / "adjusting" / str(number) / store.database.name
        images = [*part.own, *part.around]
        if not has_task(folders[-1]):
            (folders[-1] / MODEL).mkdir(parents=True, exist_ok=True)
            if database.parent == folders[-1]:
                write_part(store.database, images, database, ("keypoints",), matched=True)
            write_model(_posed(model, {i: poses[i] for i in images if i in poses}), folders[-1] / MODEL)
            paths = {"database": str(database.resolve()), "photos": str(store.image_root.resolve())}
            write_task(folders[-1], None, adjust=what == "adjusting", seed=options.seed, **paths)
    results = run_tasks(options.engine, part_task, folders, f"poses: {what}, part", options.progress, each_core=True)
    return map(load_pycolmap().Reconstruction, results)


@leaves_result
def part_task(folder: Path, facts: dict[str, Any], new: Path, progress: Progress) -> None:
    """Triangulates the points of a part, and adjusts its poses if the task says so."""
    load_pycolmap().set_random_seed(facts["seed"])
    model, options = load_pycolmap().Reconstruction(folder / MODEL), pipeline_options(True, facts["seed"], True)
    store = FeatureStore(Path(facts["database"]).parent, Path(facts["photos"]), [], {})
    progress.update("poses: part", 0, 1)
    model = triangulated(model, store, options)
    if facts["adjust"]:
        model = refined(model, store, options, add=False)
    else:
        model.extract_colors_for_all_images(store.image_root)
    write_model(model, new)
