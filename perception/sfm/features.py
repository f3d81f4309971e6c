"""SIFT features and verified matches in a COLMAP database, on the CPU (pycolmap)."""

from __future__ import annotations

import sqlite3
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from perception.machine import refuse_full_disk
from perception.photos.decode import CAMERA_FOLDER, exif_of, open_photo, photo_size
from perception.photos.lens import load_pycolmap
from perception.progress import Progress
from perception.types import Lens

MAX_IMAGE_SIDE = 1600
"""Larger photos are downscaled for feature extraction only; keypoints are in full-resolution pixels."""
MIN_FEATURES = 450
"""Photos with fewer than MIN_FEATURES are extracted again at double size (first octave −1), at four times the cost."""
FEW_FEATURES = 50
"""Photos with fewer, at double size, are blank, dark or blurred: no more effort registers them."""
PEAK_THRESHOLD = 0.004
FOCAL_LENGTHS, USUAL = (0.22, 10.0), 1.2
"""Range of focal lengths by EXIF that are taken, as shares of the long side: 8 to 360 mm on film of 35 mm. A manual
lens gives 0, some phones their true millimetres. The share where EXIF says nothing, as COLMAP's."""
_FULL_SIZE = (0xA002, 0xA003)
"""EXIF tags: width and height of the photo when it was taken, in pixels."""
PHOTOS_AT_ONCE, PAIRS_AT_ONCE = 64, 2000
"""Photos and pairs between two steps of the progress bar, at which the disk is looked at, too."""


@dataclass(frozen=True)
class Effort:
    """features: most of a photo. octave: the first, −1 is the image at double size. inliers: least number of verified
    matches of a pair of photos. trials: most of RANSAC."""

    features: int
    octave: int
    inliers: int
    trials: int


QUICK, THOROUGH = Effort(2048, 0, 20, 2000), Effort(8192, -1, 15, 10_000)
"""THOROUGH has COLMAP's defaults."""
Group = tuple[list[str], Any]
"""Names of the photos of one camera, and the pycolmap.ImageReaderOptions for them."""


def import_photos(
    database: Path, root: Path, photos: list[Path], names: list[str], lenses: list[Lens | None]
) -> list[Group]:
    """Creates the database with cameras and images. This fixes the image ids, which otherwise depend on the timing of
    threads; later random choices depend on the ids."""
    pycolmap, groups = load_pycolmap(), camera_groups(root, photos, names, lenses)
    pycolmap.Database.open(database).close()  # creates the file
    for group in groups:
        pycolmap.import_images(database, root, pycolmap.CameraMode.SINGLE, *group)
    _check_focal_lengths(database, {n: p for n, p, lens in zip(names, photos, lenses, strict=True) if lens is None})
    return groups


def _check_focal_lengths(database: Path, photos: dict[str, Path]) -> None:
    """Corrects focal lengths that pycolmap has read from EXIF, or drops them. photos: by name, without a known lens."""
    seen = set[int]()
    with load_pycolmap().Database.open(database) as db:
        for name, photo in photos.items():
            if (number := db.read_image_with_name(name).camera_id) in seen:
                continue
            seen.add(number)
            camera = db.read_camera(number)
            if not camera.has_prior_focal_length:
                continue
            side = max(camera.width, camera.height)
            focal = camera.focal_length * _resized_since(photo, side)
            known = FOCAL_LENGTHS[0] <= focal / side <= FOCAL_LENGTHS[1]
            if not known or focal != camera.focal_length:
                camera.focal_length = focal if known else USUAL * side
                camera.has_prior_focal_length = known
                db.update_camera(camera)


