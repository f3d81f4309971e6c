"""SIFT features, pair selection and verified matches in a COLMAP database, on the CPU (pycolmap).

pycolmap ignores EXIF rotation and reads few formats. Its name lists cannot contain blanks, line ends, a leading "#" or
bytes that are not UTF-8. So photos are prepared for it: upright, in a format that it reads, with numbers as names.
"""

from __future__ import annotations

import hashlib
import json
import shutil
import sqlite3
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from perception.cores import cores
from perception.io.atomic import atomic_directory, recover
from perception.io.ignore_masks import stage_masks
from perception.io.lens import load_pycolmap
from perception.io.photos import LARGE_PIXELS, exif_of, open_photo, photo_size, read_photo
from perception.progress import Progress
from perception.types import Lens

_PLAIN = {"JPEG": ".jpg", "MPO": ".jpg", "PNG": ".png"}
"""Formats that pycolmap reads as they are (MPO: a JPEG followed by further images)."""
_EXIF_FOLDER, _MAKE_AND_MODEL = 0x8769, (0x010F, 0x0110)
_FOCAL_LENGTH = (0x920A, 0xA405, 0xA20E, 0xA20F, 0xA210)
"""EXIF tags: focal length in mm, the same for 35 mm film, resolution of the focal plane in x and y and its unit."""


def stage_photos(folder: Path, photos: list[Path], progress: Progress) -> list[str]:
    """Fills the new `folder`; returns the names there, in the order of `photos`, which is also their sorted order.

    Upright JPEG and PNG are linked. Others are written as PNG, which keeps the pixels of every 8-bit format (16 bits
    become 8), with the EXIF data that tell the focal length, by several threads.
    """
    folder.mkdir()
    names, converted = [], []
    for index, photo in enumerate(photos):
        suffix = _plain_suffix(photo)
        names.append(f"{index:06d}{suffix or '.png'}")
        if suffix is None:
            converted.append((photo, folder / names[-1]))
        else:
            _link(photo.resolve(), folder / names[-1])
    with ThreadPoolExecutor(min(4, cores())) as pool:
        for done, _ in enumerate(pool.map(_convert, *zip(*converted, strict=True)) if converted else (), start=1):
            progress.update("poses: turning and converting photos", done, len(converted))
    return names


def _plain_suffix(photo: Path) -> str | None:
    with open_photo(photo) as image:
        plain = exif_of(image, photo).get(0x0112, 1) == 1 and image.mode in ("RGB", "L")
        small = image.width * image.height <= LARGE_PIXELS
        return _PLAIN.get(image.format or "") if plain and small else None


def _link(photo: Path, target: Path) -> None:
    try:
        target.symlink_to(photo)
    except OSError:  # a file system without symbolic links
        shutil.copyfile(photo, target)


def _convert(photo: Path, target: Path) -> None:
    kept = Image.Exif()
    with open_photo(photo) as image:
        exif = exif_of(image, photo)
        kept.update({tag: exif[tag] for tag in _MAKE_AND_MODEL if tag in exif})
        lens = exif.get_ifd(_EXIF_FOLDER)
        kept.get_ifd(_EXIF_FOLDER).update({tag: lens[tag] for tag in _FOCAL_LENGTH if tag in lens})
    Image.fromarray(read_photo(photo)).save(target, compress_level=1, exif=kept)


MAX_IMAGE_SIDE = 1600
"""Larger photos are downscaled for feature extraction only; keypoints are in full-resolution pixels."""
MAX_FEATURES, MIN_FEATURES = 2048, 450
"""Photos with fewer than MIN_FEATURES are extracted again at double size (first octave −1), at four times the cost."""
PEAK_THRESHOLD = 0.004
MIN_INLIERS = 20
"""Least number of verified matches of a pair of photos."""
EXHAUSTIVE_BELOW = 20
NEIGHBORS = 4
"""Each photo is always matched with this many neighbours by name, as photos are usually taken in order."""
COARSE_FEATURES, COARSE_MIN_MATCHES, COARSE_RATIO, PARTNERS = 256, 4, 0.7, 6
"""Preemptive matching. The strict ratio rejects pairs that share repeated textures only; these give wrong models.
Every photo keeps its PARTNERS best pairs, so that the match graph stays connected."""
RETRIEVED_ABOVE, RETRIEVED, WORDS = 200, 40, 64
"""Of more photos, only the RETRIEVED most similar of each are compared, by a global descriptor of WORDS centres."""
PAIRS_AT_ONCE = 2000
"""Pairs between two steps of the progress bar, for that many photos."""
POSED_PARTNERS = 12
"""With given poses no model has to be found: each photo is matched with this many photos at most, the best pairs."""
AT_ONCE = 64
"""Photos per matrix product. With one product per pair, threads waited for each other 10 times as long as they ran."""


