"""Shared by all benchmarks: argument parser, text table, output files, a description of the machine."""

from __future__ import annotations

import argparse
import json
import os
import platform
import sys
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from perception.io.atomic import write_file

Column = tuple[str, str, str]  # (column header, key in the row, format specification)


def bench_parser(
    name: str, about: str | None, kind: type[argparse.ArgumentParser] = argparse.ArgumentParser
) -> argparse.ArgumentParser:
    """An argument parser of this kind with the options of all benchmarks: -o FOLDER and --json."""
    raw = argparse.RawDescriptionHelpFormatter
    parser = kind(prog=f"perception bench {name}", description=about, formatter_class=raw)
    folder = Path(f"bench-{name}")
    parser.add_argument("-o", "--output", type=Path, default=folder, metavar="DIR", help=f"for results ({folder})")
    parser.add_argument("--json", action="store_true", help="print one JSON object in place of the table")
    return parser


def table(rows: Sequence[dict[str, Any]], columns: Sequence[Column], heads: Sequence[str] = ("group", "name")) -> str:
    """Rows as aligned text; '-' marks a missing value."""
    cells = [[*heads, *(head for head, _, _ in columns)]]
    for row in rows:
        figures = ["-" if row.get(key) is None else format(row[key], form) for _, key, form in columns]
        cells.append([str(row[head]) for head in heads] + figures)
    widths = [max(len(line[i]) for line in cells) for i in range(len(cells[0]))]
    left = len(heads)
    lines = [
        "  ".join(c.ljust(w) if i < left else c.rjust(w) for i, (c, w) in enumerate(zip(line, widths, strict=True)))
        for line in cells
    ]
    return "\n".join(line.rstrip() for line in lines)


def machine() -> dict[str, Any]:
    """Processor, cores, and the widest SIMD level that our kernels use on it."""
    from perception.rasterizer.cpu import simd_levels

    name = platform.processor() or platform.machine()
    with suppress(OSError, StopIteration):  # not Linux, or no model name in /proc/cpuinfo
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        name = next(line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    return {"processor": name, "cores": os.cpu_count(), "simd": simd_levels()[0]}


def finish(name: str, options: argparse.Namespace, report: dict[str, Any], text: str) -> None:
    """Prints `text`, or JSON with --json. Writes both to the output folder, with machine, versions and arguments."""
    from perception.tasks.folder import versions

    facts = {"bench": name, "arguments": dict(vars(options)), "machine": machine(), "versions": versions(), **report}
    write_file(options.output / f"{name}.json", json.dumps(facts, indent=1, default=str))
    write_file(options.output / f"{name}.txt", text + "\n")
    print(json.dumps(facts, default=str) if options.json else text)
    print(f"kept in {options.output}: {name}.json, {name}.txt", file=sys.stderr)
