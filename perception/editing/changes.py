"""The computations of the edits, on arrays and descriptions."""

from __future__ import annotations

import numpy as np

from perception.language.description import InstanceDescription, from_arrays, to_arrays

FLOATER_SPREAD = 5.0
"""A Gaussian is a floater when the logarithm of its mean distance to its neighbours exceeds the map's median by this
many robust deviations. As in statistical outlier removal (Rusu et al. 2008), but without its normal model."""
NEIGHBORS = 8


def isolated(means: np.ndarray) -> np.ndarray:
    """[N] bool: points [N, 3] whose mean distance to their NEIGHBORS nearest is an outlier (see FLOATER_SPREAD)."""
    from scipy.spatial import cKDTree

    distance, _ = cKDTree(means).query(means, k=NEIGHBORS + 1, workers=-1)
    level = np.log(np.maximum(distance[:, 1:].mean(axis=1), 1e-12))
    middle = np.median(level)
    spread = 1.4826 * np.median(np.abs(level - middle))  # the standard deviation, for a normal distribution
    return np.asarray(level > middle + FLOATER_SPREAD * max(spread, 1e-3))


def nearest_filled(means: np.ndarray, ids: np.ndarray) -> np.ndarray:
    """ids [N] with −1 replaced by the id of the nearest point that has one."""
    from scipy.spatial import cKDTree

    known = ids >= 0
    _, nearest = cKDTree(means[known]).query(means)
    return np.asarray(np.where(known, ids, ids[known][nearest]))


def joined(descriptions: list[InstanceDescription]) -> InstanceDescription:
    """One description of several instances: all views, their mean embedding, the palette of the one with most views."""
    best = max(descriptions, key=lambda d: len(d.views))
    total = np.sum([d.embedding * len(d.views) for d in descriptions], axis=0)
    norm = float(np.linalg.norm(total))
    return InstanceDescription(
        (total / norm if norm > 0 else best.embedding).astype(np.float32),
        np.concatenate([d.per_view for d in descriptions]),
        best.palette,
        [name for d in descriptions for name in d.views],
        [box for d in descriptions for box in d.boxes],
    )


def described(parts: dict[str, np.ndarray], alive: np.ndarray) -> dict[str, np.ndarray]:
    """The arrays of parts.npz with language rows only for parts that are alive [P] bool, in ascending id."""
    prefix = "language_"
    language = {name[len(prefix) :]: array for name, array in parts.items() if name.startswith(prefix)}
    if not language or alive.all():
        return parts
    descriptions, encoder = from_arrays(language)
    left = [description for description, lives in zip(descriptions, alive, strict=True) if lives]
    return {"ids": parts["ids"], **{prefix + name: a for name, a in to_arrays(left, encoder).items()}}
