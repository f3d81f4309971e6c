"""Names that a user gives to instances, kept in a map's instances.json."""

from __future__ import annotations

from pathlib import Path

from perception.errors import InputError
from perception.io.map import Map
from perception.io.store import set_labels

LONGEST = 200  # characters of a label


def given_names(path: Path) -> dict[int, str]:
    """The names given so far, by instance id; raises InputError when `path` is no map."""
    return {entry["id"]: entry["label"] for entry in Map.open(path).instances if entry.get("label")}


def give_names(path: Path, names: dict[int, str | None]) -> dict[int, str | None]:
    """Names instances by id, None takes a name away, and returns what was written, whole or not at all.

    Raises InputError for an id that the map does not hold, a name that is empty or too long, and beside another writer.
    """
    tidy = {i: None if name is None else tidy_name(name) for i, name in names.items()}
    set_labels(path, tidy)
    return tidy


def tidy_name(name: str) -> str:
    """One line without outer white space."""
    tidy = " ".join(name.split())
    if not tidy:
        raise InputError('label: it is empty; write a name such as "grandma\'s cup", or --clear to take it away')
    if len(tidy) > LONGEST:
        raise InputError(f"label: {len(tidy)} characters, at most {LONGEST} are kept; choose a shorter name")
    return tidy
