"""HTTP downloads that resume after broken connections; received bytes are kept in a `.part` file."""

from __future__ import annotations

import http.client
import urllib.error
import urllib.request
from collections.abc import Callable
from functools import partial
from pathlib import Path

from perception.errors import InputError
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
