"""The user's model store: one folder per model in the cache, `models/NAME/`, with the model files and
`perception.json`, which records the source of each file; downloads; the catalogue that `models get` fetches.

Downloads resume after broken connections; received bytes are kept in a `.part` file.
"""

from __future__ import annotations

import http.client
import json
import os
import re
import urllib.error
import urllib.request
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import quote

from perception.errors import InputError
from perception.io.atomic import atomic_file
from perception.io.documents import read_json
from perception.progress import Progress

CHUNK = 1 << 20
TIMEOUT = 30.0  # seconds without received data
ATTEMPTS = 4  # consecutive connections without new data


def is_url(source: str) -> bool:
    """Whether `source` is a URL to download rather than a local file."""
    return source.lower().startswith(("http://", "https://"))


def download(url: str, part: Path, progress: Progress | None = None, name: str = "") -> Path:
    """Downloads `url` to `part`, after the bytes of `url` already there; returns `part` when complete.

    name: stage name of the progress display, in bytes. InputError when the server refuses, or after ATTEMPTS
    connections without new data; `part` is then kept.
    """
    part.parent.mkdir(parents=True, exist_ok=True)
    fruitless = 0
    while True:
        before = _size(part)
        problem = _attempt(url, part, None if progress is None else partial(progress.update, name or part.name))
        if problem is None:
            _version(part).unlink(missing_ok=True)
            return part
        fruitless = fruitless + 1 if _size(part) <= before else 0
        if fruitless >= ATTEMPTS:
            raise InputError(f"{url}: {problem}; {_size(part)} bytes are kept, run the command again to go on")


def _attempt(url: str, part: Path, show: Callable[[int, int], object] | None) -> str | None:
    """One connection: None when the file is complete, else a description of the error.

    `Range` asks for the remaining bytes of the version (ETag or date) that was begun; if the server has another one, or
    knows no ranges, it sends the whole file.
    """
    headers = {"User-Agent": "perception", "Accept-Encoding": "identity"}
    if _size(part) and _version(part).is_file() and (begun := _version(part).read_text(encoding="utf-8")):
        headers |= {"Range": f"bytes={_size(part)}-", "If-Range": begun}
    try:
        with urllib.request.urlopen(urllib.request.Request(url, headers=headers), timeout=TIMEOUT) as answer:
            sent, length = answer.headers, answer.headers.get("Content-Length") or ""
            with part.open("ab" if answer.status == 206 else "wb") as file:
                _version(part).write_text(sent.get("ETag") or sent.get("Last-Modified") or "", encoding="utf-8")
                total = file.tell() + int(length) if length.isdigit() else None
                while chunk := answer.read(CHUNK):
                    file.write(chunk)
                    if show:
                        show(file.tell(), total or file.tell())
                done = file.tell()
        return None if total is None or done >= total else f"the connection broke at {done} of {total} bytes"
    except urllib.error.HTTPError as error:
        if error.code == 416:  # nothing remains of this version
            part.unlink(missing_ok=True)
        elif error.code not in (408, 425, 429) and error.code < 500:
            raise InputError(f"{url}: the server answers {error.code} {error.reason}; check the address") from error
        return f"the server answers {error.code} {error.reason}"
    except urllib.error.URLError as error:
        return f"no connection ({error.reason})"
    except (http.client.HTTPException, ConnectionError, TimeoutError) as error:
        return f"the connection broke ({type(error).__name__})"
    except ValueError as error:
        raise InputError(f"{url}: not a web address ({error})") from error


def _version(part: Path) -> Path:
    return part.with_name(part.name + ".version")


def _size(part: Path) -> int:
    return part.stat().st_size if part.is_file() else 0


RECORD = "perception.json"
HUB = "https://huggingface.co"
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")
_DEFAULTS = "defaults.json"


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

    revision: a commit, so that the files cannot change. Digests are those that several public projects pin for it.
    """

    purpose: str
    repository: str
    revision: str
    licence: str
    files: dict[str, list[Any]]

    def addresses(self) -> dict[str, str | None]:
        """Address of each file -> its sha256 if known. HF_ENDPOINT names a mirror of the hub."""
        home = (os.environ.get("HF_ENDPOINT") or HUB).rstrip("/")
        base = f"{home}/{self.repository}/resolve/{self.revision}"
        return {f"{base}/{quote(path)}": digest for path, (_, digest) in self.files.items()}


def catalogue() -> dict[str, Entry]:
    """Name -> entry, of catalogue.json: permissively licensed; none of the files was downloaded by this project."""
    text = (Path(__file__).parent / "catalogue.json").read_text(encoding="utf-8")
    return {name: Entry(**about) for name, about in json.loads(text).items()}


def cache_folder() -> Path:
    """Folder for cached files and models: $XDG_CACHE_HOME/perception or ~/.cache/perception."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "perception"


def models_folder() -> Path:
    """The folder of all models."""
    return cache_folder() / "models"


def check_name(name: str) -> str:
    """Returns `name`; InputError unless it is a valid folder name that is not a path."""
    if not _NAME.fullmatch(name):
        raise InputError(f"model name '{name}': expected letters, digits, '.', '_' or '-', as in mobile-sam")
    return name


def stored_models() -> list[StoredModel]:
    """All stored models, sorted by name."""
    if not models_folder().is_dir():
        return []
    found = (find_model(folder.name) for folder in sorted(models_folder().iterdir()))
    return [model for model in found if model is not None]


def find_model(name: str) -> StoredModel | None:
    """The stored model `name`, or None. InputError for a damaged record."""
    if not _NAME.fullmatch(name):
        return None
    folder = models_folder() / name
    if not (folder / RECORD).is_file():
        return None
    try:
        about = json.loads((folder / RECORD).read_text(encoding="utf-8"))
        return StoredModel(name, folder, about["family"], about["purpose"], list(about["files"]))
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"{folder / RECORD}: cannot be read ({error}); remove {folder} and add it again") from error


def resolve(spec: str) -> str:
    """`spec` itself if it is an existing path, else the folder of the stored model of that name, else `spec`."""
    if Path(spec).expanduser().exists():
        return spec
    model = find_model(spec)
    return spec if model is None else str(model.folder)


def known_names() -> str:
    """Names of the stored models, for messages."""
    names = ", ".join(model.name for model in stored_models())
    return f"the store holds {names}" if names else "the store is empty (see perception models add)"


def write_record(folder: Path, family: str | None, purpose: str | None, files: list[dict[str, Any]]) -> None:
    """Writes the model's record into its folder."""
    text = json.dumps({"family": family, "purpose": purpose, "files": files}, indent=1)
    (folder / RECORD).write_text(text + "\n", encoding="utf-8")


def default_model(purpose: str) -> str | None:
    """Folder of the model that the user chose for a purpose ("sam"), or None."""
    name = _defaults().get(purpose)
    if name is None:
        return None
    model = find_model(name)
    if model is None:
        raise InputError(f"the default {purpose} model '{name}' is not in the store any more; {known_names()}")
    return str(model.folder)


def set_default(model: StoredModel) -> None:
    """Makes a model the default for its purpose, as used by `--masks auto`."""
    if model.purpose is None:
        raise InputError(f"{model.name}: its family is unknown, so nothing can be done with it by default")
    with atomic_file(models_folder() / _DEFAULTS) as file:
        file.write_text(json.dumps({**_defaults(), model.purpose: model.name}) + "\n", encoding="utf-8")


def _defaults() -> dict[str, str]:
    file = models_folder() / _DEFAULTS
    known = read_json(file) if file.is_file() else {}
    return known if isinstance(known, dict) else {}
