"""How fast a map opens and answers, and whether every answer is right under load: `perception bench query`.

Synthetic maps whose answers are known by construction. Cold: a fresh process until its first answer. Load: load_map
alone. Warm: prompts never asked before, and prompts asked again (their ranking is remembered). Clients: many at once
through the engine, HTTP, and DDS by service and by topics; each answer is compared with the one a single thread got, a
difference is a crossed answer and an exception a lost one. Memory: resident before and after the queries.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from perception.bench.askers import CONTENDERS, Best, Contender
from perception.bench.dds import DDS_CONTENDERS
from perception.bench.synthetic_map import write_synthetic_map
from perception.errors import InputError, missing_extra

_WAYS = {**CONTENDERS, **DDS_CONTENDERS}

_COLD = """
import sys, resource
from perception.query import load_map
gmap = load_map(sys.argv[1])
opened = resource.getrusage(resource.RUSAGE_SELF)
hits = gmap.query(sys.argv[2], 1)
used = resource.getrusage(resource.RUSAGE_SELF)
peak = used.ru_maxrss  # counts the parent's memory at the fork too, where /proc knows better
try:
    status = open("/proc/self/status").read()
    peak = int(status.split("VmHWM:")[1].split()[0])
except (OSError, IndexError):
    pass
print(hits[0].instance_id, opened.ru_utime + opened.ru_stime, used.ru_utime + used.ru_stime, peak / 1024)
"""


def prompts(count: int) -> list[str]:
    """`count` different names of things, without colour words, which would bring palettes in."""
    from perception.language.colors import color_words
    from perception.language.conse import class_names

    names = [group[0] for group in class_names() if not color_words(group[0])]
    unique = list(dict.fromkeys(names))
    if count > len(unique):
        raise InputError(f"--instances: found {count}, expected at most {len(unique)}")
    return unique[:count]


def cold_start(path: Path, name: str, expected: int, rounds: int) -> dict[str, Any]:
    """Seconds from the start of a process to its first answer, wall and processor; peak memory in MiB."""
    rows = []
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(p for p in sys.path if p)}
    for _ in range(rounds):
        start = time.perf_counter()
        command = [sys.executable, "-c", _COLD, str(path), name]
        out = subprocess.run(command, capture_output=True, text=True, check=True, env=environment).stdout.split()
        rows.append([time.perf_counter() - start, *map(float, out[1:])])
        if int(out[0]) != expected:
            raise RuntimeError(f"{name}: answered {out[0]}, expected {expected}")
    wall, opened, used, peak = np.median(rows, axis=0)
    return {
        "first_answer_s": round(float(wall), 2),
        "first_answer_cpu_s": round(float(used), 2),
        "until_map_open_cpu_s": round(float(opened), 2),
        "peak_mib": round(float(peak)),
        "rounds": rounds,
    }


def load_times(path: Path, turns: int) -> dict[str, float]:
    """Milliseconds of load_map, and of load_map with the points of one instance, once the file cache is warm."""
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
    """Milliseconds, median over instances, of questions about places, each at or around another instance."""
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
    """One thread: prompts for the first time, then `queries` repeats; and the answers, which must be the true ones."""
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
    before = resident_mib()
    for n in range(queries):
        start = time.perf_counter()
        gmap.query(names[n % len(names)], 1)
        again.append(time.perf_counter() - start)
    right = sum(answers[name] is not None and answers[name][0] == k for k, name in enumerate(names))  # type: ignore[index]
    facts = {
        "new_prompt": _spread(first),
        "repeated_prompt": _spread(again),
        "resident_before_mib": before,
        "resident_after_mib": resident_mib(),
        "right_by_construction": f"{right} of {len(names)}",
    }
    return facts, answers


def answers_alone(path: Path, names: Sequence[str]) -> dict[str, Best]:
    """What a single thread is answered."""
    from perception.query import load_map

    gmap = load_map(path)
    found = {name: gmap.query(name, 1) for name in names}
    return {name: (hits[0].instance_id, len(hits[0].points)) if hits else None for name, hits in found.items()}


def clients_at_once(contender: Contender, path: Path, answers: dict[str, Best], shares: list[list[str]]) -> Any:
    """A client a share, all at once, each asking its prompts one after the other; every answer is compared."""

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
        before, start = resident_mib(served.process), time.perf_counter()
        asked = [pool.submit(client, served.client(), share) for share in shares]
        results = [future.result() for future in asked]
        seconds = time.perf_counter() - start
        after = resident_mib(served.process)
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
    """`queries` prompts dealt to `clients`, each going through `names` in an order of its own."""
    return [[names[(n * 7 + c * 31) % len(names)] for n in range(queries // clients)] for c in range(clients)]


def resident_mib(process: int | None = None) -> int | None:
    """Resident memory of a process, this one by default; None where there is no /proc."""
    try:
        pages = int(Path(f"/proc/{process or os.getpid()}/statm").read_text(encoding="ascii").split()[1])
    except OSError:
        return None
    return pages * os.sysconf("SC_PAGE_SIZE") >> 20


def measure(options: argparse.Namespace, folder: Path) -> dict[str, Any]:
    """All of it, as JSON."""
    from perception.language.encoders import make_encoder
    from perception.pipeline.record import versions

    names, encoder = prompts(options.instances), make_encoder("conse")
    report: dict[str, Any] = {
        "versions": versions(),
        "processors": os.cpu_count(),
        "settings": {key: value for key, value in vars(options).items() if key not in ("json", "plot")},
        "maps": {},
    }
    for size in options.sizes:
        path = folder / f"{size}.gsmap"
        write_synthetic_map(path, names, encoder, gaussians=size)
        row = {**load_times(path, options.turns), **cold_start(path, names[0], 0, options.rounds)}
        row |= place_times(path, options.turns)
        report["maps"][size] = row
        _say(f"{size:>9} Gaussians: load_map {row['load_map_ms']} ms, with points {row['load_map_and_points_ms']} ms")
        _say(
            f"{'':>9} process to first answer {row['first_answer_s']} s wall, {row['first_answer_cpu_s']} s processor "
            f"({row['until_map_open_cpu_s']} s until the map was open), peak {row['peak_mib']} MiB"
        )
        places = ", ".join(f"{name} {row[f'{name}_ms']}" for name in ("nearest", "instance_at", "in_box", "describe"))
        _say(f"{'':>9} places, ms: {places}")
    report["warm"], answers = warm(path, names, options.queries)
    for kind in ("new_prompt", "repeated_prompt"):
        _say(f"one thread, {kind.replace('_', ' ')}: {_told(report['warm'][kind])}")
    before, after = report["warm"]["resident_before_mib"], report["warm"]["resident_after_mib"]
    _say(f"resident before and after {options.queries} queries: {before}, {after} MiB")
    _say(f"right by construction: {report['warm']['right_by_construction']}")
    new = [f"{a} on a {b}" for a, b in zip(names, names[1:] + names[:1], strict=True)][: options.new]
    report["clients"] = {}
    for name in options.via:
        repeated = shares_of(names, options.queries, options.clients)
        rows = {
            "new prompts": clients_at_once(
                _WAYS[name],
                path,
                answers_alone(path, new),
                [new[c :: options.clients] for c in range(options.clients)],
            ),
            "repeated prompts": clients_at_once(_WAYS[name], path, answers, repeated),
        }
        report["clients"][name] = rows
        for kind, row in rows.items():
            _say(
                f"{options.clients} clients, {name}, {kind}: {_told(row)}, {row['per_second']} a second; "
                f"{row['asked']} asked, {row['lost']} lost, {row['crossed']} crossed; server "
                f"{row['server_before_mib']} MiB before, {row['server_after_mib']} after"
            )
    return report


def _spread(seconds: Sequence[float]) -> dict[str, float]:
    low, median, high, last = np.percentile(seconds, [25, 50, 75, 99])
    return {"median_ms": _ms(median), "q25_ms": _ms(low), "q75_ms": _ms(high), "p99_ms": _ms(last)}


def _told(row: dict[str, Any]) -> str:
    return f"median {row['median_ms']} ms [{row['q25_ms']}, {row['q75_ms']}], p99 {row['p99_ms']} ms"


def _ms(seconds: Any) -> float:
    return round(1e3 * float(seconds), 3)


def _say(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def plot(report: dict[str, Any], path: Path) -> None:
    """Median and 99 % latency of every way to ask, on a logarithmic axis."""
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise missing_extra("matplotlib", "bench") from error
    rows = {"new prompt": report["warm"]["new_prompt"], "asked again": report["warm"]["repeated_prompt"]}
    clients = report["settings"]["clients"]
    for name, kinds in report["clients"].items():
        rows |= {f"{clients} clients,\n{name},\n{kind}": row for kind, row in kinds.items()}
    figure = Figure(figsize=(8, 3.6), layout="constrained")
    axes = figure.subplots()
    places = np.arange(len(rows))
    for shift, key, label in ((-0.2, "median_ms", "median"), (0.2, "p99_ms", "99 %")):
        bars = axes.bar(places + shift, [row[key] for row in rows.values()], 0.4, label=label)
        axes.bar_label(bars, fmt="%.3g", fontsize=8)
    axes.set(yscale="log", ylabel="ms", xticks=places, title="One prompt, asked and answered")
    axes.set_xticklabels(list(rows))
    axes.legend(frameon=False, ncols=2, loc="upper left")
    axes.margins(y=0.25)
    figure.savefig(path, dpi=120)


def main(arguments: list[str] | None = None) -> int:
    """Prints the figures; --json and --plot keep them."""
    parser = argparse.ArgumentParser(prog="perception bench query", description=__doc__)
    parser.add_argument("--sizes", type=int, nargs="+", default=[200_000, 1_000_000], help="Gaussians of the maps")
    parser.add_argument("--instances", type=int, default=200)
    parser.add_argument("--queries", type=int, default=10_000)
    parser.add_argument("--new", type=int, default=160, help="prompts never asked before in the clients' test")
    parser.add_argument("--clients", type=int, default=8)
    parser.add_argument("--rounds", type=int, default=3, help="processes started for the cold figures")
    parser.add_argument("--turns", type=int, default=7, help="times each map is opened")
    parser.add_argument("--via", nargs="+", default=list(_WAYS), choices=list(_WAYS))
    parser.add_argument("--json", type=Path, metavar="OUT.json")
    parser.add_argument("--plot", type=Path, metavar="OUT.png")
    options = parser.parse_args(arguments)
    if min(*options.sizes, options.queries, options.new, options.clients, options.rounds, options.turns) < 1:
        raise InputError("bench query: sizes and counts must be at least 1")
    with tempfile.TemporaryDirectory() as folder:
        report = measure(options, Path(folder))
    if options.json:
        options.json.write_text(json.dumps(report, indent=1), encoding="utf-8")
    if options.plot:
        plot(report, options.plot)
    return 0


if __name__ == "__main__":
    sys.exit(main())
