"""Permissively licensed public exports on the Hugging Face hub that `perception models get` fetches.

Revisions are commits, so that the files cannot change. Digests are those that several public projects pin for the same
revision; where none is known, the size and digest that the hub states are used. None of these files was downloaded by
this project.
"""

from __future__ import annotations

import http.client
import json
import os
import urllib.request
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote

from perception.errors import InputError
from perception.io.download import TIMEOUT

HUB = "https://huggingface.co"


@dataclass(frozen=True)
class Entry:
    """A model. files: path in the repository -> [bytes, sha256], None where not known."""

    purpose: str
    repository: str
    revision: str
    licence: str
    files: dict[str, list[Any]]


def catalogue() -> dict[str, Entry]:
    """Name -> entry, of catalogue.json."""
    text = (Path(__file__).parent / "catalogue.json").read_text(encoding="utf-8")
    return {name: Entry(**about) for name, about in json.loads(text).items()}


def hub_files(entry: Entry) -> dict[str, list[Any]]:
    """Address of each file -> [bytes, sha256], as far as the catalogue or the hub knows. HF_ENDPOINT names a mirror.

    InputError when the hub does not have a file, or states another size or digest than the catalogue.
    """
    home = (os.environ.get("HF_ENDPOINT") or HUB).rstrip("/")
    url = f"{home}/api/models/{entry.repository}/revision/{entry.revision}?blobs=true"
    try:
        request = urllib.request.Request(url, headers={"User-Agent": "perception"})
        with urllib.request.urlopen(request, timeout=TIMEOUT) as answer:
            listed = {file["rfilename"]: file for file in json.load(answer)["siblings"]}
    except (OSError, http.client.HTTPException, ValueError, KeyError, TypeError) as error:
        raise InputError(f"{url}: cannot be read ({error}); go online, or name a mirror in HF_ENDPOINT") from error
    found = {}
    for path, known in entry.files.items():
        if path not in listed:
            raise InputError(f"{url}: has no {path}; the catalogue is out of date")
        stated = listed[path].get("size"), (listed[path].get("lfs") or {}).get("sha256")
        for ours, theirs in zip(known, stated, strict=True):
            if ours is not None and theirs is not None and ours != theirs:
                raise InputError(f"{url}: states {theirs} for {path}, the catalogue {ours}; nothing was fetched")
        address = f"{home}/{entry.repository}/resolve/{entry.revision}/{quote(path)}"
        found[address] = [ours or theirs for ours, theirs in zip(known, stated, strict=True)]
    return found
