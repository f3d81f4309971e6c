"""The report: one file that fetches nothing, well formed, escaped, under its limit, whole with parts
missing."""

from __future__ import annotations

import base64
import io
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from PIL import Image

from perception.report import InstanceRow, QueryRow, ReportData, ViewRow, write_report
from perception.report.page import clock, curve, short, ticks

NASTY = "<script>alert('x')</script> & \"quotes\""


def _full(side: int = 64) -> ReportData:
    rng = np.random.default_rng(0)

    def picture() -> np.ndarray:
        return rng.integers(0, 256, (side, side, 3), dtype=np.uint8)

    return ReportData(
        title=NASTY,
        subtitle=NASTY,
        figures={NASTY: NASTY},
        seconds={NASTY: 3.0, "masks": 70.0},
        psnr_curve=[(0, 12.0), (100, 20.0), (200, float("nan"))],
        gaussians_curve=[(0, 1000), (200, 90000)],
        views=[ViewRow(f"{NASTY}{i}", 25.0 + i, 0.9, picture(), picture()) for i in range(5)],
        overview={NASTY: picture()},
        instances=[InstanceRow(i, picture(), None, [NASTY], 0.5, (0.1, 0.2, 0.3), 1200) for i in range(40)],
        metric=True,
        queries=[QueryRow(NASTY, True, [(3, 0.7)], picture(), [3]), QueryRow("laptop", False, expected=[])],
        warnings=[NASTY],
        settings={NASTY: NASTY},
        command=NASTY,
    )


def _tree(path: Path) -> ElementTree.Element:
    text = path.read_text(encoding="utf-8")
    assert text.startswith("<!doctype html>")
    return ElementTree.fromstring(text.split("\n", 1)[1])  # the page is also well-formed XML


def test_the_page_is_well_formed_and_fetches_nothing(tmp_path: Path) -> None:
    path = write_report(tmp_path / "report.html", _full())
    tree = _tree(path)
    sources = [e.get(key) for e in tree.iter() for key in ("src", "href", "srcset", "action") if e.get(key)]
    assert len(sources) == 4 * 3 + 1 + 40 + 1
    assert all(source.startswith("data:image/webp;base64,") for source in sources if source)
    text = path.read_text(encoding="utf-8")
    assert not re.search(r"https?://|@import|url\(", text)
    shown = Image.open(io.BytesIO(base64.b64decode(str(sources[0]).split(",", 1)[1])))
    assert shown.size == (64, 64)
    assert [p.name for p in tmp_path.iterdir()] == ["report.html"]


def test_user_text_is_text(tmp_path: Path) -> None:
    tree = _tree(write_report(tmp_path / "report.html", _full()))
    assert not list(tree.iter("script"))
    shown = "".join(tree.itertext())
    assert shown.count("<script>alert('x')</script>") >= 12
    assert tree.find("head/title").text == NASTY  # type: ignore[union-attr]


def test_markup_in_names_is_shown_and_never_parsed(tmp_path: Path) -> None:
    """An HTML parser finds the page's own elements only, whatever labels, prompts and photo names hold."""
    evil = "<img src=x onerror=alert(1)>\"'&{{ 7 * 7 }}{% raw %}\ud800"
    plain = np.zeros((8, 8, 3), np.uint8)
    data = ReportData(
        evil,
        views=[ViewRow(evil, 20.0, 0.5, plain, plain, evil)],
        instances=[InstanceRow(1, plain, evil), InstanceRow(2, plain, None, [evil]), InstanceRow(evil, None)],  # type: ignore[arg-type]
        queries=[QueryRow(evil, True, [(1, 0.5)], plain)],
    )
    with pytest.raises((ValueError, TypeError)):  # a received map's id is a number or the page is refused
        write_report(tmp_path / "r.html", data)
    write_report(tmp_path / "r.html", replace(data, instances=data.instances[:2]))

    class Parser(HTMLParser):
        def __init__(self) -> None:
            super().__init__()
            self.seen: list[tuple[str, set[str]]] = []
            self.text = ""

        def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
            self.seen.append((tag, {name for name, _ in attrs}))

        def handle_data(self, data: str) -> None:
            self.text += data

    parser = Parser()
    parser.feed((tmp_path / "r.html").read_text(encoding="utf-8"))
    assert sum(tag == "img" for tag, _ in parser.seen) == 3 + 2 + 1
    assert not [names for _, names in parser.seen if any(name.startswith("on") for name in names)]
    assert {tag for tag, _ in parser.seen}.isdisjoint({"script", "iframe", "object", "link", "base", "form"})
    assert parser.text.count("<img src=x onerror=alert(1)>\"'&{{ 7 * 7 }}{% raw %}?") >= 6


def test_what_is_right_and_what_is_wrong(tmp_path: Path) -> None:
    queries = [
        QueryRow("a", True, [(3, 0.7)], None, [3]),
        QueryRow("b", True, [(4, 0.7)], None, [3]),
        QueryRow("c", False, (), None, []),
        QueryRow("d", False, (), None, [2]),
        QueryRow("e", True, [(1, 0.2)], None, []),
        QueryRow("f", True, [(1, 0.2)]),
    ]
    tree = _tree(write_report(tmp_path / "r.html", ReportData("t", queries=queries)))
    verdicts = [b.text for b in tree.iter("b")]
    assert verdicts == ["right", "wrong", "right", "wrong", "wrong"]


def test_nothing_but_a_title_is_a_page(tmp_path: Path) -> None:
    tree = _tree(write_report(tmp_path / "r.html", ReportData("only")))
    assert not list(tree.iter("h2")) and not list(tree.iter("img")) and tree.find("body/main/header/h1") is not None


@pytest.mark.slow
def test_many_large_pictures_stay_under_the_limit(tmp_path: Path) -> None:
    path = write_report(tmp_path / "r.html", _full(480))
    assert path.stat().st_size < 3_000_000


@pytest.mark.parametrize(("low", "high"), [(0, 1), (12.3, 29.1), (0, 93000), (-3, 4), (1e-5, 3e-5)])
def test_ticks_are_round_and_inside(low: float, high: float) -> None:
    marks = np.array(ticks(low, high))
    assert 2 <= len(marks) <= 6 and marks.min() >= low - 1e-9 and marks.max() <= high * (1 + 1e-9)
    mantissa = np.diff(marks)[0] / 10 ** np.floor(np.log10(np.diff(marks)[0] * (1 + 1e-9)))
    assert min(abs(mantissa - m) for m in (1, 2, 5, 10)) < 1e-6


def test_curve_goes_through_its_ends_and_numbers_read_well() -> None:
    points = re.search(r'points="([^"]+)"', curve([(0, 1), (5, 2), (10, 3)], "x"))
    assert points is not None
    xy = np.array([[float(v) for v in p.split(",")] for p in points[1].split()])
    assert (np.diff(xy[:, 0]) > 0).all() and (np.diff(xy[:, 1]) < 0).all()
    np.testing.assert_allclose(xy[1], (xy[0] + xy[2]) / 2, atol=0.11)
    assert curve([(0, 1)], "x") == "" and curve([(0, float("nan"))] * 3, "x") == ""
    assert (short(84210), short(0.25), clock(95), clock(59.7)) == (
        "84.2k",
        "0.25",
        "1 min 35 s",
        "1 min 00 s",
    )
