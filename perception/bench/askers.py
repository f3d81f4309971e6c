"""Clients of a served map for the load test of `bench query`: by direct calls to the engine, and over HTTP.

A `Contender` takes the path of a map and returns a context manager. It yields `Served`: a factory of clients and the id
of the serving process. A client takes a prompt and returns (instance id, number of points) of the best hit, or None.
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
Ask = Callable[[str], Best]


@dataclass(frozen=True)
class Served:
    """client: creates one client. process: id of the serving process, whose memory is measured."""

    client: Callable[[], Ask]
    process: int


Contender = Callable[[Path], AbstractContextManager[Served]]


@contextmanager
def engine_askers(path: Path) -> Iterator[Served]:
    """Clients that call one `QueryEngine` in this process. They may run in several threads."""
    from perception.query.engine import QueryEngine
    from perception.query.requests import Request

    with QueryEngine(path, watch=None, timeout=60) as engine:

        def ask(text: str) -> Best:
            hits = engine.ask(Request(text, 1)).hits
            return (hits[0].instance_id, len(hits[0].points)) if hits else None

        yield Served(lambda: ask, os.getpid())


@contextmanager
def http_askers(path: Path) -> Iterator[Served]:
    """Clients of `perception serve`, a separate process on the loopback interface; one connection per client."""
    options = ["--port", "0", "--rate", "0", "--watch", "0", "--timeout", "60"]
    with served("serve", str(path.resolve()), *options) as (told, process):
        port = int(told.rsplit(":", 1)[1].split()[0])

        def client() -> Ask:
            connection = http.client.HTTPConnection("127.0.0.1", port, timeout=60)

            def ask(text: str) -> Best:
                body = json.dumps({"text": text, "top_k": 1})
                connection.request("POST", "/query", body, {"Content-Type": "application/json"})
                answer: dict[str, Any] = json.loads(connection.getresponse().read())
                (result,) = answer["results"]
                if result["text"] != text:
                    raise RuntimeError(f"asked for {text!r}, answered {result['text']!r}")
                hits = result["hits"]
                return (hits[0]["instance_id"], hits[0]["num_points"]) if hits else None

            return ask

        yield Served(client, process)


CONTENDERS: dict[str, Contender] = {"engine": engine_askers, "http": http_askers}
