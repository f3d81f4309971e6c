"""Household things: which ImageNet classes look like them, how long and how thick they are (household.txt, by hand)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from perception.language.shape_words import thing_words

CLASSES = 1000


@dataclass(frozen=True)
class Household:
    """classes: [1000] float32 ≥ 0, sum 1: share of each ImageNet class among pictures of the thing, 1 / √rank of what
    the table lists; None where ImageNet has a class of that very name, which is better known by it. size: least and
    largest longest side in metres. thickness: largest shortest side in metres; backs may be hidden, so none is least.
    """

    classes: np.ndarray | None
    size: tuple[float, float]
    thickness: float


def household_thing(text: str) -> Household | None:
    """What the table says of the thing that a text names: its longest known ending, as "game controller" of "the red
    game controller"; None if there is none."""
    words = thing_words(text)
    endings = (" ".join(words[start:]) for start in range(max(0, len(words) - _longest()), len(words)))
    return next((known for ending in endings if (known := _table().get(ending))), None)


def size_misfits(sides: np.ndarray, known: Household) -> tuple[np.ndarray, np.ndarray]:
    """[I] each, as log2, 0 inside: how many times the longest of sides [I, 3] is shorter or longer than `known.size`,
    and how many times the shortest is thicker than `known.thickness`."""
    longest, shortest = np.maximum(sides.max(axis=1), 1e-6), np.maximum(sides.min(axis=1), 1e-6)
    length = np.maximum(np.log2(known.size[0] / longest), np.log2(longest / known.size[1]))
    return np.maximum(length, 0.0), np.maximum(np.log2(shortest / known.thickness), 0.0)


@lru_cache(maxsize=1)
def _longest() -> int:
    """The number of words of the longest name in the table."""
    return max(name.count(" ") + 1 for name in _table())


@lru_cache(maxsize=1)
def _table() -> dict[str, Household]:
    from perception.language.conse import class_names

    number: dict[str, int] = {}
    for n, names in enumerate(class_names()):
        number.setdefault(names[0], n)
    named = {name.lower() for names in class_names() for name in names}
    table: dict[str, Household] = {}
    for line in (Path(__file__).parent / "household.txt").read_text(encoding="utf-8").splitlines():
        if line.startswith("#"):
            continue
        words, classes, size, thickness = line.split(" | ")
        shares = np.zeros(CLASSES, np.float32)
        for rank, name in enumerate(classes.split(", "), start=1):
            shares[number[name]] += rank**-0.5
        least, most = (float(cm) / 100 for cm in size.split("-"))
        for word in words.split(", "):
            own = None if word in named else shares / shares.sum()
            table[word] = Household(own, (least, most), float(thickness) / 100)
    return table
