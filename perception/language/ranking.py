"""Which instances answer a prompt, and whether any does.

The relevancy of instance i for a prompt t is judged against the map's other instances: with ē the mean embedding of
the map, x_ti = cos(t, e_i − β ē) takes away what all instances share. Whether the best is good enough is told by
probes: a list of things that a scene hardly holds. Their best relevancies in this very map, under this very encoder,
are the distribution of "not here", and
    score_ti = Φ((x_ti − m) / s),   m, s: robust mean and spread over the probes' best relevancies,
so .9 means "fits better than nine in ten things that are not here". Colour words are answered by measured colour, a
label given by the user counts as the instance's name.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from perception.errors import InputError
from perception.language.base import Encoder, check_texts, unit_rows
from perception.language.colors import color_match, color_words, without_color_words
from perception.language.description import InstanceDescription

PRESENT = 0.9  # default least score of a hit: one absent thing in ten is let through
BETA = 0.5  # share of the map's mean embedding that is taken away
COLOR_WEIGHT = 0.1  # relevancy that a full colour match adds


@dataclass(frozen=True)
class Answer:
    """Ranked (position of the instance, score in [0, 1]), best first, and whether the best reaches the threshold."""

    text: str
    hits: list[tuple[int, float]]
    present: bool


class Ranker:
    """A map's descriptions made ready for prompts: one text encoding and one matrix product each."""

    def __init__(
        self,
        descriptions: Sequence[InstanceDescription],
        encoder: Encoder,
        labels: Sequence[str | None] | None = None,
    ) -> None:
        """labels: the user's name of each instance or None; as many as descriptions."""
        if labels is not None and len(labels) != len(descriptions):
            raise InputError(f"labels: expected one per instance ({len(descriptions)}), found {len(labels)}")
        self._encoder = encoder
        self._seen = np.array([d.seen for d in descriptions], bool)
        rows = np.array([d.embedding for d in descriptions], np.float32).reshape(len(descriptions), -1)
        if len(rows) and rows.shape[1] != encoder.dim:
            raise InputError(
                f"embeddings have {rows.shape[1]} dimensions, encoder '{encoder.identity}' {encoder.dim}"
            )
        mean = rows[self._seen].mean(axis=0) if self._seen.any() else np.zeros(encoder.dim, np.float32)
        self._rows = unit_rows(rows - BETA * mean) if self._seen.sum() > 1 else rows
        self._palettes = np.array([d.palette for d in descriptions])
        self._labels = [_words(label) for label in labels] if labels else [""] * len(descriptions)
        self._null = self._probe()

    def rank(self, prompt: str, min_score: float | None = None) -> Answer:
        """Score every instance for one prompt; see the module's docstring."""
        text = check_texts([prompt])[0]
        least = PRESENT if min_score is None else min_score
        if not len(self._rows):
            return Answer(text, [], False)
        scores = self._scores(text)
        order = np.argsort(-scores, kind="stable")
        hits = [(int(i), float(scores[i])) for i in order]
        return Answer(text, hits, hits[0][1] >= least)

    def _scores(self, text: str) -> np.ndarray:
        colors = color_words(text)
        relevancy = self._rows @ self._encoder.encode_texts([without_color_words(text)])[0]
        if colors:
            relevancy = relevancy + COLOR_WEIGHT * (color_match(self._palettes, colors) - 0.5)
        middle, spread = self._null
        scores = np.array([_phi((x - middle) / spread) for x in relevancy])
        scores[~self._seen] = 0.0
        words = _words(text)
        scores[[label == words and label != "" for label in self._labels]] = 1.0
        return scores

    def _probe(self) -> tuple[float, float]:
        """Robust mean and standard deviation of the probes' best relevancies in this map."""
        if not self._seen.any():
            return 0.0, 1.0
        best = (self._encoder.encode_texts(probes()) @ self._rows[self._seen].T).max(axis=1)
        low, middle, high = np.quantile(best, [0.1, 0.5, 0.9])
        return float(middle), max(float(high - low) / 2.563, 1e-6)


def rank(
    prompt: str,
    descriptions: Sequence[InstanceDescription],
    encoder: Encoder,
    labels: Sequence[str | None] | None = None,
    min_score: float | None = None,
) -> Answer:
    """One prompt against a map; for several prompts make a `Ranker` once."""
    return Ranker(descriptions, encoder, labels).rank(prompt, min_score)


def probes() -> list[str]:
    """Things that a scene hardly holds, one a line in probes.txt."""
    return (Path(__file__).parent / "probes.txt").read_text(encoding="utf-8").split("\n")[:-1]


def _phi(z: float) -> float:
    return 0.5 * math.erfc(-z / math.sqrt(2.0))


def _words(text: str | None) -> str:
    return " ".join((text or "").lower().split())
