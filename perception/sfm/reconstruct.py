"""Structure from motion from a folder of photos: features, matches, a model (pycolmap), checks, report.

The seed fixes every random choice: the same machine gives the same poses bit for bit up to
incremental.REPEATABLE_PHOTOS photos. More are mapped by submodels, where cameras of 1,200 photos differed by
micrometres from run to run, or in one piece by several threads.
"""

from __future__ import annotations

import json
import shutil
import time
from collections import defaultdict
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

from perception.errors import InputError
from perception.io.atomic import atomic_directory, recover
from perception.photos.decode import photo_size
from perception.photos.folder import PhotoSet, choose_photos
from perception.photos.ignore_masks import mask_of
from perception.photos.lens import lens_from_camera, lens_text, load_pycolmap
from perception.photos.still import with_still
from perception.sfm.consistency import model_warnings
from perception.sfm.database import FeatureStore, build_features, verified_matches
from perception.sfm.escalation import MORE, Candidate, Escalation
from perception.sfm.features import FEW_FEATURES, camera_groups
from perception.sfm.incremental import (
    REPEATABLE_PHOTOS,
    map_photos,
    pipeline_options,
    read_models,
    write_model,
    write_models,
)
from perception.sfm.model import cloud_of, views_of_model
from perception.sfm.options import ReadOptions
from perception.sfm.submodels import map_submodels
from perception.types import Scene

MIN_PHOTOS, FEW_MATCHES = 3, 30
"""Least number of photos; verified matches with the best partner below which a photo overlaps the others too little."""
AT_ONCE = "at-once"
"""Folder in that of the features."""


def reconstruct(folder: Path, options: ReadOptions) -> Scene:
    """Poses and a sparse cloud of the photos in `folder`, from the largest model; unit and orientation are arbitrary.

    options.lens: known intrinsics shared by all photos, kept fixed; None estimates focal length and radial distortion.
    Results in the workdir are reused for unchanged photos, lens and seed. `choose_photos` decides which photos are left
    out.
    """
    lens, chosen = options.lens, choose_photos(folder, options.strict, options.progress)
    photos = chosen.photos
    if len(photos) < MIN_PHOTOS:
        raise _too_few(folder, chosen)
    for photo in photos:
        if lens and photo_size(photo) != (lens.width, lens.height):
            found = "×".join(map(str, photo_size(photo)))
            raise InputError(f"{photo}: the photo is {found}, the camera file says {lens.width}×{lens.height}")
    own = [mask_of(options.masks, name) for name in chosen.names]
    still = with_still(photos, list(map(photo_size, photos)), own, options.still_folder(own), options.progress)
    store = build_features(photos, [lens] * len(photos), options, still.masks)
    model, report = _map(store, chosen, folder, options)
    staged = dict(zip(store.names, zip(chosen.names, photos, strict=True), strict=True))
    located = {image_id: staged[model.images[image_id].name] for image_id in model.reg_image_ids()}
    views, facts = views_of_model(model, located, folder, options)
    masks = dict(zip(chosen.names, still.masks, strict=True))
    views = [replace(view, mask=masks[view.name]) for view in views]
    points, colors = cloud_of(model)
    report["left_out"] = sorted([*chosen.left_out, *report["left_out"]], key=lambda entry: entry["name"])
    notes = [*chosen.notes, *_brought(report.get("steps", []), len(photos))]
    report |= {"exposure": facts["exposure"], "notes": notes}
    return Scene(views, points, colors, report=report | still.added_to(report))


def _too_few(folder: Path, chosen: PhotoSet) -> InputError:
    found = f"{folder}: no photos found" if not chosen.photos else f"{folder}: {len(chosen.photos)} photo(s) found"
    if chosen.left_out:
        first = chosen.left_out[0]
        found += f" that can be used ({len(chosen.left_out)} left out: {first['name']}: {first['why']})"
    elif not chosen.photos:
        expected = "expected .jpg, .heic, .png, .tif, .bmp or .webp files, or a video itself"
        return InputError("; ".join([found, expected, *chosen.notes[:1]]))
    return InputError(f"{found}; at least {MIN_PHOTOS} are needed, 20 or more give good maps")


