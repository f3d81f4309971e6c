"""The table of household things, read by a plain parser of its own; sizes by hand."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from perception.language import household
from perception.language.description import InstanceDescription
from perception.language.household import Household, class_names, household_thing, size_misfits
from perception.query.ranking import Ranker
from perception.query.text_ranking import extents


def test_every_line_names_known_classes_and_no_word_twice() -> None:
    text = (Path(household.__file__).parent / "household.txt").read_text(encoding="utf-8")
    lines = [line.split(" | ") for line in text.splitlines() if not line.startswith("#")]
    words = [word for line in lines for word in line[0].split(", ")]
    firsts = {names[0] for names in class_names()}
    named = {name.lower() for names in class_names() for name in names}
    assert "laptop" in named and household_thing("laptop").classes is None  # type: ignore[union-attr]
    assert len(words) == len(set(words)) > 450
    for line in lines:
        least, most = map(int, line[2].split("-"))
        assert 0 < least < most < 1000 and set(line[1].split(", ")) <= firsts and 0 < int(line[3]) <= most
        word = line[0].split(", ")[-1]
        known = household_thing(f"the big {word} on the table")
        assert known is not None and known.size == (least / 100, most / 100)
        assert known.thickness == int(line[3]) / 100
        if word in named:  # its own class is better than what looks like it
            assert known.classes is None
            continue
        assert known.classes is not None and known.classes.sum() == pytest.approx(1)
        assert class_names()[int(known.classes.argmax())][0] == line[1].split(", ")[0]


def test_the_longest_ending_counts() -> None:
    controller, box, wooden = (household_thing(t) for t in ("a red game controller", "tool-less box", "old wooden box"))
    assert controller and box and wooden and controller.classes is not box.classes is not wooden.classes
    assert household_thing("a pair of scissors") is household_thing("scissors")
    assert household_thing("quasar") is None and household_thing("") is None


def test_sizes_by_hand() -> None:
    extents = np.array([[0.1, 0.2, 0.1], [0.1, 0.8, 0.1], [0.05, 0.01, 0.0], [0, 0, 0]])
    length, thickness = size_misfits(extents, Household(None, (0.1, 0.2), 0.05))
    assert length[:3].tolist() == [0, 2, 1] and length[3] > 9
    assert thickness.tolist() == [1, 1, 0, 0]


class Same:
    """Everything looks like every text."""

    identity, dim, templates = "same", 2, ("{}",)

    def encode_images(self, images: object) -> np.ndarray:
        raise AssertionError

    def encode_texts(self, texts: list[str]) -> np.ndarray:
        return np.tile(np.float32([1, 0]), (len(texts), 1))


def test_of_two_alike_the_one_of_the_usual_size_is_the_mug() -> None:
    row = np.array([1, 0], np.float32)
    things = [InstanceDescription(row, row[None], np.zeros((24, 4), np.float32), ["a"], [(0, 0, 1, 1)])] * 2
    extents = np.array([[0.9, 0.9, 1.0], [0.1, 0.1, 0.1]])
    assert [n for n, _ in Ranker(things, Same(), extents=extents).rank("red mug")] == [1, 0]
    assert [n for n, _ in Ranker(things, Same(), extents=extents).rank("fridge")] == [0, 1]
    assert [n for n, _ in Ranker(things, Same()).rank("red mug")] == [0, 1]


def test_sides_are_without_strays_and_thin_across_their_plane() -> None:
    """A book of 20 × 30 × 2 cm that leans by 40° has those sides, whatever its box and a few points far off say."""
    rng = np.random.default_rng(0)
    turn = Rotation.from_euler("x", 40, degrees=True).as_matrix()
    points = (rng.random((2000, 3)) - 0.5) * [0.3, 0.2, 0.02] @ turn.T
    points[::100] *= 10
    book = SimpleNamespace(
        instances=[{"id": 7, "obb": {"rotation": np.eye(3).tolist()}}], index=SimpleNamespace(of=lambda _: points)
    )
    sides = extents(book)[0]  # type: ignore[arg-type]
    assert sides[0] == pytest.approx(0.3, rel=0.05) and sides.min() == pytest.approx(0.02, rel=0.15)
