"""HTTP downloads that resume after broken connections; received bytes are kept in a `.part` file.

A `Range` request fetches the remaining bytes; with `If-Range` the server sends the whole file if it has changed.
Servers without range support also send the whole file, which then replaces the partial one.
"""

from __future__ import annotations

import hashlib
import http.client
import json
import urllib.error
import urllib.request
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from perception.errors import InputError
from perception.progress import Progress

CHUNK = 1 << 20
TIMEOUT = 30.0  # seconds without received data
ATTEMPTS = 4  # consecutive connections without new data

Told = Callable[[int, int], object]


def is_url(source: str) -> bool:
    """Whether `source` is a URL to download rather than a local file."""
    return source.lower().startswith(("http://", "https://"))


def download(url: str, part: Path, progress: Progress | None = None, name: str = "") -> Path:
    """Downloads `url` to `part`, after the bytes already there; returns `part` when complete.

    part: the sibling `*.part.json` records the version of the file. name: stage name of the progress display, in bytes.
    InputError when the server refuses, or after ATTEMPTS connections without new data; `part` is then kept.
    """
    part.parent.mkdir(parents=True, exist_ok=True)
    fruitless = 0
    while True:
        before = _size(part)
        problem = _attempt(url, part, None if progress is None else partial(progress.update, name or part.name))
        if problem is None:
            _memory(part).unlink(missing_ok=True)
            return part
        fruitless = fruitless + 1 if _size(part) <= before else 0
        if fruitless >= ATTEMPTS:
            raise InputError(f"{url}: {problem}; {_size(part)} bytes are kept, run the command again to go on")


def sha256_of(path: Path) -> str:
    """Hex digest of a file."""
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while chunk := file.read(CHUNK):
            digest.update(chunk)
    return digest.hexdigest()


def _attempt(url: str, part: Path, told: Told | None) -> str | None:
    """One connection: None when the file is complete, else a description of the error."""
    have = _size(part)
    try:
        with urllib.request.urlopen(_request(url, part, have), timeout=TIMEOUT) as answer:
            start, total = _extent(answer, have)
            if start not in (0, have):
                return f"the server sent bytes from {start} on, asked for {have}"
            _memory(part).write_text(json.dumps({"url": url, "mark": _mark(answer)}), encoding="utf-8")
            return _receive(answer, part, start, total, told)
    except urllib.error.HTTPError as error:
        if error.code == 416 and have:  # range not satisfiable: file complete, or changed
            if str(error.headers.get("Content-Range", "")).endswith(f"/{have}"):
                return None
            part.unlink()
            return "the file has changed on the server"
        if error.code in (408, 425, 429) or error.code >= 500:
            return f"the server answers {error.code} {error.reason}"
        raise InputError(f"{url}: the server answers {error.code} {error.reason}; check the address") from error
    except urllib.error.URLError as error:
        return f"no connection ({error.reason})"
    except (http.client.HTTPException, ConnectionError, TimeoutError) as error:
        return f"the connection broke ({type(error).__name__})"
    except ValueError as error:
        raise InputError(f"{url}: not a web address ({error})") from error


def _request(url: str, part: Path, have: int) -> urllib.request.Request:
    headers = {"User-Agent": "perception", "Accept-Encoding": "identity"}
    if have:
        known = _recall(part)
        if known.get("url") == url:
            headers["Range"] = f"bytes={have}-"
            if known.get("mark"):
                headers["If-Range"] = known["mark"]
    return urllib.request.Request(url, headers=headers)


def _extent(answer: Any, have: int) -> tuple[int, int | None]:
    """Offset of the first byte in the response, and the size of the whole file if given."""
    length = answer.headers.get("Content-Length")
    size = int(length) if length is not None and length.isdigit() else None
    if answer.status != 206:
        return 0, size
    span, _, total = str(answer.headers.get("Content-Range", "")).removeprefix("bytes ").partition("/")
    first = span.split("-")[0]
    start = int(first) if first.isdigit() else have
    return start, int(total) if total.isdigit() else (None if size is None else start + size)


def _receive(answer: Any, part: Path, start: int, total: int | None, told: Told | None) -> str | None:
    with part.open("r+b" if start else "wb") as file:
        file.seek(start)
        file.truncate()
        done = start
        while chunk := answer.read(CHUNK):
            file.write(chunk)
            done += len(chunk)
            if told:
                told(done, total or done)
    if total is not None and done < total:
        return f"the connection broke at {done} of {total} bytes"
    return None


def _mark(answer: Any) -> str | None:
    """Version identifier of a file: its strong ETag, else its modification date."""
    tag = answer.headers.get("ETag")
    if tag and not tag.startswith("W/"):
        return str(tag)
    date = answer.headers.get("Last-Modified")
    return str(date) if date else None


def _recall(part: Path) -> dict[str, Any]:
    try:
        known = json.loads(_memory(part).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return known if isinstance(known, dict) else {}


def _memory(part: Path) -> Path:
    return part.with_name(part.name + ".json")


def _size(part: Path) -> int:
    return part.stat().st_size if part.is_file() else 0
