"""CPU and wall seconds of short commands as processes of their own: --help, info, query, export.

    python tools speed.start MAP [--runs 5] [--beside CHECKOUT]

Prints the least and the median of the CPU seconds (user and system) over the runs, and the least wall seconds.
--beside: the same for the package in another checkout, in turns.
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np


def spent(command: list[str], checkout: Path, folder: str) -> tuple[float, float]:
    """CPU and wall seconds of one process with the package of `checkout`."""
    before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    run = [sys.executable, "-m", "perception.cli", *command]
    subprocess.run(run, cwd=folder, env=os.environ | {"PYTHONPATH": str(checkout)}, capture_output=True, check=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return cpu, time.perf_counter() - start


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("map", type=Path, metavar="MAP")
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--beside", type=Path, metavar="CHECKOUT")
    options = parser.parse_args()
    gmap, here = str(options.map.absolute()), Path(__file__).resolve().parents[2]
    checkouts = [here, *([options.beside.absolute()] if options.beside else [])]
    commands = [["--help"], ["info", gmap], ["query", gmap, "red mug"], ["export", gmap, "-o", "out.ply"]]
    print(f"{'':>8} {'CPU least':>10} {'median':>8} {'wall least':>11}")
    with tempfile.TemporaryDirectory() as folder:
        for command in commands:
            turns = [[spent(command, checkout, folder) for checkout in checkouts] for _ in range(options.runs)]
            for checkout, runs in zip(checkouts, np.swapaxes(turns, 0, 1), strict=True):
                (cpu, wall), median = runs.min(axis=0), np.median(runs[:, 0])
                beside = "" if checkout == here else f"  {checkout}"
                print(f"{command[0]:>8} {cpu:10.2f} {median:8.2f} {wall:11.2f}{beside}")


if __name__ == "__main__":
    main()
