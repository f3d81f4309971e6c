"""HTTP downloads that resume after broken connections; received bytes are kept in a `.part` file.

A `Range` request fetches the remaining bytes; with `If-Range` the server sends the whole file if it has changed.
Servers without range support also send the whole file, which then replaces the partial one.
"""

from __future__ import annotations

import http.client
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

Show = Callable[[int, int], object]


def is_url(source: str) -> bool:
    """Whether `source` is a URL to download rather than a local file."""
    return source.lower().startswith(("http://", "https://"))


def download(url: str, part: Path, progress: Progress | None = None, name: str = "") -> Path:
    """Downloads `url` to `part`, after the bytes of `url` already there; returns `part` when complete.

    part: the sibling `*.part.version` names the version of the file. name: stage name of the progress display, in
    bytes. InputError when the server refuses, or after ATTEMPTS connections without new data; `part` is then kept.
    """
    part.parent.mkdir(parents=True, exist_ok=True)
    fruitless = 0
    while True:
        before = _size(part)
        problem = _attempt(url, part, None if progress is None else partial(progress.update, name or part.name))
        if problem is None:
            _version_file(part).unlink(missing_ok=True)
            return part
        fruitless = fruitless + 1 if _size(part) <= before else 0
        if fruitless >= ATTEMPTS:
            raise InputError(f"{url}: {problem}; {_size(part)} bytes are kept, run the command again to go on")


def _attempt(url: str, part: Path, show: Show | None) -> str | None:
    """One connection: None when the file is complete, else a description of the error."""
    have = _size(part)
    headers = {"User-Agent": "perception", "Accept-Encoding": "identity"}
    if have and _version_file(part).is_file():
        version = _version_file(part).read_text(encoding="utf-8")
        headers |= {"Range": f"bytes={have}-"} | ({"If-Range": version} if version else {})
    try:
        with urllib.request.urlopen(urllib.request.Request(url, headers=headers), timeout=TIMEOUT) as answer:
            return _receive(answer, part, have if answer.status == 206 else 0, show)
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


def _receive(answer: Any, part: Path, start: int, show: Show | None) -> str | None:
    """Writes the body of a response from byte `start` on, with the file's strong ETag or date as its version."""
    sent = str(answer.headers.get("Content-Range", ""))
    if start and not sent.startswith(f"bytes {start}-"):
        return f"the server sent '{sent}', asked for the bytes from {start} on"
    tag, length = answer.headers.get("ETag") or "W/", answer.headers.get("Content-Length") or ""
    version = answer.headers.get("Last-Modified") or "" if tag.startswith("W/") else tag
    _version_file(part).write_text(version, encoding="utf-8")
    total = start + int(length) if length.isdigit() else None
    with part.open("r+b" if start else "wb") as file:
        file.seek(start)
        file.truncate()
        done = start
        while chunk := answer.read(CHUNK):
            file.write(chunk)
            done += len(chunk)
            if show:
                show(done, total or done)
    if total is not None and done < total:
        return f"the connection broke at {done} of {total} bytes"
    return None


def _version_file(part: Path) -> Path:
    return part.with_name(part.name + ".version")


def _size(part: Path) -> int:
    return part.stat().st_size if part.is_file() else 0
