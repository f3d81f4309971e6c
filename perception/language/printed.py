"""Matches prompts with the texts printed on instances, despite errors of OCR.

A prompt may quote a text ("the book that says BIRDS", 'box labelled "oat milk"'), which an instance must then bear. In
any other prompt a printed word is evidence: "cereal box" for a thing with CEREAL on it. A word of the prompt matches a
text with quality 1 − d / length, where d is the edit distance to a word of the text, or for LONG words to any stretch
of it (Sellers 1980); characters that OCR confuses (0 and O, 1 and l) are equal. English grammar, words of any language.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

import numpy as np

from perception.language.colors import color_words
from perception.language.shape_words import head_noun, singular

QUALITY = 0.75  # least quality of a match: one wrong character in four
PART = 0.6  # least share of a word that a text cut off at either end must hold
SHORT = 3  # up to so many characters a word must be equal
LONG = 5  # from so many on, spaces missing in the text do not matter
RIVAL = 4  # a match counts by (its quality / that of the map's best)^RIVAL: where BUTTER is, BATTERY is not it
_SAYS = re.compile(  # in a text of single spaces, so that every repeat has an end
    r"(?<=[, ])(?:(?:that|which) )?(?:(?:says?|saying|titled|labell?ed)(?: (?:as|with))?|"
    r"(?:reads?|reading|marked)(?= [\"'“«A-Z0-9])|"
    r"(?:with|bears?|has|bearing|having) (?:the )?(?:words?|texts?|titles?|labels?|letters|names?|print|inscription)) "
    r"(?=.*\w)"
)
_QUOTED = re.compile(r"[\"“”«»]([^\"“”«»\w]*\w[^\"“”«»]*)[\"“”«»]")
_WORDS = {
    "article": "a an the some any this that my our your",
    "stop": "of on in with and or for to at by from near next left right under over above below behind front top "
    "bottom big small large little tiny one two it its is there",
    # things known by what is printed on them: in "cereal box" only "cereal" tells which box
    "carrier": "box book package packet pack bag can bottle carton tin jar sign poster magazine brochure leaflet flyer "
    "label sticker container thing object item something cover bar tube pot tub pouch sachet newspaper paper card menu "
    "placard plate board binder folder drink food product",
}
_KIND = {word: kind for kind, words in _WORDS.items() for word in words.split()}
_SAME = str.maketrans({"0": "o", "1": "l", "i": "l", "|": "l", "5": "s", "8": "b", "2": "z"})
_WORD, _LETTER = re.compile(r"\w+"), re.compile(r"\w")


def quoted_text(prompt: str) -> tuple[str, str] | None:
    """(thing, text) of a prompt that quotes what is printed: "the book that says BIRDS" → ("the book", "BIRDS")."""
    prompt = " ".join(prompt.split())
    said = found_after_a_word(_SAYS, prompt)
    thing, text = (prompt[: said.start()].rstrip(", "), prompt[said.end() :]) if said else (prompt, "")
    if quote := _QUOTED.search(prompt):
        thing, text = (thing if said else _QUOTED.sub(" ", prompt)), quote[1]
    words = [word for word in _WORD.findall(thing.lower()) if _KIND.get(word) != "article"]
    if not text or (said and not quote and not words):
        return None
    return " ".join(thing.split()) if words else "thing", text.strip(" .,;:!?'")


def found_after_a_word(pattern: re.Pattern[str], text: str) -> re.Match[str] | None:
    """The first match of the pattern that has a letter or a digit before it."""
    word = _LETTER.search(text)
    return pattern.search(text, word.end()) if word else None


class Printed:
    """The texts of a map's instances, prepared for prompts. texts: of each instance, entries {"text", "score"}. groups:
    [I], the map of each instance, 0 to G - 1, where they are of several maps; each is matched within its own map."""

    def __init__(self, texts: Sequence[Sequence[dict[str, Any]]], groups: np.ndarray | None = None) -> None:
        self.count, self._groups = len(texts), np.zeros(len(texts), int) if groups is None else groups
        self._lines = [(i, tuple(_folded(e["text"])), float(e["score"])) for i, es in enumerate(texts) for e in es]

    def __bool__(self) -> bool:
        return bool(self._lines)

    def quoted(self, text: str) -> np.ndarray:
        """[I] in [0, 1]: how well each instance bears `text`: as a whole, or its words, weighted by their lengths."""
        words = _folded(text)
        return np.maximum(self._borne(words, [len(word) for word in words]), self._borne(["".join(words)], [1]))

    def evidence(self, prompt: str) -> np.ndarray:
        """[I] in [0, 1]: share of the prompt's telling words that each instance bears; squared unless the prompt names
        a thing known by its print, because COFFEE may be on a poster as well as on a coffee mug."""
        words = [word for word in _WORD.findall(prompt.lower()) if not color_words(f"{word} thing")]
        telling = [_folded(word)[0] for word in words if singular(word) not in _KIND]
        share = self._borne(telling, [1] * len(telling))
        return share if len(telling) == 1 == len(words) or _KIND.get(head_noun(prompt)) == "carrier" else share**2

    def _borne(self, words: Sequence[str], weights: Sequence[float]) -> np.ndarray:
        best, most = np.zeros((len(words), self.count)), np.full((len(words), self._groups.max(initial=0) + 1), 1e-9)
        different = {line for _, line, _ in self._lines}
        for n, word in enumerate(words):
            quality = {line: match_quality(word, line) for line in different}
            for i, line, score in self._lines:
                best[n, i] = max(best[n, i], score * quality[line])
                most[n, self._groups[i]] = max(most[n, self._groups[i]], best[n, i])
        best *= (best / most[:, self._groups]) ** RIVAL
        return np.asarray(weights, np.float64) @ best / max(sum(weights), 1)


def match_quality(word: str, line: Sequence[str]) -> float:
    """Quality in {0} ∪ [PART, 1] of the best match of a folded word with the folded words of a line."""
    best = 0.0
    for other in line:
        if word == other:
            return 1.0
        if len(word) > SHORT and (other.startswith(word) or other.endswith(word)):
            best = max(best, QUALITY)  # run together with the next word
        if SHORT < len(other) < len(word) and other in word:
            best = max(best, len(other) / len(word) * (len(other) >= PART * len(word)))
        elif min(len(word), len(other)) > SHORT:
            best = max(best, _quality(edit_distance(word, other), len(word)))
    joined = "".join(line)
    if len(word) >= LONG and len(joined) >= QUALITY * len(word):  # a shorter text lacks too many characters
        best = max(best, _quality(edit_distance(word, joined, inside=True), len(word)))
    return best


def edit_distance(a: str, b: str, inside: bool = False) -> int:
    """Levenshtein's distance of a and b; with `inside`, of a and the stretch of b nearest to it."""
    row = [0] * (len(b) + 1) if inside else list(range(len(b) + 1))
    for n, x in enumerate(a, start=1):
        last, row[0] = row[0], n
        for m, y in enumerate(b, start=1):
            last, row[m] = row[m], min(last + (x != y), row[m] + 1, row[m - 1] + 1)
    return min(row) if inside else row[-1]


def _quality(distance: int, length: int) -> float:
    quality = 1.0 - distance / length
    return quality if quality >= QUALITY else 0.0


def _folded(text: str) -> list[str]:
    """Its words in lower case, singular, with characters that OCR confuses made equal."""
    return [singular(word).translate(_SAME) for word in _WORD.findall(text.lower())]
