"""Ranks instances for a prompt, and decides whether any of them matches.

The relevancy of instance i for a prompt t is relative to the other instances of the map. With ē the map's mean,
x_ti = cos(t, e_i − β ē) / σ_t removes what all instances share. σ_t is the standard deviation of cos(t, ·) over the
encoder's reference words; it makes specific and vague prompts comparable. For an encoder with parts, x is the weighted
sum over the parts.

Probes decide whether the best instance is good enough: LERF's canonical phrases (object, things, stuff, texture) and a
list of objects that are rarely in a scene. Their best relevancies in this map are the distribution of "not present":
    z_ti = (x_ti − m) / s,   m: their median,   s: chosen so that their 80 % quantile has Φ(z) = .8
    score_ti = Φ(a z_ti + b)
a and b are properties of the encoder, so that the best score is the probability that the thing is there: absent objects
that resemble a present one (a laptop, a book) exceed the probes. Unknown, they are 1 and 0. An instance answers the
prompt if it scores PRESENT or more and is at most BESIDE behind the best: "chair" has four answers, "red chair" one.
For encoders with canonical phrases, the prompt must also be more likely than each phrase (LERF's relevancy, with the
scale at which the model was trained in place of LERF's 10) and, where the model has a bias (SigLIP), likelier than not.
Colour words are matched with measured colours, shape words (floor, wall, picture, ball: see `shape_words`) also with
the measured shape, and all words with the texts printed on an instance (see `printed`; a quoted text must be there).
Household things are no floor, wall or ceiling and, in a metric map, of usual length and thickness (see `household`). A
label set by the user counts as a name of the instance.

All of this is relative to one map. What a map's instances need of it is prepared once (`Ranker.prepared`), so that the
instances of many maps are ranked together (`Ranker.joined`), each with the score that it has in its own map.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path

import numpy as np
from scipy.special import ndtr, ndtri

from perception.errors import InputError
from perception.language.base import Encoder, Part, check_texts, reading_of, unit_rows
from perception.language.colors import COLOR_WORDS, color_share, color_words, match_of_shares, without_color_words
from perception.language.description import InstanceDescription
from perception.language.household import household_thing, size_misfits
from perception.language.printed import Printed, quoted_text
from perception.language.shape_words import HINTS, KINDS, STUFF, shape_kind

PRESENT = 0.8  # default minimum score of an answer; the probes are harder than typical absent objects
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
STUFF_WEIGHT = 2.0  # subtracted from z of a floor, wall or ceiling for a household thing
LABEL_MARGIN = 2.0  # subtracted from z of a label, where z is the similarity of label and prompt relative to the probes


THING = np.dtype(
    [
        ("seen", "?"),
        ("null", "f8", 2),
        ("colors", "f8", len(COLOR_WORDS)),
        ("sides", "f8", 3),
        ("shapes", "f8", len(KINDS)),
    ]
)
"""What ranking needs of an instance beside its embedding: m and s of its map, share of each of COLOR_WORDS, sides of
its box in metres, scores of `shape_words.KINDS`. NaN where not known."""


@dataclass(frozen=True)
class Answer:
    """hits: (index of the instance, score in [0, 1]), all instances, best first. present: whether any answers."""

    text: str
    hits: list[tuple[int, float]]
    present: bool


def answering(hits: Sequence[tuple[int, float]], min_score: float | None = None) -> list[tuple[int, float]]:
    """Those of `hits`, best first, that answer the prompt; with `min_score` those with at least this score."""
    if min_score is None:
        min_score = float(least_score(np.array(max((score for _, score in hits), default=0.0))))
    return [(i, score) for i, score in hits if score >= min_score]


def least_score(best: np.ndarray) -> np.ndarray:
    """The least score of an answer, given the best score of each map."""
    return np.maximum(PRESENT, ndtr(ndtri(np.clip(best, PRESENT, 1 - 1e-9)) - BESIDE))


class Ranker:
    """Descriptions of a map, prepared for prompts. A prompt costs one text encoding and one matrix product."""

    reads: np.ndarray | None = None
    """[I] bool: instances of maps whose printed texts were looked for, where not all maps of a joined Ranker are."""

    def __init__(
        self,
        descriptions: Sequence[InstanceDescription],
        encoder: Encoder,
        labels: Sequence[str | None] | None = None,
        shapes: Callable[[], np.ndarray] | None = None,
        printed: Printed | None = None,
        extents: np.ndarray | None = None,
    ) -> None:
        """labels: the user's name of each instance, or None. shapes: returns scores [I, K] of `shape_words.KINDS`. It
        is called at the first prompt. printed: the texts of the instances; None: not looked for.
        extents: [I, 3] sides of their boxes in metres; None if the map's scale is unknown.
        """
        if labels is not None and len(labels) != len(descriptions):
            raise InputError(f"labels: expected one per instance ({len(descriptions)}), found {len(labels)}")
        self._measure_shapes, self._printed, self._extents = shapes, printed, extents
        self.seen = np.array([d.seen for d in descriptions], bool)
        rows = np.array([d.embedding for d in descriptions], np.float32).reshape(
            len(descriptions), len(descriptions[0].embedding) if descriptions else encoder.dim
        )
        if rows.shape[1] != encoder.dim:
            raise InputError(
                f"embeddings have {rows.shape[1]} dimensions, those of encoder '{encoder.identity}' {encoder.dim}"
            )
        texts = self._use(encoder)
        self._plain, self._compared = rows, self._less_mean(rows)
        palettes = np.array([d.palette for d in descriptions])
        self._share_of: Callable[[str], np.ndarray] = partial(color_share, palettes)
        self._names = [_words(label) for label in labels or [None] * len(descriptions)]
        self._null: tuple[np.ndarray | float, np.ndarray | float] = self._best_of_absent(texts)
        self._named = np.flatnonzero([name != "" for name in self._names])
        self._label_rows = self._encode([self._names[i] for i in self._named])
        fits = self._label_rows @ texts.T
        self._label_null = fits.mean(axis=1), np.maximum(fits.std(axis=1), 1e-6)

    def _use(self, encoder: Encoder) -> np.ndarray:
        """Prepares the encoder's side; returns the embeddings of the probes."""
        self._encoder, self._reading = encoder, reading_of(encoder)
        self._canonical = self._encode(self._reading.canonical)
        texts = self._encode(probes())
        self._usual_spreads = [float(self._spreads(texts, *part).mean()) for part in self._places]
        return texts

    @classmethod
    def joined(
        cls,
        encoder: Encoder,
        arrays: dict[str, np.ndarray],
        labels: Sequence[str | None],
        printed: Printed,
        reads: np.ndarray,
    ) -> Ranker:
        """One Ranker of many maps, whose instances have the scores that they have in their maps.

        arrays: those of `prepared`, concatenated along their first axis. labels: of each instance. printed: of all
        instances, in groups by map. reads: [I] bool, whether their map's printed texts were looked for.
        """
        made = cls.__new__(cls)
        made._use(encoder)
        things, labelled = arrays["things"], arrays["label_null"]
        made.seen, made._extents, made._measure_shapes = things["seen"], things["sides"], lambda: things["shapes"]
        made._printed, made.reads, made._null = printed, reads, tuple(things["null"].T)
        made._plain = arrays["plain"]
        made._compared = [arrays[f"part_{n}"] for n in range(len(made._places))]
        made._share_of = lambda word: things["colors"][:, COLOR_WORDS.index(word)]
        made._names = [_words(label) for label in labels]
        made._named = np.flatnonzero([name != "" for name in made._names])
        made._label_rows, made._label_null = arrays["label_rows"], (labelled[:, 0], labelled[:, 1])
        return made

    def prepared(self) -> dict[str, np.ndarray]:
        """What `joined` needs of the I instances of this map, L of them labelled: things [I] of `THING`; part_N [I, d]
        float32 per part of the embeddings; plain [I, D] float32 where the encoder has canonical phrases, else [I, 0];
        label_rows [L, D] float32; label_null [L, 2] float32."""
        things = np.zeros(len(self.seen), THING)
        things["seen"], things["null"] = self.seen, self._null
        for n, word in enumerate(COLOR_WORDS):
            things["colors"][:, n] = self._share_of(word) if len(things) else 0.0
        things["sides"] = np.nan if self._extents is None else self._extents
        things["shapes"] = np.nan if self.shapes is None else self.shapes
        parts = {f"part_{n}": rows for n, rows in enumerate(self._compared)}
        plain = self._plain if len(self._canonical) else self._plain[:, :0]
        null = np.stack(self._label_null, axis=1)
        return {"things": things, **parts, "plain": plain, "label_rows": self._label_rows, "label_null": null}

    def over(self, descriptions: Sequence[InstanceDescription], shapes: np.ndarray | None = None) -> Ranker:
        """A Ranker with the same encoder for other instances, without labels. shapes: as `self.shapes`, for these."""
        return Ranker(descriptions, self._encoder, shapes=None if shapes is None else lambda: shapes)

    def rank(self, prompt: str, gain: np.ndarray | float = 0.0) -> Answer:
        """Scores every instance for one prompt; see the module docstring. gain: [I], added to z."""
        scores = self.scores(prompt, gain)
        hits = [(int(i), float(scores[i])) for i in np.argsort(-scores, kind="stable")]
        return Answer(check_texts([prompt])[0], hits, bool(answering(hits)))

    def scores(self, prompt: str, gain: np.ndarray | float = 0.0) -> np.ndarray:
        """Scores [I] in [0, 1] of all instances for one prompt. gain: [I], added to z."""
        text = check_texts([prompt])[0]
        if not len(self.seen):
            return np.zeros(0)
        quoted = quoted_text(text) if self._printed is not None else None
        if quoted is None:
            return self._scores(text, None, gain)
        scores = self._scores(*quoted, gain)
        if self.reads is None or self.reads.all():
            return scores
        return np.where(self.reads, scores, self._scores(text, None, gain))

    def _scores(self, text: str, quoted: str | None = None, gain: np.ndarray | float = 0.0) -> np.ndarray:
        """Scores [I] for a prompt; quoted: what must be printed on the instance; gain: added to z."""
        kept = self._reading.colors  # "a duck with a red hat" is not a red thing
        colors = color_words(text.partition(" with ")[0] if kept else text)
        row = self._encode([text if kept else without_color_words(text)])
        relevancy = self._relevancy(row)[0]
        borne, (middle, spread) = np.ones(len(self.seen)), self._null
        z = (relevancy - middle) / spread + self._shape_bonus(text) + gain
        if self._extents is not None and (known := household_thing(text)):
            length, thickness = np.nan_to_num(np.minimum(size_misfits(self._extents, known), 2.0))
            z = z - SIZE_WEIGHT * length - THICK_WEIGHT * thickness
        if quoted is not None and self._printed is not None:
            borne = self._printed.quoted(quoted)
            z = z + QUOTED_WEIGHT * (borne - 0.5)
        elif self._printed:
            z = z + PRINTED_WEIGHT * self._printed.evidence(text)
        if colors:
            z = z + COLOR_WEIGHT * (match_of_shares([self._share_of(word) for word in colors]) - 0.5)
        slope, offset = self._reading.calibration
        scores = ndtr(slope * z + offset) * np.minimum(1.0, QUOTED_LEAST + borne)
        if len(self._canonical):
            scores = np.minimum(scores, 2 * PRESENT * self._against_canonical(row))
        scores[~self.seen] = 0.0
        return self._with_labels(scores, text)

    @cached_property
    def shapes(self) -> np.ndarray | None:
        """Scores [I, K] of `shape_words.KINDS`; None if shapes are not available."""
        return None if self._measure_shapes is None else self._measure_shapes()

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
        """LERF's relevancy [I]: probability of the prompt [1, D] against the best-matching canonical phrase."""
        rival = (self._plain @ self._canonical.T).max(axis=1)
        if self._reading.even is not None:
            rival = np.maximum(rival, self._reading.even)
        return 1.0 / (1.0 + np.exp(self._reading.scale * (rival - self._plain @ row[0])))

    def _with_labels(self, scores: np.ndarray, text: str) -> np.ndarray:
        """Combines image score and label: 1 if the label equals the prompt, else max(score, Φ(z − LABEL_MARGIN))."""
        if not len(self._named):
            return scores
        fits = self._label_rows @ self._encode([text])[0]
        z = ((fits - self._label_null[0]) / self._label_null[1]).astype(np.float64)
        words = _words(text)
        same = np.array([self._names[i] == words for i in self._named])
        scores[self._named] = np.where(same, 1.0, np.maximum(scores[self._named], ndtr(z - LABEL_MARGIN)))
        return scores

    def similarity(self, texts: Sequence[str]) -> np.ndarray:
        """Cosine of each text's embedding with each instance's [T, I] in [−1, 1], as in the paper; −1 if unseen."""
        return np.where(self.seen, self._encode(texts) @ self._plain.T, -1.0)

    def relevancy(self, texts: Sequence[str]) -> np.ndarray:
        """Relevancy of each text for each instance [T, I], without colours, shapes and labels."""
        return self._relevancy(self._encode(texts))

    def _relevancy(self, texts: np.ndarray) -> np.ndarray:
        """x [T, I] of text embeddings [T, D], in units of a typical prompt's deviation, summed over the parts."""
        x = np.zeros((len(texts), len(self.seen)))
        for (place, references, weight), rows, usual in zip(
            self._places, self._compared, self._usual_spreads, strict=True
        ):
            fits = unit_rows(texts[:, place]) @ rows.T
            x += weight * fits * (usual / self._spreads(texts, place, references))[:, None]
        return x

    @cached_property
    def _places(self) -> list[tuple[slice, np.ndarray | None, float]]:
        """Of each part of the embeddings: its slice, reference words and weight."""
        parts = self._reading.parts or (Part(self._encoder.dim),)
        starts = [0, *(part.stop for part in parts)]
        return [
            (slice(start, part.stop), part.references, part.weight) for start, part in zip(starts, parts, strict=False)
        ]

    def _less_mean(self, rows: np.ndarray) -> list[np.ndarray]:
        """The parts of the embeddings [I, D]: each minus BETA times the map's mean, then scaled to length 1."""
        seen, parts = rows[self.seen], []
        for place, _, _ in self._places:
            own = rows[:, place]
            if len(seen) > 1:
                own = own - BETA * unit_rows(seen[:, place]).mean(axis=0) * np.linalg.norm(own, axis=1, keepdims=True)
            parts.append(unit_rows(own))
        return parts

    def _spreads(self, texts: np.ndarray, place: slice, references: np.ndarray | None, _: float = 0.0) -> np.ndarray:
        if references is None:
            return np.ones(len(texts))
        return np.maximum((unit_rows(texts[:, place]) @ references.T).std(axis=1), 1e-3)

    def _encode(self, texts: Sequence[str]) -> np.ndarray:
        """Text embeddings, averaged over the encoder's templates; unit rows [T, D]."""
        if not len(texts):
            return np.zeros((0, self._encoder.dim), np.float32)
        templates = self._encoder.templates
        filled = [template.replace("{}", text) for template in templates for text in texts]
        rows = self._encoder.encode_texts(filled).reshape(len(templates), len(texts), -1)
        return unit_rows(rows.mean(axis=0))

    def _best_of_absent(self, probe_rows: np.ndarray) -> tuple[float, float]:
        """m and s of the module docstring: median and scale of the probes' best relevancies in this map."""
        if not self.seen.any():
            return 0.0, 1.0
        best = self._relevancy(probe_rows)[:, self.seen].max(axis=1)
        middle, high = np.quantile(best, [0.5, QUANTILE])
        return float(middle), max(float(high - middle) / NORMAL_QUANTILE, 1e-6)


def probes() -> list[str]:
    """Objects that are rarely in a scene, one per line in probes.txt."""
    return (Path(__file__).parent / "probes.txt").read_text(encoding="utf-8").split("\n")[:-1]


def _words(text: str | None) -> str:
    return " ".join((text or "").lower().split())
