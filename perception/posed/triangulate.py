"""The scene of photos with known poses: poses are checked against matched features, a sparse cloud is triangulated."""

from __future__ import annotations

import time
from dataclasses import replace
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from perception.errors import InputError
from perception.geometry import inverse_se3
from perception.photos.depth import load_depth
from perception.photos.lens import camera_from_lens, lens_text, load_pycolmap
from perception.photos.still import with_still
from perception.photos.views import view_lens
from perception.posed.pose_refinement import checked_poses
from perception.sfm.database import FeatureStore, build_features
from perception.sfm.exposure import with_gains
from perception.sfm.model import cloud_of
from perception.sfm.options import Cloud, ReadOptions
from perception.sfm.tracks import features_of, tracks_of
from perception.types import Lens, Scene, View

MIN_POINTS = 50
FALLBACK_POINTS = 5000


def posed_scene(views: list[View], cloud: Cloud, facts: dict[str, Any], options: ReadOptions, least: int) -> Scene:
    """The Scene of views with known poses. cloud: points [P, 3] and colors [P, 3] from the input.
    With fewer than `least` points, triangulated points are used instead. facts: report entries, with "warnings"."""
    cameras = sorted({lens_text(view_lens(view)) for view in views})
    views, unread = _without_damaged_depth(views, options.strict)
    report = {**facts, "registered": len(views), "cameras": cameras, "seconds": {}}
    report["warnings"] = [*report["warnings"], *unread]
    photos, sizes, own = map(list, zip(*((view.photo, view.photo_size, view.mask) for view in views), strict=True))
    as_stored = [view.as_stored for view in views]
    still = with_still(photos, sizes, own, options.still_folder(own), options.progress, as_stored)
    views = [replace(view, mask=mask) for view, mask in zip(views, still.masks, strict=True)]
    report |= still.added_to(report)
    points, colors = cloud
    few = len(points) < least
    doubted = options.poses == "auto" and (few or any(view.depth is not None for view in views))
    check = doubted or options.poses == "refine"
    if few or check:
        lenses: list[Lens | None] = [view_lens(view) for view in views]
        store = build_features(photos, lenses, options, still.masks, posed=True, as_stored=as_stored)
        report["seconds"] = store.facts["seconds"]
        features = features_of(views, store)
        if check:
            started = time.perf_counter()
            views, found = checked_poses(views, features, options.poses)
            report |= {key: [*report.get(key, []), *found[key]] for key in ("notes", "warnings")}
            report["poses"] = found["poses"]
            report["seconds"]["refinement"] = time.perf_counter() - started
        views, found = with_gains(views, tracks_of(features, features.pairs))
        report |= found
        if few:
            points, colors, found = triangulated_cloud(views, store, options.seed)
            report |= {**found, "warnings": [*report["warnings"], *found["warnings"]]}
    report["points"] = len(points)
    return Scene(views, points, colors, report=report)


def _without_damaged_depth(views: list[View], strict: bool) -> tuple[list[View], list[str]]:
    """The views without depth images that cannot be read or do not fit their cameras, and a warning for them.
    InputError where that is all of them, or strict."""
    kept, damaged = list[View](), list[InputError]()
    for view in views:
        try:
            load_depth(view, 2, 2)
        except InputError as error:
            damaged.append(error)
            view = replace(view, depth=None)
        kept.append(view)
    if damaged and (strict or not any(view.depth for view in kept)):
        raise damaged[0]
    return kept, [f"{len(damaged)} depth images are not used, such as {damaged[0]}"] if damaged else []


def triangulated_cloud(
    views: list[View], store: FeatureStore, seed: int
) -> tuple[np.ndarray, np.ndarray, dict[str, Any]]:
    """points [P, 3] float64 in the world of the views, colors [P, 3] uint8, facts for the report.
    store: the matched features of the views (see sfm.database). With fewer than MIN_POINTS points, random points in the
    view frusta are returned, with a warning."""
    pycolmap, model = load_pycolmap(), load_pycolmap().Reconstruction()
    with pycolmap.Database.open(store.database) as db:
        images = [db.read_image_with_name(name) for name in store.names]
    for view, image in zip(views, images, strict=True):
        if image.camera_id not in model.cameras:
            model.add_camera_with_trivial_rig(camera_from_lens(view_lens(view), image.camera_id))
        plain = pycolmap.Image(name=image.name, camera_id=image.camera_id, image_id=image.image_id)
        model.add_image_with_trivial_frame(plain, pycolmap.Rigid3d(view.camera_from_world[:3]))
    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed = seed
    options.num_threads = 1  # the order of sums in several threads is not repeatable
    options.ba_refine_focal_length = options.ba_refine_extra_params = False
    with TemporaryDirectory(dir=store.folder) as out:
        if len(views) > 1:  # COLMAP refuses one
            model = pycolmap.triangulate_points(model, store.database, store.image_root, out, True, options)
    points, colors = cloud_of(model)
    error = float(model.compute_mean_reprojection_error()) if len(points) else None
    facts: dict[str, Any] = {"points_from": "triangulated", "mean_reprojection_error_px": error, "warnings": []}
    if len(points) < MIN_POINTS:
        others = f"{FALLBACK_POINTS} random points in the cameras' view"
        others = "depth images" if any(view.depth for view in views) else others
        few = f"only {len(points)} points could be triangulated with the given poses (are they right?)"
        facts |= {"points_from": "random", "warnings": [f"{few}; {others} are used instead"]}
        points, colors = random_cloud(views, seed)
    return points, colors, facts


def random_cloud(views: list[View], seed: int) -> Cloud:
    """Random grey points in the frusta of the views, at 0.5 to 2.5 times the spread of the cameras."""
    rng = np.random.default_rng(seed)
    worlds = np.stack([inverse_se3(v.camera_from_world) for v in views])
    spread = np.linalg.norm(worlds[:, :3, 3] - worlds[:, :3, 3].mean(0), axis=1).mean() or 1.0
    which = rng.integers(len(views), size=FALLBACK_POINTS)
    depth = spread * rng.uniform(0.5, 2.5, FALLBACK_POINTS)
    points = np.empty((FALLBACK_POINTS, 3))
    for index, view in enumerate(views):
        mine = which == index
        pixel = rng.uniform(size=(int(mine.sum()), 2)) * (view.width, view.height)
        ray = np.c_[pixel, np.ones(len(pixel))] @ np.linalg.inv(view.K).T * depth[mine, None]
        points[mine] = ray @ worlds[index, :3, :3].T + worlds[index, :3, 3]
    return points, np.full((FALLBACK_POINTS, 3), 128, np.uint8)
