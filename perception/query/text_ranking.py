"""Ranks the instances of a map for prompts; embeddings and encoder are loaded at the first prompt."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from functools import cached_property, lru_cache

import numpy as np

from perception.errors import InputError
from perception.frame.gravity import Gravity
from perception.language.base import Encoder
from perception.language.description import check_encoder, from_arrays
from perception.language.printed import Printed
from perception.language.shapes import plane_normal, shape_scores
from perception.machine import torch_on_one_thread
from perception.map.map import Map
from perception.query.ranking import Ranker, Ranking
from perception.query.relations import LevelBoxes, ranked
from perception.query.where import tidy

Encoders = Callable[[str], Encoder | None]
SAMPLES, TRIM = 1000, 0.05  # points per instance, and share of them left out, when its sides are measured
REMEMBERED = 256  # number of prompts whose ranking is cached, because planners repeat the same prompts


class TextRanking:
    """Ranks the instances of `gmap` for prompts; thread-safe. `encoders` makes an encoder from its name. names: labels
    that the user gave to other instances as well, which stood in the map once."""

    def __init__(self, gmap: Map, encoders: Encoders, names: Sequence[str | None] = ()) -> None:
        self._gmap, self._encoders, self._names = gmap, encoders, names
        self._lock = threading.RLock()
        self._made: Ranker | InputError | None = None
        self._remembered = lru_cache(REMEMBERED)(self._ranked)

    def rank(self, text: str) -> Ranking:
        """The ranking of `perception.query.ranking`. Without embeddings or encoder, the instances with this label.

        Raises InputError when the map has no embeddings or encoder and no instance has, or had, the label `text`.
        """
        try:
            _ = self.ranker
        except InputError:
            named = self._by_label(text)
            if named or any(tidy(name or "") == tidy(text) for name in self._names):
                return named
            raise
        rows, scores = self._remembered(text)
        return list(zip(rows.tolist(), scores.tolist(), strict=True))

    def _ranked(self, text: str) -> tuple[np.ndarray, np.ndarray]:
        """The ranking as two arrays, which take a tenth of the memory: many prompts are remembered."""
        with torch_on_one_thread():
            hits = self.ranker.rank(text) if self._by_label(text) else ranked(self.ranker, self.boxes, text)
        return np.array([row for row, _ in hits], np.int32), np.array([score for _, score in hits])

    def _by_label(self, text: str) -> Ranking:
        """The instances that the user labelled `text`. Needs no embeddings and no encoder."""
        return [(n, 1.0) for n, e in enumerate(self._gmap.instances) if tidy(e.get("label") or "") == tidy(text)]

    @property
    def ranker(self) -> Ranker:
        """Made once; raises the same InputError every time when the map has no embeddings or encoder."""
        with self._lock:
            if self._made is None:
                try:
                    self._made = self._make()
                except InputError as error:
                    self._made = error
            if isinstance(self._made, InputError):
                raise InputError(str(self._made))
            return self._made

    def _make(self) -> Ranker:
        if not self._gmap.language:
            todo = "name things by perception label, or map again with --set language.encoder=conse or clip:FOLDER"
            raise InputError(f"{self._gmap.path}: holds no language embeddings; {todo}")
        descriptions, identity = from_arrays(self._gmap.language)
        encoder = encoder_of(self._gmap, self._encoders)
        if encoder is None:
            raise InputError(f"{self._gmap.path}: was mapped without an encoder; map again with language.encoder=conse")
        check_encoder(identity, encoder.identity)
        labels = [entry.get("label") for entry in self._gmap.instances]
        sizes = extents(self._gmap) if self._gmap.metric else None
        return Ranker(descriptions, encoder, labels, self._shapes, printed_on(self._gmap), sizes)

    @cached_property
    def boxes(self) -> LevelBoxes | None:
        """The instances' boxes with z up; None where up is not known."""
        return LevelBoxes.of(self._gmap)

    def _shapes(self) -> np.ndarray:
        gmap, index = self._gmap, self._gmap.index
        gravity = Gravity.from_json(gmap.info["gravity"]) if gmap.info.get("gravity") else None
        owners, wanted = np.repeat(index.ids, np.diff(index.starts)), [entry["id"] for entry in gmap.instances]
        return shape_scores(index.points, owners, wanted, gmap.poses, gravity)


def encoder_name(gmap: Map) -> str:
    """The encoder that the map was made with, as `make_encoder` takes it."""
    spec = gmap.setting("language", "encoder", "auto")
    return "conse" if spec == "auto" else str(spec)


def encoder_of(gmap: Map, encoders: Encoders) -> Encoder | None:
    """The encoder that the map was made with, None if with none; InputError when it cannot be made."""
    try:
        return encoders(encoder_name(gmap))
    except InputError as error:
        raise InputError(f"{gmap.path}: config.language.encoder: {error}") from error


def extents(gmap: Map) -> np.ndarray:
    """[I, 3] sides of the instances along the axes of their boxes, or thinner: along the normal of their best plane;
    without the outer TRIM of the points at either end, which stray in a map, and scaled as if spread evenly.
    """
    sides = np.zeros((len(gmap.instances), 3))
    for n, entry in enumerate(gmap.instances):
        points = gmap.index.of(entry["id"]).astype(np.float64)
        points = points[:: len(points) // SAMPLES + 1]
        if len(points):
            axes = np.vstack([entry["obb"]["rotation"], plane_normal(points)])
            a, b, c, thickness = np.diff(np.quantile(points @ axes.T, [TRIM, 1 - TRIM], axis=0), axis=0)[0]
            sides[n] = np.array([a, b, min(c, thickness)]) / (1 - 2 * TRIM)
    return sides


def printed_on(gmap: Map) -> Printed | None:
    """The texts printed on the map's instances; None if the map was made without reading texts."""
    read = gmap.info.get("instances", {}).get("texts") is not None
    return Printed([entry.get("texts", []) for entry in gmap.instances]) if read else None