def _map(store: FeatureStore, chosen: PhotoSet, folder: Path, options: ReadOptions) -> tuple[Any, dict[str, Any]]:
    """The largest model, kept in the store's folder, and its report."""
    done = store.folder / "model"
    recover(done)
    if not done.is_dir():
        started, count = time.perf_counter(), len(chosen.photos)
        best, steps = _at_once(store, options), list[dict[str, Any]]()
        seconds = {**store.facts["seconds"], "mapping": time.perf_counter() - started}
        if len(best.registered) < count:
            groups = camera_groups(store.image_root, chosen.photos, store.names, [options.lens] * count)
            best, steps = Escalation(best, groups, options).run()
        if not best.models or not best.models[0].num_points3D():  # all of a plane's may be filtered out
            advice = "take sharp, overlapping photos of a textured scene from different positions"
            found = f"{len(best.registered) or 'none'} of the {count} photos could be registered"
            raise InputError(f"{folder}: {found}{', in a model without points' if best.models else ''}; {advice}")
        seconds |= {step["step"]: step["seconds"] for step in steps[1:]}
        report = _report(best, chosen.names, seconds) | ({"steps": steps} if steps else {})
        with atomic_directory(done) as new:
            write_model(best.models[0], new)
            (new / "report.json").write_text(json.dumps(report))
    for name in (AT_ONCE, MORE):
        shutil.rmtree(store.folder / name, ignore_errors=True)
    return load_pycolmap().Reconstruction(done), json.loads((done / "report.json").read_text())


def _at_once(store: FeatureStore, options: ReadOptions) -> Candidate:
    """The models by the features and pairs of the store. Where they lack photos, they are kept for a later call."""
    folder, count = store.folder / AT_ONCE, len(store.names)
    recover(folder)
    if not folder.is_dir():
        few = count <= REPEATABLE_PHOTOS
        found = None if few else map_submodels(store, options)
        pipeline = pipeline_options(options.lens is not None, options.seed, few)
        models, contradicted = found or map_photos(store, pipeline, count, options.progress)
        if models and models[0].num_reg_images() == count:
            return Candidate(models, contradicted, store)
        with atomic_directory(folder) as new:
            write_models(models, new)
            (new / "contradicted.json").write_text(json.dumps(sorted(contradicted)))
    return Candidate(read_models(folder), set(json.loads((folder / "contradicted.json").read_text())), store)


def _brought(steps: list[dict[str, Any]], count: int) -> list[str]:
    """A note on the steps for photos that are not registered at once, if there were any."""
    if len(steps) < 2:
        return []
    gains = [(step["step"], step["registered"] - before["registered"]) for before, step in pairwise(steps)]
    added = ", ".join(f"{name} added {gain or 'none'}" for name, gain in gains)
    return [f"poses: {steps[0]['registered']} of {count} photos registered at once; {added}"]


def _report(found: Candidate, shown: list[str], seconds: dict[str, float]) -> dict[str, Any]:
    models, contradicted, store = found.models, found.contradicted, found.store
    best, matches = models[0], _best_partners(store)
    inside = [{model.images[i].name for i in model.reg_image_ids()} for model in models]
    outside = [(name, photo) for name, photo in zip(store.names, shown, strict=True) if name not in inside[0]]
    return {
        "input": "photos",
        "photos": len(shown),
        "registered": len(inside[0]),
        "left_out": [{"name": p, "why": _reason(n, contradicted, inside[1:], matches)} for n, p in outside],
        "models": [len(names) for names in inside],
        "points": best.num_points3D(),
        "mean_reprojection_error_px": float(best.compute_mean_reprojection_error()),
        "mean_track_length": float(best.compute_mean_track_length()),
        "cameras": [lens_text(lens_from_camera(best.cameras[key])) for key in sorted(best.cameras)],
        "pairs_matched": store.facts["pairs_matched"],
        "pairs_possible": store.facts["pairs_possible"],
        "seconds": seconds,
        "warnings": model_warnings(models, store.database, len(shown)),
    }


def _best_partners(store: FeatureStore) -> dict[str, tuple[int, int]]:
    """name -> (features, geometrically verified matches with the best partner)."""
    best = defaultdict[int, int](int)
    for pair, matches in verified_matches(store.database).items():
        for image in pair:
            best[image] = max(best[image], len(matches))
    with load_pycolmap().Database.open(store.database) as db:
        ids = {image.name: image.image_id for image in db.read_all_images()}
        return {name: (db.num_keypoints_for_image(image), best[image]) for name, image in ids.items()}


def _reason(name: str, contradicted: set[str], others: list[set[str]], matches: dict[str, tuple[int, int]]) -> str:
    features, best = matches[name]
    if name in contradicted:
        return "most of its verified matches contradict every pose found for it (equal textures?)"
    if any(name in other for other in others):
        return "registered in another, smaller model that does not connect to the largest"
    if features < FEW_FEATURES:
        return f"too few features ({features}): blurred, dark or without texture"
    if best < FEW_MATCHES:
        return f"too few verified matches (best partner: {best}): too little overlap with the other photos"
    return f"matches found (best partner: {best}), but no consistent pose"
