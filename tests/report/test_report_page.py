"""The report's page: one file that fetches nothing, well formed, escaped, under its limit."""

from __future__ import annotations

import base64
import io
import re
from html.parser import HTMLParser
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from PIL import Image

from perception.errors import InputError
from perception.query import load_map
from perception.report import page
from perception.report.page import clock, write_page
from support.query_maps import encoders, write_map_of

NASTY = "<script>alert('x')</script> & \"quotes\""


def _instance(number: Any, crop: np.ndarray | None, label: str | None, names: list[str]) -> dict[str, Any]:
    known = {"score": 0.5, "extent": (0.1, 0.2, 0.3), "num_gaussians": 1200}
    return {"id": number, "crop": crop, "label": label, "names": names, **known}


def _full(side: int = 64) -> dict[str, Any]:
    rng = np.random.default_rng(0)

    def picture() -> np.ndarray:
        return rng.integers(0, 256, (side, side, 3), dtype=np.uint8)

    return {
        "title": NASTY,
        "subtitle": NASTY,
        "figures": {NASTY: NASTY},
        "seconds": {NASTY: 3.0, "masks": 70.0},
        "views": [{f"photo {NASTY}": picture(), f"render {NASTY}": picture(), "error": picture()} for _ in range(3)],
        "overview": {NASTY: picture()},
        "changes": {
            "title": NASTY,
            "rows": [
                {"id": 3, "pictures": (picture(), None), "cells": ["moved", NASTY, "", "confidence 0.9", NASTY, NASTY]}
            ],
            "rest": [NASTY],
        },
        "instances": [_instance(i, picture(), None, [NASTY]) for i in range(40)],
        "metric": True,
        "queries": [
            {"text": NASTY, "hits": [(3, 0.7)], "picture": picture()},
            {"text": "laptop", "hits": [], "picture": None},
        ],
        "warnings": [NASTY],
        "settings": {NASTY: NASTY},
    }


def _tree(path: Path) -> ElementTree.Element:
    text = path.read_text(encoding="utf-8")
    assert text.startswith("<!doctype html>")
    return ElementTree.fromstring(text.split("\n", 1)[1])  # the page is also well-formed XML


def test_the_page_is_well_formed_and_fetches_nothing(tmp_path: Path) -> None:
    path = write_page(tmp_path / "report.html", _full())
    tree = _tree(path)
    sources = [e.get(key) for e in tree.iter() for key in ("src", "href", "srcset", "action") if e.get(key)]
    assert len(sources) == 3 * 3 + 1 + 40 + 1 + 1
    assert all(source.startswith("data:image/webp;base64,") for source in sources if source)
    text = path.read_text(encoding="utf-8")
    assert not re.search(r"https?://|@import|url\(", text)
    shown = Image.open(io.BytesIO(base64.b64decode(str(sources[0]).split(",", 1)[1])))
    assert shown.size == (64, 64)
    assert [p.name for p in tmp_path.iterdir()] == ["report.html"]


def test_user_text_is_text(tmp_path: Path) -> None:
    tree = _tree(write_page(tmp_path / "report.html", _full()))
    assert not list(tree.iter("script"))
    assert "not present" in "".join(tree.itertext())
    shown = "".join(tree.itertext())
    assert shown.count("<script>alert('x')</script>") >= 12
    assert tree.find("head/title").text == NASTY  # type: ignore[union-attr]


def test_markup_in_names_is_shown_and_never_parsed(tmp_path: Path) -> None:
    """An HTML parser finds the page's own elements only, whatever labels, prompts and photo names hold."""
    evil = "<img src=x onerror=alert(1)>\"'&{{ 7 * 7 }}{% raw %}\ud800"
    plain = np.zeros((8, 8, 3), np.uint8)
    instances = [_instance(1, plain, evil, []), _instance(2, plain, None, [evil])]
    views, queries = [{evil: plain, f"render {evil}": plain}], [{"text": evil, "hits": [(1, 0.5)], "picture": plain}]
    data = {**_full(8), "title": evil, "views": views, "overview": {}, "instances": instances, "queries": queries}
    with pytest.raises((ValueError, TypeError)):  # a received map's id is a number or the page is refused
        write_page(tmp_path / "r.html", {**data, "instances": [*instances, _instance(evil, None, None, [])]})
    write_page(tmp_path / "r.html", data)

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
    assert sum(tag == "img" for tag, _ in parser.seen) == 2 + 2 + 1 + 1
    assert not [names for _, names in parser.seen if any(name.startswith("on") for name in names)]
    assert {tag for tag, _ in parser.seen}.isdisjoint({"script", "iframe", "object", "link", "base", "form"})
    assert parser.text.count("<img src=x onerror=alert(1)>\"'&{{ 7 * 7 }}{% raw %}?") >= 6


@pytest.mark.slow
def test_many_large_pictures_stay_under_the_limit(tmp_path: Path) -> None:
    path = write_page(tmp_path / "r.html", _full(480))
    assert path.stat().st_size < 3_000_000


def test_a_refused_prompt_is_told_before_the_work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(page, "_Album", lambda gmap: pytest.fail("it renders already"))
    opened = load_map(write_map_of(tmp_path / "a.gsmap", gaussians=100), encoders)
    with pytest.raises(InputError, match="not or lacks"):
        page.write_map_report(opened, tmp_path / "report.html", ["mug", "mug without a handle"])


def test_times_read_well() -> None:
    assert (clock(95), clock(59.7), clock(42.3), clock(0.5)) == ("1 min 35 s", "1 min 00 s", "42 s", "0.5 s")
