"""Finds the files that lists and models name, as other systems spell them.

Lists come from Windows ("cam\\0001.JPG"), from file systems that do not tell capitals from small letters, and from
macOS, which stores "é" as two characters.
"""

from __future__ import annotations

import os
import re
import unicodedata
from collections.abc import Iterable
from pathlib import Path

_SEPARATOR = re.compile(r"[/\\]")
_ABSOLUTE = re.compile(r"[/\\]|[A-Za-z]:")


def folded(name: str) -> str:
    """A name for comparisons: "/" between folders, small letters, one form of Unicode."""
    return unicodedata.normalize("NFC", "/".join(parts_of(name))).casefold()


def parts_of(name: str) -> list[str]:
    """The folders and the file of a relative name, without "."; both "/" and "\\" separate."""
    return [part for part in _SEPARATOR.split(name) if part not in ("", ".")]


def leads_out(name: str) -> bool:
    """Whether a name is an absolute path of any operating system, or has a part ".."."""
    return bool(_ABSOLUTE.match(name)) or ".." in parts_of(name)


def below(name: str) -> str:
    """A name as below its folder: of one that leads out its folders and its file, without a drive and ".."."""
    parts = parts_of(name)[":" in name[1:2] :]
    return "/".join(part for part in parts if part != "..") if leads_out(name) else name


class NamedFiles:
    """The files below `folder`, by the names that lists give them. Each folder is listed once.
    beyond: whether an absolute path, or one with "..", may lead to a file elsewhere."""

    def __init__(self, folder: Path, beyond: bool = True) -> None:
        self.folder, self.beyond = folder, beyond
        self._listed: dict[Path, dict[str, list[str]]] = {}

    def find(self, name: str, suffixes: Iterable[str] = ()) -> Path | None:
        """The file `name` as it is written, else with "\\" as "/", else the only one that differs by capitals or by the
        form of Unicode; with each of `suffixes` where it has none. Of an absolute path that leads nowhere, and of what
        may not lead elsewhere, the longest end that is a file below the folder. None without a file."""
        outside = not self.beyond and leads_out(name)
        endings, parts = ("", *suffixes), parts_of(below(name) if outside else name)
        for path in (self.folder / f"{name}{end}" for end in endings if not outside):
            if os.path.isfile(path):  # noqa: PTH113 - Path.is_file raises for a name that is too long
                return path
        starts = range(len(parts)) if outside or _ABSOLUTE.match(name) else range(min(1, len(parts)))
        return next(filter(None, (self._below(parts[start:], endings) for start in starts)), None)

    def _below(self, parts: list[str], endings: tuple[str, ...]) -> Path | None:
        here = self.folder
        for part in parts[:-1]:
            if (inside := self._entry(here, part)) is None:
                return None
            here = inside
        found = (self._entry(here, f"{parts[-1]}{end}") for end in endings)
        return next((path for path in found if path is not None and os.path.isfile(path)), None)  # noqa: PTH113

    def _entry(self, folder: Path, name: str) -> Path | None:
        if os.path.exists(folder / name):  # noqa: PTH110 - Path.exists raises for a name that is too long
            return folder / name
        if folder not in self._listed:
            entries = self._listed.setdefault(folder, {})
            try:
                for entry in sorted(os.listdir(folder)):  # noqa: PTH208
                    entries.setdefault(folded(entry), []).append(entry)
            except OSError:  # no folder, or not readable
                pass
        alike = self._listed[folder].get(folded(name), [])
        return folder / alike[0] if len(alike) == 1 else None