def _resized_since(photo: Path, side: int) -> float:
    """The long side in pixels over that when the photo was taken, where pycolmap has the focal length by the sensor's
    pixels per inch or centimetre; these stay in EXIF when a photo is resized. 1 where it has it otherwise."""
    with open_photo(photo) as image:
        details = exif_of(image, photo, CAMERA_FOLDER)
    full = max((size for tag in _FULL_SIZE if isinstance(size := details.get(tag), int)), default=0)
    of_film, of_sensor = details.get(0xA405), details.get(0xA20E)
    return side / full if full > 0 and of_sensor and not of_film and details.get(0xA210, 2) in (2, 3) else 1.0


def camera_groups(root: Path, photos: list[Path], names: list[str], lenses: list[Lens | None]) -> list[Group]:
    """The photos of each camera."""
    pycolmap = load_pycolmap()
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
    return groups


def extract(database: Path, root: Path, groups: list[Group], progress: Progress, effort: Effort = QUICK) -> None:
    """Extracts the features of imported photos."""
    pycolmap = load_pycolmap()
    done, count = 0, sum(len(names) for names, _ in groups)
    parts = [(names[n : n + PHOTOS_AT_ONCE], of) for names, of in groups for n in range(0, len(names), PHOTOS_AT_ONCE)]
    for names, reader in parts:
        refuse_full_disk(database.parent)
        options = pycolmap.FeatureExtractionOptions()
        options.use_gpu = False
        options.max_image_size = MAX_IMAGE_SIDE
        options.sift.max_num_features = effort.features
        options.sift.peak_threshold = PEAK_THRESHOLD
        options.sift.first_octave = effort.octave
        pycolmap.extract_features(database, root, names, pycolmap.CameraMode.SINGLE, reader, options)
        poor = _drop_poor(database, names) if effort.octave == 0 else []
        if poor:
            options.sift.first_octave = -1
            pycolmap.extract_features(database, root, poor, pycolmap.CameraMode.SINGLE, reader, options)
        done += len(names)
        progress.update("poses: features", done, count)


def _drop_poor(database: Path, names: list[str]) -> list[str]:
    """Deletes the features of photos that have fewer than MIN_FEATURES and returns those photos.
    pycolmap then extracts these again. It has no function that deletes the features of one image."""
    with load_pycolmap().Database.open(database) as db:
        ids = {name: db.read_image_with_name(name).image_id for name in names}
        poor = [name for name in names if db.num_keypoints_for_image(ids[name]) < MIN_FEATURES]
    with closing(sqlite3.connect(database)) as tables, tables:
        for name in poor:
            for table in ("keypoints", "descriptors"):
                tables.execute(f"DELETE FROM {table} WHERE image_id = ?", (ids[name],))
    return poor


def _camera_key(photo: Path) -> tuple[Any, ...]:
    """Key of photos that share one camera: size, and EXIF maker, model, focal length, the same on film, and zoom (as
    text: 0/0 is NaN). A phone that cuts the middle out of its sensor may state it by the second alone."""
    with open_photo(photo) as image:
        exif, details = exif_of(image, photo), exif_of(image, photo, CAMERA_FOLDER)
    lens = (str(details.get(tag)) for tag in (0x920A, 0xA405, 0xA404))
    return (*photo_size(photo), exif.get(0x010F), exif.get(0x0110), *lens)


def match(
    database: Path, chosen: Sequence[Sequence[str]], seed: int, progress: Progress, effort: Effort = QUICK
) -> None:
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
    verification.ransac.max_num_trials = effort.trials
    verification.min_num_inliers = effort.inliers
    listed = pycolmap.ImportedPairingOptions()
    listed.match_list_path = database.with_name("pairs.txt")
    for first in range(0, len(chosen), PAIRS_AT_ONCE):
        some = chosen[first : first + PAIRS_AT_ONCE]
        refuse_full_disk(database.parent)
        listed.match_list_path.write_text("".join(f"{one} {other}\n" for one, other in some))
        pycolmap.match_image_pairs(database, matching, listed, verification)
        pycolmap.verify_matches(database, listed.match_list_path, verification)
        progress.update("poses: matching", first + len(some), len(chosen))
