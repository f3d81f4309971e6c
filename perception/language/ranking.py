"""Which instances answer a prompt, and whether any does.

The relevancy of instance i for a prompt t is judged against the map's other instances: with ē the mean
embedding of the map, x_ti = cos(t, e_i − β ē) / σ_t takes away what all instances share, and σ_t, the spread
of cos(t, ·) over the encoder's reference words, makes specific and vague prompts comparable. Whether the
best is good enough is told by probes: LERF's canonical phrases (object, things, stuff, texture) and a list
of things that a scene seldom holds. Their best relevancies in this very map, under this very encoder, are
the distribution of "not here", and
    score_ti = Φ((x_ti − m) / s),   m: their median, s: such that their 80 % quantile scores .8,
so .8 means "fits better than four probes in five". Colour words are answered by measured colour; a label
given by the user counts as the instance's name.
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

PRESENT = 0.8  # default least score of a hit; the probes are harder than the usual absent thing (see bench)
QUANTILE, NORMAL_QUANTILE = 0.8, 0.8416  # Φ(.8416) = .8
BETA = 0.5  # share of the map's mean embedding that is taken away
COLOR_WEIGHT = 0.1  # relevancy between no and a full colour match
LABEL_MARGIN = 2.0  # a label means the prompt from 2 + Φ⁻¹(score) spreads above what probes mean to it


@dataclass(frozen=True)
class Answer:
    """Ranked (position of the instance, score in [0, 1]), best first, and whether the best reaches the
    threshold.
    """

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
        rows = np.array([d.embedding for d in descriptions], np.float32).reshape(
            len(descriptions), len(descriptions[0].embedding) if descriptions else encoder.dim
        )
        if rows.shape[1] != encoder.dim:
            raise InputError(
                f"embeddings have {rows.shape[1]} dimensions, those of encoder '{encoder.identity}' {encoder.dim}"
            )
        mean = rows[self._seen].mean(axis=0) if self._seen.any() else np.zeros(encoder.dim, np.float32)
        self._rows = unit_rows(rows - BETA * mean) if self._seen.sum() > 1 else rows
        self._palettes = np.array([d.palette for d in descriptions])
        self._names = [_words(label) for label in labels or [None] * len(descriptions)]
        self._named = np.flatnonzero([name != "" for name in self._names])
        texts = self._encode(probes())
        self._usual_spread = float(self._spreads(texts).mean())
        self._null = self._best_of_absent(texts)
        self._label_rows = self._encode([self._names[i] for i in self._named])
        self._label_null = _middle_and_spread(self._label_rows @ texts.T)

    def over(self, descriptions: Sequence[InstanceDescription]) -> Ranker:
        """The same encoder over other instances, without labels."""
        return Ranker(descriptions, self._encoder)

    def rank(self, prompt: str, min_score: float | None = None) -> Answer:
        """Score every instance for one prompt; see the module's docstring."""
        text = check_texts([prompt])[0]
        least = PRESENT if min_score is None else min_score
        if not len(self._rows):
            return Answer(text, [], False)
        scores = self._scores(text)
        hits = [(int(i), float(scores[i])) for i in np.argsort(-scores, kind="stable")]
        return Answer(text, hits, hits[0][1] >= least)

    def _scores(self, text: str) -> np.ndarray:
        colors = color_words(text)
        row = self._encode([without_color_words(text)])
        relevancy = self._relevancy(row)[0]
        if colors:
            relevancy = relevancy + COLOR_WEIGHT * (color_match(self._palettes, colors) - 0.5)
        middle, spread = self._null
        scores = np.array([_phi((x - middle) / spread) for x in relevancy])
        scores[~self._seen] = 0.0
        return self._with_labels(scores, text)

    def _with_labels(self, scores: np.ndarray, text: str) -> np.ndarray:
        """The better of picture and label: 1 where the label is the prompt, Φ(z − margin) where it means
        it.
        """
        if not len(self._named):
            return scores
        z = (self._label_rows @ self._encode([text])[0] - self._label_null[0]) / self._label_null[1]
        for n, i in enumerate(self._named):
            same = self._names[i] == _words(text)
            scores[i] = 1.0 if same else max(scores[i], _phi(float(z[n]) - LABEL_MARGIN))
        return scores

    def _relevancy(self, texts: np.ndarray) -> np.ndarray:
        """x [T, I] of text embeddings [T, D] in units of a usual prompt's spread."""
        return (texts @ self._rows.T) * (self._usual_spread / self._spreads(texts))[:, None]

    def _spreads(self, texts: np.ndarray) -> np.ndarray:
        references = self._encoder.references
        if references is None:
            return np.ones(len(texts))
        return np.maximum((texts @ references.T).std(axis=1), 1e-3)

    def _encode(self, texts: Sequence[str]) -> np.ndarray:
        """Mean over the encoder's templates, unit rows [T, D]."""
        if not len(texts):
            return np.zeros((0, self._encoder.dim), np.float32)
        templates = self._encoder.templates
        filled = [template.replace("{}", text) for template in templates for text in texts]
        rows = self._encoder.encode_texts(filled).reshape(len(templates), len(texts), -1)
        return unit_rows(rows.mean(axis=0))

    def _best_of_absent(self, probe_rows: np.ndarray) -> tuple[float, float]:
        """Median of the probes' best relevancies in this map, and the spread that puts their quantile at
        .8.
        """
        if not self._seen.any():
            return 0.0, 1.0
        best = self._relevancy(probe_rows)[:, self._seen].max(axis=1)
        middle, high = np.quantile(best, [0.5, QUANTILE])
        return float(middle), max(float(high - middle) / NORMAL_QUANTILE, 1e-6)


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


def _middle_and_spread(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean and standard deviation of each row."""
    return x.mean(axis=1), np.maximum(x.std(axis=1), 1e-6)


def _phi(z: float) -> float:
    return 0.5 * math.erfc(-z / math.sqrt(2.0))


def _words(text: str | None) -> str:
    return " ".join((text or "").lower().split())