class FeatureStore:
    """A folder with the COLMAP `database.db` and `photos/`, which holds the photos under numbered names (see staging).
    names[i] is the name of the i-th photo in both."""

    def __init__(self, folder: Path, names: list[str], facts: dict[str, Any]) -> None:
        self.folder, self.image_root, self.names, self.facts = folder, folder / "photos", names, facts

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
) -> FeatureStore:
    """Extracts and matches features, unless `workdir` holds the result of the same photos, lenses, seed and options.

    lenses: known intrinsics per photo, or None to let structure from motion find them. Photos share one camera when
    size, EXIF camera and known lens agree. masks: of pixels without features, per photo (see `ignore_masks`).
    posed: the poses are known, so fewer pairs are matched (POSED_PARTNERS).
    """
    masks = masks if masks and any(masks) else None
    most = POSED_PARTNERS if posed else len(photos)
    folder = workdir / f"features-{_key(photos, lenses, (seed, most), masks)}"
    recover(folder)
    if not (folder / "facts.json").exists():
        with atomic_directory(folder) as new:
            load_pycolmap().set_random_seed(seed)
            started = time.perf_counter()
            names = stage_photos(new / "photos", photos, progress)
            if masks is not None:
                stage_masks(new / "masks", photos, names, masks)
            _extract(new / "database.db", new / "photos", photos, names, lenses, progress)
            extracted = time.perf_counter()
            count, total = _match(new / "database.db", new / "pairs.txt", names, seed, most, progress)
            seconds = {"features": extracted - started, "matching": time.perf_counter() - extracted}
            made = {"names": names, "pairs_matched": count, "pairs_possible": total, "seconds": seconds}
            (new / "facts.json").write_text(json.dumps(made))
    facts = json.loads((folder / "facts.json").read_text())
    return FeatureStore(folder, facts.pop("names"), facts)


def _extract(
    database: Path, root: Path, photos: list[Path], names: list[str], lenses: list[Lens | None], progress: Progress
) -> None:
    pycolmap = load_pycolmap()
    groups: dict[Any, list[int]] = {}
    for index, photo in enumerate(photos):
        groups.setdefault(lenses[index] or _camera_key(photo), []).append(index)
    pycolmap.Database.open(database).close()  # creates the file
    done = 0
    for members in groups.values():
        lens = lenses[members[0]]
        options = pycolmap.FeatureExtractionOptions()
        options.use_gpu = False
        options.max_image_size = MAX_IMAGE_SIDE
        options.sift.max_num_features = MAX_FEATURES
        options.sift.peak_threshold = PEAK_THRESHOLD
        options.sift.first_octave = 0
        reader = pycolmap.ImageReaderOptions()
        if (root.parent / "masks").is_dir():
            reader.mask_path = root.parent / "masks"
        if lens is not None:
            reader.camera_model = lens.model
            reader.camera_params = ", ".join(map(repr, lens.params))
        chosen = [names[i] for i in members]
        # Fixes the image ids, which otherwise depend on thread timing; later random choices depend on the ids.
        pycolmap.import_images(database, root, pycolmap.CameraMode.SINGLE, chosen, reader)
        pycolmap.extract_features(database, root, chosen, pycolmap.CameraMode.SINGLE, reader, options)
        poor = _drop_poor(database, chosen)
        if poor:
            options.sift.first_octave = -1
            pycolmap.extract_features(database, root, poor, pycolmap.CameraMode.SINGLE, reader, options)
        done += len(members)
        progress.update("poses: features", done, len(photos))


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
        details = exif.get_ifd(0x8769)
    return (*photo_size(photo), exif.get(0x010F), exif.get(0x0110), details.get(0x920A), details.get(0xA404))


