"""The computations of the edits, on arrays and descriptions."""

from __future__ import annotations

import numpy as np

from perception.language.description import InstanceDescription, from_arrays, to_arrays


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
