"""Printed texts of instances: lines of text read in their best views, assigned by silhouette and fused over the views.

A line belongs to the instance that covers most of its rectangle. Views read a text in part or with errors. Of all reads
of an instance, the text that explains most characters is kept, those that agree with it are set aside, and so on.

    r, s_r  a read and its score     v      a view; maxima are over its reads that agree with t
    t       a text                   l, L   lengths of the shorter and longer of r and t
    d, d'   edit distance of r and t, and of the shorter to the nearest stretch of the longer

    explained(t) = Σ_v max s_r · (l − d'(r, t) − UNREAD · (L − l))
    score(t) = 1 − Π_v (1 − max s_r · (1 − d(r, t) / L))
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from perception.language.ocr import TextReader
from perception.language.printed import Texts
from perception.progress import QUIET, Progress

MOST_VIEWS = 120  # most photos read for a map, those that are best for an instance first: bounds the time
MOST_TEXTS = 20  # kept per instance, best supported first
LEAST = 0.6  # score of a read, and of a text
SINGLE = 0.8  # score of a text of under FEW characters, or read in one view only
FEW = 4
UNREAD = 0.5  # weight of characters beyond the ends of the shorter text, which may be cut off
AGREE = 0.6  # share of the shorter of two texts that the longer must hold to be the same
COVER = 0.5  # share of a line's rectangle that its instance must cover

Read = tuple[int, str, float]  # view, text, score


def read_texts(
    reader: TextReader,
    choices: Sequence[np.ndarray],
    load: Callable[[int], tuple[np.ndarray, np.ndarray]],
    progress: Progress = QUIET,
) -> list[list[dict[str, Any]]]:
    """Texts of the I instances, best supported first: entries {"text": str, "score": in [0, 1]}.

    choices and load: as for `describe.describe_instances`.
    """
    best: dict[int, int] = {}  # rank of each view for the instance that it is best for
    for rank, view in ((rank, int(view)) for views in choices for rank, view in enumerate(views)):
        best[view] = min(rank, best.get(view, rank))
    wanted = sorted(sorted(best, key=lambda view: (best[view], view))[:MOST_VIEWS])
    reads: list[list[Read]] = [[] for _ in choices]
    for done, view in enumerate(wanted, start=1):
        photo, ids = load(view)
        for line in reader.read(photo):
            owner = owner_of(line.corners, ids)
            if owner is not None and line.score >= LEAST and sum(c.isalnum() for c in line.text) > 1:
                reads[owner].append((view, line.text, line.score))
        progress.update("texts", done, len(wanted))
    return [fuse(own) for own in reads]


def store_texts(entries: Sequence[dict[str, Any]], texts: Sequence[list[dict[str, Any]]]) -> None:
    """Sets `texts` of the entries of instances.json; the key is absent where nothing was read."""
    for entry, found in zip(entries, texts, strict=True):
        entry.pop("texts", None)
        if found:
            entry["texts"] = found


def owner_of(corners: np.ndarray, ids: np.ndarray) -> int | None:
    """The instance that covers most of a rectangle [4, 2] in the instance image [H, W]; None below the share COVER."""
    s, t = (np.arange(n)[..., None] / n + 0.5 / n for n in (24, 6))
    top, bottom = corners[0] + s * (corners[1] - corners[0]), corners[3] + s * (corners[2] - corners[3])
    points = np.floor(top[:, None] + t[None] * (bottom - top)[:, None]).astype(np.int64).reshape(-1, 2)
    inside = ((points >= 0) & (points < ids.shape[::-1])).all(axis=1)
    shown = ids[points[inside, 1], points[inside, 0]]
    counts = np.bincount(shown[shown >= 0], minlength=1)
    return int(counts.argmax()) if counts.max() >= COVER * len(points) else None


def fuse(reads: Sequence[Read]) -> list[dict[str, Any]]:
    """The texts that reads of several views agree on; see the module docstring."""
    plain = ["".join(c for c in text.casefold() if c.isalnum()) for _, text, _ in reads]
    pairs, texts, left = _Pairs(plain), list[dict[str, Any]](), np.arange(len(reads))
    number = np.array([pairs.number[text] for text in plain], int)
    view, score = np.array([read[0] for read in reads], int), np.array([read[2] for read in reads])
    while len(left) and len(texts) < MOST_TEXTS:
        candidates = sorted({reads[n][1]: number[n] for n in left.tolist()}.items())
        agreeing = [left[pairs.agree(number[left], own)] for _, own in candidates]
        support = [
            _by_view(view[mine], score[mine, None] * pairs.alike(own, number[mine]))
            for mine, (_, own) in zip(agreeing, candidates, strict=True)
        ]
        chosen = int(np.argmax([views[:, 0].sum() for views in support]))
        best, views = candidates[chosen][0], support[chosen]
        sure = 1.0 - float(np.prod(1.0 - views[:, 1]))
        if sure >= (SINGLE if len(views) == 1 or len(best) < FEW else LEAST):
            texts.append({"text": best, "score": round(min(sure, 0.99), 2)})
        left = np.setdiff1d(left, agreeing[chosen])
    return texts


def _by_view(view: np.ndarray, values: np.ndarray) -> np.ndarray:
    """[V, 2] the largest of values [R, 2] of each view, at least 0; view [R]."""
    views, index = np.unique(view, return_inverse=True)
    best = np.zeros((len(views), 2))
    np.maximum.at(best, index, values)
    return best


class _Pairs:
    """Distances of each two of some texts, each computed once. number: of each text, in order of length."""

    def __init__(self, texts: Sequence[str]) -> None:
        distinct = Texts(sorted(set(texts)))
        self.number, self._length = distinct.number, np.array([len(text) for text in distinct.number], int)
        self._inside, self._apart = np.zeros((2, len(self.number), len(self.number)), np.int16)  # of the shorter: row
        for text, n in self.number.items():
            for table, inside in ((self._inside, True), (self._apart, False)):
                longer, distance = distinct.distances(text, len(text), inside=inside)
                table[n, longer] = distance

    def agree(self, a: np.ndarray, b: np.ndarray | int) -> np.ndarray:
        """Whether most of the shorter of two texts, the first of equal ones, is in the longer; numbers a, b."""
        short, long = self._ordered(a, b)
        return np.asarray(self._inside[short, long] <= (1 - AGREE) * self._length[short])

    def alike(self, a: np.ndarray | int, b: np.ndarray) -> np.ndarray:
        """[R, 2] characters of one explained by the other, and similarity of the two."""
        short, long = self._ordered(a, b)
        least, most = self._length[short], self._length[long]
        explained = least - self._inside[short, long] - UNREAD * (most - least)
        return np.stack([explained, 1.0 - self._apart[short, long] / np.maximum(most, 1)], axis=1)

    def _ordered(self, a: Any, b: Any) -> tuple[np.ndarray, np.ndarray]:
        first = self._length[a] <= self._length[b]
        return np.where(first, a, b), np.where(first, b, a)
