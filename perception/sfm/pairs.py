"""Which pairs of photos are matched: neighbours by name, and photos whose largest features match."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from itertools import combinations
from pathlib import Path

import numpy as np
from scipy import sparse

from perception.machine import cores
from perception.photos.lens import load_pycolmap
from perception.progress import Progress

EXHAUSTIVE_BELOW = 20
NEIGHBORS = 4
"""Each photo is always matched with this many neighbours by name, as photos are usually taken in order."""
COARSE_FEATURES, COARSE_MIN_MATCHES, COARSE_RATIO, PARTNERS = 256, 4, 0.7, 6
"""Preemptive matching. The strict ratio rejects pairs that share repeated textures only; these give wrong models.
Every photo keeps its PARTNERS best pairs, so that the match graph stays connected."""
RETRIEVED_ABOVE, RETRIEVED, WORDS = 200, 40, 64
"""Of more photos, only the RETRIEVED most similar of each are compared, by a global descriptor of WORDS centres."""
AT_ONCE = 64
"""Photos per matrix product. With one product per pair, threads waited for each other 10 times as long as they ran."""


def select_pairs(database: Path, names: list[str], most: int, progress: Progress) -> list[tuple[int, int]]:
    """All pairs of a small set; else neighbours by name and pairs whose largest features match, of these the `most`
    best pairs of each photo. Indices of names, ascending.

    Preemptive matching (Wu, "Towards Linear-time Incremental Structure from Motion", 3DV 2013, section 3): the
    few largest-scale features predict whether a pair overlaps. This also finds loop closures without a vocabulary.
    Of a large set, not all pairs are compared, but those of `similar_photos`.
    """
    count = len(names)
    if count < EXHAUSTIVE_BELOW:
        return list(combinations(range(count), 2))
    descriptors = largest_features(database, names)
    compared = similar_photos(descriptors) if count > RETRIEVED_ABOVE else [np.arange(count)] * count
    votes = coarse_votes(descriptors, compared, progress)
    pairs = {(i, j) for i in range(count) for j in range(i + 1, min(i + NEIGHBORS + 1, count))}
    for i in range(count):
        run = slice(*votes.indptr[i : i + 2])
        best = np.argsort(-votes.data[run], kind="stable")[:most]
        strong = votes.data[run][best] >= np.where(np.arange(len(best)) < PARTNERS, 1, COARSE_MIN_MATCHES)
        pairs |= {(min(i, j), max(i, j)) for j in votes.indices[run][best[strong]].tolist()}
    return sorted(pairs)


def similar_photos(descriptors: list[np.ndarray]) -> list[np.ndarray]:
    """Of each photo those, ascending and with itself, that are among its RETRIEVED most similar or it among theirs.

    descriptors: those [F, 128] uint8 of each photo. Similarity is the cosine of two VLADs (Jégou et al., "Aggregating
    local descriptors into a compact image representation", CVPR 2010): sums of the residuals of a photo's features to
    the nearest of WORDS k-means centres, each sum at unit length (Arandjelović and Zisserman, CVPR 2013).
    """
    from scipy.cluster.vq import kmeans2

    count, end = len(descriptors), np.cumsum([len(each) for each in descriptors])
    sample = np.sort(np.random.default_rng(0).permutation(end[-1])[: 200 * WORDS])
    if len(sample) < WORDS:
        return [np.arange(count)] * count
    parts = np.split(sample, np.searchsorted(sample, end[:-1]))
    some = [descriptors[i][part - end[i] + len(descriptors[i])] for i, part in enumerate(parts)]
    centres = kmeans2(unit(np.concatenate(some)), WORDS, iter=10, minit="points", seed=0)[0].astype(np.float32)
    half = 0.5 * (centres**2).sum(axis=1)
    vlads = np.zeros((count, WORDS, 128), np.float32)
    for first in range(0, count, AT_ONCE):
        some = descriptors[first : first + AT_ONCE]
        features = unit(np.concatenate(some))
        nearest = (features @ centres.T - half).argmax(axis=1)
        row = np.repeat(np.arange(len(some)), [len(each) for each in some]) * WORDS + nearest
        entries = (np.ones(len(row), np.float32), (row, np.arange(len(row))))
        sums = sparse.csr_matrix(entries, shape=(len(some) * WORDS, len(row))) @ (features - centres[nearest])
        each = sums.reshape(-1, WORDS, 128)
        each /= np.maximum(np.linalg.norm(each, axis=2, keepdims=True), 1e-9)
        vlads[first : first + AT_ONCE] = each
    rows = vlads.reshape(count, -1)
    rows /= np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), 1e-9)
    best = np.zeros((count, min(RETRIEVED + 1, count)), np.int32)
    for first in range(0, count, AT_ONCE):
        order = np.argsort(-(rows[first : first + AT_ONCE] @ rows.T), axis=1, kind="stable")
        best[first : first + AT_ONCE] = order[:, : RETRIEVED + 1]
    ends = best.shape[1] * np.arange(count + 1)
    alike = sparse.csr_matrix((np.ones(best.size, bool), best.ravel(), ends), shape=(count, count))
    alike = sparse.csr_matrix(alike + alike.T + sparse.eye(count, dtype=bool))
    alike.sort_indices()
    return np.split(alike.indices, alike.indptr[1:-1])


def largest_features(database: Path, names: list[str]) -> list[np.ndarray]:
    """Descriptors [F, 128] uint8 of the COARSE_FEATURES largest features of each photo."""
    return [data[by_size[:COARSE_FEATURES]] for _, data, by_size in stored_features(database, names)]


def stored_features(database: Path, names: list[str]) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Of each photo's features: pixels [F, 2], descriptors [F, 128] uint8, and their order by size, largest first."""
    pycolmap = load_pycolmap()
    with pycolmap.Database.open(database) as db:
        for name in names:
            image = db.read_image_with_name(name)
            keypoints = db.read_keypoints(image.image_id)
            keypoints = keypoints if isinstance(keypoints, np.ndarray) else pycolmap.keypoints_to_matrix(keypoints)
            area = np.abs(keypoints[:, 2] * keypoints[:, 5] - keypoints[:, 3] * keypoints[:, 4])
            data = np.asarray(db.read_descriptors(image.image_id).data)
            yield keypoints[:, :2].astype(np.float64), data, np.argsort(-area, kind="stable")


def unit(descriptors: np.ndarray) -> np.ndarray:
    """Descriptors [F, 128] as float32 of unit length."""
    data = descriptors.astype(np.float32)
    return np.asarray(data / np.maximum(np.linalg.norm(data, axis=1, keepdims=True), 1e-9))


def coarse_votes(descriptors: list[np.ndarray], compared: list[np.ndarray], progress: Progress) -> sparse.csr_matrix:
    """[n, n] number of matches of each photo with those of `compared`, from descriptors [F, 128] uint8 of each.
    The columns of each row ascend."""
    count = len(descriptors)
    of_photo = lru_cache(RETRIEVED_ABOVE)(lambda i: unit(descriptors[i]))

    def compare(i: int) -> sparse.csr_matrix:
        later, found = compared[i][compared[i] > i], list[int]()
        for chosen in (later[first : first + AT_ONCE] for first in range(0, len(later), AT_ONCE)):
            others = [of_photo(j) for j in chosen.tolist()]
            similarity = of_photo(i) @ np.concatenate(others).T
            blocks = np.split(similarity, np.cumsum([len(other) for other in others])[:-1], axis=1)
            found += [len(mutual_matches(block)) for block in blocks]
        votes = np.array(found, np.int64)
        more = votes > 0
        return sparse.csr_matrix((votes[more], (np.zeros(more.sum(), int), later[more])), shape=(1, count))

    rows = []
    with ThreadPoolExecutor(cores() if count > RETRIEVED_ABOVE else 1) as pool:
        for done, row in enumerate(pool.map(compare, range(count)), start=1):
            rows.append(row)
            progress.update("poses: pairing", done, count)
    votes = sparse.vstack(rows, format="csr")
    votes = sparse.csr_matrix(votes + votes.T)
    votes.sort_indices()
    return votes


def mutual_matches(similarity: np.ndarray, ratio: float = COARSE_RATIO) -> np.ndarray:
    """[M, 2] mutual nearest neighbours that pass Lowe's ratio test; [F, G] dot products of unit descriptors.
    The largest value of each row is overwritten."""
    if min(similarity.shape) < 2:
        return np.empty((0, 2), np.int64)
    rows = np.arange(len(similarity))
    best = similarity.argmax(1)
    mutual = similarity.argmax(0)[best] == rows
    first = similarity[rows, best]
    similarity[rows, best] = -1
    good = mutual & (1 - first <= ratio**2 * (1 - similarity.max(1)))
    return np.stack([rows[good], best[good]], axis=1)
