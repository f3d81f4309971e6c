"""Measures seconds and peak memory of every stage of `perception map`, and how soon a signal ends it.

python tools speed.stages INPUT MAP [KEY=VALUE …]

A stage is what the progress bar names, from its first step on. What comes before it and has no bar is a row of its own.
Settings are those of `perception map --set`. Idle are the seconds of the cores that the process may use and did not,
beside other work more; `taskset -c 0` before the command gives one core. A peak is that of the process up to the end of
the row; a wait is the longest time for which a signal such as SIGTERM is not heeded, EVERY seconds or more.
"""

from __future__ import annotations

import argparse
import signal
import time
from pathlib import Path

from perception.config import load_config
from perception.machine import cores, peak_memory_mib
from perception.pipeline.mapping import build_map
from perception.progress import Progress

EVERY = 0.1


class Stages(Progress):
    """Progress that notes when a stage begins and is done. rows: its name, seconds, CPU seconds, peak MiB at its end,
    and the longest time in seconds between two signals that were handled."""

    def __init__(self) -> None:
        super().__init__()
        self.rows: list[tuple[str, float, float, float, float]] = []
        self._stage, self._begun, self._used = "", time.monotonic(), 0.0
        self._heeded, self._wait = time.monotonic(), 0.0
        signal.signal(signal.SIGALRM, self._heed)
        signal.setitimer(signal.ITIMER_REAL, EVERY, EVERY)

    def _heed(self, *_: object) -> None:
        now = time.monotonic()
        self._wait, self._heeded = max(self._wait, now - self._heeded), now

    def note(self, name: str) -> None:
        """Ends the row `name`."""
        now, used = time.monotonic(), time.process_time()
        if self.rows and self.rows[-1][0] == name:  # a bar that was there before
            _, seconds, cpu, _, wait = self.rows.pop()
            self._begun, self._used, self._wait = self._begun - seconds, self._used - cpu, max(self._wait, wait)
        self.rows.append((name, now - self._begun, used - self._used, peak_memory_mib(), self._wait))
        self._begun, self._used, self._wait = now, used, 0.0

    def update(self, stage: str, done: int, total: int, *figures: str) -> None:
        super().update(stage, done, total, *figures)
        if stage != self._stage:
            self.note(f"before {stage}")
            self._stage = stage
        if done >= total:
            self.note(stage)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("input", type=Path)
    parser.add_argument("map", type=Path)
    parser.add_argument("settings", nargs="*", metavar="KEY=VALUE")
    options = parser.parse_args()
    stages = Stages()
    with stages:
        gmap = build_map(options.input, options.map, load_config(None, options.settings, "default"), progress=stages)
        stages.note("the map is written")
    signal.setitimer(signal.ITIMER_REAL, 0)
    print(f"{len(gmap)} Gaussians, {len(gmap.instances)} instances, {time.process_time():.0f} s of CPU\n")
    print("| stage | seconds | CPU seconds | idle | peak so far | longest wait |\n|---|---|---|---|---|---|")
    for name, seconds, cpu, peak, wait in stages.rows:
        idle = max(0.0, cores() * seconds - cpu)
        print(f"| {name} | {seconds:.1f} | {cpu:.1f} | {idle:.1f} | {peak / 1024:.1f} GiB | {wait:.1f} s |")


if __name__ == "__main__":
    main()
