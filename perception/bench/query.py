"""How fast a map opens and answers, and whether every answer is the same under load: `perception bench query MAP`.

Cold: a fresh process until its first answer. Opening: load_map alone. Warm: prompts never asked before, and prompts
asked again (their ranking is remembered). Clients: many at once through the engine and HTTP; each answer is compared
with the one a single thread got, a difference is a crossed answer and an exception a lost one. Memory: resident before
and after the queries.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from perception.bench.clients import WAYS, Best
from perception.bench.output import bench_parser, finish
from perception.bench.processes import run_python, status_mib
from perception.errors import InputError
from perception.io.store import read_info

_COLD = """
import sys, time
from perception.bench.processes import status_mib
from perception.query import load_map
gmap = load_map(sys.argv[1])
opened = time.process_time()
gmap.query(sys.argv[2], 1)
print(opened, time.process_time(), status_mib("VmHWM"))
"""


def prompts(count: int) -> list[str]:
    """`count` different object names without colour words, so that queries do not use palettes."""
    from perception.language.colors import color_words
    from perception.language.conse import class_names

    unique = list(dict.fromkeys(group[0] for group in class_names() if not color_words(group[0])))
    if not 1 <= count <= len(unique):
        raise InputError(f"--prompts: found {count}, expected 1 to {len(unique)}")
    return unique[:count]


def cold_start(path: Path, name: str, rounds: int) -> dict[str, Any]:
    """Seconds from process start to the first answer, wall time and CPU time, and peak memory in MiB."""
    rows = []
    for _ in range(rounds):
        start = time.perf_counter()
        figures = map(float, run_python("-c", _COLD, str(path.resolve()), name).split())
        rows.append([time.perf_counter() - start, *figures])
    wall, opened, used, peak = (round(float(value), 2) for value in np.median(rows, axis=0))
    return {"first_answer_s": wall, "until_map_open_cpu_s": opened, "first_answer_cpu_s": used, "peak_mib": peak}


def open_map_times(path: Path, turns: int) -> dict[str, float]:
    """Median milliseconds of load_map (file cache warm), of an instance's points, and of spatial queries at others."""
    from perception.query import axis_box, load_map

    gmap = load_map(path)
    hits = gmap.find()[:: max(1, len(gmap.instances) // (8 * turns))]
    calls: dict[str, tuple[Callable[[Any], Any], Sequence[Any]]] = {
        "load_map": (lambda _: load_map(path), range(turns)),
        "load_map_and_points": (lambda _: load_map(path).get(0), range(turns)),
        "nearest": (lambda hit: gmap.nearest(hit.centroid, 3), hits),
        "instance_at": (lambda hit: gmap.instance_at(hit.centroid), hits),
        "in_box": (lambda hit: gmap.in_box(axis_box(hit.centroid - 1.5, hit.centroid + 1.5)), hits),
        "describe": (lambda hit: gmap.describe(hit.instance_id), hits),
    }
    return {f"{name}_ms": _ms(np.median(_seconds(call, over)[0])) for name, (call, over) in calls.items()}


def warm(path: Path, names: Sequence[str], queries: int) -> tuple[dict[str, Any], dict[str, Best]]:
    """One thread: new prompts, then `queries` repeated ones. Returns the figures and the answers."""
    from perception.query import load_map

    gmap = load_map(path)
    gmap.warm()
    first, found = _seconds(lambda name: gmap.query(name, 1), names)
    answers: dict[str, Best] = {
        name: (hits[0].instance_id, len(hits[0].points)) if hits else None
        for name, hits in zip(names, found, strict=True)
    }
    before = status_mib("VmRSS")
    again, _ = _seconds(lambda n: len(gmap.query(names[n % len(names)], 1)), range(queries))
    facts = {
        "new_prompt": _spread(first),
        "repeated_prompt": _spread(again),
        "resident_before_mib": before,
        "resident_after_mib": status_mib("VmRSS"),
        "present": f"{sum(best is not None for best in answers.values())} of {len(names)}",
    }
    return facts, answers


def clients_at_once(way: Any, path: Path, answers: dict[str, Best], shares: list[list[str]]) -> dict[str, Any]:
    """Runs one client per share concurrently. Each sends its prompts in sequence, and every answer is compared."""

    def run(ask: Any, share: list[str]) -> tuple[list[float], int, int]:
        times, crossed, lost = [], 0, 0
        for name in share:
            start = time.perf_counter()
            try:
                answer = ask(name)
            except (OSError, RuntimeError, ValueError, KeyError):
                lost += 1
                continue
            times.append(time.perf_counter() - start)
            crossed += answer != answers[name]
        return times, crossed, lost

    with way(path) as served, ThreadPoolExecutor(len(shares)) as pool:
        before, start = status_mib("VmRSS", served.process), time.perf_counter()
        results = [future.result() for future in [pool.submit(run, served.client(), share) for share in shares]]
        seconds = time.perf_counter() - start
        after = status_mib("VmRSS", served.process)
    times = [t for row, _, _ in results for t in row]
    return {
        "asked": sum(map(len, shares)),
        "lost": sum(lost for _, _, lost in results),
        "crossed": sum(crossed for _, crossed, _ in results),
        "per_second": round(len(times) / seconds),
        "server_before_mib": before,
        "server_after_mib": after,
        **_spread(times),
    }


def shares_of(names: Sequence[str], queries: int, clients: int) -> list[list[str]]:
    """`queries` prompts divided among `clients`. Each client gets `names` in a different order."""
    return [[names[(n * 7 + c * 31) % len(names)] for n in range(queries // clients)] for c in range(clients)]


def measure(options: argparse.Namespace) -> tuple[dict[str, Any], str]:
    """All figures, and a text of them."""
    path, names = options.map, prompts(options.prompts)
    opened = {**open_map_times(path, options.turns), **cold_start(path, names[0], options.rounds)}
    facts, answers = warm(path, names, options.queries)
    new = [f"{a} on a {b}" for a, b in zip(names, names[1:] + names[:1], strict=True)]
    alone = warm(path, new, 0)[1]
    clients: dict[str, Any] = {}
    for name in options.via:
        shares = [new[c :: options.clients] for c in range(options.clients)]
        repeated = shares_of(names, options.queries, options.clients)
        clients |= {
            f"{options.clients} clients, {name}, new": clients_at_once(WAYS[name], path, alone, shares),
            f"{options.clients} clients, {name}, repeated": clients_at_once(WAYS[name], path, answers, repeated),
        }
    groups = {"opening": opened, "one thread": facts, **clients}
    lines = [f"{head}\n" + "\n".join(f"  {key}: {value}" for key, value in row.items()) for head, row in groups.items()]
    return groups, "\n".join(lines)


def _seconds(call: Callable[[Any], Any], over: Sequence[Any]) -> tuple[list[float], list[Any]]:
    """Wall-clock seconds of call(item) for each item, and what it returned."""
    seconds, results = [], []
    for item in over:
        start = time.perf_counter()
        results.append(call(item))
        seconds.append(time.perf_counter() - start)
    return seconds, results


def _spread(seconds: Sequence[float]) -> dict[str, float]:
    if not seconds:
        return {}
    low, median, high, last = np.percentile(seconds, [25, 50, 75, 99])
    return {"median_ms": _ms(median), "q25_ms": _ms(low), "q75_ms": _ms(high), "p99_ms": _ms(last)}


def _ms(seconds: Any) -> float:
    return round(1e3 * float(seconds), 3)


def main(arguments: Sequence[str] | None = None) -> None:
    """Prints the figures; JSON goes to the output folder."""
    parser = bench_parser("query", __doc__)
    parser.add_argument("map", type=Path, metavar="MAP")
    parser.add_argument("--prompts", type=int, default=160, help="different ones, and as many that combine two")
    parser.add_argument("--queries", type=int, default=10_000, help="in all, repeating the prompts")
    parser.add_argument("--clients", type=int, default=8)
    parser.add_argument("--rounds", type=int, default=3, help="processes started for the cold figures")
    parser.add_argument("--turns", type=int, default=7, help="times the map is opened")
    parser.add_argument("--via", nargs="+", default=list(WAYS), choices=list(WAYS))
    options = parser.parse_args(arguments)
    if min(options.queries, options.clients, options.rounds, options.turns) < 1:
        raise InputError("bench query: counts must be at least 1")
    read_info(options.map)  # its error is the clearest when there is no map
    finish("query", options, *measure(options))
