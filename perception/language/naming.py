"""The likeliest names of instances, for people to read: from a list of common words, by the same ranking as prompts."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from perception.language.ranking import Ranker
from perception.language.shape_words import HINTS, KINDS

SURE = 0.7  # a shape that geometry alone decides is named first from this score on
PLAIN_WORDS = (
    "apple", "bag", "blanket", "bread", "broom", "cabinet", "chair", "clock", "coat", "cup", "door", "fruit", "glass",
    "hat", "jar", "knife", "lamp", "painting", "pan", "paper", "plant", "pot", "shelf", "shoe", "sofa", "spoon",
    "telephone", "towel", "toy", "window",
)  # fmt: skip


def likely_names(ranker: Ranker, count: int = 3) -> list[list[str]]:
    """For each instance its `count` likeliest names, best first; none for an instance that no photo shows."""
    words = vocabulary()
    relevancy = ranker.relevancy(words)
    shapes = ranker.shapes
    names: list[list[str]] = []
    for i, row in enumerate(relevancy.T):
        if not ranker.seen[i]:
            names.append([])
            continue
        ranked = [words[n] for n in np.argsort(-row, kind="stable")[: count + 1]]
        if shapes is not None:
            ranked = [kind for k, kind in enumerate(KINDS) if kind not in HINTS and shapes[i, k] >= SURE] + ranked
        names.append(list(dict.fromkeys(ranked))[:count])
    return names


@lru_cache(maxsize=1)
def vocabulary() -> list[str]:
    """The first name of every ImageNet class, and plain words that those are too special for."""
    from perception.language.conse import class_names

    return list(dict.fromkeys([group[0] for group in class_names()] + list(PLAIN_WORDS)))
