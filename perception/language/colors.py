"""Measured colours of instances, and colour words.

The palette of an instance: the most frequent CIELAB colours of its pixels with their shares. A colour word is defined
by a few sRGB examples e. With d² = (LIGHTNESS ΔL*)² + Δa*² + Δb*² to the nearest example, the word covers the fraction
Σ share · exp(−d² / 2 SIGMA²) of an instance. Lightness has less weight, because exposure and shade change it.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from itertools import dropwhile

import numpy as np

from perception.geometry import sums_by
from perception.language.shape_words import head_noun

PALETTE = 24  # colours kept per instance
BIN = 8.0  # CIELAB units per histogram cell
SIGMA = 15.0  # CIELAB distance at which a colour counts 60 %
LIGHTNESS = 0.6  # weight of a lightness difference relative to one of hue or chroma
# sRGB (IEC 61966-2-1) and CIE 1931 with D65, as scikit-image has them.
_LINEAR = np.arange(256) / 255
_LINEAR = np.where(_LINEAR > 0.04045, ((_LINEAR + 0.055) / 1.055) ** 2.4, _LINEAR / 12.92)
_XYZ_FROM_RGB = np.array(
    [[0.412453, 0.357580, 0.180423], [0.212671, 0.715160, 0.072169], [0.019334, 0.119193, 0.950227]]
)
_WHITE = np.array([0.95047, 1.0, 1.08883])

# Examples of the English colour words, sRGB 0–255. Words with a wide range have several.
_EXAMPLES: dict[str, tuple[tuple[int, int, int], ...]] = {
    "red": ((200, 25, 30), (150, 20, 25), (220, 60, 50)),
    "orange": ((240, 130, 30), (215, 105, 30), (250, 160, 60)),
    "yellow": ((245, 215, 50), (220, 190, 50), (250, 235, 120)),
    "green": ((40, 140, 60), (90, 170, 70), (30, 90, 45), (110, 140, 60)),
    "blue": ((35, 80, 180), (30, 50, 110), (90, 140, 210)),
    "purple": ((120, 50, 150), (80, 40, 110), (150, 100, 180)),
    "pink": ((240, 150, 180), (230, 100, 150)),
    "brown": ((110, 65, 35), (75, 45, 25), (145, 95, 60)),
    "black": ((15, 15, 15), (40, 40, 42)),
    "white": ((250, 250, 250), (220, 220, 218)),
    "gray": ((128, 128, 128), (90, 90, 90), (170, 170, 170)),
    "beige": ((225, 205, 170), (200, 180, 145)),
    "turquoise": ((50, 190, 180), (30, 140, 140)),
    "gold": ((200, 160, 60),),
    "silver": ((180, 182, 185), (140, 142, 145)),
}
COLOR_NAMES = tuple(_EXAMPLES)
_SYNONYMS = {
    "grey": "gray", "crimson": "red", "scarlet": "red", "maroon": "red", "reddish": "red", "violet": "purple",
    "lilac": "purple", "magenta": "pink", "cyan": "turquoise", "teal": "turquoise", "tan": "beige",
    "cream": "beige", "navy": "blue", "bluish": "blue", "golden": "gold", "silvery": "silver",
    "olive": "green", "greenish": "green", "amber": "orange", "yellowish": "yellow", "brownish": "brown",
}  # fmt: skip
COLOR_WORDS, NOT = (*COLOR_NAMES, "many"), "not "
"""All that `color_words` returns, with NOT before it or without."""
_NOT = re.compile(r"(?:\b(?:not|no|non|without|neither|nor)|n['’]t)(?: an?| the)?[ -]$", re.IGNORECASE)
"""What ends before a colour that a thing is not to have."""
_MANY = {"colorful", "colourful", "multicolored", "multicoloured", "rainbow"}
_PATTERN = re.compile(r"[^\W\d_]+")
# Fruit and metals: before one of these nouns the word is part of the object's name, not a colour.
_NOT_A_COLOR = {
    ("orange", "juice"), ("orange", "tree"), ("gold", "fish"), ("black", "board"), ("white", "board"),
    ("black", "pepper"), ("red", "wine"), ("white", "wine"), ("green", "tea"), ("black", "tea"),
}  # fmt: skip


def color_words(text: str) -> list[str]:
    """Colour words of a text in canonical spelling, in order, without duplicates. "many" stands for multicoloured, and
    "not red" for what a thing is not to be."""
    return list(dict.fromkeys(name for name, _ in _colors_said(text)))


def denials(text: str) -> list[tuple[int, int]]:
    """(start, end) of each "not " of a text that stands before a colour."""
    return [span for _, span in _colors_said(text) if span is not None]


def _colors_said(text: str) -> Iterator[tuple[str, tuple[int, int] | None]]:
    """(colour word as of `color_words`, place of the "not " before it, if any) of each in a text."""
    found = list(_PATTERN.finditer(text))
    words = [match[0].lower() for match in found]
    fruit, ruled_out = head_noun(text) == "orange", -2
    for n, word in enumerate(words):
        before, after = words[n - 1] if n else "", words[n + 1] if n + 1 < len(words) else ""
        if (word, after) in _NOT_A_COLOR:
            continue
        if word == "orange" and (fruit or not (after or before in ("is", "are", "not", "t"))):  # "isn't": "isn", "t"
            continue
        name = "many" if word in _MANY else _SYNONYMS.get(word, word)
        if name in _EXAMPLES or name == "many":
            end = found[n].start()
            denied = _NOT.search(text[:end], max(0, end - 15))
            if denied or (before == "or" and ruled_out == n - 2):
                name, ruled_out = f"{NOT}{name}", n
            yield name, denied and denied.span()


def without_color_words(text: str) -> str:
    """The text without its colour words. Returns the text unchanged if nothing else would be left."""
    drop = set(color_words(text))

    def keep(word: str) -> bool:
        bare = word.lower().strip(",.;:-")
        name = "many" if bare in _MANY else _SYNONYMS.get(bare, bare)
        return name not in drop

    words = dropwhile(lambda word: word.lower() == "and", filter(keep, text.split()))
    return " ".join(words) or text


def palette(pixels: np.ndarray) -> np.ndarray:
    """Most frequent colours of sRGB pixels [P, 3] uint8: float32 [PALETTE, 4] rows (L*, a*, b*, share), share falling.

    Shares sum to 1. Short palettes are padded with zero rows. Without pixels all rows are zero.
    """
    out = np.zeros((PALETTE, 4), np.float32)
    if not len(pixels):
        return out
    lab = lab_of(pixels)
    cells = np.floor(lab / BIN).astype(np.int64) @ np.array([1 << 20, 1 << 10, 1])  # a and b lie within ±2^9 cells
    _, inverse, counts = np.unique(cells, return_inverse=True, return_counts=True)
    sums = sums_by(inverse, lab, len(counts))
    top = np.argsort(-counts, kind="stable")[:PALETTE]
    out[: len(top), :3] = sums[top] / counts[top, None]
    out[: len(top), 3] = counts[top] / counts[top].sum()
    return out


def lab_of(pixels: np.ndarray) -> np.ndarray:
    """sRGB [P, 3] uint8 → CIELAB (D65) [P, 3] float64. scikit-image has it too, but takes longer to import than a
    prompt to answer."""
    xyz = _LINEAR[np.asarray(pixels, np.uint8)] @ _XYZ_FROM_RGB.T / _WHITE
    x, y, z = np.where(xyz > 0.008856, np.cbrt(xyz), 7.787 * xyz + 16 / 116).T
    return np.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)], axis=1)


def color_share(palettes: np.ndarray, word: str) -> np.ndarray:
    """Fraction of each instance that a colour word covers: palettes [I, P, 4] → [I] in [0, 1]."""
    weights = palettes[..., 3]
    if word == "many":  # share-weighted standard deviation in the a*b* plane, 1 at 40 CIELAB units
        mean = (palettes[..., 3:] * palettes[..., 1:3]).sum(axis=1, keepdims=True)
        spread = (weights * ((palettes[..., 1:3] - mean) ** 2).sum(axis=-1)).sum(axis=1)
        return np.minimum(1.0, np.sqrt(spread) / 40.0)
    examples = lab_of(np.array(_EXAMPLES[word], np.uint8))
    apart = palettes[..., None, :3] - examples
    squared = (LIGHTNESS * apart[..., 0]) ** 2 + apart[..., 1] ** 2 + apart[..., 2] ** 2
    near = np.exp(-squared.min(axis=-1) / (2 * SIGMA**2))
    return (weights * near).sum(axis=-1)


def match_of_shares(shares: Sequence[np.ndarray]) -> np.ndarray:
    """Match of each instance with all colour words [I] in [0, 1], from the share [I] of each word (at least one): 1
    where half of the instance has the colour."""
    match = np.ones(len(shares[0]))
    for share in shares:
        match *= np.minimum(1.0, share / (0.5 / len(shares)))
    return match ** (1.0 / len(shares))
