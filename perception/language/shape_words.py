"""Shape words: which of KINDS the head noun of a prompt names.

English only. Prompts in other languages are ranked by the encoder alone.
"""

from __future__ import annotations

import re

KINDS = ("floor", "ceiling", "wall", "table", "picture", "rug", "ball", "box")
STUFF = ("floor", "ceiling", "wall")
HINTS = ("ball", "box", "rug", "table")
"""Kinds for which shape supports the score but does not decide it: a ball may be flat, a box open, a desk covered."""

# Words of each kind. A carton may have a gable top and still counts as a box; a desk counts as a table.
_WORDS = {
    "floor": "floor ground flooring",
    "ceiling": "ceiling",
    "wall": "wall",
    "table": "table desk tabletop counter countertop workbench worktop",
    "picture": "picture poster painting photograph print artwork portrait placard canvas",
    "rug": "rug carpet mat doormat",
    "ball": "ball basketball football softball volleyball sphere globe",
    "box": "box carton package packet crate cube",
}
_KIND = {word: kind for kind, words in _WORDS.items() for word in words.split()}
# Words after which the object itself is no longer named: "the rug ON the floor".
_RELATIONS = re.compile(
    r"\b(?:on|of|with|without|under|in|inside|at|by|from|near|for|behind|above|below|beside|next|over|to|that|which|"
    r"between|full|against|beneath|underneath|(?:and|or)(?=\s+(?:an?|the|some|one|two|three|four)\b))\b"
)
_MEASURES = re.compile(r"\b(?:pair|piece|set|pile|stack|bunch|sheet|kind|sort)s? of\b")
_WORD = re.compile(r"[^\W\d_]+")


def thing_words(text: str) -> list[str]:
    """The words that name the object, in lower case: "a framed picture of a forest" → ["a", "framed", "picture"]."""
    thing = _MEASURES.sub(" ", text.lower())
    words = _WORD.findall(_RELATIONS.split(thing, maxsplit=1)[0]) or _WORD.findall(thing)
    while len(words) > 1 and len(words[-1]) == 1:  # "wall E": a single letter is an identifier
        words.pop()
    return words


def head_noun(text: str) -> str:
    """The singular noun that names the object: "a framed picture of a forest" → "picture"; "" if there is none."""
    words = thing_words(text)
    return singular(words[-1]) if words else ""


def shape_kind(text: str) -> str | None:
    """The kind of shape that a prompt names, or None."""
    return _KIND.get(head_noun(text))


def singular(word: str) -> str:
    """The word without its plural s; words of up to three letters, such as "bus", as they are."""
    if word.endswith("xes"):
        return word[:-2]
    return word[:-1] if len(word) > 3 and word.endswith("s") and not word.endswith("ss") else word
