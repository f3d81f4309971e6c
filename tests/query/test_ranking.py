"""Ranking against closed forms with known vectors; colours against known CIELAB values; the stored form."""

from __future__ import annotations

import io
import sys
from collections.abc import Sequence
from functools import cache
from itertools import chain
from typing import Any

import numpy as np
import pytest
from scipy.special import ndtr, ndtri
from scipy.stats import norm
from skimage.color import rgb2lab

from perception.errors import InputError
from perception.language.base import Part, Reading, normal_cdf
from perception.language.colors import (
    color_share,
    color_words,
    lab_of,
    match_of_shares,
    palette,
    without_color_words,
)
from perception.language.conse import ConseEncoder
from perception.language.description import (
    InstanceDescription,
    check_encoder,
    from_arrays,
    to_arrays,
    unseen,
)
from perception.language.printed import Printed
from perception.language.shape_words import KINDS
from perception.query.ranking import (
    BESIDE,
    LAPSE,
    PRESENT,
    Ranker,
    Ranking,
    TextEncoder,
    answering,
    least_score,
    lines,
    probes,
)
from score.queries import ABSENT, HOUSEHOLD

DIM = 24


@cache
def conse() -> TextEncoder:
    return TextEncoder(ConseEncoder())


def rank(prompt: str, things: list[InstanceDescription], encoder: Any, labels: Any = None) -> Ranking:
    return Ranker(things, encoder, labels).rank(prompt)


class Table:
    """A hand-made encoder: known words have known vectors, every other text a fixed random direction."""

    identity, dim, templates = "table", DIM, ("{}",)

    def __init__(self, known: dict[str, np.ndarray]) -> None:
        self.known = known

    def encode_images(self, images: Sequence[np.ndarray]) -> np.ndarray:
        raise AssertionError("no pictures in these tests")

    def encode_texts(self, texts: Sequence[str]) -> np.ndarray:
        rows = [self.known[t] if t in self.known else _direction(t) for t in texts]
        return np.array(rows, np.float32)


def _direction(text: str) -> np.ndarray:
    x = np.random.default_rng(list(text.encode())).normal(size=DIM)
    return x / np.linalg.norm(x)


def _thing(vector: np.ndarray, rgb: tuple[int, int, int] = (128, 128, 128)) -> InstanceDescription:
    colors = palette(np.array([rgb], np.uint8))
    row = vector.astype(np.float32)
    return InstanceDescription(row, row[None], colors, ["a.jpg"], [(0, 0, 1, 1)])


@pytest.fixture
def scene() -> tuple[Table, list[InstanceDescription]]:
    axes = np.eye(DIM)
    things = [
        _thing(axes[0], (200, 30, 30)),
        _thing(axes[0], (30, 60, 200)),
        _thing(axes[1]),
        _thing(axes[2]),
    ]
    return Table({"mug": axes[0], "plate": axes[1], "lamp": axes[2]}), things


def test_what_fits_comes_first_and_is_present(scene: tuple[Table, list[InstanceDescription]]) -> None:
    encoder, things = scene
    answer = rank("plate", things, encoder)
    assert answering(answer) and answer[0][0] == 2
    scores = [s for _, s in answer]
    assert scores == sorted(scores, reverse=True) and min(scores) >= 0 and max(scores) <= 1


def test_color_words_choose_between_equals(scene: tuple[Table, list[InstanceDescription]]) -> None:
    encoder, things = scene
    ranker = Ranker(things, encoder)
    assert ranker.rank("red mug")[0][0] == 0
    assert ranker.rank("blue mug")[0][0] == 1
    assert ranker.rank("mug")[0][1] == pytest.approx(ranker.rank("mug")[1][1])


