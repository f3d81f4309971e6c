"""Parses untrusted JSON and YAML files, and checks names of photos in them before paths are made from these."""

from __future__ import annotations

import codecs
import json
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from perception.errors import InputError


def text_of(data: bytes, errors: str = "strict") -> str:
    """Text in UTF-8, with or without a byte-order mark, or in UTF-16 with one. errors: as of bytes.decode."""
    sixteen = data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    return data.decode("utf-16" if sixteen else "utf-8-sig", errors)


def read_json(file: Path) -> Any:
    """The value in a JSON file; InputError when it is not valid JSON."""
    try:
        return json.loads(text_of(file.read_bytes()))
    except FileNotFoundError as error:
        raise InputError(f"{file}: no such file") from error
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"{file}: not readable JSON ({brief(error)})") from error


def read_yaml(file: Path, expected: str) -> Any:
    """The value in a YAML file; InputError naming `expected` when it is not valid YAML.
    Aliases (*name) are refused: nested aliases can expand to more values than fit into memory."""
    import yaml

    class Loader(yaml.SafeLoader):
        def compose_node(self, parent: Any, index: Any) -> Any:
            if self.check_event(yaml.AliasEvent):
                raise yaml.YAMLError("aliases are not taken")
            return super().compose_node(parent, index)

    with refusing(f"{file}: not readable YAML ({{why}}); expected {expected}"):
        return yaml.load(text_of(file.read_bytes()), Loader)


@contextmanager
def refusing(message: str) -> Iterator[None]:
    """For the calls of a library that decodes untrusted bytes: whatever it raises becomes an InputError.
    message: of that error; "{why}" in it stands for the library's message. An InputError passes as it is."""
    try:
        yield
    except InputError:
        raise
    except Exception as error:  # libraries have no common base class of errors, and raise others' too
        raise InputError(message.replace("{why}", brief(error))) from error


def brief(value: object, most: int = 120) -> str:
    """An error's text, or a value as Python writes it, on one line of bounded length."""
    import reprlib

    text = str(value) if isinstance(value, BaseException) else reprlib.repr(value)
    if isinstance(value, OSError) and value.strerror:  # without the number and the path
        text = value.strerror
    return " ".join(text.split())[:most] or type(value).__name__


_SEPARATOR = re.compile(r"[/\\]")  # maps are exchanged between operating systems
_DRIVE = re.compile(r"[A-Za-z]:")
_CONTROL = re.compile(r"[\x00-\x1f\x7f-\x9f\u2028\u2029\ud800-\udfff]")


def safe_name(name: object, source: object) -> str:
    """`name` itself when it is a relative path that stays below the folder it is joined to ("a/0001.jpg"), InputError
    for what `what_is_wrong` tells. source: the file or folder that gave the name, for the message."""
    wrong = what_is_wrong(name)
    if wrong is None:
        return str(name)
    raise InputError(
        f"{source}: the photo name {ascii(name)[:200]} {wrong}; expected a relative path inside the photo folder, such "
        'as "a/0001.jpg"; rename that photo'
    )


def what_is_wrong(name: object) -> str | None:
    """Why `safe_name` refuses a name; None if it does not. Both "/" and "\\" count as separators; line-based files and
    terminals cannot hold control characters (NUL, newline) and lone surrogates."""
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
        code = ord(found.group())
        return f"holds the character U+{code:04X}{', so is not in UTF-8' if 0xD800 <= code < 0xE000 else ''}"
    return None
