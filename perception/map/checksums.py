"""Integrity of a map folder: file sizes are checked at every opening, SHA-256 on demand and at full reads."""

from __future__ import annotations

import hashlib
import json
import re
from pathlib import Path
from typing import Any

from perception.errors import InputError

REPORT = "report.html"
FACTS = "map.json"
STORE = "store.json"
"""In the folder of a store of many maps, the list of its maps."""
IGNORED = "ignored.png"
"""The mask of what stays in the photos and is ignored, as in map.json, for people to look at."""
EDITABLE = "instances.json"
"""Users may edit labels in this file by hand, so a changed checksum is reported and not an error."""
DATA = (
    *("gaussians.ply", "features.npy", "instance_ids.npy", "membership.npy"),
    *("cameras.npz", "index.npz", "language.npz", "parts.npz", "groups.npz", "past.npz"),
    IGNORED,
)
"""Names of a map's other files, in all format versions."""
_UNFINISHED = re.compile(r"^\.(.+)\.new-\d+-\w{8}$")


def damaged(file: Path, what: str) -> InputError:
    """The error for a file of a map that is not as it was written."""
    return InputError(f"{file}: {what}; the map is damaged, build it again or copy it anew")


def facts_of(file: Path) -> dict[str, Any]:
    """{"bytes", "sha256"} of one file."""
    return {"bytes": file.stat().st_size, "sha256": sha256(file)}


def is_map(folder: Path) -> bool:
    """Whether `folder` holds the facts of a map of any version."""
    return "format_version" in (_facts_in(folder) or {})


def own_files(folder: Path) -> set[str] | None:
    """Names of the files in `folder` that a map wrote; what else lies there is its user's. None without a map.json."""
    facts = _facts_in(folder)
    if facts is None:
        return None
    listed = facts.get("files")
    own = {FACTS, EDITABLE, REPORT, *(set(DATA).intersection(listed) if isinstance(listed, dict) else DATA)}
    files = (item.name for item in folder.iterdir() if item.is_symlink() or item.is_file())
    return {name for name in files if _UNFINISHED.sub(r"\1", name) in own}


def _facts_in(folder: Path) -> dict[str, Any] | None:
    """The content of map.json, {} where that is damaged, None where there is none."""
    if not (folder / FACTS).is_file():
        return None
    try:
        facts = json.loads((folder / FACTS).read_bytes())
    except (OSError, ValueError, RecursionError):
        return {}
    return facts if isinstance(facts, dict) else {}


def listed_files(folder: Path) -> list[Path]:
    """The files of a map that its map.json lists: all but itself and the report."""
    return sorted(folder / name for name in (EDITABLE, *DATA) if (folder / name).is_file())


def sha256(file: Path) -> str:
    """Hexadecimal SHA-256 of a file."""
    digest = hashlib.sha256()
    with file.open("rb") as stream:
        while block := stream.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()


def seal(info: dict[str, Any]) -> dict[str, Any]:
    """`info` with its own checksum under "sha256", over its canonical JSON without that key."""
    plain = {key: value for key, value in info.items() if key != "sha256"}
    text = json.dumps(plain, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return {**plain, "sha256": hashlib.sha256(text.encode()).hexdigest()}


def check_sizes(folder: Path, info: dict[str, Any]) -> None:
    """InputError naming the first file of map.json's list that is missing or of another size."""
    for name, facts in info.get("files", {}).items():
        if name == EDITABLE:
            continue
        file = folder / name
        if not file.is_file():
            raise damaged(file, "is missing")
        if (found := file.stat().st_size) != facts["bytes"]:
            raise damaged(file, f"has {found} bytes, {facts['bytes']} were written")


def check_file(folder: Path, info: dict[str, Any], name: str) -> None:
    """InputError when the file's SHA-256 is not the one recorded; a file without a record passes."""
    facts = info.get("files", {}).get(name)
    if facts is not None and sha256(folder / name) != facts["sha256"]:
        raise damaged(folder / name, "its bytes are not those that were written (SHA-256 differs)")


def verify(folder: Path, info: dict[str, Any]) -> dict[str, str]:
    """Checks every byte: {file: "ok", "edited" or "no checksum"}; InputError naming the first damaged file.

    "edited": instances.json differs from what was written, as after setting labels by hand. "no checksum": the map was
    made before checksums were recorded.
    """
    check_sizes(folder, info)
    known = info.get("files", {})
    if "sha256" in info and seal(info)["sha256"] != info["sha256"]:
        raise InputError(f"{folder / FACTS}: its own checksum differs; it was edited or is damaged")
    states = {FACTS: "ok" if "sha256" in info else "no checksum"}
    for file in listed_files(folder):
        if file.name not in known:
            states[file.name] = "no checksum"
        elif file.name == EDITABLE:
            states[file.name] = "ok" if sha256(file) == known[file.name]["sha256"] else "edited"
        else:
            check_file(folder, info, file.name)
            states[file.name] = "ok"
    return states
