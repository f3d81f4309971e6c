"""Checks names of photos and views from untrusted files before paths are made from them."""

from __future__ import annotations

import re

from perception.errors import InputError

_SEPARATOR = re.compile(r"[/\\]")  # maps are exchanged between operating systems
_DRIVE = re.compile(r"[A-Za-z]:")
_CONTROL = re.compile(r"[\x00-\x1f\x7f-\x9f\u2028\u2029\ud800-\udfff]")


def safe_name(name: object, source: object) -> str:
    """`name` itself when it is a relative path that stays below the folder it is joined to ("a/0001.jpg").

    source: the file or folder that gave the name, for the message. Both "/" and "\\" count as separators.
    InputError if it is not a string, for an empty name, an absolute path, a drive letter, a part "..", and for control
    characters (NUL, newline) and lone surrogates, which line-based files and terminals cannot hold.
    """
    wrong = _what_is_wrong(name)
    if wrong is None:
        return str(name)
    raise InputError(
        f"{source}: the photo name {ascii(name)[:200]} {wrong}; expected a relative path inside the photo folder, such "
        'as "a/0001.jpg"; rename that photo'
    )


def _what_is_wrong(name: object) -> str | None:
    if not isinstance(name, str):
        return f"is {type(name).__name__}, not text"
    parts = _SEPARATOR.split(name)
    if parts[-1] in ("", ".", ".."):
        return "names no file"
    if parts[0] == "" or _DRIVE.match(name):
        return "is an absolute path"
    if ".." in parts:
        return 'leaves its folder by ".."'
    if found := _CONTROL.search(name):
        return f"holds the character U+{ord(found.group()):04X}"
    return None
