"""Names that a user gives to instances, kept in a map's instances.json."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from perception.errors import InputError
from perception.io.atomic import atomic_file
from perception.io.store import read_info

LONGEST = 200  # characters of a label


def read_instances(path: Path) -> list[dict[str, Any]]:
    """The list of instances.json; raises InputError when `path` is no map."""
    read_info(path)
    file = path / "instances.json"
    try:
        instances: list[dict[str, Any]] = json.loads(file.read_text(encoding="utf-8"))["instances"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"{file}: the map is damaged ({error}); build it again with `perception map`") from error
    return instances


def set_labels(path: Path, labels: dict[int, str | None]) -> None:
    """Gives labels to instances by id, None takes one away; the file appears whole under its name or stays as it was.

    Raises InputError for an id that the map does not hold, or a label that is empty or too long.
    """
    instances = read_instances(path)
    by_id = {entry["id"]: entry for entry in instances}
    for instance, label in labels.items():
        if instance not in by_id:
            known = f"0 to {max(by_id)}" if by_id else "none"
            raise InputError(f"{path}: has no instance {instance}; its ids are {known} (see perception export)")
        by_id[instance]["label"] = None if label is None else tidy_label(label)
    with atomic_file(path / "instances.json") as file:
        file.write_text(json.dumps({"instances": instances}, indent=1, allow_nan=False) + "\n", encoding="utf-8")


def tidy_label(label: str) -> str:
    """One line without outer white space."""
    tidy = " ".join(label.split())
    if not tidy:
        raise InputError('label: it is empty; write a name such as "grandma\'s cup", or --clear to take it away')
    if len(tidy) > LONGEST:
        raise InputError(f"label: {len(tidy)} characters, at most {LONGEST} are kept; choose a shorter name")
    return tidy
