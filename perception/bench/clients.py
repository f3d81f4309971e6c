"""Clients of a served map for the load test of `bench query`: direct calls of the engine, and HTTP.

Each of WAYS takes the path of a map and is a context manager of a `Served`. A client takes a prompt and returns the
best hit, (instance id, number of points), or None; it raises RuntimeError for an answer to another prompt. Another
server, such as the DDS node, needs one more function here.
"""

from __future__ import annotations

import http.client
import json
import os
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from perception.bench.processes import served

Best = tuple[int, int] | None
Client = Callable[[str], Best]
_SECONDS = 60.0


@dataclass(frozen=True)
class Served:
    """client: creates one client. process: id of the serving process, whose memory is measured."""

    client: Callable[[], Client]
    process: int


@contextmanager
def by_engine(path: Path) -> Iterator[Served]:
    """Clients of one `QueryEngine` in this process. They may run in several threads."""
    from perception.query.engine import QueryEngine
    from perception.query.requests import Request

    with QueryEngine(path, watch=None, timeout=_SECONDS) as engine:

        def ask(text: str) -> Best:
            hits = engine.ask(Request(text, 1)).hits
            return (hits[0].instance_id, len(hits[0].points)) if hits else None

        yield Served(lambda: ask, os.getpid())


@contextmanager
def by_http(path: Path) -> Iterator[Served]:
    """Clients of `perception serve` on the loopback interface; one connection per client."""
    options = ["--port", "0", "--rate", "0", "--watch", "0", "--timeout", f"{_SECONDS:g}"]
    with served("serve", str(path.resolve()), *options) as (line, process):
        port = int(line.rsplit(":", 1)[1].split()[0])

        def client() -> Client:
            connection = http.client.HTTPConnection("127.0.0.1", port, timeout=_SECONDS)

            def ask(text: str) -> Best:
                body = json.dumps({"text": text, "top_k": 1})
                connection.request("POST", "/query", body, {"Content-Type": "application/json"})
                (result,) = json.loads(connection.getresponse().read())["results"]
                return _best(text, result)

            return ask

        yield Served(client, process)


def _best(text: str, answer: Any) -> Best:
    if not isinstance(answer, dict) or answer.get("text") != text:
        raise RuntimeError(f"asked for {text!r}, answered {str(answer)[:80]}")
    hits = answer["hits"]
    return (hits[0]["instance_id"], hits[0]["num_points"]) if hits else None


WAYS: dict[str, Callable[[Path], AbstractContextManager[Served]]] = {"engine": by_engine, "http": by_http}
