"""Likely names of instances for display: a list of common words, ranked in the same way as prompts."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from perception.language.household import class_names
from perception.language.shape_words import HINTS, KINDS
from perception.query.ranking import Ranker

SURE = 0.7  # shape score from which a kind decided by geometry alone is named first
PLAIN_WORDS = (
    "apple", "bag", "blanket", "bread", "broom", "cabinet", "chair", "clock", "coat", "cup", "door", "fruit", "glass",
    "hat", "jar", "knife", "lamp", "painting", "pan", "paper", "plant", "pot", "shelf", "shoe", "sofa", "spoon",
    "telephone", "towel", "toy", "window",
)  # fmt: skip


def likely_names(ranker: Ranker, count: int = 3) -> list[list[str]]:
    """The `count` most likely names of each instance, best first; empty for an instance that no photo shows."""
    nouns = vocabulary()
    relevancy = ranker.relevancy(nouns)
    shapes = ranker.shapes
    names: list[list[str]] = []
    for i, row in enumerate(relevancy.T):
        ranked = [nouns[n] for n in np.argsort(-row, kind="stable")[: count + 1]]
        if shapes is not None:
            ranked = [kind for k, kind in enumerate(KINDS) if kind not in HINTS and shapes[i, k] >= SURE] + ranked
        names.append(list(dict.fromkeys(ranked))[:count] if ranker.seen[i] else [])
    return names


@lru_cache(maxsize=1)
def vocabulary() -> list[str]:
    """The first name of every ImageNet class, and common words where the class names are too specific."""
    return list(dict.fromkeys([group[0] for group in class_names()] + list(PLAIN_WORDS)))
