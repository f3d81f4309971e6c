"""SIFT features and verified matches in a COLMAP database, on the CPU (pycolmap)."""

from __future__ import annotations

import hashlib
import json
import shutil
import sqlite3
import time
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np

from perception.io.atomic import atomic_directory, recover
from perception.photos.decode import exif_folder, exif_of, open_photo, photo_size
from perception.photos.ignore_masks import stage_masks
from perception.photos.lens import load_pycolmap
from perception.progress import Progress
from perception.sfm import pairs
from perception.sfm.staging import stage_photos
from perception.tasks.engine import Engine
from perception.types import Lens

MAX_IMAGE_SIDE = 1600
"""Larger photos are downscaled for feature extraction only; keypoints are in full-resolution pixels."""
MAX_FEATURES, MIN_FEATURES = 2048, 450
"""Photos with fewer than MIN_FEATURES are extracted again at double size (first octave −1), at four times the cost."""
PEAK_THRESHOLD = 0.004
MIN_INLIERS = 20
"""Least number of verified matches of a pair of photos."""
PAIRS_AT_ONCE = 2000
"""Pairs between two steps of the progress bar."""
POSED_PARTNERS = 12
"""With given poses no model has to be found: each photo is matched with this many photos at most, the best pairs."""


class FeatureStore:
    """A folder with the COLMAP `database.db` and `photos/`, which holds the photos under numbered names (see staging).
    names[i] is the name of the i-th photo in both."""

    def __init__(self, folder: Path, names: list[str], facts: dict[str, Any], photos: Path | None = None) -> None:
        self.folder, self.image_root, self.names, self.facts = folder, photos or folder / "photos", names, facts

    @property
    def database(self) -> Path:
        return self.folder / "database.db"


def verified_matches(database: Path) -> dict[tuple[int, int], np.ndarray]:
    """Verified matches [M, 2] of each pair of image ids, in order of the ids."""
    pycolmap = load_pycolmap()
    db = pycolmap.Database.open(database)
    keys, geometries = db.read_two_view_geometries()
    db.close()
    found = zip(map(pycolmap.pair_id_to_image_pair, keys), geometries, strict=True)
    return {pair: geometry.inlier_matches for pair, geometry in sorted(found, key=lambda item: item[0])}


def build_features(
    photos: list[Path],
    lenses: list[Lens | None],
    workdir: Path,
    seed: int,
    progress: Progress,
    masks: list[Path | None] | None = None,
    posed: bool = False,
    engine: Engine | None = None,
) -> FeatureStore:
    """Extracts and matches features, unless `workdir` holds the result of the same photos, lenses, seed and options.

    lenses: known intrinsics per photo, or None to let structure from motion find them. Photos share one camera when
    size, EXIF camera and known lens agree. masks: of pixels without features, per photo (see `ignore_masks`).
    posed: the poses are known, so fewer pairs are matched (POSED_PARTNERS). engine: where; None: here.
    """
    from perception.sfm.feature_tasks import FeatureTasks

    masks = masks if masks and any(masks) else None
    most = POSED_PARTNERS if posed else len(photos)
    key = _key(photos, lenses, (seed, most), masks)
    folder, tasks = workdir / f"features-{key}", None
    if engine is not None and engine.kind != "local":
        tasks = FeatureTasks(workdir / f"feature-tasks-{key}", engine, progress)
    recover(folder)
    if not (folder / "facts.json").exists():
        with atomic_directory(folder) as new:
            load_pycolmap().set_random_seed(seed)
            started = time.perf_counter()
            names = stage_photos(new / "photos", photos, progress)
            if masks is not None:
                stage_masks(new / "masks", photos, names, masks)
            database = new / "database.db"
            groups = import_photos(database, new / "photos", photos, names, lenses)
            if tasks is None:
                extract(database, new / "photos", groups, progress)
            else:
                tasks.extract(database, photos, masks)
            extracted = time.perf_counter()
            chosen = [(names[i], names[j]) for i, j in pairs.select_pairs(database, names, most, progress)]
            if tasks is None:
                match(database, chosen, seed, progress)
            else:
                tasks.match(database, chosen, seed)
            seconds = {"features": extracted - started, "matching": time.perf_counter() - extracted}
            possible = len(names) * (len(names) - 1) // 2
            made = {"names": names, "pairs_matched": len(chosen), "pairs_possible": possible, "seconds": seconds}
            (new / "facts.json").write_text(json.dumps(made))
    if tasks is not None:
        shutil.rmtree(tasks.folder, ignore_errors=True)
    facts = json.loads((folder / "facts.json").read_text())
    return FeatureStore(folder, facts.pop("names"), facts)


Group = tuple[list[str], Any]
"""Names of the photos of one camera, and the pycolmap.ImageReaderOptions for them."""


