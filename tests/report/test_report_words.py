"""What is printed and reported of a map: missing photos, its summary, answers."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from perception.cli import build_parser
from perception.query import Hit
from perception.report.page import _left_out
from perception.report.text import info_text, query_text
from perception.types import OrientedBox


def test_photos_that_are_not_in_the_map_are_named_by_reason() -> None:
    lost = [{"name": f"{i}.jpg", "why": "too blurred"} for i in range(14)] + [{"name": "x.jpg", "why": "no overlap"}]
    told = _left_out({"left_out": lost})
    assert len(told) == 2
    assert told[0].startswith("14 photos not in the map, too blurred: 0.jpg, ") and told[0].endswith(" and 2 more")
    assert told[1] == "1 photo not in the map, no overlap: x.jpg"
    assert _left_out({}) == []


def hit_of(instance_id: int, x: float, label: str | None = None) -> Hit:
    box = OrientedBox(np.zeros(3), np.eye(3), np.array([0.1, 0.25, 1.5]))
    return Hit(instance_id, 0.9, np.zeros((4, 3), np.float32), np.array([x, 0.0, 0.0]), box, label)


def test_answers_stand_in_columns_with_their_names_and_units() -> None:
    hits = [hit_of(3, 1.0, "grandma's cup"), hit_of(12, -10.5), hit_of(7, 0.0)]
    lines = query_text([("mug", hits, []), ("dragon", [], [])], True, {12: "coffee mug (guessed)"}).splitlines()
    assert lines[0] == '"mug": 3 found' and lines[-1] == '"dragon": not present'
    rows = lines[1:4]
    assert [row.split()[1] for row in rows] == ["grandma's", "coffee", "no"]
    assert "coffee mug (guessed)" in rows[1] and "(guessed)" not in rows[0]
    for column in ("score", "at ", "size ", "instance "):
        assert len({row.index(column) for row in rows}) == 1
    assert all("size 10 x 25 x 150 cm" in row for row in rows) and "at -10.50 0.00 0.00 m" in rows[1]
    assert "cm" not in query_text([("mug", hits, [])], False)  # without a scale no unit is claimed


def test_labels_and_prints_of_a_map_from_others_cannot_write_into_the_terminal() -> None:
    evil = "red\x1b[2J\nmug"
    lines = query_text([("mug", [hit_of(3, 1.0, evil)], [])], True).splitlines()
    assert len(lines) == 2 and "red\\x1b[2J\\nmug" in lines[1]
    info: dict[str, Any] = {"num_gaussians": 1, "num_instances": 1, "sh_degree": 1}
    told = info_text(Path("k.gsmap"), info, [{"id": 0, "texts": [{"text": evil, "score": 0.9}]}])
    assert 'printed on 0: "red\\x1b[2J\\nmug"' in told.splitlines()


def test_the_first_three_lines_of_info_are_what_how_good_and_what_next() -> None:
    info: dict[str, Any] = {
        "num_gaussians": 12345,
        "num_instances": 6,
        "sh_degree": 1,
        "views": [{}] * 9,
        "metric": True,
    }
    info["quality"] = {"psnr": 18.2, "ssim": 0.61, "views": {"a.jpg": {}}}
    info["scene"] = {"left_out": [{"name": "b.jpg", "why": "too blurred"}], "warnings": ["few matches"]}
    what, how_good, after = info_text(Path("k.gsmap"), info).splitlines()[:3]
    assert what == "k.gsmap: 6 instances in 12,345 Gaussians, from 9 photos, in metres"
    assert how_good == "quality: poor: PSNR 18.20 dB, SSIM 0.610, held-out photos: 1, photos left out: 1, warnings: 1"
    assert after.startswith("next: perception query k.gsmap")
    assert "perception scale" in info_text(Path("k.gsmap"), {**info, "metric": False}).splitlines()[2]


def test_info_names_the_photos_that_the_times_are_of() -> None:
    info: dict[str, Any] = {"num_gaussians": 9, "num_instances": 0, "sh_degree": 1, "source": "before", "seed": 0}
    info["seconds"] = {"poses": 60.0, "total": 91.4}
    assert "made from before (seed 0) in 91 s: poses 60" in info_text(Path("k.gsmap"), info).splitlines()
    info["visits"] = [{"time": None, "input": name, "photos": 9} for name in ("before", "today")]
    assert "updated from today (seed 0) in 91 s: poses 60" in info_text(Path("k.gsmap"), info).splitlines()


@pytest.mark.parametrize("name", ["k.gsmap", "my kitchen's.gsmap", "-k.gsmap"])
def test_the_next_command_can_be_copied_for_any_name(name: str) -> None:
    info = {"num_gaussians": 9, "num_instances": 6, "sh_degree": 1, "metric": True, "views": []}
    line = info_text(Path(name), info).splitlines()[2].removeprefix("next: ").partition(", or")[0]
    args = build_parser().parse_args(shlex.split(line)[1:])
    assert (args.command, args.map, args.text) == ("query", Path(name), ["mug"])


def test_what_is_printed_is_told_of_things_that_are_there() -> None:
    info = {"num_gaussians": 9, "num_instances": 2, "sh_degree": 1, "metric": True, "views": []}
    entries = [{"id": n, "texts": [{"text": f"NO {n}", "score": 0.9}]} for n in (3, 4)]
    entries[1]["state"] = "removed"
    lines = info_text(Path("k.gsmap"), info, entries).splitlines()
    assert [line for line in lines if line.startswith("printed")] == ['printed on 3: "NO 3"']


def test_who_has_no_encoder_is_told_to_name_things() -> None:
    info = {"num_gaussians": 9, "num_instances": 6, "sh_degree": 1, "metric": True, "views": []}
    line = info_text(Path("k.gsmap"), {**info, "instances": {"encoder": None}}).splitlines()[2]
    args = build_parser().parse_args(shlex.split(line.removeprefix("next: ").partition(" to ")[0])[1:])
    assert (args.command, args.map) == ("view", Path("k.gsmap")) and "query" not in line
