"""Ask a finished map: text in, ranked 3D instances out."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from perception.errors import InputError
from perception.io.store import GaussianMap, read_map
from perception.types import OrientedBox

if TYPE_CHECKING:
    from perception.language.ranking import Ranker


@dataclass(frozen=True)
class Hit:
    """One instance that answers a prompt. points [P, 3] float32 and centroid [3] in the map frame; score in [0, 1];
    views: the photos that show it best."""

    instance_id: int
    score: float
    points: np.ndarray
    centroid: np.ndarray
    obb: OrientedBox
    label: str | None = None
    views: tuple[str, ...] = ()

    def to_json(self) -> dict[str, Any]:
        return {
            "instance_id": self.instance_id,
            "score": round(float(self.score), 4),
            "num_points": len(self.points),
            "centroid": [float(x) for x in self.centroid],
            "obb": self.obb.to_json(),
            "label": self.label,
            "views": list(self.views),
        }


class LoadedMap:
    """A map opened for questions. Encoders load on the first prompt."""

    def __init__(self, gmap: GaussianMap, path: Path | None = None):
        self.gmap = gmap
        self.path = path

    @property
    def frame(self) -> str:
        return str(self.gmap.info.get("frame", "map"))

    @property
    def metric(self) -> bool:
        return bool(self.gmap.info.get("metric", False))

    @property
    def instances(self) -> list[dict[str, Any]]:
        return self.gmap.instances

    @cached_property
    def _ranker(self) -> Ranker:
        from perception.language import make_encoder
        from perception.language.description import check_encoder, from_arrays
        from perception.language.ranking import Ranker

        if not self.gmap.language:
            raise InputError(
                f"{self.path}: holds no language embeddings; map again with an encoder (language.encoder=…)"
            )
        descriptions, identity = from_arrays(self.gmap.language)
        spec = self.gmap.info.get("config", {}).get("language", {}).get("encoder", "auto")
        encoder = make_encoder("conse" if spec == "auto" else spec)
        if encoder is None:
            raise InputError(f"{self.path}: was mapped without an encoder; map again with language.encoder=conse")
        check_encoder(identity, encoder.identity)
        labels = [entry.get("label") for entry in self.instances]
        return Ranker(descriptions, encoder, labels, self._shapes)

    def _shapes(self) -> np.ndarray:
        from perception.instances.shapes import shape_scores

        ids = [entry["id"] for entry in self.instances]
        poses = self.gmap.cameras.get("camera_from_world", np.zeros((0, 4, 4)))
        return shape_scores(self.gmap.means, self.gmap.instance_ids, ids, poses)

    def likely_names(self, count: int = 3) -> list[list[str]]:
        """The likeliest names of every instance, best first, in the order of `instances`."""
        from perception.language.naming import likely_names

        return likely_names(self._ranker, count) if self.instances else []

    def query(self, text: str, top_k: int = 3, min_score: float | None = None) -> list[Hit]:
        """The instances that answer `text`, best first, at most top_k; empty when it is not present.

        With `min_score` the encoder's own judgement of presence is replaced by that bound on the score.
        """
        if not text.strip():
            raise InputError('query: the text is empty; ask for a thing, such as "red mug"')
        if top_k < 1:
            raise InputError(f"query: top_k is {top_k}, expected at least 1")
        if not self.instances:
            return []
        answer = self._ranker.rank(text, min_score)
        if not answer.present:
            return []
        chosen = answer.hits if min_score is None else [(i, s) for i, s in answer.hits if s >= min_score]
        return [self.hit(i, s) for i, s in chosen[:top_k]]

    def hit(self, instance: int, score: float = 1.0) -> Hit:
        """Instance number `instance` (its place in instances.json) as a Hit."""
        entry = self.instances[instance]
        box = entry["obb"]
        views: tuple[str, ...] = ()
        if self.gmap.language:
            counts = self.gmap.language["view_counts"]
            stop = int(counts[: instance + 1].sum())
            views = tuple(str(name) for name in self.gmap.language["view_names"][stop - int(counts[instance]) : stop])
        return Hit(
            entry["id"],
            score,
            self.gmap.means[self.gmap.instance_ids == entry["id"]],
            np.array(entry["centroid"]),
            OrientedBox(np.array(box["center"]), np.array(box["rotation"]), np.array(box["extent"])),
            entry.get("label"),
            views,
        )


def load_map(path: str | Path) -> LoadedMap:
    """Opens a map directory. Raises InputError when it is none, damaged, or of another format version."""
    path = Path(path)
    return LoadedMap(read_map(path), path)
