"""Relations in prompts: parsing by hand; geometry of a made desk; labels on a ranking with known vectors."""

from __future__ import annotations

import tracemalloc
from typing import Any

import numpy as np
import pytest

from perception.language.description import InstanceDescription
from perception.language.negation import negation_in
from perception.language.printed import Printed
from perception.query import relations
from perception.query.ranking import Ranker, answering
from perception.query.relations import LevelBoxes, Relation, parse, ranked


@pytest.mark.parametrize(
    ("prompt", "expected"),
    [
        ("the mug on the red book", ("the mug", "on", "the red book")),
        ("book on top of another book", ("book", "on", "another book")),
        ("box to the left of the lamp", ("box", "left", "the lamp")),
        ("a mug that stands next to a plate", ("a mug", "beside", "a plate")),
        ("shoes under the chair", ("shoes", "under", "the chair")),
        ("apple in the bowl", ("apple", "in", "the bowl")),
        ("cup standing behind the box", ("cup", "behind", "the box")),
        ("cup in front of the box", ("cup", "front", "the box")),
        ("cat sitting on the mat", ("cat", "on", "the mat")),
        ("a pen that is lying on the desk", ("a pen", "on", "the desk")),
        ("box on the left of the lamp", ("box", "left", "the lamp")),
        ("coat that hangs on the left wall", ("coat", "on", "the left wall")),
        ("magazine with a shell on the cover", None),
        ("bowl of fruit in the kitchen", None),
        ("onion", None),
        ("on the table", None),
        ("red mug", None),
    ],
)
def test_parsing_by_hand(prompt: str, expected: tuple[str, str, str] | None) -> None:
    assert parse(prompt) == (expected and Relation(*expected))


def test_prompts_that_say_what_a_thing_is_not() -> None:
    refused = (
        *("no mug", "Not a mug", "without a mug", "there is no mug", "none of the mugs", "a mug, not a bowl"),
        *("mug not on the table", "mug that isn't on it", "mug that isn’t on it", "mug no longer on the table"),
        *("everything except the mug", "anything but a mug", "mug neither on nor in the box", 'not "COKE"'),
        *("no mug that is not red", "mug that is not red and not on the table", "mug not in the red box"),
        *("mug without a handle", "desk with no mug", "mug that has no handle", "mug lacking a handle"),
        *(
            "not red or blue, not on the table",
            "mug that is not red or blue and has no handle",
            "non-red mug, not a bowl",
        ),
        *("red mug without a handle", "Without the lamp", "desk without a red mug or a lamp that is not on it"),
    )
    answered = (
        *(
            "mug that is not red",
            "mug, non-red",
            "not a red mug",
            "mug that is not red or blue",
            "mug that is not orange",
        ),
        *("no smoking sign", "do not enter sign", '"no smoking"', 'mug that says "not today"', "mug without red"),
        *("mug with no blue", "no-slip mat", "forget-me-not", "notebook", "knot", "all butter cookies"),
        "nonstick pan",
    )
    assert [text for text in refused if negation_in(text) is None] == []
    assert [text for text in answered if negation_in(text) is not None] == []


# low and high corners: a desk, a book on it, a mug on the book, a lamp on the desk's other end, a bin under the desk
NAMES = ["desk", "book", "mug", "lamp", "bin"]
BOXES = np.array(
    [
        [[0, 0, 0.70], [1.6, 0.8, 0.75]],
        [[0.2, 0.2, 0.75], [0.5, 0.4, 0.78]],
        [[0.3, 0.25, 0.78], [0.38, 0.33, 0.88]],
        [[1.3, 0.3, 0.75], [1.5, 0.5, 1.20]],
        [[0.5, 0.2, 0.0], [0.8, 0.5, 0.35]],
    ]
)


def _desk() -> LevelBoxes:
    """Seen by three cameras at y = -2 that look along +y, x to the right."""
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, :3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]  # right = x, down = -z, ahead = y
    poses[:, :3, 3] = [[-x, 0.8, 2] for x in (0.2, 0.8, 1.2)]
    return LevelBoxes(BOXES[:, 0], BOXES[:, 1], poses)


ON = {("book", "desk"), ("mug", "book"), ("lamp", "desk")}
LEFT = {("book", "lamp"), ("mug", "lamp"), ("bin", "lamp"), ("desk", "lamp"), ("book", "desk"), ("mug", "desk")}
LEFT |= {("bin", "desk"), ("mug", "book"), ("mug", "bin"), ("book", "bin")}
FRONT = {("mug", b) for b in ("book", "bin", "lamp", "desk")} | {("book", b) for b in ("bin", "lamp", "desk")}
FRONT |= {("bin", "lamp"), ("bin", "desk")}


@pytest.mark.parametrize(
    ("kind", "pairs"),
    [
        ("on", ON | {("mug", "desk")}),
        ("under", {(b, a) for a, b in ON} | {("bin", "desk"), ("desk", "mug")}),
        ("above", ON | {("desk", "bin"), ("mug", "desk")}),
        ("in", set()),
        ("left", LEFT),
        ("right", {(b, a) for a, b in LEFT}),
        ("front", FRONT),
        ("behind", {(b, a) for a, b in FRONT}),
    ],
)
def test_relations_of_a_made_desk(kind: str, pairs: set[tuple[str, str]]) -> None:
    match = _desk().match(kind)
    assert match.shape == (5, 5) and match.min() >= 0 and match.max() <= 1
    assert {(NAMES[i], NAMES[j]) for i, j in zip(*np.nonzero(match > 0.3), strict=True)} == pairs
    assert not np.diagonal(match).any()


