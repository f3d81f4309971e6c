"""The COLMAP database of a set of photos: features and verified matches, made once and kept."""

from __future__ import annotations

import hashlib
import json
import shutil
import time
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from perception.io.atomic import atomic_directory, recover
from perception.machine import refuse_full_disk
from perception.photos.ignore_masks import stage_masks
from perception.photos.lens import load_pycolmap
from perception.sfm import features, pairs
from perception.sfm.feature_tasks import FeatureTasks
from perception.sfm.features import QUICK, Effort
from perception.sfm.options import ReadOptions
from perception.sfm.staging import stage_photos
from perception.types import Lens

POSED_PARTNERS = 12
"""With given poses no model has to be found: each photo is matched with this many photos at most, the best pairs."""

PHOTO_DISK = 1 << 20
"""Bytes of a photo's features and matches there: .3 and .4 MiB at 640 × 480 and 540 × 960 pixels, more if left out."""


@dataclass(frozen=True)
class FeatureStore:
    """A folder with the COLMAP `database.db`. image_root: of the photos under numbered names (see staging).
    names[i] is the name of the i-th photo in both. facts: numbers of pairs, seconds. effort: of its features."""

    folder: Path
    image_root: Path
    names: list[str]
    facts: dict[str, Any]
    effort: Effort = QUICK

    @property
    def database(self) -> Path:
        return self.folder / "database.db"


def verified_matches(database: Path) -> dict[tuple[int, int], np.ndarray]:
    """Verified matches [M, 2] of each pair of image ids, in order of the ids."""
    pycolmap = load_pycolmap()
    with pycolmap.Database.open(database) as db:
        keys, geometries = db.read_two_view_geometries()
    keyed = zip(map(pycolmap.pair_id_to_image_pair, keys), geometries, strict=True)
    return {pair: geometry.inlier_matches for pair, geometry in sorted(keyed, key=lambda item: item[0])}


def delete_pairs(database: Path, pairs: Iterable[tuple[int, int]]) -> None:
    """Deletes the matches of pairs of image ids."""
    with load_pycolmap().Database.open(database) as db:
        for pair in pairs:
            db.delete_matches(*pair)
            db.delete_two_view_geometry(*pair)


def build_features(
    photos: list[Path],
    lenses: list[Lens | None],
    options: ReadOptions,
    masks: list[Path | None] | None = None,
    posed: bool = False,
    as_stored: list[bool] | None = None,
) -> FeatureStore:
    """Extracts and matches features, unless the workdir holds the result of the same photos, lenses, seed and options.

    lenses: known intrinsics per photo, or None to let structure from motion find them. Photos share one camera when
    size, EXIF camera and known lens agree. masks: of pixels without features, per photo (see `ignore_masks`).
    posed: the poses are known, so fewer pairs are matched (POSED_PARTNERS). as_stored: see `stage_photos`.
    InputError where the disk has not PHOTO_DISK for each photo.
    """
    seed, progress, local = options.seed, options.progress, options.engine.kind == "local"
    masks = masks if masks and any(masks) else None
    as_stored = as_stored if as_stored and any(as_stored) else None
    most = POSED_PARTNERS if posed else len(photos)
    key = _key(photos, lenses, (seed, most, *(as_stored or ())), masks)
    folder = options.workdir / f"features-{key}"
    tasks = FeatureTasks(options.workdir / f"feature-tasks-{key}", options.engine, progress)
    recover(folder)
    if not (folder / "facts.json").exists():
        with atomic_directory(folder) as new:
            refuse_full_disk(new, PHOTO_DISK * len(photos))
            load_pycolmap().set_random_seed(seed)
            started = time.perf_counter()
            names = stage_photos(new / "photos", photos, progress, as_stored)
            if masks is not None:
                stage_masks(new / "masks", photos, names, masks, as_stored)
            database = new / "database.db"
            groups = features.import_photos(database, new / "photos", photos, names, lenses)
            if local:
                features.extract(database, new / "photos", groups, progress)
            else:
                tasks.extract(database, photos, masks, as_stored)
            extracted = time.perf_counter()
            chosen = [(names[i], names[j]) for i, j in pairs.select_pairs(database, names, most, progress)]
            tasks.match(database, chosen, seed)
            seconds = {"features": extracted - started, "matching": time.perf_counter() - extracted}
            possible = len(names) * (len(names) - 1) // 2
            made = {"names": names, "pairs_matched": len(chosen), "pairs_possible": possible, "seconds": seconds}
            (new / "facts.json").write_text(json.dumps(made))
    shutil.rmtree(tasks.folder, ignore_errors=True)
    facts = json.loads((folder / "facts.json").read_text())
    return FeatureStore(folder, folder / "photos", facts.pop("names"), facts)


def _key(
    photos: list[Path], lenses: list[Lens | None], search: tuple[int, ...], masks: list[Path | None] | None
) -> str:
    paths = [*photos, *(masks or ())]
    files = [path and (str(path.resolve()), path.stat().st_size, path.stat().st_mtime_ns) for path in paths]
    constants = [{name: of for name, of in vars(module).items() if name.isupper()} for module in (features, pairs)]
    return hashlib.sha256(repr((files, lenses, constants, search)).encode()).hexdigest()[:12]
