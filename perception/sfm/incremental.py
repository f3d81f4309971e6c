"""Incremental structure from motion (pycolmap), with retries against errors from repeated textures."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from perception.machine import refuse_full_disk
from perception.photos.lens import load_pycolmap
from perception.progress import Progress
from perception.sfm.consistency import Pair, is_contradicted, outvoted_photos, verified_pairs
from perception.sfm.database import FeatureStore, delete_pairs
from perception.sfm.features import QUICK, Effort

MIN_MODEL_SIZE = 3
REPEATABLE_PHOTOS = 150
"""Up to this many photos are mapped by one thread, which makes the result repeatable bit for bit."""
Mapped = tuple[list[Any], set[str]]
"""Models, largest first, and the names of the photos left out because most of their matches contradict the largest."""
LEVELS = (1, 2, 4, 8)
"""Least verified matches of a pair, as multiples of the store's, tried in turn until the model contradicts no pair
stronger than those it uses."""


def pipeline_options(fixed: bool, seed: int, one_thread: bool, effort: Effort = QUICK) -> Any:
    """pycolmap.IncrementalPipelineOptions. fixed: the intrinsics are not refined. With one thread, results repeat."""
    options = load_pycolmap().IncrementalPipelineOptions()
    options.random_seed = seed
    if one_thread:
        options.num_threads = 1
    options.min_num_matches = effort.inliers
    options.min_model_size = MIN_MODEL_SIZE
    if effort == QUICK:
        options.structure_less_registration_fallback = False
        # Global bundle adjustment at every 40 % of growth, not 10 %, as it takes most of the mapping time.
        options.ba_global_frames_ratio = options.ba_global_points_ratio = 1.4
        options.ba_global_max_refinements = 3
    options.ba_refine_focal_length = options.ba_refine_extra_params = not fixed
    return options


def map_photos(store: FeatureStore, options: Any, count: int, progress: Progress, start: Any | None = None) -> Mapped:
    """All models, largest first (pycolmap does not sort them), and names of photos left out as contradicted.
    options: of `pipeline_options`. start: a model of the store's features, to which photos are added."""
    with TemporaryDirectory(dir=store.folder) as folder:
        mapping = _Mapping(store, options, Path(folder), count, progress)
        return mapping.run() if start is None else mapping.extended(start)


def candidates(store: FeatureStore, options: Any, progress: Progress, most: int) -> Iterator[Mapped]:
    """As `map_photos`, but all that it chooses from, at most `most`."""
    with TemporaryDirectory(dir=store.folder) as folder:
        yield from islice(_Mapping(store, options, Path(folder), len(store.names), progress).candidates(), most)


@dataclass
class _Mapping:
    """Computes models from subsets of the verified pairs and selects the best."""

    store: FeatureStore
    options: Any
    folder: Path
    count: int
    progress: Progress
    shown: float = 0.0
    runs: int = 0

    def run(self) -> Mapped:
        """The first model that is not contradicted, else the one with most agreeing matches."""
        tried: list[tuple[int, Mapped]] = []
        for found in self.candidates():
            pairs = verified_pairs(found[0][0], self.store.database)
            tried.append((sum(pair.inliers for pair in pairs if pair.agrees), found))
            if not is_contradicted(pairs):
                break
        return max(tried, key=lambda item: item[0], default=(0, ([], set())))[1]

    def extended(self, start: Any) -> Mapped:
        """`start` with the photos that can be added to it."""
        return self._without_outvoted(self._map(self.store.database, self.store.effort.inliers, start) or [start])

    def candidates(self) -> Iterator[Mapped]:
        """For each level: a model from its pairs, then one from all pairs except those that the first contradicts."""
        least = self.store.effort.inliers
        for level in LEVELS:
            models = self._map(self.store.database, level * least)
            if not models:
                return
            found = self._without_outvoted(models)
            yield found
            pairs = verified_pairs(found[0][0], self.store.database)
            wrong = [pair for pair in pairs if not pair.agrees]
            again = self._map(self._database_without(wrong), least) if wrong else []
            if again:
                yield self._without_outvoted(again)

    def _database_without(self, pairs: list[Pair]) -> Path:
        copy = self.folder / "pairs.db"
        shutil.copyfile(self.store.database, copy)
        delete_pairs(copy, [(pair.i, pair.j) for pair in pairs])
        return copy

    def _without_outvoted(self, models: list[Any]) -> Mapped:
        """Removes photos most of whose matches contradict the model, tries them again, leaves out those that fail."""
        best = models[0]
        pairs = verified_pairs(best, self.store.database)
        wrong = outvoted_photos(pairs)
        if not wrong or len(wrong) > best.num_reg_images() / 4:
            return models, set()
        name_of = {image: best.images[image].name for image in best.reg_image_ids()}
        take_out(best, wrong)
        others = [p for p in pairs if not p.agrees and p.i not in wrong and p.j not in wrong]
        again = self._map(self._database_without(others), self.store.effort.inliers, best)
        best = again[0] if again and again[0].num_reg_images() >= best.num_reg_images() else best
        still = outvoted_photos(verified_pairs(best, self.store.database))
        registered = set(best.reg_image_ids())
        name_of |= {image: best.images[image].name for image in registered}
        take_out(best, still & registered)
        return [best, *models[1:]], {name_of[image] for image in still | (wrong - registered)}

    def _map(self, database: Path, min_inliers: int, start: Any | None = None) -> list[Any]:
        self.options.min_num_matches = min_inliers
        self.options.multiple_models = start is None
        self.runs += 1
        source = self.folder / f"start-{self.runs}"
        if start is not None:
            source.mkdir()
            write_model(start, source)
        out = self.folder / f"run-{self.runs}"
        out.mkdir()
        registered = 2

        def next_image() -> None:
            nonlocal registered
            registered += 1
            self.shown = max(self.shown, min(1.0, registered / self.count))
            self.progress.update("poses: mapping", round(100 * self.shown), 100)

        paths, begun = (database, self.store.image_root, out), source if start is not None else ""
        found = load_pycolmap().incremental_mapping(
            *paths, self.options, input_path=begun, next_image_callback=next_image
        )
        models = [model for model in found.values() if model.num_reg_images() >= MIN_MODEL_SIZE]
        return sorted(models, key=lambda model: (-model.num_reg_images(), -model.num_points3D()))


def write_model(model: Any, folder: Path) -> None:
    """Writes a model into a folder. COLMAP says nothing of a disk on which it becomes full: its files are cut short."""
    refuse_full_disk(folder)
    model.write(folder)


def write_models(models: list[Any], folder: Path) -> None:
    """Writes models into folders of their own in `folder`, which `read_models` reads in the same order."""
    for number, model in enumerate(models):
        (folder / f"{number:04}").mkdir()
        write_model(model, folder / f"{number:04}")


def read_models(folder: Path) -> list[Any]:
    """The models that `write_models` has written."""
    return [load_pycolmap().Reconstruction(each) for each in sorted(folder.iterdir()) if each.is_dir()]


def take_out(model: Any, images: set[int]) -> None:
    """Takes photos out of a model."""
    for image in sorted(images):
        model.deregister_frame(model.images[image].frame_id)