def test_an_encoder_that_knows_colours_reads_the_whole_prompt() -> None:
    """ "rubber duck with red hat" must not become "rubber duck with hat", nor a red thing its answer."""
    axes = np.eye(DIM)
    things = [_thing(axes[0], (200, 30, 30)), _thing(axes[1], (240, 210, 40)), _thing(axes[2], (30, 60, 200))]
    encoder = Table({"rubber duck with red hat": axes[1], "rubber duck with hat": axes[2]})
    assert rank("rubber duck with red hat", things, encoder)[0][0] == 2
    encoder.reading = Reading(colors=True)  # type: ignore[attr-defined]
    assert rank("rubber duck with red hat", things, encoder)[0][0] == 1


def test_similarity_is_the_plain_cosine() -> None:
    axes = np.eye(DIM)
    things = [_thing(axes[0]), _thing((axes[0] + axes[1]) / np.sqrt(2)), unseen(DIM)]
    found = Ranker(things, Table({"mug": axes[0], "red mug": axes[1]})).similarity(["mug", "red mug"])
    np.testing.assert_allclose(found, [[1, np.sqrt(0.5), -1], [0, np.sqrt(0.5), -1]], atol=1e-6)


def test_absent_things_are_not_present(scene: tuple[Table, list[InstanceDescription]]) -> None:
    """Texts that fit nothing pass about as often as probes do, never as a rule."""
    encoder, things = scene
    ranker = Ranker(things, encoder)
    passed = [bool(answering(ranker.rank(f"absent thing {n}"))) for n in range(400)]
    assert np.mean(passed) == pytest.approx(0.2, abs=0.1)
    assert answering(ranker.rank("mug"), 1.1) == []


def test_order_of_instances_changes_no_score(scene: tuple[Table, list[InstanceDescription]]) -> None:
    encoder, things = scene
    forward = dict(rank("mug", things, encoder))
    backward = dict(rank("mug", things[::-1], encoder))
    assert all(forward[i] == pytest.approx(backward[3 - i], abs=1e-6) for i in range(4))


def test_a_users_label_is_the_name(scene: tuple[Table, list[InstanceDescription]]) -> None:
    encoder, things = scene
    answer = rank("Grandma's  cup", things, encoder, labels=[None, "grandma's cup", None, None])
    assert answer[0] == (1, 1.0) and answering(answer)
    with pytest.raises(InputError, match=r"expected one per instance \(4\), found 1"):
        rank("mug", things, encoder, labels=["a"])


def test_a_label_that_means_the_prompt_is_an_answer(scene: tuple[Table, list[InstanceDescription]]) -> None:
    encoder, things = scene
    encoder.known["beaker"] = np.eye(DIM)[0] * 0.98 + np.eye(DIM)[5] * 0.199
    answer = rank("mug", things, encoder, labels=[None, None, None, "beaker"])
    without = rank("mug", things, encoder)
    assert dict(answer)[3] > 0.9 > dict(without)[3]
    assert dict(answer)[2] == pytest.approx(dict(without)[2])


@pytest.mark.parametrize("label", ["Werkzeugwagen", "книга", "桌子", "K17"])
def test_a_label_that_the_encoder_cannot_read_answers_to_itself_alone(label: str) -> None:
    ranker = Ranker([unseen(ConseEncoder.dim)], conse(), [label])
    for prompt in ("Schraubendreher", "ноутбук", "电视", "T800", "and"):  # others, in words that no list here holds
        assert not answering(ranker.rank(prompt))
    assert ranker.rank(label) == [(0, 1.0)]


def test_a_prompt_of_which_the_encoder_knows_no_word_is_answered_by_print_and_names_alone() -> None:
    """Each thing, red, looks as the encoder takes one of the prompts to be."""
    encoder, prompts = conse(), ["🍌", "red 🍌", "καρέκλα", "কলা", "여우", "ＦＯＸ", "狐", "?", "..."]
    things = [_thing(row, (200, 25, 30)) for row in encoder.encoder.encode_texts(prompts)]
    print_of_3 = Printed([[{"text": "КОФЕ", "score": 1.0}] if n == 3 else [] for n in range(len(things))])
    plain, named = Ranker(things, encoder), Ranker(things, encoder, ["🦊", "αλεπού", "শিয়াল", *prompts[:6]])
    printed = Ranker(things, encoder, printed=print_of_3)
    for n, prompt in enumerate(prompts):
        assert not answering(plain.rank(prompt))
        assert [i for i, _ in answering(named.rank(prompt))] == ([n + 3] if n < 6 else [])
    assert [i for i, _ in answering(printed.rank("кофе"))] == [3] and not answering(printed.rank("чай"))


