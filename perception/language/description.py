"""The description of an instance in a map: embeddings and colours."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from perception.errors import InputError
from perception.language.colors import PALETTE

Box = tuple[int, int, int, int]


@dataclass
class InstanceDescription:
    """Description of one instance by an encoder.

    embedding: [D] float32, unit: mean of the unit embeddings of all crops; zeros if no photo shows the instance.
    per_view: [V, D] float32, unit, best view first: mean over the crops of one photo.
    palette: [P, 4] float32 rows (L*, a*, b*, share) of the instance's pixels, see `colors.palette`.
    views: [V] names of these photos; boxes: [V] bounding boxes (x0, y0, x1, y1) in their pixels.
    """

    embedding: np.ndarray
    per_view: np.ndarray
    palette: np.ndarray
    views: list[str] = field(default_factory=list)
    boxes: list[Box] = field(default_factory=list)

    @property
    def seen(self) -> bool:
        """Whether any photo shows it."""
        return len(self.views) > 0


def unseen(dim: int) -> InstanceDescription:
    """The description of an instance that no photo shows."""
    none, colours = np.zeros((0, dim), np.float32), np.zeros((PALETTE, 4), np.float32)
    return InstanceDescription(np.zeros(dim, np.float32), none, colours)


def to_arrays(descriptions: Sequence[InstanceDescription], encoder: str) -> dict[str, np.ndarray]:
    """Descriptions as plain arrays for one .npz (no pickles), with the encoder's identity."""
    dim = len(descriptions[0].embedding) if descriptions else 0
    views = [name for d in descriptions for name in d.views]
    boxes = [box for d in descriptions for box in d.boxes]
    return {
        "encoder": np.array(encoder),
        "embeddings": np.array([d.embedding for d in descriptions], np.float32).reshape(len(descriptions), dim),
        "palettes": np.array([d.palette for d in descriptions], np.float32).reshape(len(descriptions), PALETTE, 4),
        "view_counts": np.array([len(d.views) for d in descriptions], np.int64),
        "view_names": np.array(views, dtype=np.str_),
        "view_boxes": np.array(boxes, np.int32).reshape(len(boxes), 4),
        "view_embeddings": np.concatenate([np.zeros((0, dim), np.float32), *(d.per_view for d in descriptions)]),
    }


def from_arrays(arrays: dict[str, np.ndarray]) -> tuple[list[InstanceDescription], str]:
    """Inverse of `to_arrays`: the descriptions and the encoder's identity."""
    descriptions = []
    ends = np.cumsum(arrays["view_counts"]).tolist()
    for n, (start, end) in enumerate(pairwise([0, *ends])):
        names, boxes = arrays["view_names"][start:end].tolist(), arrays["view_boxes"][start:end].tolist()
        embeddings = arrays["embeddings"][n], arrays["view_embeddings"][start:end]
        descriptions.append(InstanceDescription(*embeddings, arrays["palettes"][n], names, [tuple(b) for b in boxes]))
    return descriptions, str(arrays["encoder"])


def chosen_rows(arrays: dict[str, np.ndarray], rows: Iterable[int]) -> dict[str, np.ndarray]:
    """The arrays of some rows of `to_arrays`, in this order; {} of {}."""
    if not arrays:
        return {}
    descriptions, encoder = from_arrays(arrays)
    return to_arrays([descriptions[n] for n in rows], encoder)


def check_encoder(stored: str, used: str) -> None:
    """Raises InputError if the stored embeddings come from another encoder."""
    if stored != used:
        raise InputError(
            f"the map's embeddings were made by '{stored}', the encoder in use is '{used}'; "
            "query with the first, or run: perception upgrade MAP"
        )
