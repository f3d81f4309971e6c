"""How fast a map opens and answers, and whether every answer is right under load: `perception bench query`.

Synthetic maps whose answers are known by construction. Cold: a fresh process until its first answer. Load: load_map
alone. Warm: prompts never asked before, and prompts asked again (their ranking is remembered). Clients: many at once
through the engine, HTTP, and DDS by service and by topics; each answer is compared with the one a single thread got, a
difference is a crossed answer and an exception a lost one. Memory: resident before and after the queries.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from perception.bench.askers import CONTENDERS, Best, Contender
from perception.bench.dds import DDS_CONTENDERS
from perception.bench.memory import status_mib
from perception.bench.output import bench_parser, finish, save_plot
from perception.bench.processes import run_python
from perception.bench.synthetic_map import write_synthetic_map
from perception.errors import InputError

_WAYS = {**CONTENDERS, **DDS_CONTENDERS}

_COLD = """
import sys, resource
from perception.bench.memory import status_mib
from perception.query import load_map
gmap = load_map(sys.argv[1])
opened = resource.getrusage(resource.RUSAGE_SELF)
hits = gmap.query(sys.argv[2], 1)
used = resource.getrusage(resource.RUSAGE_SELF)
times = (opened.ru_utime + opened.ru_stime, used.ru_utime + used.ru_stime)
print(hits[0].instance_id, *times, status_mib("VmHWM"))
"""


def prompts(count: int) -> list[str]:
    """`count` different object names without colour words, so that queries do not use palettes."""
    from perception.language.colors import color_words
    from perception.language.conse import class_names

    names = [group[0] for group in class_names() if not color_words(group[0])]
    unique = list(dict.fromkeys(names))
    if count > len(unique):
        raise InputError(f"--instances: found {count}, expected at most {len(unique)}")
    return unique[:count]


def cold_start(path: Path, name: str, expected: int, rounds: int) -> dict[str, Any]:
    """Seconds from process start to the first answer, wall time and CPU time, and peak memory in MiB."""
    rows = []
    for _ in range(rounds):
        start = time.perf_counter()
        out = run_python("-c", _COLD, str(path.resolve()), name).split()
        rows.append([time.perf_counter() - start, *map(float, out[1:])])
        if int(out[0]) != expected:
            raise RuntimeError(f"{name}: answered {out[0]}, expected {expected}")
    wall, opened, used, peak = np.median(rows, axis=0)
    return {
        "first_answer_s": round(float(wall), 2),
        "first_answer_cpu_s": round(float(used), 2),
        "until_map_open_cpu_s": round(float(opened), 2),
        "peak_mib": round(float(peak)) if np.isfinite(peak) else None,
        "rounds": rounds,
    }


def load_times(path: Path, turns: int) -> dict[str, float]:
    """Milliseconds of load_map, alone and with reading the points of one instance. The file cache is warm."""
    from perception.query import load_map

    load_map(path)
    opening, pointing = [], []
    for _ in range(turns):
        start = time.perf_counter()
        gmap = load_map(path)
        opening.append(time.perf_counter() - start)
        gmap.get(0)
        pointing.append(time.perf_counter() - start)
    return {"load_map_ms": _ms(np.median(opening)), "load_map_and_points_ms": _ms(np.median(pointing))}


def place_times(path: Path, turns: int) -> dict[str, float]:
    """Milliseconds of spatial queries, each at or around another instance; median over instances."""
    from perception.query import axis_box, load_map

    gmap = load_map(path)
    hits = gmap.find()[:: max(1, len(gmap.instances) // (8 * turns))]
    questions: dict[str, Callable[[Any], Any]] = {
        "nearest": lambda hit: gmap.nearest(hit.centroid, 3),
        "instance_at": lambda hit: gmap.instance_at(hit.centroid),
        "in_box": lambda hit: gmap.in_box(axis_box(hit.centroid - 1.5, hit.centroid + 1.5)),
        "describe": lambda hit: gmap.describe(hit.instance_id),
    }
    found = {}
    for name, ask in questions.items():
        times = []
        for hit in hits:
            start = time.perf_counter()
            ask(hit)
            times.append(time.perf_counter() - start)
        found[f"{name}_ms"] = _ms(np.median(times))
    return found


def warm(path: Path, names: Sequence[str], queries: int) -> tuple[dict[str, Any], dict[str, Best]]:
    """One thread: new prompts, then `queries` repeated ones. Returns the figures (with correctness) and answers."""
    from perception.query import load_map

    gmap = load_map(path)
    gmap.warm()
    answers: dict[str, Best] = {}
    first, again = [], []
    for name in names:
        start = time.perf_counter()
        hits = gmap.query(name, 1)
        first.append(time.perf_counter() - start)
        answers[name] = (hits[0].instance_id, len(hits[0].points)) if hits else None
    before = status_mib("VmRSS")
    for n in range(queries):
        start = time.perf_counter()
        gmap.query(names[n % len(names)], 1)
        again.append(time.perf_counter() - start)
    right = sum(answers[name] is not None and answers[name][0] == k for k, name in enumerate(names))  # type: ignore[index]
    facts = {
        "new_prompt": _spread(first),
        "repeated_prompt": _spread(again),
        "resident_before_mib": before,
        "resident_after_mib": status_mib("VmRSS"),
        "right_by_construction": f"{right} of {len(names)}",
    }
    return facts, answers


def clients_at_once(contender: Contender, path: Path, answers: dict[str, Best], shares: list[list[str]]) -> Any:
    """Runs one client per share concurrently. Each sends its prompts in sequence, and every answer is compared."""

    def client(ask: Any, share: list[str]) -> tuple[list[float], int, int]:
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

    with contender(path) as served, ThreadPoolExecutor(len(shares)) as pool:
        before, start = status_mib("VmRSS", served.process), time.perf_counter()
        asked = [pool.submit(client, served.client(), share) for share in shares]
        results = [future.result() for future in asked]
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


def measure(options: argparse.Namespace, folder: Path) -> tuple[dict[str, Any], str]:
    """All figures, and a text with the main ones."""
    from perception.language.encoders import make_encoder

    names, encoder = prompts(options.instances), make_encoder("conse")
    report: dict[str, Any] = {"maps": {}, "clients": {}}
    lines = []
    for size in options.sizes:
        path = folder / f"{size}.gsmap"
        write_synthetic_map(path, names, encoder, gaussians=size)
        row = {**load_times(path, options.turns), **cold_start(path, names[0], 0, options.rounds)}
        report["maps"][size] = row | place_times(path, options.turns)
        lines += [f"{size} Gaussians", *(f"  {key}: {value}" for key, value in report["maps"][size].items())]
    report["warm"], answers = warm(path, names, options.queries)
    for kind in ("new_prompt", "repeated_prompt"):
        lines.append(f"one thread, {kind.replace('_', ' ')}: {_told(report['warm'][kind])}")
    before, after = report["warm"]["resident_before_mib"], report["warm"]["resident_after_mib"]
    lines.append(f"resident before and after {options.queries} queries: {before:.0f}, {after:.0f} MiB")
    lines.append(f"right by construction: {report['warm']['right_by_construction']}")
    new = [f"{a} on a {b}" for a, b in zip(names, names[1:] + names[:1], strict=True)][: options.new]
    alone = warm(path, new, 0)[1]
    for name in options.via:
        repeated = shares_of(names, options.queries, options.clients)
        shares = [new[c :: options.clients] for c in range(options.clients)]
        rows = {
            "new prompts": clients_at_once(_WAYS[name], path, alone, shares),
            "repeated prompts": clients_at_once(_WAYS[name], path, answers, repeated),
        }
        report["clients"][name] = rows
        lines += [
            f"{options.clients} clients, {name}, {kind}: {_told(row)}, {row['per_second']} a second; "
            f"{row['asked']} asked, {row['lost']} lost, {row['crossed']} crossed; "
            f"server {row['server_after_mib']:.0f} MiB"
            for kind, row in rows.items()
        ]
    return report, "\n".join(lines)


def _spread(seconds: Sequence[float]) -> dict[str, float]:
    if not seconds:
        return {}
    low, median, high, last = np.percentile(seconds, [25, 50, 75, 99])
    return {"median_ms": _ms(median), "q25_ms": _ms(low), "q75_ms": _ms(high), "p99_ms": _ms(last)}


def _told(row: dict[str, Any]) -> str:
    return f"median {row['median_ms']} ms [{row['q25_ms']}, {row['q75_ms']}], p99 {row['p99_ms']} ms"


def _ms(seconds: Any) -> float:
    return round(1e3 * float(seconds), 3)


def _draw(report: dict[str, Any], clients: int) -> Callable[[Any], None]:
    """Median and 99th percentile latency of every kind of client, on a logarithmic axis."""
    rows = {"new prompt": report["warm"]["new_prompt"], "asked again": report["warm"]["repeated_prompt"]}
    for name, kinds in report["clients"].items():
        rows |= {f"{clients} clients,\n{name},\n{kind}": row for kind, row in kinds.items()}

    def draw(figure: Any) -> None:
        axes = figure.subplots()
        places = np.arange(len(rows))
        for shift, key, label in ((-0.2, "median_ms", "median"), (0.2, "p99_ms", "99 %")):
            bars = axes.bar(places + shift, [row[key] for row in rows.values()], 0.4, label=label)
            axes.bar_label(bars, fmt="%.3g", fontsize=8)
        axes.set(yscale="log", ylabel="ms", xticks=places, title="One prompt, asked and answered")
        axes.set_xticklabels(list(rows))
        axes.legend(frameon=False, ncols=2, loc="upper left")
        axes.margins(y=0.25)

    return draw


def main(arguments: Sequence[str] | None = None) -> None:
    """Prints the figures; JSON and a plot go to the output folder."""
    parser = bench_parser("query", __doc__)
    parser.add_argument("--sizes", type=int, nargs="+", default=[200_000, 1_000_000], help="Gaussians of the maps")
    parser.add_argument("--instances", type=int, default=200)
    parser.add_argument("--queries", type=int, default=10_000)
    parser.add_argument("--new", type=int, default=160, help="prompts never asked before in the clients' test")
    parser.add_argument("--clients", type=int, default=8)
    parser.add_argument("--rounds", type=int, default=3, help="processes started for the cold figures")
    parser.add_argument("--turns", type=int, default=7, help="times each map is opened")
    parser.add_argument("--via", nargs="+", default=list(_WAYS), choices=list(_WAYS))
    options = parser.parse_args(arguments)
    if min(*options.sizes, options.queries, options.new, options.clients, options.rounds, options.turns) < 1:
        raise InputError("bench query: sizes and counts must be at least 1")
    with tempfile.TemporaryDirectory() as folder:
        report, text = measure(options, Path(folder))
    save_plot(options.output / "query.png", _draw(report, options.clients), (8, 3.6))
    finish("query", options, report, text)