@pytest.mark.parametrize(("label", "prompt"), [("red mug", "cup"), ("armchair", "chair"), ("fridge", "refrigerator")])
def test_a_label_in_words_that_the_encoder_knows_answers_to_others_for_it(label: str, prompt: str) -> None:
    assert answering(rank(prompt, [unseen(ConseEncoder.dim)], conse(), labels=[label]))


def test_labels_are_compared_without_regard_to_capitals_and_to_how_accents_are_written(
    scene: tuple[Table, list[InstanceDescription]],
) -> None:
    encoder, things = scene
    for label, prompt in (("Cafe\u0301", "caf\u00c9"), ("Straße", "STRASSE"), ("my_cup", "My cup")):
        assert rank(prompt, things, encoder, labels=[None, label, None, None])[0] == (1, 1.0)


def test_an_empty_map_and_unseen_instances(scene: tuple[Table, list[InstanceDescription]]) -> None:
    encoder, things = scene
    assert rank("mug", [], encoder) == [] and not answering(rank("mug", [], encoder))
    answer = rank("mug", [unseen(DIM), things[0]], encoder)
    assert answer[-1] == (0, 0.0)
    assert not answering(rank("mug", [unseen(DIM)], encoder))
    with pytest.raises(InputError, match="it is empty"):
        rank("  ", things, encoder)
    with pytest.raises(InputError, match="embeddings have 3 dimensions"):
        rank("mug", [unseen(3)], encoder)


def test_letters_without_meaning_are_told_from_things(monkeypatch: pytest.MonkeyPatch) -> None:
    """Random letters, random syllables and what people type, none of it in nonsense.txt, and things that are absent in
    the scorer's scenes."""
    rng, consonants = np.random.default_rng(3), "bcdfghjklmnpqrstvwxz"
    letters = ["".join(rng.choice([*consonants, *"aeiou"], rng.integers(4, 8))) for _ in range(40)]
    spoken = ["".join(rng.choice([*of]) for of in (consonants, "aeiou") * 3) for _ in range(40)]
    typed = ["asdf qwer", "blorf", "xqzzt", "zorp", "sdkfjh", "florp glarb", "qwe rty", "wug"]
    assert not set(letters + spoken + typed) & set(lines("nonsense.txt"))
    over = conse().meaningless(conse().embed([*letters, *spoken, *typed]))
    assert (over > 0).mean() > 0.6  # .74; others are made of syllables of real words
    assert not conse().meaningless(conse().embed([*ABSENT, *HOUSEHOLD, *probes()])).any()
    things = [_thing(row) for row in conse().embed(["mug", "chair", "book"])]
    before = [rank(prompt, things, conse()) for prompt in ("zorp", "mug")]
    monkeypatch.setattr("perception.query.ranking.NONSENSE_WEIGHT", 0.0)
    after = [rank(prompt, things, conse()) for prompt in ("zorp", "mug")]
    assert before[0][0][1] < after[0][0][1] and before[1] == after[1]


def test_probes_are_many_and_unique() -> None:
    assert len(probes()) == len(set(probes())) >= 100


def test_lab_of_known_colors() -> None:
    """Published CIELAB (D65) values of the sRGB primaries."""
    rgb = np.array([[255, 255, 255], [0, 0, 0], [255, 0, 0], [0, 255, 0], [0, 0, 255]], np.uint8)
    expected = [
        [100, 0, 0],
        [0, 0, 0],
        [53.24, 80.09, 67.20],
        [87.73, -86.18, 83.18],
        [32.30, 79.19, -107.86],
    ]
    assert np.allclose(lab_of(rgb), expected, atol=0.02)


