"""DDS clients for `bench query`, through the query node: `dds` uses its service, `dds-topics` its topics.

On topics every client receives all answers. A client that is more than 64 answers behind loses some and repeats its
prompt after two seconds. Such an answer counts as late (see the 99th percentile), not as lost.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from perception.bench.askers import Ask, Best, Contender, Served
from perception.bench.processes import served
from perception.node.client import NodeClient, cloud_rows
from perception.node.config import NodeConfig

_SECONDS = 60.0


@contextmanager
def _node(path: Path) -> Iterator[tuple[NodeConfig, int]]:
    """`perception node` in a separate process on the loopback interface, on an otherwise unused DDS domain."""
    config = NodeConfig(
        namespace=f"bench{os.getpid()}", transport="dds", domain=20 + os.getpid() % 200, network="localhost"
    )
    place = ["--namespace", config.namespace, "--domain", str(config.domain), "--network", "localhost"]
    more = ["--set", f"timeout={_SECONDS}", "--set", "watch=3600", "--set", "discovery_seconds=0.2"]
    with served("node", str(path.resolve()), "--transport", "dds", *place, *more) as (_, process):
        yield config, process


@contextmanager
def service_askers(path: Path) -> Iterator[Served]:
    """Each client is a DDS participant that calls the query service. The answer is JSON."""
    with _node(path) as (config, process):

        def client() -> Ask:
            asker = NodeClient(config, retry=_SECONDS)
            asker.wait_for_node(_SECONDS)

            def ask(text: str) -> Best:
                (told,) = asker.query([{"text": text, "top_k": 1}], _SECONDS)
                if not isinstance(told, dict) or told["text"] != text:
                    raise RuntimeError(f"asked for {text!r}, answered {str(told)[:80]}")
                hits = told["hits"]
                return (hits[0]["instance_id"], hits[0]["num_points"]) if hits else None

            return ask

        yield Served(client, process)


@contextmanager
def topic_askers(path: Path) -> Iterator[Served]:
    """Each client publishes its prompt and waits for all four messages of the answer, including the points."""
    with _node(path) as (config, process):

        def client() -> Ask:
            asker = NodeClient(config)
            asker.wait_for_node(_SECONDS)

            def ask(text: str) -> Best:
                answer = asker.ask({"text": text, "top_k": 1}, _SECONDS)
                if answer.facts["text"] != text or answer.points is None:
                    raise RuntimeError(f"asked for {text!r}, answered {str(answer.facts)[:80]}")
                rows = cloud_rows(answer.points)
                return (int(rows["instance_id"][0]), len(rows)) if len(rows) else None

            return ask

        yield Served(client, process)


DDS_CONTENDERS: dict[str, Contender] = {"dds": service_askers, "dds-topics": topic_askers}
