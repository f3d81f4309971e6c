"""Measures the stages of a training step, by kind of step and number of threads.

    python tools speed.steps SCENE [--masks labels:FOLDER] [--at 300 1200] [--set KEY=VALUE ...]

Maps SCENE once with one thread and once with two, in processes of their own, and prints the median milliseconds of
every stage over the 120 steps around each iteration: steps of half the size, of the full size, and with features. A
pair is one Gaussian contributing to one pixel. Stages of the rasterizer are those of `perception bench rasterizer`;
"other" holds activations, buffers, statistics for growth and Python. Then where the CPU seconds of the whole training
went, one thread, and the PSNR of the held-out photos. --once: this alone, for comparisons in turns.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

AROUND = 60
PARTS = ("rasterizer forward", "losses", "rasterizer backward", "Adam", "other")
STAGES = ("project", "sort", "bin", "blend", "blend_backward", "reduce", "losses", "Adam", "other")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path)
    parser.add_argument("--masks", default="builtin")
    parser.add_argument("--at", type=int, nargs="+", default=[300, 1200])
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--once", action="store_true")
    parser.add_argument("--threads", type=int, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.threads:
        print(json.dumps(measure(options)))
        return
    found, totals = {}, {}
    for threads in (1,) if options.once else (1, 2):
        command = [sys.executable, __file__, *sys.argv[1:], "--threads", str(threads)]
        environment = os.environ | {"OMP_NUM_THREADS": str(threads), "OMP_WAIT_POLICY": "passive"}
        run = subprocess.run(command, env=environment, stdout=subprocess.PIPE, text=True, check=True)
        rows, totals[threads] = json.loads(run.stdout.splitlines()[-1])
        found[threads] = {(row["at"], row["kind"]): row for row in rows}
    for key, one in found[1].items() if not options.once else ():
        two = found[2][key]
        print(f"\n{key[1]} around {key[0]}: {one['steps']} steps, {one['gaussians']:.0f} Gaussians, ", end="")
        print(f"{one['pairs'] / 1e6:.2f} M pairs of {one['evaluated'] / 1e6:.2f} M evaluated")
        print(f"{'ms':>16} {'1 thread':>9} {'2':>9} {'ratio':>6}")
        for stage in (*STAGES, "all"):
            a, b = one["ms"][stage], two["ms"][stage]
            print(f"{stage:>16} {a:9.2f} {b:9.2f} {a / max(b, 1e-9):6.2f}")
        print(f"{'ns a pair, CPU':>16} {1e6 * one['ms']['all'] / one['pairs']:9.2f}")
    print_totals(totals[1])


def print_totals(totals: dict[str, Any]) -> None:
    """CPU seconds of the training by kind of step and part, and what it reached."""
    print(f"\n{'CPU seconds':>20} {'steps':>6} " + " ".join(f"{part.split()[-1]:>9}" for part in (*PARTS, "all")))
    for kind, (steps, seconds) in totals["kinds"].items():
        columns = [seconds.get(part, 0.0) for part in PARTS]
        print(f"{kind:>20} {steps:6} " + " ".join(f"{value:9.2f}" for value in (*columns, sum(columns))))
    reached, gaussians = totals["psnr"], totals["gaussians"]
    print(f"{totals['all']:.2f} CPU seconds of training, {gaussians} Gaussians, {reached or 0:.3f} dB")


def measure(options: argparse.Namespace) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Medians over the steps of one run, by iteration and kind, and CPU seconds of all of its training."""
    from perception import _core
    from perception.config import load_config
    from perception.gaussians import schedule, state, train
    from perception.pipeline.mapping import build_map
    from perception.rasterizer import cpu

    _core.training.set_threads(options.threads)
    frames: list[Any] = []
    steps: list[dict[str, Any]] = []
    backward, step, run, timed_part = cpu.rasterize_backward, train.Trainer.step, train.Trainer.run, state.timed
    spent: Counter[str] = Counter()  # CPU seconds by part, of the step or between steps
    kinds: dict[str, tuple[int, Counter[str]]] = {}
    total = 0.0

    def booked(kind: str, whole: float) -> None:
        count, seconds = kinds.setdefault(kind, (0, Counter()))
        parts = Counter({part: spent[part] for part in PARTS})
        parts["other"] = whole - sum(parts.values())
        kinds[kind] = count + 1, seconds + parts
        spent.clear()

    @contextmanager
    def counted(profile: dict[str, float], part: str) -> Iterator[None]:
        start = time.process_time()
        with timed_part(profile, part):
            yield
        spent[part] += time.process_time() - start

    def whole_run(self: train.Trainer, *arguments: Any, **more: Any) -> Any:
        nonlocal total
        start = time.process_time()
        try:
            return run(self, *arguments, **more)
        finally:
            total += time.process_time() - start

    def noted(inputs: Any, settings: Any, forward: Any, *rest: Any, **more: Any) -> None:
        backward(inputs, settings, forward, *rest, **more)
        frames.append((forward.frames, forward.features is not None))

    def timed(self: train.Trainer, progress: float) -> float:
        spent.clear()
        before, start, began = dict(self.record.profile), time.perf_counter(), time.process_time()
        loss = step(self, progress)
        whole, taken = time.perf_counter() - start, time.process_time() - began
        (frame, features), frames[:] = frames[-1], []
        ms = dict(frame.seconds) | {n: self.record.profile[n] - before.get(n, 0) for n in ("losses", "Adam")}
        ms |= {"other": whole - sum(ms.values()), "all": whole}
        coarse = features or progress < schedule.coarse_until(self)
        kind = "features" if features else "half size" if coarse else "full size"
        booked(kind, taken)
        pairs = {"pairs": frame.contributing, "evaluated": frame.evaluated, "gaussians": len(self.gaussians)}
        steps.append({"iteration": self.iteration, "kind": kind, "ms": ms, **pairs})
        return loss

    cpu.rasterize_backward, train.Trainer.step = noted, timed  # type: ignore[assignment, method-assign]
    state.timed, train.Trainer.run = counted, whole_run  # type: ignore[assignment, method-assign]
    with tempfile.TemporaryDirectory() as folder:
        pairs = [f"masks={options.masks}", "language.encoder=none", *options.set]
        gmap = build_map(options.scene, Path(folder) / "a.gsmap", load_config(None, pairs))
    rows = []
    for at in options.at:
        near = [s for s in steps if abs(s["iteration"] - at) <= AROUND]
        for kind in sorted({s["kind"] for s in near}):
            some = [s for s in near if s["kind"] == kind]
            ms = {name: 1e3 * float(np.median([s["ms"][name] for s in some])) for name in some[0]["ms"]}
            means = {name: float(np.mean([s[name] for s in some])) for name in ("pairs", "evaluated", "gaussians")}
            rows.append({"at": at, "kind": kind, "steps": len(some), "ms": ms, **means})
    spent.clear()
    booked("growth, evaluation", total - sum(sum(seconds.values()) for _, seconds in kinds.values()))
    reached = gmap.info["quality"].get("psnr")
    return rows, {"kinds": kinds, "all": total, "psnr": reached, "gaussians": len(gmap)}


if __name__ == "__main__":
    main()