def test_lab_equals_scikit_image() -> None:
    rgb = np.concatenate([np.random.default_rng(0).integers(0, 256, (2000, 3)), np.tile(np.arange(256)[:, None], 3)])
    assert np.allclose(lab_of(rgb), rgb2lab(rgb.astype(np.uint8)), atol=1e-10)


def test_normal_distribution_equals_scipy() -> None:
    z = np.linspace(-9, 9, 5001)
    assert np.allclose(normal_cdf(z), ndtr(z), rtol=1e-13, atol=0)
    assert np.allclose(normal_cdf(z.astype(np.float32)), ndtr(z.astype(np.float32)), rtol=1e-5, atol=0)
    best = np.linspace(0, 1, 1001)
    evidence = ndtri(np.clip(best / (1 - LAPSE), 1e-9, 1 - 1e-9))
    expected = np.maximum(PRESENT, (1 - LAPSE) * ndtr(evidence - BESIDE))
    assert np.allclose(least_score(best), expected, rtol=1e-12)


def test_the_normal_distribution_without_the_compiled_core(monkeypatch: pytest.MonkeyPatch) -> None:
    """As in a robot's Python that has the sources alone."""
    z = np.linspace(-9, 9, 101)
    expected = normal_cdf(z)
    monkeypatch.setitem(sys.modules, "perception._core", None)
    assert np.allclose(normal_cdf(z), expected, rtol=1e-13, atol=0)


def test_palette_shares_and_means() -> None:
    pixels = np.array([[255, 0, 0]] * 3 + [[255, 255, 255]], np.uint8)
    colors = palette(pixels)
    assert colors[:2, 3].tolist() == [0.75, 0.25] and not colors[2:].any()
    assert np.allclose(colors[0, :3], [53.24, 80.09, 67.20], atol=0.02)
    assert not palette(np.zeros((0, 3), np.uint8)).any()


@pytest.mark.parametrize(
    ("text", "words", "rest"),
    [
        ("red mug", ["red"], "mug"),
        ("yellow and white cup", ["yellow", "white"], "cup"),
        ("a Grey, golden chair", ["gray", "gold"], "a chair"),
        ("orange juice carton", [], "orange juice carton"),
        ("orange", [], "orange"),
        ("the orange on the white plate", ["white"], "the orange on the plate"),
        ("the mug that is not red", ["not red"], "the mug that is not red"),
        ("white mug, non-red", ["white", "not red"], "mug, non-red"),
        ("mug that isn't a blue one", ["not blue"], "mug that isn't a blue one"),
        ("mug that is neither red nor blue", ["not red", "not blue"], "mug that is neither red nor blue"),
        ("mug that is not red or blue", ["not red", "not blue"], "mug that is not red or blue"),
        ("red or blue mug", ["red", "blue"], "or mug"),
        ("mug that is orange", ["orange"], "mug that is"),
        ("mug that isn't orange", ["not orange"], "mug that isn't orange"),
        ("knot red mug", ["red"], "knot mug"),
        ("orange food box", ["orange"], "food box"),
        ("colorful cube toy", ["many"], "cube toy"),
        ("red", ["red"], "red"),
        ("whiteboard", [], "whiteboard"),
        ("красная чашка", [], "красная чашка"),
    ],
)
def test_color_words(text: str, words: list[str], rest: str) -> None:
    assert color_words(text) == words
    assert without_color_words(text) == rest


def test_a_colour_that_is_ruled_out_speaks_for_the_others() -> None:
    axes, prompts = np.eye(DIM), ("red mug", "mug that is not red", "white mug, not red")
    encoder = Table(dict.fromkeys(("mug", *prompts, "mug, not red"), axes[0]))
    things = [_thing(axes[0], (200, 25, 30)), _thing(axes[0], (250, 250, 250)), _thing(axes[1])]
    assert [rank(prompt, things, encoder)[0][0] for prompt in prompts] == [0, 1, 1]
    assert [i for i, _ in answering(rank("mug", things, encoder))] == [0, 1]