@pytest.mark.parametrize("kind", ["on", "beside", "left"])
def test_relations_of_many_are_those_of_few_and_take_little_memory(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    few = _desk().match(kind)
    monkeypatch.setattr(relations, "ROWS", 2)
    assert np.array_equal(_desk().match(kind), few)
    monkeypatch.setattr(relations, "ROWS", 64)
    lows = np.random.default_rng(0).uniform(0, 30, (1000, 3))
    many, most = LevelBoxes(lows, lows + 0.5, np.eye(4)[None]), 0.0
    tracemalloc.start()
    for _, match in many.matches(kind):
        most = max(most, float(match.max()))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert most > 0 and peak < 16e6  # of [1000, 1000, 3] float64 one array has 24 MB


def test_beside_is_near_and_not_stacked() -> None:
    lows = np.array([[0.0, 0, 0], [0.15, 0, 0], [0, 0, 0.2], [3, 0, 0]])
    match = LevelBoxes(lows, lows + np.array([0.1, 0.1, 0.2]), np.zeros((0, 4, 4))).match("beside")
    assert match[0, 1] == match[1, 0] == pytest.approx(1, abs=0.2) and match[0, 2] == match[2, 0] == match[0, 3] == 0


class Axes:
    """Known words have an axis each, other texts a fixed random direction."""

    identity, dim, templates = "axes", 24, ("{}",)

    def encode_images(self, images: Any) -> np.ndarray:
        raise AssertionError

    def encode_texts(self, texts: Any) -> np.ndarray:
        words = {"book": 0, "the lamp": 1, "the shelf": 3}
        rows = [np.eye(24)[words[t]] if t in words else _direction(t) for t in texts]
        return np.array(rows, np.float32).reshape(-1, 24)


def _direction(text: str) -> np.ndarray:
    x = np.random.default_rng(list(text.encode())).normal(size=24)
    return x / np.linalg.norm(x)


def thing(axis: int) -> InstanceDescription:
    row = np.eye(24, dtype=np.float32)[axis]
    return InstanceDescription(row, row[None], np.zeros((24, 4), np.float32), ["a"], [(0, 0, 1, 1)])


def test_the_place_decides_between_equals_and_an_absent_other_changes_nothing() -> None:
    ranker = Ranker([thing(0), thing(0), thing(1)], Axes())
    lows = np.array([[0.0, 0, 0], [3, 0, 0], [3.5, 0, 0]])
    places = LevelBoxes(lows, lows + np.array([0.3, 0.3, 0.2]), np.zeros((0, 4, 4)))
    answer = ranked(ranker, places, "book next to the lamp")
    assert answer[0][0] == 1 and answering(answer)
    plain = ranker.rank("book")
    assert ranked(ranker, places, "book next to the shelf") == plain
    assert ranked(ranker, None, "book") == plain


def test_a_label_names_the_thing_and_not_its_place() -> None:
    """Two books, both called so by the user: the one next to the lamp answers, unless there is no such lamp."""
    labels = ["book", "Book", None]
    ranker = Ranker([thing(5), thing(6), thing(1)], Axes(), labels)
    lows = np.array([[0.0, 0, 0], [3, 0, 0], [3.5, 0, 0]])
    places = LevelBoxes(lows, lows + np.array([0.3, 0.3, 0.2]), np.zeros((0, 4, 4)))
    hits = ranked(ranker, places, "book next to the lamp")
    assert hits[0] == (1, 1.0) and [n for n, _ in answering(hits)] == [1]
    assert ranked(ranker, places, "book next to the shelf")[:2] == [(0, 1.0), (1, 1.0)] == ranker.rank("book")[:2]


def test_a_label_names_the_thing_and_not_its_print() -> None:
    texts: list[list[dict[str, Any]]] = [[], [{"text": "BIRDS", "score": 0.9}]]
    ranker = Ranker([thing(0), thing(0)], Axes(), ["book", "book"], printed=Printed(texts))
    assert [n for n, _ in answering(ranker.rank("book that says BIRDS"))] == [1]
    assert ranker.rank("book") == [(0, 1.0), (1, 1.0)]
    called = Ranker([thing(0), thing(5)], Axes(), [None, 'a book that says "FISH"'], printed=Printed(texts))
    assert called.rank('A book that says "fish"')[0] == (1, 1.0)


def test_relations_may_be_chained() -> None:
    """Both books stand next to a lamp; one lamp stands next to the shelf."""
    ranker = Ranker([thing(axis) for axis in (0, 0, 1, 1, 3)], Axes())
    lows = np.array([[0.0, 0, 0], [6.0, 0, 0], [0.5, 0, 0], [6.5, 0, 0], [7.0, 0, 0]])
    places = LevelBoxes(lows, lows + np.array([0.3, 0.3, 0.2]), np.zeros((0, 4, 4)))
    hits = dict(ranked(ranker, places, "book next to the lamp next to the shelf"))
    assert hits[1] > hits[0] and hits[1] == max(hits.values())
    once = dict(ranked(ranker, places, "book next to the lamp"))
    assert once[0] == pytest.approx(once[1])
