"""The words of a map: its embeddings and their encoder, loaded at the first prompt, and rankings kept for the next."""

from __future__ import annotations

import sys
import threading
from collections import OrderedDict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from perception.errors import InputError
from perception.io.instance_index import InstanceIndex
from perception.io.map_files import MapFiles
from perception.io.store import GaussianMap
from perception.language.base import Encoder
from perception.language.encoders import make_encoder

if TYPE_CHECKING:
    from perception.language.ranking import Answer, Ranker

Encoders = Callable[[str], Encoder | None]
REMEMBERED = 256
"""Prompts whose ranking is kept: planners ask the same thing again and again."""


class Words:
    """Ranks the instances of an opened map for prompts; thread-safe."""

    def __init__(
        self,
        held: GaussianMap | MapFiles,
        path: Path | None,
        encoders: Encoders | None,
        index: Callable[[], InstanceIndex],
    ) -> None:
        """index: gives the points of the instances when a prompt first names a shape."""
        self._held, self._path, self._index = held, path, index
        self._encoders = encoders or make_encoder
        self._lock = threading.RLock()
        self._made: Ranker | InputError | None = None
        self._ranked: OrderedDict[tuple[str, float | None], Answer] = OrderedDict()

    @property
    def problem(self) -> str | None:
        """Why prompts cannot be ranked (no embeddings, no encoder), one line; None when they can."""
        try:
            _ = self.ranker
        except InputError as error:
            return str(error)
        return None

    def rank(self, text: str, min_score: float | None) -> Answer:
        """See `perception.language.ranking`; InputError when the map has no words."""
        key = (" ".join(text.split()), min_score)
        with self._lock:
            if key in self._ranked:
                self._ranked.move_to_end(key)
                return self._ranked[key]
        ranker = self.ranker
        with _one_thread():
            answer = ranker.rank(text, min_score)
        with self._lock:
            self._ranked[key] = answer
            if len(self._ranked) > REMEMBERED:
                self._ranked.popitem(last=False)
        return answer

    @property
    def ranker(self) -> Ranker:
        """Made once; InputError when the map has no words, the same one every time."""
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
        from perception.language.description import check_encoder, from_arrays
        from perception.language.ranking import Ranker

        if not self._held.language:
            raise InputError(
                f"{self._path}: holds no language embeddings; map again with an encoder (language.encoder=…)"
            )
        descriptions, identity = from_arrays(self._held.language)
        spec = self._held.info.get("config", {}).get("language", {}).get("encoder", "auto")
        encoder = self._encoders("conse" if spec == "auto" else spec)
        if encoder is None:
            raise InputError(f"{self._path}: was mapped without an encoder; map again with language.encoder=conse")
        check_encoder(identity, encoder.identity)
        labels = [entry.get("label") for entry in self._held.instances]
        return Ranker(descriptions, encoder, labels, self._shapes)

    def _shapes(self) -> np.ndarray:
        from perception.instances.shapes import shape_scores

        index = self._index()
        owners = np.repeat(index.ids, np.diff(index.starts))
        poses = self._held.cameras.get("camera_from_world", np.zeros((0, 4, 4)))
        return shape_scores(index.points, owners, [entry["id"] for entry in self._held.instances], poses)


@contextmanager
def _one_thread() -> Iterator[None]:
    """A prompt is a few tokens: torch's second thread costs more than it brings (10 ms of one processor against 24 of
    two, and far more when the machine is busy). Servers answer several prompts side by side instead."""
    torch = sys.modules.get("torch")
    before = 1 if torch is None else torch.get_num_threads()
    if torch is None or before == 1:
        yield
        return
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