def test_shares_follow_the_painted_fraction() -> None:
    red, white = [200, 25, 30], [250, 250, 250]
    mixed = np.stack([palette(np.array([red] * n + [white] * (10 - n), np.uint8)) for n in (0, 3, 10)])
    share = color_share(mixed, "red")
    assert share[0] < 0.02 and share[1] == pytest.approx(0.3, abs=0.02) and share[2] == pytest.approx(1, abs=0.01)
    assert np.argmax(match_of_shares([share, color_share(mixed, "white")])) == 1
    assert np.argmax(match_of_shares([color_share(mixed, "white")])) == 0


def test_stored_form_round_trips(scene: tuple[Table, list[InstanceDescription]]) -> None:
    things = [scene[1][0], unseen(DIM), scene[1][2]]
    things[0].views, things[0].boxes = ["ä/1.jpg", "2.jpg"], [(1, 2, 3, 4), (5, 6, 7, 8)]
    things[0].per_view = np.eye(DIM, dtype=np.float32)[:2]
    file = io.BytesIO()
    np.savez(file, **to_arrays(things, "table"))
    file.seek(0)
    read, encoder = from_arrays(dict(np.load(file)))
    assert encoder == "table" and len(read) == 3
    for a, b in zip(things, read, strict=True):
        assert np.array_equal(a.embedding, b.embedding) and np.array_equal(a.per_view, b.per_view)
        assert np.array_equal(a.palette, b.palette) and a.views == b.views and a.boxes == b.boxes
    empty, _ = from_arrays(to_arrays([], "table"))
    assert empty == []


def test_another_encoder_is_refused() -> None:
    with pytest.raises(InputError, match="made by 'conse-2', the encoder in use is 'clip/x'"):
        check_encoder("conse-2", "clip/x")


class Read(Table):
    """The table with a reading of its own."""

    def __init__(self, known: dict[str, np.ndarray], reading: Reading) -> None:
        super().__init__(known)
        self.reading = reading


def _z(scores: list[tuple[int, float]]) -> np.ndarray:
    """Scores back on the normal scale, in the order of the instances."""
    return np.array([norm.ppf(s / (1 - LAPSE)) for _, s in sorted(scores)])


def test_no_picture_makes_an_answer_certain(scene: tuple[Table, list[InstanceDescription]]) -> None:
    encoder, things = scene
    shapes = np.zeros((4, len(KINDS)))
    shapes[:, KINDS.index("wall")] = 1.0
    sure = Ranker(things, encoder, shapes=lambda: shapes).rank("wall")
    assert 0.9 < sure[0][1] <= 1 - LAPSE
    assert rank("stove", things, encoder, ["stove", None, None, None])[0] == (0, 1.0)  # the user said so


def test_a_margin_is_taken_off_every_answer(scene: tuple[Table, list[InstanceDescription]]) -> None:
    encoder, things = scene
    for text in ("plate", "vague prompt"):
        plain = _z(rank(text, things, encoder))
        strict = _z(rank(text, things, Read(encoder.known, Reading(calibration=(1.0, -0.7)))))
        assert np.allclose(plain - strict, 0.7, atol=1e-6)


def test_none_one_or_several_answer() -> None:
    """Scores by their quantiles: .7 behind the best is too far, .5 is not; below PRESENT nothing answers."""
    hits = [(n, (1 - LAPSE) * float(norm.cdf(x))) for n, x in enumerate((2.0, 1.5, 1.3, -1.0))]
    assert answering(hits) == hits[:2] and answering(hits[1:]) == hits[1:3] and answering(hits[3:]) == []
    assert answering(hits, 0.0) == hits and answering(hits, 0.99) == [] and answering([]) == []
    assert answering([(1, PRESENT + 0.01), (0, PRESENT - 0.01)]) == [(1, PRESENT + 0.01)]
    assert answering([(0, 1.0), (1, 1.0), (2, 0.97)]) == [(0, 1.0), (1, 1.0)]  # labels that equal the prompt


