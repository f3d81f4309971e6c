"""Builds maps on local Ray clusters of 1, 2 and 4 nodes, whose workers and driver are killed on the way.

python tools kills.ray_cluster        # a quarter of an hour on two cores

A row of things with given poses is mapped in blocks, with votes and silhouettes by tasks; a tabletop from photos alone,
with features, matches and submodels by tasks. Every map must be that of the local engine. Of every kind of task a
worker must have been killed, and the driver while one ran. Nodes are processes of one machine, with one core each.
"""

from __future__ import annotations

import collections
import itertools
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from kills.cases import contents
from support.row_scene import write_row
from worlds import make_photos

SETTINGS = ["train.budget=1200", "densify.every=20", "language.encoder=none"]
OF_SCENE = {
    "row": ["photos.poses=keep", "frame.keep_world=true", "train.block_photos=230", "train.iterations=2000"],
    "tabletop": ["train.iterations=60"],
}
TASKS = ("extract_task", "match_task", "submodel_task", "optimise_block", "vote_task", "silhouette_task")
START, EXTRACT, EXTRACTED, MATCH, MATCHED, PLACE, PLACED, BLOCK, JOINED, VOTE, GROUPED, SHOW, DONE = range(13)
"""How far a run is: before the first task; while tasks of a kind run; after them, while the driver works alone."""
WORKER = {"row": [*[BLOCK] * 3, VOTE, SHOW], "tabletop": [EXTRACT, MATCH, PLACE]}
DRIVER = {
    "row": [*[BLOCK] * 7, VOTE, SHOW, DONE],
    "tabletop": [EXTRACT, EXTRACT, EXTRACTED, MATCH, MATCH, PLACE, PLACE, PLACED],
}
"""Where a worker and the driver are killed, in order: there, or where the run is when it is further."""
MOMENTS, LATER, SHORTLY = random.Random(0), 1.5, 0.2
"""A kill is later by a random number of seconds, LATER at most; SHORTLY in votes and silhouettes."""
QUIET = 0.5
"""Seconds without a task after which the tasks of a kind are over."""


def command(name: str, scene: Path, out: Path, *more: str) -> list[str]:
    words = [sys.executable, "-m", "perception.cli", "map", str(scene), "-o", str(out), "--resume", *more]
    return [*words, *(f"--set={pair}" for pair in [*SETTINGS, *OF_SCENE[name], f"masks=labels:{scene.parent}/labels"])]


def write_tabletop(folder: Path) -> Path:
    """152 photos: several tasks of features and of matches, and poses by submodels."""
    make_photos(folder / "photos", views=152, width=160, height=120, light_samples=1)
    shutil.copytree(folder / "truth" / "labels", folder / "labels")
    return folder / "photos"


@contextmanager
def cluster_of(nodes: int) -> Iterator[str]:
    """The address of a new cluster."""
    from ray.cluster_utils import Cluster

    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
    try:
        for _ in range(nodes - 1):
            cluster.add_node(num_cpus=1)
        yield cluster.address
    finally:
        cluster.shutdown()


def workers() -> dict[int, str]:
    """The task that each worker runs, by process; only of clusters that this script has started."""
    listed = subprocess.run(["ps", "-eo", "pid=,ppid=,args="], capture_output=True, text=True, check=True).stdout
    rows = {int(pid): (int(above), name) for pid, above, name in (line.split(None, 2) for line in listed.splitlines())}
    found = {}
    for pid, (above, name) in rows.items():
        while above in rows and above != os.getpid():
            above = rows[above][0]
        task = next((task for task in TASKS if name.startswith(f"ray::{task}")), None)
        if task is not None and above == os.getpid():
            found[pid] = task
    return found


def make(words: list[str], log: Path, who: str, plan: Sequence[int]) -> tuple[int, list[str]]:
    """The exit code of `perception map`, which is started again when it, the driver, was killed; for each kill the task
    that ran, or none."""
    kills: list[str] = []
    far, last = START, 0.0
    with log.open("wb") as told:
        process = subprocess.Popen(words, stdout=told, stderr=told)
        try:
            while process.poll() is None:
                time.sleep(0.1)
                if running := workers():
                    far, last = max(2 * TASKS.index(task) + 1 for task in running.values()), time.monotonic()
                elif far % 2 and time.monotonic() > last + QUIET:
                    far += 1
                if len(kills) == len(plan) or far < plan[len(kills)]:
                    continue
                time.sleep(MOMENTS.uniform(0, SHORTLY if far in (VOTE, SHOW) else LATER))
                pid, task = next(iter(workers().items()), (None, "none"))
                if process.poll() is None and who == "the driver":
                    process.kill()
                    process.wait()
                    process, far = subprocess.Popen(words, stdout=told, stderr=told), START
                    kills.append(task)
                elif process.poll() is None and pid is not None:
                    os.kill(pid, signal.SIGKILL)
                    kills.append(task)
            return process.returncode, kills
        finally:
            process.kill()


def main() -> None:
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))
    failed, killed = 0, collections.Counter[tuple[str, str]]()
    with tempfile.TemporaryDirectory() as folder:
        os.environ["RAY_TMPDIR"] = folder  # nothing stays in /tmp/ray, not even the address of a cluster that is gone
        home = Path(folder)
        scenes = {"row": write_row(home / "row", photos=384), "tabletop": write_tabletop(home / "tabletop")}
        wanted = {}
        for name, scene in scenes.items():
            subprocess.run(command(name, scene, home / f"{name}.gsmap"), check=True, capture_output=True)
            wanted[name] = contents(home / f"{name}.gsmap")
        for nodes, (name, scene) in itertools.product((1, 2, 4), scenes.items()):
            with cluster_of(nodes) as address:
                for who, plan in {"nothing": [], "a worker": WORKER[name], "the driver": DRIVER[name]}.items():
                    out, start = home / f"{name}-{nodes}-{who.split()[-1]}.gsmap", time.monotonic()
                    words = command(name, scene, out, "--engine", "ray", "--address", address)
                    code, kills = make(words, log := out.with_suffix(".log"), who, plan)
                    same = code == 0 and contents(out) == wanted[name]
                    failed += not same
                    killed.update((who, task) for task in kills)
                    seconds = time.monotonic() - start
                    told = "same map" if same else f"ANOTHER MAP: {log.read_text()[-500:]}"
                    print(f"{name}, {nodes} nodes, killed: {who} ({len(kills)}): {told}, {seconds:.0f} s", flush=True)
    for task in TASKS:
        of_worker, of_driver = killed["a worker", task], killed["the driver", task]
        failed += not (of_worker and of_driver)
        print(f"{task}: its worker was killed {of_worker} times, the driver {of_driver} times while it ran")
    sys.exit(failed)


if __name__ == "__main__":
    main()