def _match(
    database: Path, pair_file: Path, names: list[str], seed: int, most: int, progress: Progress
) -> tuple[int, int]:
    pycolmap = load_pycolmap()
    pairs = _select_pairs(database, names, most, progress)
    progress.update("poses: matching", 0, len(pairs))
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
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = pair_file
    at_once = PAIRS_AT_ONCE if len(names) > RETRIEVED_ABOVE else max(len(pairs), 1)
    for first in range(0, len(pairs), at_once):
        some = pairs[first : first + at_once]
        pair_file.write_text("".join(f"{names[i]} {names[j]}\n" for i, j in some))
        pycolmap.match_image_pairs(database, matching, pairing)
        pycolmap.verify_matches(database, pair_file, verification)
        progress.update("poses: matching", first + len(some), len(pairs))
    return len(pairs), len(names) * (len(names) - 1) // 2


def _select_pairs(database: Path, names: list[str], most: int, progress: Progress) -> list[tuple[int, int]]:
    """All pairs of a small set; else neighbours by name and pairs whose largest features match, of these the `most`
    best pairs of each photo.

    Preemptive matching (Wu, "Towards Linear-time Incremental Structure from Motion", 3DV 2013, section 3): the
    few largest-scale features predict whether a pair overlaps. This also finds loop closures without a vocabulary.
    Of a large set, not all pairs are compared, but those of `similar_photos`.
    """
    count = len(names)
    if count < EXHAUSTIVE_BELOW:
        return list(combinations(range(count), 2))
    descriptors = _largest_features(database, names)
    compared = similar_photos(descriptors) if count > RETRIEVED_ABOVE else np.ones((count, count), bool)
    votes = _coarse_votes(descriptors, compared, progress)
    rank = np.argsort(np.argsort(-votes, axis=1, kind="stable"), axis=1)
    keep = (rank < most) & (votes >= np.where(rank < PARTNERS, 1, COARSE_MIN_MATCHES))
    near = np.abs(np.subtract.outer(np.arange(count), np.arange(count))) <= NEIGHBORS
    return [(i, j) for i, j in np.argwhere(np.triu(near | keep | keep.T, 1)).tolist()]


def similar_photos(descriptors: list[np.ndarray]) -> np.ndarray:
    """[n, n] bool, symmetric: whether one of two photos is among the RETRIEVED most similar of the other.

    descriptors: unit features [F, 128] of each photo. Similarity is the cosine of two VLADs (Jégou et al., "Aggregating
    local descriptors into a compact image representation", CVPR 2010): sums of the residuals of a photo's features to
    the nearest of WORDS k-means centres, each sum at unit length (Arandjelović and Zisserman, CVPR 2013).
    """
    from scipy.cluster.vq import kmeans2
    from scipy.sparse import csr_matrix

    every = np.concatenate(descriptors)
    sample = np.sort(np.random.default_rng(0).permutation(len(every))[: 200 * WORDS])
    if len(sample) < WORDS:
        return np.ones((len(descriptors), len(descriptors)), bool)
    centres = kmeans2(every[sample], WORDS, iter=10, minit="points", seed=0)[0].astype(np.float32)
    half = 0.5 * (centres**2).sum(axis=1)
    count = len(descriptors)
    vlads = np.zeros((count, WORDS, 128), np.float32)
    for first in range(0, count, AT_ONCE):
        some = descriptors[first : first + AT_ONCE]
        features = np.concatenate(some)
        word = (features @ centres.T - half).argmax(axis=1)  # the nearest centre
        place = np.repeat(np.arange(len(some)), [len(each) for each in some]) * WORDS + word
        entries = (np.ones(len(place), np.float32), (place, np.arange(len(place))))
        sums = csr_matrix(entries, shape=(len(some) * WORDS, len(place))) @ (features - centres[word])
        vlads[first : first + AT_ONCE] = sums.reshape(-1, WORDS, 128)
    vlads /= np.maximum(np.linalg.norm(vlads, axis=2, keepdims=True), 1e-9)
    rows = vlads.reshape(count, -1)
    rows /= np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), 1e-9)
    similar = np.zeros((count, count), bool)
    for first in range(0, count, AT_ONCE):
        order = np.argsort(-(rows[first : first + AT_ONCE] @ rows.T), axis=1, kind="stable")
        np.put_along_axis(similar[first : first + AT_ONCE], order[:, : RETRIEVED + 1], True, axis=1)
    return similar | similar.T | np.eye(count, dtype=bool)


