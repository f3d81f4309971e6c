"""Prompts that say what a thing is not. English only."""

from __future__ import annotations

import re

from perception.io.documents import brief
from perception.language.colors import denials
from perception.language.printed import quoted_text
from perception.language.shape_words import head_noun

_NOT = re.compile(
    r"^(?:there (?:is|are) )?(?:no|none)(?![-\w])|\bno longer\b|\b(?:all|anything|everything) but\b"
    r"|(?<![-\w])(?:not|neither|nor|never|except|without|lacks|lacking)(?![-\w])|n['’]t\b"
    r"|\b(?:with|has|have|having) no(?![-\w])",
    re.IGNORECASE,
)
_SIGNS = ("sign", "poster", "placard", "sticker", "label", "notice", "symbol")
"""Things whose names may say what not to do: "no smoking sign"."""


def negation_in(text: str) -> str | None:
    """The error of a prompt that says what a thing is not or lacks, beyond its colours, None of others: to encoders
    "mug", "no mug" and "mug without a handle" are alike. Quoted texts may say so, and names of signs."""
    quoted = quoted_text(text)
    unquoted = rest = " ".join(text.split()) if quoted is None else quoted[0]
    for start, end in denials(unquoted):
        rest = f"{rest[:start]}{' ' * (end - start)}{rest[end:]}"
    if not _NOT.search(rest) or head_noun(unquoted) in _SIGNS:
        return None
    found = 'says what a thing is not or lacks, which is understood of colours alone ("mug that is not red")'
    return f"query: {brief(text)} {found}; ask for what it is, and quote what is printed on it"
