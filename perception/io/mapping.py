"""Incremental mapping (pycolmap) that trusts the strongest pairs first: equal textures must not fold the model."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

from perception.io.doubts import MAX_OVERRULED, Pair, outvoted_photos, overruled, verified_pairs
from perception.io.features import MIN_INLIERS, FeatureStore, Progress
from perception.io.lens import load_pycolmap

MIN_MODEL_SIZE = 3
LEVELS = (MIN_INLIERS, 2 * MIN_INLIERS, 4 * MIN_INLIERS, 8 * MIN_INLIERS)
"""Pairs with fewer verified matches are left out in turn until a model stands that overrules no stronger pair."""


def map_photos(
    store: FeatureStore, fixed: bool, seed: int, count: int, progress: Progress
) -> tuple[list[Any], set[str]]:
    """All models, largest first (pycolmap's numbering is no ranking), and names of photos left out as contradicted.

    fixed: the intrinsics in the database are kept as they are.
    """
    folder = store.folder / "mapping"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    try:
        return _Mapping(store, folder, fixed, seed, count, progress).run()
    finally:
        shutil.rmtree(folder, ignore_errors=True)


class _Mapping:
    """One database copy, from which contradicted pairs are taken out, and the models made of it."""

    def __init__(
        self, store: FeatureStore, folder: Path, fixed: bool, seed: int, count: int, progress: Progress
    ) -> None:
        self.original, self.image_root, self.folder = store.database, store.image_root, folder
        self.database = folder / "database.db"
        shutil.copyfile(store.database, self.database)
        self.fixed, self.seed, self.count, self.progress = fixed, seed, count, progress
        self.told, self.runs = 0.0, 0

    def run(self) -> tuple[list[Any], set[str]]:
        models, level = self._strongest_first()
        if not models:
            return [], set()
        if level > LEVELS[0]:
            self._forget([p for p in verified_pairs(models[0], self.database) if not p.agrees])
            again = self._map(LEVELS[0])
            if again and _faults(again[0], self.original) <= _faults(models[0], self.original):
                models = again
        return self._without_outvoted(models)

    def _strongest_first(self) -> tuple[list[Any], int]:
        """The first model of LEVELS that overrules almost nothing; else the one that overrules least."""
        tried = []
        for level in LEVELS:
            models = self._map(level)
            if not models or (tried and models[0].num_reg_images() < tried[0][1][0].num_reg_images() / 2):
                break
            faults = _faults(models[0], self.database)
            tried.append((faults, models, level))
            if faults <= MAX_OVERRULED / 4:
                break
        if not tried:
            return [], LEVELS[0]
        _, models, level = min(tried, key=lambda item: item[0])
        return models, level

    def _without_outvoted(self, models: list[Any]) -> tuple[list[Any], set[str]]:
        """Photos that most of their matches contradict are taken out, tried once more, and left out if need be."""
        best = models[0]
        wrong = outvoted_photos(verified_pairs(best, self.original))
        if not wrong or best.num_reg_images() - len(wrong) < MIN_MODEL_SIZE:
            return models, set()
        _take_out(best, wrong)
        source = self.folder / "kept"
        source.mkdir()
        best.write(source)
        again = self._map(LEVELS[0], source)
        best = again[0] if again and again[0].num_reg_images() >= best.num_reg_images() else best
        still = outvoted_photos(verified_pairs(best, self.original))
        still |= wrong - set(best.reg_image_ids())
        names = {best.images[image].name for image in still}
        _take_out(best, still & set(best.reg_image_ids()))
        return [best, *models[1:]], names

    def _map(self, min_inliers: int, source: Path | None = None) -> list[Any]:
        pycolmap = load_pycolmap()
        options = pycolmap.IncrementalPipelineOptions()
        options.random_seed = self.seed
        options.min_num_matches = min_inliers
        options.min_model_size = MIN_MODEL_SIZE
        options.multiple_models = source is None
        options.structure_less_registration_fallback = False
        # Global adjustment at every 40 % of growth, not 10 %: most of the time of mapping goes there.
        options.ba_global_frames_ratio = options.ba_global_points_ratio = 1.4
        options.ba_global_max_refinements = 3
        options.ba_refine_focal_length = options.ba_refine_extra_params = not self.fixed
        self.runs += 1
        out = self.folder / f"run-{self.runs}"
        out.mkdir()
        registered = 2

        def next_image() -> None:
            nonlocal registered
            registered += 1
            self.told = max(self.told, min(1.0, registered / self.count))
            self.progress("mapping", self.told)

        found = pycolmap.incremental_mapping(
            self.database,
            self.image_root,
            out,
            options,
            input_path=source or "",
            next_image_callback=next_image,
        )
        models = [model for model in found.values() if model.num_reg_images() >= MIN_MODEL_SIZE]
        return sorted(models, key=lambda model: (-model.num_reg_images(), -model.num_points3D()))

    def _forget(self, pairs: list[Pair]) -> None:
        db = load_pycolmap().Database.open(self.database)
        for pair in pairs:
            db.delete_two_view_geometry(pair.i, pair.j)
            db.delete_matches(pair.i, pair.j)
        db.close()


def _faults(model: Any, database: Path) -> float:
    """Share of the verified pairs that the model overrules in favour of weaker ones."""
    pairs = verified_pairs(model, database)
    return len(overruled(pairs)) / max(1, len(pairs))


def _take_out(model: Any, images: set[int]) -> None:
    for image in sorted(images):
        model.deregister_frame(model.images[image].frame_id)
