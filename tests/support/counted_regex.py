"""Counts the steps of regular expressions: a backtracking matcher over their parse trees, as Python's own works."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from functools import cache
from typing import Any

try:
    from re import _constants as c
    from re import _parser as parser  # type: ignore[attr-defined]
except ImportError:  # Python 3.10
    import sre_constants as c  # type: ignore[no-redef]
    import sre_parse as parser  # type: ignore[no-redef]

_CLASSES: dict[Any, Callable[[str], bool]] = {
    c.CATEGORY_WORD: lambda x: x.isalnum() or x == "_",
    c.CATEGORY_SPACE: str.isspace,
    c.CATEGORY_DIGIT: str.isdecimal,
    c.CATEGORY_NOT_WORD: lambda x: not (x.isalnum() or x == "_"),
    c.CATEGORY_NOT_SPACE: lambda x: not x.isspace(),
    c.CATEGORY_NOT_DIGIT: lambda x: not x.isdecimal(),
}
_ONE = {c.LITERAL, c.NOT_LITERAL, c.IN, c.ANY}


@cache
def _same(x: str, y: str, any_case: bool) -> bool:
    return x == y or (any_case and re.fullmatch(re.escape(y), x, re.IGNORECASE) is not None)


class Counted:
    """Stands for a compiled pattern; `step` is called for each step of every match that is tried."""

    def __init__(self, pattern: re.Pattern[str], step: Callable[[], None]) -> None:
        self._pattern, self._step = pattern, step
        self._tree = list(parser.parse(pattern.pattern, pattern.flags))

    def search(self, text: str, *bounds: int) -> re.Match[str] | None:
        found = self._pattern.search(text, *bounds)
        assert self._first(text, *bounds) == (found.span() if found else None)  # the matcher is right
        return found

    def match(self, text: str) -> re.Match[str] | None:
        next(self._ends(self._tree, text, 0), None)
        return self._pattern.match(text)

    def fullmatch(self, text: str) -> re.Match[str] | None:
        any(end == len(text) for end in self._ends(self._tree, text, 0))
        return self._pattern.fullmatch(text)

    def _of_all(name: str) -> Any:  # type: ignore[misc]
        def method(self: Counted, *arguments: Any, **options: Any) -> Any:
            text, at = arguments[-1], 0
            while found := self._first(text, at):
                at = max(found[1], found[0] + 1)
            return getattr(self._pattern, name)(*arguments, **options)

        return method

    findall, finditer, split, sub = map(_of_all, ("findall", "finditer", "split", "sub"))

    def _first(self, text: str, start: int = 0, stop: int | None = None) -> tuple[int, int] | None:
        text = text if stop is None else text[:stop]
        for at in range(start, len(text) + 1):
            for end in self._ends(self._tree, text, at):
                return at, end
        return None

    def _ends(self, items: list[Any], text: str, at: int) -> Iterator[int]:
        """Where a match of `items` that begins at `at` ends, in the order in which they are tried."""
        self._step()
        if not items:
            yield at
            return
        for middle in self._one(*items[0], text, at):
            yield from self._ends(items[1:], text, middle)

    def _one(self, kind: Any, given: Any, text: str, at: int) -> Iterator[int]:
        if kind in _ONE:
            if at < len(text) and self._is(kind, given, text[at]):
                yield at + 1
        elif kind == c.BRANCH:
            for branch in given[1]:
                yield from self._ends(list(branch), text, at)
        elif kind == c.SUBPATTERN:
            yield from self._ends(list(given[-1]), text, at)
        elif kind in (c.MAX_REPEAT, c.MIN_REPEAT):
            yield from self._repeated(given[0], given[1], list(given[2]), text, at, kind == c.MAX_REPEAT)
        elif kind == c.AT:
            if self._stands(given, text, at):
                yield at
        elif kind in (c.ASSERT, c.ASSERT_NOT):
            side, inner = given
            start = at if side > 0 else at - inner.getwidth()[0]
            found = start >= 0 and next(self._ends(list(inner), text, start), None) is not None
            if found == (kind == c.ASSERT):
                yield at
        else:
            raise NotImplementedError(str(kind))

    def _repeated(self, least: int, most: Any, items: list[Any], text: str, at: int, greedy: bool) -> Iterator[int]:
        if len(items) == 1 and items[0][0] in _ONE:
            ends = [at]
            while len(ends) <= most and ends[-1] < len(text) and self._is(*items[0], text[ends[-1]]):
                self._step()
                ends.append(ends[-1] + 1)
            yield from reversed(ends[least:]) if greedy else ends[least:]
            return
        if not greedy or most > 1:
            raise NotImplementedError("repeats of groups")
        yield from self._ends(items, text, at)
        if least == 0:
            yield at

    def _is(self, kind: Any, given: Any, x: str) -> bool:
        if kind == c.ANY:
            return x != "\n"
        if kind in (c.LITERAL, c.NOT_LITERAL):
            return _same(x, chr(given), bool(self._pattern.flags & re.IGNORECASE)) == (kind == c.LITERAL)
        negated = given[0][0] == c.NEGATE
        return negated != any(self._in(*member, x) for member in given[negated:])

    def _in(self, kind: Any, given: Any, x: str) -> bool:
        if kind == c.RANGE:
            return bool(given[0] <= ord(x) <= given[1])
        return x == chr(given) if kind == c.LITERAL else _CLASSES[given](x)

    def _stands(self, where: Any, text: str, at: int) -> bool:
        if where in (c.AT_BEGINNING, c.AT_BEGINNING_STRING):
            return at == 0
        if where in (c.AT_END, c.AT_END_STRING):
            return at == len(text)
        word = _CLASSES[c.CATEGORY_WORD]
        return (at > 0 and word(text[at - 1])) != (at < len(text) and word(text[at]))
