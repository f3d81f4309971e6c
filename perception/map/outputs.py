"""Checks before work that no command writes over what it reads, or over a file that the user did not name."""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from perception.errors import InputError
from perception.io.atomic import pointed
from perception.map.checksums import DATA, EDITABLE, FACTS, STORE, is_map
from perception.photos.view_json import absolute

MAP_FILES = (FACTS, EDITABLE, *DATA)


def refuse_inputs(outputs: Iterable[Path | None], inputs: Iterable[Path | None]) -> None:
    """InputError if a file to write is an input, a map's own or written twice: by its path, by links or by hard links;
    and where its folder does not allow it.

    outputs: files. inputs: files, and maps or stores, of which their own files and all that they were made from are
    meant. None is skipped.
    """
    read: dict[Any, Path] = {}
    for file in (file for source in inputs if source is not None for file in _files(source)):
        read.update(dict.fromkeys(_identities(file), file))
    written: dict[Any, Path] = {}
    for output in (output for output in outputs if output is not None):
        if output.name in MAP_FILES and is_map(output.parent):
            raise InputError(f"{output}: is the name of a file of that map; write to another file")
        folder = next(above for above in pointed(output).absolute().parents if os.path.lexists(above))
        if not folder.is_dir() or not os.access(folder, os.W_OK | os.X_OK):
            why = "does not allow it" if folder.is_dir() else "is no folder"
            raise InputError(f"{output}: cannot be written, as {folder} {why}; choose another path")
        for identity in _identities(output):
            if identity in read:
                raise InputError(f"{output}: is {read[identity]}, which this command reads; write to another file")
            if written.setdefault(identity, output) is not output:
                raise InputError(f"{output}: would be written twice, also as {written[identity]}; choose another name")


def check_empty(output: Path) -> None:
    """InputError unless `output` is an empty folder, or nothing is there."""
    if os.path.lexists(output) and not (output.is_dir() and not any(output.iterdir())):
        raise InputError(f"{output}: is not empty, or no folder; choose another -o or remove it first")


def check_side_file(side: Path, output: Path, key: str) -> None:
    """InputError if `side`, to be written beside `output`, is something else: JSON without a text or an object at `key`
    (a map's instances.json has a list), JSON of another `cloud` that lies there, .npy without ids."""
    if not os.path.lexists(side):
        return
    other = ""
    try:
        if not side.is_file():  # reading a named pipe would wait for its writer
            raise ValueError
        if side.suffix == ".npy":
            ids = np.load(side, mmap_mode="r")
            good = ids.dtype == np.int32 and ids.ndim == 1
        else:
            found = json.loads(side.read_bytes())
            good = isinstance(found, dict) and isinstance(found.get(key), (str, dict))
            cloud = str(found.get("cloud", output.name)) if good else output.name
            other = cloud if cloud != output.name and (side.parent / cloud).is_file() else ""
    except (OSError, ValueError, EOFError, RecursionError):
        good = False
    if not good:
        what = f"lies there, and is not of a file such as {output.name}, beside which it would be replaced"
        raise InputError(f"{side}: {what}; choose another name for the output")
    if other:
        what = f"is of {other}, which lies beside it, and would be replaced by that of {output.name}"
        raise InputError(f"{side}: {what}; choose another name for the output")


def _identities(file: Path) -> Iterator[Any]:
    """The path without links and, where there is a file, its device and inode."""
    with contextlib.suppress(OSError, ValueError):  # nothing is there, or a NUL is in the name
        yield os.path.realpath(file)
        stat = file.stat()
        yield stat.st_dev, stat.st_ino


def _files(source: Path) -> Iterator[Path]:
    """The file itself, or the files of a map with its photos and what else it was made from, or those of a store."""
    if not source.is_dir():
        yield source
    elif (source / STORE).is_file():
        yield from (file for file in source.rglob("*") if file.is_file())
    else:
        yield from (source / name for name in MAP_FILES)
        # The command itself reports what is wrong with its map.
        with contextlib.suppress(OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
            facts = json.loads((source / FACTS).read_bytes())
            for key, names in facts.get("inputs", {}).items():
                named = Path(key.partition("=")[2])
                yield from ((named if named.is_dir() else named.parent) / name for name in names)
            for view in facts["views"]:
                yield Path(view["photo"])
                if view.get("photo_beside") is not None:
                    yield absolute(pointed(source) / view["photo_beside"])