def import_photos(
    database: Path, root: Path, photos: list[Path], names: list[str], lenses: list[Lens | None]
) -> list[Group]:
    """Creates the database with cameras and images. This fixes the image ids, which otherwise depend on the timing of
    threads; later random choices depend on the ids."""
    pycolmap = load_pycolmap()
    pycolmap.Database.open(database).close()  # creates the file
    cameras: dict[Any, list[int]] = {}
    for index, photo in enumerate(photos):
        cameras.setdefault(lenses[index] or _camera_key(photo), []).append(index)
    groups = []
    for members in cameras.values():
        reader, lens = pycolmap.ImageReaderOptions(), lenses[members[0]]
        if (root.parent / "masks").is_dir():
            reader.mask_path = root.parent / "masks"
        if lens is not None:
            reader.camera_model = lens.model
            reader.camera_params = ", ".join(map(repr, lens.params))
        groups.append(([names[i] for i in members], reader))
        pycolmap.import_images(database, root, pycolmap.CameraMode.SINGLE, *groups[-1])
    return groups


def extract(database: Path, root: Path, groups: list[Group], progress: Progress) -> None:
    """Extracts the features of imported photos."""
    pycolmap = load_pycolmap()
    done, count = 0, sum(len(names) for names, _ in groups)
    for names, reader in groups:
        options = pycolmap.FeatureExtractionOptions()
        options.use_gpu = False
        options.max_image_size = MAX_IMAGE_SIDE
        options.sift.max_num_features = MAX_FEATURES
        options.sift.peak_threshold = PEAK_THRESHOLD
        options.sift.first_octave = 0
        pycolmap.extract_features(database, root, names, pycolmap.CameraMode.SINGLE, reader, options)
        poor = _drop_poor(database, names)
        if poor:
            options.sift.first_octave = -1
            pycolmap.extract_features(database, root, poor, pycolmap.CameraMode.SINGLE, reader, options)
        done += len(names)
        progress.update("poses: features", done, count)


def _drop_poor(database: Path, names: list[str]) -> list[str]:
    """Deletes the features of photos that have fewer than MIN_FEATURES and returns those photos.
    pycolmap then extracts these again. It has no function that deletes the features of one image."""
    db = load_pycolmap().Database.open(database)
    ids = {name: db.read_image_with_name(name).image_id for name in names}
    poor = [name for name in names if db.num_keypoints_for_image(ids[name]) < MIN_FEATURES]
    db.close()
    with closing(sqlite3.connect(database)) as tables, tables:
        for name in poor:
            for table in ("keypoints", "descriptors"):
                tables.execute(f"DELETE FROM {table} WHERE image_id = ?", (ids[name],))
    return poor


def _camera_key(photo: Path) -> tuple[Any, ...]:
    """Key of photos that share one camera: size, and EXIF maker, model, focal length and zoom."""
    with open_photo(photo) as image:
        exif = exif_of(image, photo)
        details = exif_folder(image, photo, 0x8769)
    return (*photo_size(photo), exif.get(0x010F), exif.get(0x0110), details.get(0x920A), details.get(0xA404))


def match(database: Path, chosen: list[tuple[str, str]], seed: int, progress: Progress) -> None:
    """Matches and verifies the chosen pairs of photos, given by their names in the database."""
    pycolmap = load_pycolmap()
    progress.update("poses: matching", 0, len(chosen))
    matching = pycolmap.FeatureMatchingOptions()
    matching.use_gpu = False
    # The index of descriptors is trained with OpenBLAS, in pycolmap's wheel one without threads or locks. With several
    # threads it differed now and then, and with it the matches. The verification uses all threads.
    matching.num_threads = 1
    matching.skip_geometric_verification = True
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = seed
    verification.ransac.max_num_trials = 2000
    verification.min_num_inliers = MIN_INLIERS
    listed = pycolmap.ImportedPairingOptions()
    listed.match_list_path = database.with_name("pairs.txt")
    for first in range(0, len(chosen), PAIRS_AT_ONCE):
        some = chosen[first : first + PAIRS_AT_ONCE]
        listed.match_list_path.write_text("".join(f"{one} {other}\n" for one, other in some))
        pycolmap.match_image_pairs(database, matching, listed)
        pycolmap.verify_matches(database, listed.match_list_path, verification)
        progress.update("poses: matching", first + len(some), len(chosen))


def _key(photos: list[Path], lenses: list[Lens | None], how: tuple[int, int], masks: list[Path | None] | None) -> str:
    paths = [*photos, *(mask for mask in masks or () if mask is not None)]
    files = [(str(path.resolve()), path.stat().st_size, path.stat().st_mtime_ns) for path in paths]
    extraction = (MAX_IMAGE_SIDE, MAX_FEATURES, MIN_FEATURES, PEAK_THRESHOLD)
    constants: list[float] = [pairs.EXHAUSTIVE_BELOW, pairs.NEIGHBORS, pairs.COARSE_FEATURES, pairs.COARSE_MIN_MATCHES]
    constants += [pairs.COARSE_RATIO, pairs.PARTNERS, MIN_INLIERS]
    if len(photos) > pairs.RETRIEVED_ABOVE:
        constants += [pairs.RETRIEVED_ABOVE, pairs.RETRIEVED, pairs.WORDS]
    return hashlib.sha256(repr((files, lenses, extraction, constants, how)).encode()).hexdigest()[:12]
