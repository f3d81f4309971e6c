"""The limits of a prompt, which Python and all servers share."""

from __future__ import annotations

from typing import Any

import numpy as np

from perception.errors import InputError

MAX_TEXT = 1000
"""Largest number of characters in a prompt. No encoder reads more; the bound limits the work of a server."""
TOP, MAX_TOP = 20, 1000  # hits of a prompt: by default, and at most


class UnknownInstance(InputError):
    """The map has no instance with this id."""


def check_prompt(text: Any, top_k: Any = TOP, min_score: Any = None) -> str:
    """The text with white space and "_", as in "milk_carton", as single spaces. InputError unless it is a text that is
    neither empty nor too long, and the numbers are in their range."""
    if not isinstance(text, str):
        raise InputError(f"query: the text is {type(text).__name__}, expected a text")
    if any("\ud800" <= letter <= "\udfff" for letter in text):
        raise InputError("query: the text holds bytes that are no UTF-8, or half of a surrogate pair; mend it")
    words = " ".join(text.replace("_", " ").split())
    if not words:
        raise InputError('query: the text is empty; ask for a thing, such as "red mug"')
    if len(text) > MAX_TEXT:
        raise InputError(f"query: the text has {len(text)} characters, expected at most {MAX_TEXT}")
    if isinstance(top_k, bool) or not isinstance(top_k, (int, np.integer)):
        raise InputError(f"query: top_k is {top_k!r}, expected a whole number")
    if not 1 <= top_k <= MAX_TOP:
        raise InputError(
            f"query: the number of hits (top_k, --top) is {top_k}, expected at least 1 and at most {MAX_TOP}"
        )
    if min_score is None:
        return words
    if isinstance(min_score, bool) or not isinstance(min_score, (int, float, np.number)):
        raise InputError(f"query: min_score is {min_score!r}, expected a number or none")
    if not -np.inf < min_score < np.inf:
        raise InputError(f"query: min_score is {min_score}, expected a finite number")
    return words
