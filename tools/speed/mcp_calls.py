"""Measures the latency of `perception mcp MAP` over stdio, and prints a transcript.

python tools speed.mcp_calls MAP [--calls 1000]

The calls go round all tools, one at a time, with the instances of the map and, if it answers prompts, their names.
Transcript: the first call of each tool and of each kind of error. Latencies: of the client, milliseconds.
"""

from __future__ import annotations

import argparse
import asyncio
import itertools
import json
import os
import sys
import time
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
from mcp import Client, StdioServerParameters

SHOWN = 600  # characters of an answer in the transcript


def plan(found: list[dict[str, Any]], standing: bool) -> list[tuple[str, dict[str, Any]]]:
    """One round of calls for each instance."""
    calls: list[tuple[str, dict[str, Any]]] = []
    for one, other in zip(found, [*found[1:], *found[:1]], strict=True):
        names = one["names"] or ["thing"]
        calls += [("find", {"text": names[0], "top_k": 3}), ("describe", {"id": one["instance_id"]})]
        calls += [("nearest", {"point": one["centroid"], "top_k": 3}), ("list_objects", {})]
        calls += [("measure", {"a": one["instance_id"], "b": other["instance_id"]})]
        calls += [("where_to_stand", {"id": one["instance_id"]})] if standing else []
    return calls


def wrong(found: list[dict[str, Any]]) -> list[tuple[str, dict[str, Any]]]:
    unknown = max(one["instance_id"] for one in found) + 1
    return [
        ("describe", {"id": unknown}),
        ("find", {"text": "mug", "map_id": "0123456789ab"}),
        ("find", {"text": "mug", "frame": "base_link"}),
        ("find", {"text": "mug " * 1000}),
        ("list_objects", {"unit": "m"}),
    ]


def told(name: str, arguments: dict[str, Any], result: Any) -> None:
    asked = json.dumps(arguments)
    answer = json.dumps(result.structured_content)
    pictures = [f"[{item.mime_type}, {len(item.data)} base64]" for item in result.content if item.type == "image"]
    print(f"> {name} {asked[:100]}\n< {answer[:SHOWN]}{' …' if len(answer) > SHOWN else ''} {' '.join(pictures)}\n")


async def measured(path: Path, count: int) -> dict[str, list[float]]:
    command = StdioServerParameters(
        command=sys.executable, args=["-m", "perception.cli", "mcp", str(path)], env=dict(os.environ)
    )
    spent: dict[str, list[float]] = defaultdict(list)
    async with Client(command) as client:
        tools = [tool.name for tool in (await client.list_tools()).tools]
        print(f"{client.server_info.name} {client.server_info.version}: {', '.join(tools)}\n")
        found = (await client.call_tool("list_objects", {})).structured_content["hits"]
        for name, arguments in wrong(found):
            told(name, arguments, await client.call_tool(name, arguments))
        for name, arguments in itertools.islice(itertools.cycle(plan(found, "where_to_stand" in tools)), count):
            began = time.perf_counter()
            result = await client.call_tool(name, arguments)  # validated against the output schema
            spent[name].append(1e3 * (time.perf_counter() - began))
            if len(spent[name]) == 1:
                told(name, arguments, result)
            kind = (result.structured_content.get("error") or {}).get("kind")
            if kind is not None:
                spent[f"{name}: {kind}"].append(spent[name].pop())
    return spent


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("map", type=Path)
    parser.add_argument("--calls", type=int, default=1000)
    args = parser.parse_args()
    spent = asyncio.run(measured(args.map, args.calls))
    print(f"{'tool':<32}{'calls':>7}{'median ms':>11}{'p99 ms':>9}")
    for name, values in spent.items():
        if values:
            median, high = np.percentile(values, [50, 99])
            print(f"{name:<32}{len(values):>7}{median:>11.2f}{high:>9.2f}")


if __name__ == "__main__":
    main()
