"""The user's model store: one folder per model in the cache, `models/NAME/`, with the model files and
`perception.json`, which records the source of each file; the catalogue that `models get` fetches.
"""

from __future__ import annotations

import json
import os
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from perception.errors import InputError, home_path
from perception.io.documents import read_json

RECORD = "perception.json"
NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")


@dataclass(frozen=True)
class StoredModel:
    """A stored model. files: name, source, bytes and sha256 of each; purpose: "sam", "clip" or None."""

    name: str
    folder: Path
    family: str | None = None
    purpose: str | None = None
    files: list[dict[str, Any]] = field(default_factory=list)


@dataclass(frozen=True)
class Entry:
    """A model on the Hugging Face hub. files: path in the repository -> [bytes, sha256], None where not known.
    revision: a commit, so that the files cannot change. Digests are those that several public projects pin for it."""

    purpose: str
    repository: str
    revision: str
    licence: str
    files: dict[str, list[Any]]


def catalogue() -> dict[str, Entry]:
    """Name -> entry, of catalogue.json: permissively licensed; none of the files was downloaded by this project."""
    text = (Path(__file__).parent / "catalogue.json").read_text(encoding="utf-8")
    return {name: Entry(**about) for name, about in json.loads(text).items()}


def cache_folder() -> Path:
    """Folder for cached files and models: $XDG_CACHE_HOME/perception or ~/.cache/perception; /.cache/perception, where
    nothing can be kept, for a user without a home, as of a container."""
    home = Path("/", str(home_path("~")).removeprefix("~"))
    return Path(os.environ.get("XDG_CACHE_HOME") or home / ".cache") / "perception"


def models_folder() -> Path:
    """The folder of all models."""
    return cache_folder() / "models"


def stored_models() -> list[StoredModel]:
    """All stored models, sorted by name."""
    found = (find_model(folder.name) for folder in sorted(models_folder().glob("*")))
    return [model for model in found if model is not None]


def find_model(name: str) -> StoredModel | None:
    """The stored model `name`, or None. InputError for a damaged record."""
    if not NAME.fullmatch(name):
        return None
    folder = models_folder() / name
    if not (folder / RECORD).is_file():
        return None
    try:
        about = read_json(folder / RECORD)
        return StoredModel(name, folder, about["family"], about["purpose"], list(about["files"]))
    except (InputError, KeyError, TypeError) as error:
        raise InputError(f"{folder / RECORD}: cannot be read ({error}); remove {folder} and add it again") from error


def resolve(spec: str) -> str:
    """`spec` itself if it is an existing path, else the folder of the stored model of that name, else `spec`."""
    if home_path(spec).exists():
        return spec
    model = find_model(spec)
    return spec if model is None else str(model.folder)


def known_names() -> str:
    """Names of the stored models, for messages."""
    names = ", ".join(model.name for model in stored_models())
    return f"the store holds {names}" if names else "the store is empty (see perception models add)"
