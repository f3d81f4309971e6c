"""Ranks instances for a prompt, and decides whether any of them answers it.

Symbols, of a prompt t and an instance i of a map:

    t_k, e_ik   their embeddings in part k of the encoder's embedding, of length 1; w_k: weight of that part
    ē_k         mean of e_ik over the instances that a photo shows;  β: share of it that is subtracted (BETA)
    σ_tk        standard deviation of cos(t_k, r) over the encoder's reference words r: large for vague prompts
    σ_k         mean of σ_tk over the probes: objects that are rarely in a scene (probes.txt)
    m, s        median of the probes' best relevancies in this map, and their scale: their 80 % quantile has Φ(z) = .8
    a, b        the encoder's calibration, so that the best score is the probability that the thing is there

The relevancy is relative to what all instances share, and z to what an absent object reaches:

    x_ti = Σ_k w_k (σ_k / σ_tk) cos(t_k, e_ik − β ē_k)
    z_ti = (x_ti − m) / s + bonuses
    score_ti = (1 − LAPSE) Φ(a z_ti + b)

The bonuses compare what is measured with what the prompt names: its colour, its shape (see `shape_words`), the texts
printed on it (see `printed`; a quoted text must be there), and, for household things, usual size (see `household`).
Further rules:

    at most 2 PRESENT p for encoders with canonical phrases c (LERF's "object", "thing" …), where with the model's own
        scale κ   p_ti = 1 / (1 + exp κ (max_c cos(c, e_i) − cos(t, e_i)))
    at least (1 − LAPSE) Φ((cos(t, l_i) − m_i) / s_i − LABEL_MARGIN) for a label l_i of the user, where m_i and s_i are
        mean and standard deviation of cos(p, l_i) over the probes p, or over texts that encoders may not understand and
        find all alike (unread.txt), whichever of the two asks for more;   1 if the label equals the prompt
    a prompt of which the encoder knows no word (`Encoder.reads`) has z_ti = the bonuses, and is like no label
    z_ti is less by NONSENSE_WEIGHT times what a prompt is more like texts without meaning (nonsense.txt) than any probe
    where a prompt describes a thing by a relation (`relations`) or its print, labels count only where that is true

An instance answers if it scores PRESENT or more and its Φ⁻¹(score / (1 − LAPSE)) is at most BESIDE below the best:
"chair" has four answers, "red chair" one. All of this is relative to one map. `Prepared` holds what a prompt needs of a
map's instances, so those of many maps are ranked together by one `Scorer`, each with the score that it has in its own.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from statistics import NormalDist
from typing import TypeVar

import numpy as np

from perception.errors import InputError
from perception.language.base import Encoder, Part, check_texts, like_nonsense, normal_cdf, reading_of, unit_rows
from perception.language.colors import COLOR_WORDS, NOT, color_share, color_words, match_of_shares, without_color_words
from perception.language.description import InstanceDescription
from perception.language.household import household_thing, size_misfits
from perception.language.printed import Printed, quoted_text
from perception.language.shape_words import HINTS, KINDS, STUFF, shape_kind
from perception.query.where import tidy

PRESENT = 0.8  # default minimum score of an answer; the probes are harder than typical absent objects
LAPSE = 0.02  # share of prompts that mislead however large z is: 4 of 275 whose best hit had z > 2 were absent
BESIDE = 0.6  # largest difference in Φ⁻¹(score) to the best hit, of another one that answers the prompt too
QUANTILE, NORMAL_QUANTILE = 0.8, 0.8416  # Φ(.8416) = .8
BETA = 0.5  # fraction of the map's mean embedding that is subtracted
SHAPE_WEIGHT = 6.0  # difference in z between no and full match of shape, for kinds that geometry alone decides
SHAPE_HINT = 2.0  # added to z for a full match of the kinds in HINTS, where shape is only supporting evidence
COLOR_WEIGHT = 3.0  # difference in z between no and full match of colour: separates two objects of one kind
QUOTED_WEIGHT = 6.0  # difference in z between an instance that bears the quoted text and one that does not
QUOTED_LEAST = 0.5  # factor of the score of an instance that bears nothing of the quoted text, so it is no answer
PRINTED_WEIGHT = 4.0  # added to z if all words of the prompt are printed on the instance
SIZE_WEIGHT = 2.0  # subtracted from z per factor of two that a thing is too small or too large, at most twice
THICK_WEIGHT = 1.0  # the same where it is too thick
NONSENSE_WEIGHT = 20.0  # subtracted from z per unit of cosine by which a prompt is more like nonsense than any probe
STUFF_WEIGHT = 2.0  # subtracted from z of a floor, wall or ceiling for a household thing
LABEL_MARGIN = 2.0  # subtracted from z of a label, where z is the similarity of label and prompt relative to the probes
LEAST_SPREAD = 1e-3  # of σ_tk, so that no text divides by zero
NO_GAINS = np.zeros((2, 1))

T = TypeVar("T")
Ranking = list[tuple[int, float]]  # (index of the instance, score in [0, 1]), all instances, best first
_quantiles = np.vectorize(NormalDist().inv_cdf, otypes=[float])
"""Φ⁻¹ of each number. SciPy has it too, but takes longer to import than a prompt to answer."""


def answering(hits: Sequence[tuple[T, float]], min_score: float | None = None) -> list[tuple[T, float]]:
    """Those of `hits`, best first, that answer the prompt; with `min_score` those with at least this score."""
    if min_score is None:
        min_score = float(least_score(np.array(max((score for _, score in hits), default=0.0))))
    return [(i, score) for i, score in hits if score >= min_score]


def least_score(best: np.ndarray) -> np.ndarray:
    """The least score of an answer, given the best score of each map."""
    return np.maximum(PRESENT, (1 - LAPSE) * normal_cdf(evidence_of(best) - BESIDE))


def evidence_of(score: np.ndarray) -> np.ndarray:
    """a z + b of scores, at most 6, also for labels that equal the prompt."""
    return _quantiles(np.clip(np.asarray(score) / (1 - LAPSE), 1e-9, 1 - 1e-9))


@dataclass(frozen=True)
class Prepared:
    """What prompts need of I instances, of one map or of several after each other, where the user named L of them.

    seen [I] bool: whether a photo shows it. null [I, 2]: m and s of its map. colors [I, C]: its share of each of
    COLOR_WORDS. sides [I, 3]: of its box, metres; NaN without metric scale. plain [I, D] float32: its embedding;
    compared: of each part k, [I, d] float32, its direction of e_ik − β ē_k. labels: by the user, or None. label_rows
    [L, D] float32, label_null [L, 2]: embeddings l_i, and their m_i and s_i.
    """

    seen: np.ndarray
    null: np.ndarray
    colors: np.ndarray
    sides: np.ndarray
    plain: np.ndarray
    compared: list[np.ndarray]
    labels: Sequence[str | None]
    label_rows: np.ndarray
    label_null: np.ndarray


class TextEncoder:
    """An encoder's side of the formulas: embeddings, parts, and spreads σ of texts."""

    def __init__(self, encoder: Encoder) -> None:
        self.encoder, self.reading = encoder, reading_of(encoder)
        parts = self.reading.parts or (Part(encoder.dim),)
        starts = [0, *(part.stop for part in parts)]
        self.parts = [(slice(start, part.stop), part) for start, part in zip(starts, parts, strict=False)]
        self.canonical = self.embed(self.reading.canonical)
        known, nonsense = probes(), lines("nonsense.txt") if self.parts[0][1].references is not None else []
        rows = self.embed([*known, *nonsense])  # at once: a long list is kept in the user's cache
        self.probes, self._nonsense = rows[: len(known)], rows[len(known) :]
        self._usual = [float(self._spreads(self.probes, *part).mean()) for part in self.parts]

    def reads(self, text: str) -> bool:
        """Whether the encoder knows any word of the text."""
        return not hasattr(self.encoder, "reads") or self.encoder.reads(text)

    def embed(self, texts: Sequence[str]) -> np.ndarray:
        """Text embeddings, averaged over the encoder's templates; unit rows [T, D]."""
        if not len(texts):
            return np.zeros((0, self.encoder.dim), np.float32)
        templates = self.encoder.templates
        filled = [template.replace("{}", text) for template in templates for text in texts]
        rows = self.encoder.encode_texts(filled).reshape(len(templates), len(texts), -1)
        return unit_rows(rows.mean(axis=0))

    def relevancy(self, texts: np.ndarray, compared: list[np.ndarray]) -> np.ndarray:
        """x [T, I] of text embeddings [T, D] and the instances' `Prepared.compared`."""
        x = np.zeros((len(texts), len(compared[0])))
        for (columns, part), rows, usual in zip(self.parts, compared, self._usual, strict=True):
            fits = unit_rows(texts[:, columns]) @ rows.T
            x += part.weight * fits * (usual / self._spreads(texts, columns, part))[:, None]
        return x

    def compared(self, rows: np.ndarray, seen: np.ndarray) -> list[np.ndarray]:
        """Of each part, the unit rows [I, d] of e_ik − β ē_k, given the embeddings [I, D] and which are seen [I]."""
        parts = []
        for columns, _ in self.parts:
            own = rows[:, columns]
            if seen.sum() > 1:
                mean = unit_rows(rows[seen][:, columns]).mean(axis=0)
                own = own - BETA * mean * np.linalg.norm(own, axis=1, keepdims=True)
            parts.append(unit_rows(own))
        return parts

    def null(self, compared: list[np.ndarray], seen: np.ndarray) -> tuple[float, float]:
        """m and s of one map."""
        if not seen.any():
            return 0.0, 1.0
        best = self.relevancy(self.probes, compared)[:, seen].max(axis=1)
        middle, high = np.quantile(best, [0.5, QUANTILE])
        return float(middle), max(float(high - middle) / NORMAL_QUANTILE, 1e-6)

    def label_null(self, rows: np.ndarray) -> np.ndarray:
        """m_i and s_i [L, 2] of labels with the embeddings [L, D]."""
        if not len(rows):
            return np.zeros((0, 2), np.float32)
        fits = [rows @ texts.T for texts in (self.probes, self.embed(lines("unread.txt")))]
        nulls = [np.stack([fit.mean(axis=1), np.maximum(fit.std(axis=1), 1e-6)], axis=1) for fit in fits]
        known, unread = (null @ [1.0, LABEL_MARGIN] for null in nulls)
        return np.where((known >= unread)[:, None], *nulls)

    def meaningless(self, texts: np.ndarray) -> np.ndarray:
        """`like_nonsense` of text embeddings [T, D] in the first part [T]; 0 for encoders without reference words."""
        return like_nonsense(*(unit_rows(rows[:, self.parts[0][0]]) for rows in (texts, self.probes, self._nonsense)))

    def _spreads(self, texts: np.ndarray, columns: slice, part: Part) -> np.ndarray:
        """σ_tk [T] of text embeddings [T, D] in one part; 1 where the encoder has no reference words for it."""
        if part.references is None:
            return np.ones(len(texts))
        return np.maximum((unit_rows(texts[:, columns]) @ part.references.T).std(axis=1), LEAST_SPREAD)


