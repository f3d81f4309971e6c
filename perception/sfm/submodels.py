"""Structure from motion of many photos, by submodels.

The photos are partitioned where few of them match; each submodel is mapped by one thread, in a frame of its own, as a
task of the engine. Neighbouring submodels share some photos, by which they are aligned and merged; then one bundle
adjustment goes over all, or over parts of very many photos. So time grows little faster than the number of photos, and
the result is repeatable.
"""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

from perception.progress import Progress
from perception.sfm import incremental, merge, partition, parts
from perception.sfm.consistency import is_contradicted, outvoted_photos, verified_pairs
from perception.sfm.database import FeatureStore, verified_matches
from perception.sfm.feature_tasks import write_part
from perception.sfm.incremental import map_photos, pipeline_options, take_out
from perception.sfm.options import ReadOptions
from perception.tasks.folder import has_task, leaves_result, run_tasks, write_task


def map_submodels(store: FeatureStore, options: ReadOptions) -> incremental.Mapped | None:
    """As `map_photos`, by submodels; None where the photos' matches contradict the merged model."""
    counts = {pair: len(matches) for pair, matches in verified_matches(store.database).items() if len(matches)}
    if not counts:
        return None
    fixed, seed, progress = options.lens is not None, options.seed, options.progress
    divided = partition.divide(counts, partition.LARGEST)
    submodels = partition.with_overlap(divided, counts)
    folders = [_task(store, images, number, fixed, seed) for number, images in enumerate(submodels)]
    results = run_tasks(options.engine, submodel_task, folders, "poses: submodel", progress, each_core=True)
    found = [incremental.read_models(result) for result in results]
    groups = merge.align(merge.without_repeats(found), seed)
    if not groups:
        return None
    progress.update("poses: adjusting", 0, 1)
    best, *others = map(merge.merged, groups)
    if best.num_reg_images() > parts.WHOLE:
        best = parts.adjusted_in_parts(best, store, parts.parts_of(divided, counts), options)
    else:
        best = merge.adjusted(best, store, pipeline_options(fixed, seed, one_thread=True))
    pairs = verified_pairs(best, store.database)
    progress.update("poses: adjusting", 1, 1)
    if is_contradicted(pairs):
        progress.log("poses: matches contradict the model merged from submodels; all photos are mapped in one piece")
        return None
    wrong = outvoted_photos(pairs)
    left_out = {best.images[image].name for image in wrong}
    had = set(best.reg_image_ids())  # photos of the others may have been added
    others = [model for model in others if len(set(model.reg_image_ids()) - had) >= incremental.MIN_MODEL_SIZE]
    take_out(best, wrong)
    shutil.rmtree(store.folder / "submodels")
    return [best, *others], left_out


def _task(store: FeatureStore, images: list[int], number: int, fixed: bool, seed: int) -> Path:
    """The folder of the task that maps one submodel."""
    folder = store.folder / "submodels" / str(number)
    if not has_task(folder):
        folder.mkdir(parents=True, exist_ok=True)
        write_part(store.database, images, folder / store.database.name, ("keypoints",), matched=True)
        write_task(folder, count=len(images), fixed=fixed, seed=seed, photos=str(store.image_root.resolve()))
    return folder


@leaves_result
def submodel_task(folder: Path, facts: dict[str, Any], new: Path, progress: Progress) -> None:
    """Maps a submodel."""
    store = FeatureStore(folder, Path(facts["photos"]), [], {})
    models, _ = map_photos(store, pipeline_options(facts["fixed"], facts["seed"], True), facts["count"], progress)
    incremental.write_models(models, new)
