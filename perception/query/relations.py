"""Prompts with a relation: "the mug on the book", "the box left of the lamp". English only.

Such a prompt names a thing, a relation and another thing. Instances i are ranked for the thing, with the gain

    z_i + WEIGHT · f_i      f_i = max over j ≠ i of score(other, j) · f_j · g(i, j)

where g(i, j) in [0, 1] says how well the boxes of i and j, with z up, are in the relation, and f_j does the same for a
relation in the name of the other thing ("the cup on the desk next to the monitor"), else 1. "Left", "right", "in front"
and "behind" are as most photos that show both see them. If the other thing is not in the map, no instance gains.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from perception.errors import InputError
from perception.frame.gravity import up_from_cameras
from perception.language.negation import negation_in
from perception.language.printed import found_after_a_word, quoted_text
from perception.language.shapes import level_frame, ramp
from perception.map.map import Map
from perception.query.ranking import PRESENT, Ranking, Scorer

TRIM = 0.02  # share of an instance's points left out of its box at either end of each axis
WEIGHT = 3.0  # added to z for a full match, in standard deviations of the map's probes
NESTED = 3  # relations that are read in the name of the other thing; each costs as much as a prompt
ROWS = 256  # instances whose boxes are compared with all others at a time
_KINDS = {
    "on": ("on top of", "on", "upon"),
    "under": ("under", "underneath", "beneath", "below"),
    "above": ("above", "over"),
    "beside": ("next to", "beside", "near", "close to", "by"),
    "in": ("inside", "in"),
    "left": ("left of",),
    "right": ("right of",),
    "front": ("in front of",),
    "behind": ("behind",),
}
_KIND = {phrase: kind for kind, phrases in _KINDS.items() for phrase in phrases}
_RELATION = re.compile(  # in a text of single spaces, so that every repeat has an end
    r"(?<= )(?:(?:that|which) )?(?:(?:is|are) )?(?:(?:stand|sitt?|lie|ly|hang|lean)(?:s|ing)? )?"
    r"(?:(?:to|on|at) the (?=left|right))?"
    rf"(?P<relation>{'|'.join(sorted(_KIND, key=len, reverse=True))}) (?=.*\w)",  # "in front of" is not "in"
    re.IGNORECASE,
)
_DETAIL = re.compile(r"\b(?:with|of|full|made|without)\b", re.IGNORECASE)


@dataclass(frozen=True)
class Relation:
    """thing is in the relation `kind`, a key of _KINDS, to other."""

    thing: str
    kind: str
    other: str


def parse(prompt: str) -> Relation | None:
    """The relation in a prompt, None without one: "a mug on the red book" → Relation("a mug", "on", "the red book").

    What follows "with" or "of" describes the thing itself: "magazine with a shell on the cover" has no relation.
    """
    text = " ".join(prompt.split())
    match = found_after_a_word(_RELATION, text)
    kind = None if match is None else _KIND.get(match["relation"].lower())  # None too for "İn", as i without its case
    if match is None or kind is None or _DETAIL.search(text, 0, match.start()):
        return None
    return Relation(text[: match.start() - 1], kind, text[match.end() :])


def ranked(ranker: Scorer, boxes: LevelBoxes | None, text: str) -> Ranking:
    """The ranking of the instances for a prompt, by the relation in it if there is one and z is known. InputError where
    the prompt says what a thing is not (`negation_in`)."""
    if wrong := negation_in(text):
        raise InputError(wrong)
    relation = parse(text)
    if relation is None or boxes is None or quoted_text(text) is not None:
        return ranker.rank(text)
    return ranker.rank(relation.thing, gains_of(ranker, [(slice(None), boxes)], relation))


def gains_of(ranker: Scorer, maps: Sequence[tuple[slice, LevelBoxes]], relation: Relation) -> np.ndarray:
    """[2, I]: WEIGHT · f, and how much less that is than the most of the own map. maps: as of `fulfilled`."""
    gain = WEIGHT * fulfilled(ranker, maps, relation)
    most = gain.copy()
    for own, _ in maps:
        most[own] = gain[own].max(initial=0.0)
    return np.stack([gain, most - gain])


def fulfilled(
    ranker: Scorer, maps: Sequence[tuple[slice, LevelBoxes]], relation: Relation, nested_most: int = NESTED
) -> np.ndarray:
    """f [I] in [0, 1]: how well each instance is in the relation to the other thing.

    maps: of each map whose boxes are known, its slice of the ranker's instances, and the boxes. nested_most: relations
    that are read in the name of the other thing; further ones are taken as part of a name.
    """
    nested = parse(relation.other) if nested_most else None
    score = ranker.scores(relation.other if nested is None else nested.thing)
    further = np.ones(len(score)) if nested is None else fulfilled(ranker, maps, nested, nested_most - 1)
    best = np.zeros(len(score))
    for own, boxes in maps:
        if score[own].max(initial=0.0) >= PRESENT:
            others, of_map = score[own] * further[own], best[own]
            for rows, match in boxes.matches(relation.kind):
                of_map[rows] = (match * others[None]).max(axis=1, initial=0.0)
    return best


def level_from_map(gmap: Map) -> np.ndarray | None:
    """The rotation [3, 3] to a frame with z up: against the map's gravity or, where that is not recorded, up as the
    cameras were held; None if they were not held level."""
    down = (gmap.info.get("gravity") or {}).get("direction")
    up = up_from_cameras(gmap.poses) if down is None else -np.asarray(down, np.float64)
    return None if up is None else level_frame(up / np.linalg.norm(up))


class LevelBoxes:
    """lows, highs: [I, 3] corners of the instances' boxes, z up. poses: [C, 4, 4] cameras from that frame."""

    def __init__(self, lows: np.ndarray, highs: np.ndarray, poses: np.ndarray) -> None:
        self.lows, self.highs = np.asarray(lows, np.float64), np.asarray(highs, np.float64)
        self.poses = poses

    @classmethod
    def of(cls, gmap: Map) -> LevelBoxes | None:
        """The boxes of a map's instances; None if up is not known (`level_from_map`)."""
        level = level_from_map(gmap)
        if level is None:
            return None
        boxes = np.zeros((len(gmap.instances), 2, 3))
        for n, entry in enumerate(gmap.instances):
            points = gmap.index.of(entry["id"]) @ level.T
            if len(points):
                boxes[n] = np.quantile(points, [TRIM, 1 - TRIM], axis=0)
        poses = gmap.poses.copy()
        poses[:, :3, :3] = poses[:, :3, :3] @ level.T
        return cls(boxes[:, 0], boxes[:, 1], poses)

    def match(self, kind: str) -> np.ndarray:
        """g [I, I] in [0, 1]: how well the row's instance is in the relation to the column's; 0 to itself."""
        whole = np.zeros((len(self.lows), len(self.lows)))
        for rows, match in self.matches(kind):
            whole[rows] = match
        return whole

    def matches(self, kind: str) -> Iterator[tuple[slice, np.ndarray]]:
        """The rows of `match`, ROWS at a time: memory does not grow with the square of the instances."""
        for start in range(0, len(self.lows), ROWS):
            match = self._match(kind, rows := slice(start, start + ROWS))
            match[np.arange(len(match)), start + np.arange(len(match))] = 0
            yield rows, match

    def _match(self, kind: str, rows: slice) -> np.ndarray:
        low, high = self.lows[rows, None], self.highs[rows, None]
        other_low, other_high = self.lows[None], self.highs[None]
        other_size = np.maximum(self.highs - self.lows, 1e-9)
        size = other_size[rows]
        shared = np.clip(np.minimum(high, other_high) - np.maximum(low, other_low), 0, None) / size[:, None]
        covered = shared[..., 0] * shared[..., 1]  # share of its footprint that lies over or under the other's
        tall, other_tall = size[:, None, 2], other_size[None, :, 2]
        slack = 0.25 * np.minimum(tall, other_tall) + 0.02 * np.median(other_size.max(axis=1))
        below, top = low[..., 2] - other_high[..., 2], other_low[..., 2] + 0.2 * other_tall
        if kind == "on":
            return covered * ramp(below, 2 * slack, slack) * ramp(top - low[..., 2], slack, 0 * slack)
        area, other_area = size[:, 0] * size[:, 1], other_size[:, 0] * other_size[:, 1]
        smaller = np.minimum(area[:, None], other_area[None])
        stacked = np.minimum(1, covered * area[:, None] / smaller)  # share of the smaller footprint
        if kind == "above":
            return stacked * ramp(-below, 2 * slack, slack)
        if kind == "under":
            middle = (low + high)[..., 2] / 2
            return stacked * ramp(middle - other_high[..., 2], 0 * slack, -slack)
        if kind == "in":
            return covered * shared[..., 2]
        gaps = np.clip(np.maximum(other_low - high, low - other_high), 0, None)
        gap, reach = np.linalg.norm(gaps, axis=2), (size.max(axis=1)[:, None] + other_size.max(axis=1)[None]) / 2
        if kind == "beside":
            return ramp(gap, 1.5 * reach, 0.25 * reach) * (1 - stacked)
        return ramp(gap, 6 * reach, reach) * np.clip(2 * self._seen(kind, rows) - 1, 0, 1)

    def _seen(self, kind: str, rows: slice) -> np.ndarray:
        """[R, I]: share of the photos showing both in which the row's instance is left, right, in front or behind."""
        middles = (self.lows + self.highs) / 2
        yes, all_ = np.zeros((2, len(middles[rows]), len(middles)))
        for pose in self.poses:
            x, y, z = pose[:3, :3] @ middles.T + pose[:3, 3:]
            ahead = (z > 0) & (np.maximum(np.abs(x), np.abs(y)) < z)  # within 45° of the axis
            x = x / np.maximum(z, 1e-9)
            value = {"left": -x, "right": x, "front": -z, "behind": z}[kind]
            both = ahead[rows, None] & ahead[None]
            yes += both & (value[rows, None] > value[None])
            all_ += both
        return (yes + 0.5) / (all_ + 1)