def test_shapes_add_by_kind_and_only_where_named(scene: tuple[Table, list[InstanceDescription]]) -> None:
    encoder, things = scene
    shapes = np.zeros((len(things), len(KINDS)))
    shapes[3, KINDS.index("wall")], shapes[1, KINDS.index("box")] = 1.0, 0.75
    flat, shaped = Ranker(things, encoder), Ranker(things, encoder, shapes=lambda: shapes)
    wall = _z(shaped.rank("brick wall")) - _z(flat.rank("brick wall"))
    assert np.allclose(wall, [-3, -3, -3, 3], atol=1e-6)
    box = _z(shaped.rank("box")) - _z(flat.rank("box"))
    assert np.allclose(box, [0, 1.5, 0, -2], atol=1e-6)  # a wall is no household thing
    assert shaped.rank("vague prompt") == flat.rank("vague prompt")
    assert flat.shapes is None and Ranker(things, shaped.encoder).rank("box") == flat.rank("box")


def test_canonical_phrases_cap_what_they_fit_better() -> None:
    """LERF's relevancy by hand: at equal fit one half, which is the threshold; below it no answer is present."""
    axes = np.eye(DIM)
    known = {"mug": axes[0], "thing": (axes[0] + axes[1]) / np.sqrt(2)}
    things = [_thing(axes[0]), _thing((axes[0] + 2 * axes[1]) / np.sqrt(5)), _thing(axes[3])]
    free = dict(Ranker(things, Table(known)).rank("mug"))
    capped = dict(Ranker(things, Read(known, Reading(canonical=("thing",)))).rank("mug"))
    for i, thing in enumerate(things):
        own, rival = (float(thing.embedding @ known[name]) for name in ("mug", "thing"))
        relevancy = np.exp(10 * own) / (np.exp(10 * own) + np.exp(10 * rival))
        assert capped[i] == pytest.approx(min(free[i], 1.6 * relevancy), abs=1e-6)
    assert capped[1] < 0.1


def test_parts_are_compared_each_on_its_own() -> None:
    """Two parts of weight .3 and .7: what another length of one part's numbers would change, changes nothing."""
    rng = np.random.default_rng(0)
    halves = rng.normal(size=(5, 2, DIM // 2))
    halves /= np.linalg.norm(halves, axis=2, keepdims=True)
    texts = {name: rng.normal(size=DIM) for name in ("mug", "plate")}
    reading = Reading((Part(DIM // 2, 0.3), Part(DIM, 0.7)))
    orders = []
    for scale in (1.0, 5.0):
        rows = np.concatenate([halves[:, 0], scale * halves[:, 1]], axis=1) / np.sqrt(1 + scale**2)
        ranker = Ranker([_thing(row) for row in rows], Read(texts, reading))
        orders.append([ranker.rank(name) for name in texts])
    for (i, a), (j, b) in zip(chain(*orders[0]), chain(*orders[1]), strict=True):
        assert i == j and a == pytest.approx(b, abs=1e-5)
    less = halves - 0.5 * halves.mean(axis=0)
    less /= np.linalg.norm(less, axis=2, keepdims=True)
    mug = texts["mug"].reshape(2, -1) / np.linalg.norm(texts["mug"].reshape(2, -1), axis=1, keepdims=True)
    x = 0.3 * less[:, 0] @ mug[0] + 0.7 * less[:, 1] @ mug[1]
    assert [i for i, _ in orders[0][0]] == np.argsort(-x).tolist()
    assert np.allclose(ranker.relevancy(["mug"])[0], x, atol=1e-5)


@pytest.mark.parametrize("text", ["красная кружка", "赤いマグカップ", "🙂", "كوب", "mug; DROP TABLE", "a" * 5000])
def test_any_script_gets_an_answer(scene: tuple[Table, list[InstanceDescription]], text: str) -> None:
    encoder, things = scene
    hits = rank(text, things, encoder)
    assert sorted(i for i, _ in hits) == [0, 1, 2, 3] and all(0 <= s <= 1 for _, s in hits)