def _largest_features(database: Path, names: list[str]) -> list[np.ndarray]:
    pycolmap = load_pycolmap()
    result = []
    db = pycolmap.Database.open(database)
    for name in names:
        image = db.read_image_with_name(name)
        keypoints = db.read_keypoints(image.image_id)
        keypoints = keypoints if isinstance(keypoints, np.ndarray) else pycolmap.keypoints_to_matrix(keypoints)
        data = np.asarray(db.read_descriptors(image.image_id).data, dtype=np.float32)
        area = np.abs(keypoints[:, 2] * keypoints[:, 5] - keypoints[:, 3] * keypoints[:, 4])
        top = np.argsort(-area, kind="stable")[:COARSE_FEATURES]
        norms = np.linalg.norm(data[top], axis=1, keepdims=True)
        result.append(data[top] / np.maximum(norms, 1e-9))
    db.close()
    return result


def _coarse_votes(descriptors: list[np.ndarray], compared: np.ndarray, progress: Progress) -> np.ndarray:
    """[n, n] number of matches of each pair of photos in `compared` [n, n], from unit descriptors [F, 128] of each."""
    count = len(descriptors)
    votes = np.zeros((count, count), np.int64)

    def compare(i: int) -> None:
        later = i + 1 + np.flatnonzero(compared[i, i + 1 :])
        for chosen in (later[first : first + AT_ONCE] for first in range(0, len(later), AT_ONCE)):
            others = [descriptors[j] for j in chosen]
            similarity = descriptors[i] @ np.concatenate(others).T
            blocks = np.split(similarity, np.cumsum([len(other) for other in others])[:-1], axis=1)
            votes[i, chosen] = [_mutual_matches(block) for block in blocks]

    with ThreadPoolExecutor(cores() if count > RETRIEVED_ABOVE else 1) as pool:
        for done, _ in enumerate(pool.map(compare, range(count)), start=1):
            progress.update("poses: pairing", done, count)
    return votes + votes.T


def _mutual_matches(similarity: np.ndarray) -> int:
    """Number of mutual nearest neighbours that pass Lowe's ratio test; [F, G] dot products of unit descriptors.
    The largest value of each row is overwritten."""
    if min(similarity.shape) < 2:
        return 0
    rows = np.arange(len(similarity))
    best = similarity.argmax(1)
    mutual = similarity.argmax(0)[best] == rows
    first = similarity[rows, best]
    similarity[rows, best] = -1
    return int((mutual & (1 - first <= COARSE_RATIO**2 * (1 - similarity.max(1)))).sum())


def _key(photos: list[Path], lenses: list[Lens | None], how: tuple[int, int], masks: list[Path | None] | None) -> str:
    paths = [*photos, *(mask for mask in masks or () if mask is not None)]
    files = [(str(path.resolve()), path.stat().st_size, path.stat().st_mtime_ns) for path in paths]
    extraction = (MAX_IMAGE_SIDE, MAX_FEATURES, MIN_FEATURES, PEAK_THRESHOLD)
    pairing: tuple[float, ...] = (
        EXHAUSTIVE_BELOW,
        NEIGHBORS,
        COARSE_FEATURES,
        COARSE_MIN_MATCHES,
        COARSE_RATIO,
        PARTNERS,
        MIN_INLIERS,
    )
    if len(photos) > RETRIEVED_ABOVE:
        pairing += (RETRIEVED_ABOVE, RETRIEVED, WORDS)
    return hashlib.sha256(repr((files, lenses, extraction, pairing, how)).encode()).hexdigest()[:12]