class Scorer:
    """Scores prepared instances for prompts. A prompt costs one text encoding and one matrix product.

    shapes: returns scores [I, K] of `shape_words.KINDS`, called at the first prompt; None: not known. printed: texts on
    the instances; None: not looked for. reads [I] bool: instances of maps whose printed texts were looked for, where
    that is not all of them.
    """

    def __init__(
        self,
        encoder: TextEncoder,
        prepared: Prepared,
        shapes: Callable[[], np.ndarray] | None = None,
        printed: Printed | None = None,
        reads: np.ndarray | None = None,
    ) -> None:
        self.encoder, self.prepared, self.seen = encoder, prepared, prepared.seen
        self._measure_shapes, self._printed, self._reads = shapes, printed, reads
        names = [tidy(label or "") for label in prepared.labels]
        self._named = np.flatnonzero([name != "" for name in names])
        self._names = [names[i] for i in self._named]

    @cached_property
    def shapes(self) -> np.ndarray | None:
        """Scores [I, K] of `shape_words.KINDS`; None if shapes are not available."""
        return None if self._measure_shapes is None else self._measure_shapes()

    def rank(self, prompt: str, gains: np.ndarray = NO_GAINS) -> Ranking:
        """Scores every instance for one prompt; see the module docstring. gains: of `scores`."""
        scores = self.scores(prompt, gains)
        return [(int(i), float(scores[i])) for i in np.argsort(-scores, kind="stable")]

    def scores(self, prompt: str, gains: np.ndarray = NO_GAINS) -> np.ndarray:
        """Scores [I] in [0, 1] of all instances for one prompt. gains [2, I]: what is added to z; how much less that is
        than the most in the map, which is subtracted from the evidence of labels."""
        text = check_texts([prompt])[0]
        if not len(self.seen):
            return np.zeros(0)
        quoted = quoted_text(text) if self._printed is not None else None
        if quoted is None:
            return self._scores(text, None, gains)
        scores = self._scores(*quoted, gains)
        scores[self._named[[name == tidy(text) for name in self._names]]] = 1.0
        if self._reads is None or self._reads.all():
            return scores
        return np.where(self._reads, scores, self._scores(text, None, gains))

    def similarity(self, texts: Sequence[str]) -> np.ndarray:
        """Cosine of each text's embedding with each instance's [T, I] in [−1, 1], as in the paper; −1 if unseen."""
        return np.where(self.seen, self.encoder.embed(texts) @ self.prepared.plain.T, -1.0)

    def relevancy(self, texts: Sequence[str]) -> np.ndarray:
        """Relevancy x of each text for each instance [T, I], without the bonuses and labels."""
        return self.encoder.relevancy(self.encoder.embed(texts), self.prepared.compared)

    def _scores(self, text: str, quoted: str | None, gains: np.ndarray) -> np.ndarray:
        """Scores [I] for a prompt; quoted: what must be printed on the instance; gains: of `scores`."""
        reading, known, (gain, lack) = self.encoder.reading, self.prepared, gains
        colors = color_words(text.partition(" with ")[0] if reading.colors else text)  # "duck with red hat" is not red
        asked = text if reading.colors else without_color_words(text)
        row, (middle, spread) = self.encoder.embed([asked]), known.null.T
        z = self._shape_bonus(text)
        if self.encoder.reads(asked):
            z = (self.encoder.relevancy(row, known.compared)[0] - middle) / spread + z + gain
            z = z - NONSENSE_WEIGHT * self.encoder.meaningless(row)
        if usual := household_thing(text):
            length, thickness = np.nan_to_num(np.minimum(size_misfits(known.sides, usual), 2.0))
            z = z - SIZE_WEIGHT * length - THICK_WEIGHT * thickness
        borne = np.ones(len(z))
        if quoted is not None and self._printed is not None:
            borne = self._printed.quoted(quoted)
            z = z + QUOTED_WEIGHT * (borne - 0.5)
        elif self._printed:
            z = z + PRINTED_WEIGHT * self._printed.evidence(text)
        if colors:
            shares = [known.colors[:, COLOR_WORDS.index(word.removeprefix(NOT))] for word in colors]
            shares = [0.5 - np.minimum(s, 0.5) if w.startswith(NOT) else s for s, w in zip(shares, colors, strict=True)]
            z = z + COLOR_WEIGHT * (match_of_shares(shares) - 0.5)
        a, b = reading.calibration
        bears = np.minimum(1.0, QUOTED_LEAST + borne)
        scores = (1 - LAPSE) * normal_cdf(a * z + b) * bears
        if len(self.encoder.canonical):
            scores = np.minimum(scores, 2 * PRESENT * self._against_canonical(row))
        scores[~self.seen] = 0.0
        return self._with_labels(scores, text, bears, np.broadcast_to(lack, len(z)))

    def _shape_bonus(self, text: str) -> np.ndarray:
        """Contribution of the instances' shapes to z [I]; 0 if the prompt names no shape and no household thing."""
        kind, bonus = shape_kind(text), np.zeros(len(self.seen))
        if self.shapes is None:
            return bonus
        if kind is not None:
            match = self.shapes[:, KINDS.index(kind)]
            bonus = SHAPE_HINT * match if kind in HINTS else SHAPE_WEIGHT * (match - 0.5)
        if kind not in (*STUFF, "picture", "rug") and household_thing(text):
            bonus -= STUFF_WEIGHT * self.shapes[:, [KINDS.index(stuff) for stuff in STUFF]].max(axis=1)
        return np.nan_to_num(bonus)

    def _against_canonical(self, row: np.ndarray) -> np.ndarray:
        """LERF's relevancy p [I]: probability of the prompt [1, D] against the best-matching canonical phrase, and
        where the model has a bias (SigLIP) against the cosine at which a match is as likely as not."""
        reading, plain = self.encoder.reading, self.prepared.plain
        rival = (plain @ self.encoder.canonical.T).max(axis=1)
        if reading.even is not None:
            rival = np.maximum(rival, reading.even)
        return 1.0 / (1.0 + np.exp(reading.scale * (rival - plain @ row[0])))

    def _with_labels(self, scores: np.ndarray, text: str, bears: np.ndarray, lack: np.ndarray) -> np.ndarray:
        """Combines image score and label: the larger one, where that of a label is 1 if it equals the prompt, else
        Φ(z − LABEL_MARGIN). bears [I]: factor for what is printed; lack [I]: subtracted from the label's evidence."""
        if not len(self._named):
            return scores
        middle, spread = self.prepared.label_null.T
        fits = self.prepared.label_rows @ self.encoder.embed([text])[0]
        z = ((fits - middle) / spread).astype(np.float64)
        same = np.array([name == tidy(text) for name in self._names])
        alike = (1 - LAPSE) * normal_cdf(z - LABEL_MARGIN) if self.encoder.reads(text) else 0.0
        of_labels, lack = np.where(same, 1.0, alike), lack[self._named]
        of_labels = np.where(lack > 0, (1 - LAPSE) * normal_cdf(evidence_of(of_labels) - lack), of_labels)
        scores[self._named] = np.maximum(scores[self._named], of_labels * bears[self._named])
        return scores


