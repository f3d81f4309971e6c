"""What a prompt costs: lines of Python and steps of regular expressions, in the number of its characters."""

from __future__ import annotations

import contextlib
import re
import sys
from collections.abc import Callable, Iterator
from functools import lru_cache
from types import FrameType, ModuleType
from typing import Any

import pytest

from perception.errors import InputError
from perception.language.colors import without_color_words
from perception.language.household import household_thing
from perception.language.printed import quoted_text
from perception.query.relations import parse
from perception.query.requests import MAX_TEXT
from support.counted_regex import Counted

SHORT, LONG = 50, 200
MOST = 300_000  # steps of a short prompt
FIXED = 1000  # steps of any prompt, however short: the ranking of the map's instances
PIECES = (
    "a", ",", " ,", "-", "_ ", '"', "“a", '""', "a b ", "and ", "red ", "orange ", "mug ", "of ", "pair of ", "on ",
    "a on ", "is to the ", "that ", "that says ", "with the ", "with the words ", "reads ", "labelled with ", "book, ",
    "tomato ", "honey", "é", "책 ", "İn ", "cloſe to ", "\u2003", "\t\n", "a on b that says ", "xes ", "{", "[", "<",
)  # fmt: skip


class Meter:
    """Counts steps; AssertionError beyond `most`."""

    def __init__(self, most: float) -> None:
        self.steps, self.most = 0, most

    def step(self) -> None:
        self.steps += 1
        if self.steps > self.most:
            raise AssertionError(f"more than {self.most:.0f} steps")

    def trace(self, frame: FrameType, event: str, _: Any) -> Any:
        if "/perception/" not in frame.f_code.co_filename:
            return None
        if event == "line":
            self.step()
        return self.trace


@pytest.fixture(scope="module")
def paths(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Callable[[str], object]]:
    pytest.importorskip("mcp")
    from support.query_paths import query_paths

    return query_paths(tmp_path_factory.mktemp("paths"))


@lru_cache(1)
def expressions(_: int) -> list[tuple[ModuleType, str, re.Pattern[str]]]:
    """Those of the modules that see a prompt, found anew when more modules are loaded."""
    homes = tuple(f"perception.{name}" for name in ("language", "query", "serve", "node", "viewer", "mcp"))
    return [
        (module, name, value)
        for home, module in list(sys.modules.items()) if home.startswith(homes)
        for name, value in vars(module).items() if isinstance(value, re.Pattern) and isinstance(value.pattern, str)
    ]  # fmt: skip


@contextlib.contextmanager
def counted(meter: Meter) -> Iterator[None]:
    """The expressions of every module that sees a prompt are counted, and its lines."""
    before = sys.gettrace()
    with pytest.MonkeyPatch.context() as patch:
        for module, name, value in expressions(len(sys.modules)):
            patch.setattr(module, name, Counted(value, meter.step))
        sys.settrace(meter.trace)
        try:
            yield
        finally:
            sys.settrace(before)


def steps(ask: Callable[[str], object], prompt: str, most: float) -> int:
    meter = Meter(most)
    with counted(meter), contextlib.suppress(InputError):
        ask(prompt)
    return meter.steps


def made(head: str, middle: str, tail: str, size: int) -> str:
    """`middle` repeated, then `tail`, after `head`: at most `size` characters."""
    half = size // 2
    return (head + (middle * half)[:half] + (tail * size)[: size - half])[:size]


def check(ask: Callable[[str], object], middle: str, tail: str) -> None:
    """Four times the characters cost at most four times as much, and a tenth."""
    least = steps(ask, made("x ", middle, tail, SHORT), MOST)
    steps(ask, made("x ", middle, tail, LONG), LONG / SHORT * 1.1 * least + FIXED)


@pytest.mark.parametrize("middle", [*PIECES[:8], *(pytest.param(p, marks=pytest.mark.slow) for p in PIECES[8:])])
def test_what_reads_words_takes_steps_in_proportion_to_them(middle: str) -> None:
    for read in (quoted_text, parse, without_color_words, household_thing):
        for tail in (",", ' "', " that says "):
            check(read, middle, tail)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["python", "store", "serve", "node", "viewer", "mcp"])
def test_every_answer_takes_steps_in_proportion_to_its_prompt(
    paths: dict[str, Callable[[str], object]], name: str
) -> None:
    paths[name]("mug on the lamp")  # what is read at the first prompt
    for middle, tail in (
        ("a", ","),
        ("tomato ", '"'),
        ("a on ", "a on "),
        ("a b ", " "),
        ("red ", "and "),
        ("_ ", "["),
    ):
        check(paths[name], f"{name} {middle}", tail)  # no two are the same, because rankings are remembered


def test_no_prompt_is_longer_than_the_bound(paths: dict[str, Callable[[str], object]]) -> None:
    for ask in paths.values():
        with pytest.raises(InputError, match=f"{MAX_TEXT}"):
            ask("a" * (MAX_TEXT + 1))


def test_no_path_answers_for_what_is_not(paths: dict[str, Callable[[str], object]]) -> None:
    for ask in paths.values():
        assert ask("drum that is not red") is not None
        with pytest.raises(InputError, match="'no drum' says what a thing is not") as caught:
            ask("no drum")
        assert "\n" not in str(caught.value)
