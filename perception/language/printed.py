"""Matches prompts with the texts printed on instances, despite errors of OCR.

A prompt may quote a text ("the book that says BIRDS", 'box labelled "oat milk"'), which an instance must then bear. In
any other prompt a printed word is evidence: "cereal box" for a thing with CEREAL on it. A word of the prompt matches a
text with quality 1 − d / length, where d is the edit distance to a word of the text, or for LONG words to any stretch
of it (Sellers 1980); characters that OCR confuses (0 and O, 1 and l) are equal. English grammar, words of any language.
"""

from __future__ import annotations

import math
import re
from bisect import bisect_left, bisect_right
from collections.abc import Iterable, Sequence
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
    r"(?:with|bears?|has|bearing|having) (?:the )?(?:words?|texts?|titles?|labels?|letters|names?|print|inscription)"
    r"(?! (?:on|in|of|at|across|along|around) )) "  # "with text on it" says where it is
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
_WORD, _LETTER = re.compile(r"[^\W_]+"), re.compile(r"\w")


def quoted_text(prompt: str) -> tuple[str, str] | None:
    """(thing, text) of a prompt that quotes what is printed: "the book that says BIRDS" → ("the book", "BIRDS")."""
    prompt = " ".join(prompt.split())
    verb = found_after_a_word(_SAYS, prompt)
    thing, text = (prompt[: verb.start()].rstrip(", "), prompt[verb.end() :]) if verb else (prompt, "")
    if quote := _QUOTED.search(prompt):
        thing, text = (thing if verb else _QUOTED.sub(" ", prompt)), quote[1]
    words = [word for word in _WORD.findall(thing.lower()) if _KIND.get(word) != "article"]
    if not text or (verb and not quote and not words):
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
        entries = [(i, tuple(_folded(e["text"])), float(e["score"])) for i, es in enumerate(texts) for e in es]
        entries = [entry for entry in entries if entry[1]]
        lines = sorted({line for _, line, _ in entries}, key=lambda line: sum(map(len, line)))
        number = {line: n for n, line in enumerate(lines)}
        self._owners = np.array([i for i, _, _ in entries], int)
        self._scores = np.array([score for _, _, score in entries], float)
        self._lines = np.array([number[line] for _, line, _ in entries], int)
        self._words, self._joined = Texts({word for line in lines for word in line}), Texts(map("".join, lines))
        self._words_of = np.array([self._words.number[word] for line in lines for word in line], int)
        self._starts = np.cumsum([0, *(len(line) for line in lines)])[:-1]

    def __bool__(self) -> bool:
        return bool(len(self._lines))

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
        weight_of: dict[str, float] = {}
        for word, weight in zip(words, weights, strict=True):
            weight_of[word] = weight_of.get(word, 0.0) + weight
        total = np.zeros(self.count)
        for word, weight in weight_of.items():
            quality = self._qualities(word) if len(self._lines) else self._scores
            if quality.any():
                best, most = np.zeros(self.count), np.full(self._groups.max(initial=0) + 1, 1e-9)
                np.maximum.at(best, self._owners, self._scores * quality[self._lines])
                np.maximum.at(most, self._groups, best)
                total += weight * best * (best / most[self._groups]) ** RIVAL
        return total / max(sum(weights), 1)

    def _qualities(self, word: str) -> np.ndarray:
        """Quality in {0} ∪ [PART, 1] of the best match of a folded word with each of the lines."""
        texts, size = self._words, len(word)
        quality = np.zeros(len(texts.number))
        if size > SHORT:
            nearest, distance = texts.distances(word, max(SHORT + 1, QUALITY * size), (2 - QUALITY) * size)
            quality[nearest] = _quality(distance, size)
            within = range(max(SHORT + 1, math.ceil(PART * size)), math.ceil(QUALITY * size))
            for length in texts.lengths.intersection(within):
                parts = {word[at : at + length] for at in range(size - length + 1)}
                quality[[texts.number[part] for part in parts & texts.number.keys()]] = length / size
            run_together = texts.at_an_end(word)  # with the word before or after it
            quality[run_together] = np.maximum(quality[run_together], QUALITY)
        if word in texts.number:
            quality[texts.number[word]] = 1.0
        of_lines = np.maximum.reduceat(quality[self._words_of], self._starts)
        if size >= LONG:  # a shorter text lacks too many characters
            nearest, distance = self._joined.distances(word, QUALITY * size, inside=True)
            of_lines[nearest] = np.maximum(of_lines[nearest], _quality(distance, size))
        return of_lines


class Texts:
    """Many texts, shortest first, that are compared with a word all at once."""

    def __init__(self, texts: Iterable[str]) -> None:
        ordered = sorted(texts, key=len)
        self.number = {text: n for n, text in enumerate(ordered)}
        self._sizes = [len(text) for text in ordered]
        self.lengths = set(self._sizes)
        self._text = "\0".join(["", *ordered, ""])
        self._codes = np.frombuffer(self._text.encode("utf-32-le", "surrogatepass"), np.uint32)
        self._starts = np.cumsum([0, *(size + 1 for size in self._sizes)])  # each with the 0 before it

    def distances(
        self, word: str, least: float, most: float = math.inf, inside: bool = False
    ) -> tuple[slice, np.ndarray]:
        """Which texts have `least` to `most` characters, and of each Levenshtein's distance of `word` and the text; if
        `inside`, of `word` and the nearest stretch of the text."""
        some = slice(bisect_left(self._sizes, least), bisect_right(self._sizes, most))
        starts = self._starts[some.start : max(some.start, some.stop) + 1]
        if len(starts) < 2:
            return slice(0), np.zeros(0, int)
        codes, firsts, sizes = self._codes[starts[0] : starts[-1]], starts[:-1] - starts[0], np.diff(starts)
        slope = np.arange(len(codes)) + np.repeat(np.arange(len(sizes)) * (len(word) + int(sizes.max())), sizes)
        row = np.zeros(len(codes), int) if inside else np.arange(len(codes)) - np.repeat(firsts, sizes)
        for n, letter in enumerate(word, start=1):
            after = row + 1
            np.minimum(after[1:], row[:-1] + (codes[1:] != ord(letter)), out=after[1:])
            after[firsts] = n
            after -= slope  # so that the least up to a cell counts one more per cell, and none of another text
            row = np.minimum.accumulate(after, out=after)
            row += slope
        return some, np.minimum.reduceat(row, firsts) if inside else row[firsts + sizes - 1]

    def at_an_end(self, word: str) -> np.ndarray:
        """The numbers of the texts that begin or end with the word."""
        ends = re.compile(f"\0{re.escape(word)}|{re.escape(word)}(?=\0)")
        found = [match.end() - 1 for match in ends.finditer(self._text)]
        return np.searchsorted(self._starts, np.array(found, int), side="right") - 1


def _quality(distance: np.ndarray, length: int) -> np.ndarray:
    quality = 1.0 - distance / length
    return np.where(quality >= QUALITY, quality, 0.0)


def _folded(text: str) -> list[str]:
    """Its words in lower case, singular, with characters that OCR confuses made equal."""
    return [singular(word).translate(_SAME) for word in _WORD.findall(text.lower())]