class Ranker(Scorer):
    """The scorer of one map's instances, from their descriptions."""

    def __init__(
        self,
        descriptions: Sequence[InstanceDescription],
        encoder: Encoder | TextEncoder,
        labels: Sequence[str | None] | None = None,
        shapes: Callable[[], np.ndarray] | None = None,
        printed: Printed | None = None,
        extents: np.ndarray | None = None,
    ) -> None:
        """labels: the user's name of each instance, or None. shapes, printed: of `Scorer`. extents: [I, 3] sides of
        their boxes in metres; None if the map's scale is unknown. InputError for embeddings of another length."""
        texts = encoder if isinstance(encoder, TextEncoder) else TextEncoder(encoder)
        count, dim = len(descriptions), texts.encoder.dim
        labels = [None] * count if labels is None else labels
        if len(labels) != count:
            raise InputError(f"labels: expected one per instance ({count}), found {len(labels)}")
        rows = np.array([d.embedding for d in descriptions], np.float32)
        rows = rows.reshape(count, len(descriptions[0].embedding) if descriptions else dim)
        if rows.shape[1] != dim:
            known = f"those of encoder '{texts.encoder.identity}' {dim}"
            raise InputError(f"embeddings have {rows.shape[1]} dimensions, {known}")
        seen = np.array([d.seen for d in descriptions], bool)
        compared = texts.compared(rows, seen)
        palettes = np.array([d.palette for d in descriptions])
        colors = [color_share(palettes, word) if count else np.zeros(0) for word in COLOR_WORDS]
        label_rows = texts.embed([name for label in labels if (name := tidy(label or ""))])
        prepared = Prepared(
            seen=seen,
            null=np.tile(texts.null(compared, seen), (count, 1)),
            colors=np.stack(colors, axis=1),
            sides=np.full((count, 3), np.nan) if extents is None else extents,
            plain=rows,
            compared=compared,
            labels=labels,
            label_rows=label_rows,
            label_null=texts.label_null(label_rows),
        )
        super().__init__(texts, prepared, shapes, printed)


def probes() -> list[str]:
    """Objects that are rarely in a scene."""
    return lines("probes.txt")


def lines(name: str) -> list[str]:
    """Those of a file in this folder."""
    return (Path(__file__).parent / name).read_text(encoding="utf-8").split("\n")[:-1]
