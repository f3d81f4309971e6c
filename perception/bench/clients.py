"""Clients of a served map for the load test of `bench query`: direct calls of the engine, HTTP, and the DDS node.

Each of WAYS takes the path of a map and is a context manager of a `Served`. A client takes a prompt and returns the
best hit, (instance id, number of points), or None; it raises RuntimeError for an answer to another prompt.
"""

from __future__ import annotations

import http.client
import json
import os
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from functools import partial
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


@contextmanager
def by_dds(path: Path, topics: bool = False) -> Iterator[Served]:
    """Clients of `perception node` on the loopback interface; each is a DDS participant that calls the query service.

    topics: each publishes its prompt and waits for the four messages of the answer instead. There every client receives
    all answers; one that is more than 64 behind loses some and repeats its prompt, which then counts as late.
    """
    from perception.node.client import NodeClient, cloud_rows
    from perception.node.config import NodeConfig

    domain = 20 + os.getpid() % 200  # hardly anything else is there
    config = NodeConfig(namespace=f"bench{os.getpid()}", transport="dds", domain=domain, network="localhost")
    place = ["--namespace", config.namespace, "--domain", str(domain), "--network", "localhost", "--transport", "dds"]
    more = ["--set", f"timeout={_SECONDS}", "--set", "watch=3600", "--set", "discovery_seconds=0.2"]
    with served("node", str(path.resolve()), *place, *more) as (_, process):

        def client() -> Client:
            node = NodeClient(config) if topics else NodeClient(config, retry=_SECONDS)
            node.wait_for_node(_SECONDS)

            def call(text: str) -> Best:
                (answer,) = node.query([{"text": text, "top_k": 1}], _SECONDS)
                return _best(text, answer)

            def publish(text: str) -> Best:
                answer = node.ask({"text": text, "top_k": 1}, _SECONDS)
                best = _best(text, answer.facts)
                rows = cloud_rows(answer.points or {})
                return best and (int(rows["instance_id"][0]), len(rows))

            return publish if topics else call

        yield Served(client, process)


def _best(text: str, answer: Any) -> Best:
    if not isinstance(answer, dict) or answer.get("text") != text:
        raise RuntimeError(f"asked for {text!r}, answered {str(answer)[:80]}")
    hits = answer["hits"]
    return (hits[0]["instance_id"], hits[0]["num_points"]) if hits else None


WAYS: dict[str, Callable[[Path], AbstractContextManager[Served]]] = {
    "engine": by_engine,
    "http": by_http,
    "dds": by_dds,
    "dds-topics": partial(by_dds, topics=True),
}
