"""Maps on local Ray clusters of 1, 2 and 4 nodes; workers and the driver are killed on the way:

python tests/kills/ray_cluster.py

A row of things with given poses is mapped in blocks, a tabletop from photos alone, with features, matches and places by
tasks. Every map must be that of the local engine. Nodes are processes of one machine, with one core each.
"""

from __future__ import annotations

import itertools
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

HOMES = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(HOMES))
os.environ["PYTHONPATH"] = os.pathsep.join([str(HOMES), str(HOMES.parent), os.environ.get("PYTHONPATH", "")])
from kills.cases import contents  # noqa: E402
from support.row_scene import write_row  # noqa: E402
from worlds import make_photos  # noqa: E402

SETTINGS = ["train.iterations=400", "train.budget=1200", "densify.every=20", "language.encoder=none"]
OF_ROW = ["photos.poses=keep", "frame.keep_world=true", "train.block_photos=14"]
TASKS = ("extract_task", "match_task", "place_task", "optimise_block")


def command(scene: Path, out: Path, *more: str) -> list[str]:
    words = [sys.executable, "-m", "perception.cli", "map", str(scene), "-o", str(out), "--resume", *more]
    posed = OF_ROW if scene.is_file() else []
    return [*words, *(f"--set={pair}" for pair in [*SETTINGS, *posed, f"masks=labels:{scene.parent / 'labels'}"])]


def workers() -> list[int]:
    """Processes of workers that run a task."""
    listed = subprocess.run(["ps", "-eo", "pid,args"], capture_output=True, text=True, check=True).stdout
    return [int(line.split()[0]) for line in listed.splitlines() if any(f"ray::{task}" in line for task in TASKS)]


def write_tabletop(folder: Path) -> Path:
    """160 photos: several tasks of features, and poses place by place."""
    make_photos(folder / "photos", views=160, width=320, height=240, light_samples=2)
    shutil.copytree(folder / "truth" / "labels", folder / "labels")
    return folder / "photos"


def main() -> None:
    from ray.cluster_utils import Cluster

    failed = 0
    with tempfile.TemporaryDirectory() as folder:
        home = Path(folder)
        scenes = {"row": write_row(home / "row"), "tabletop": write_tabletop(home / "tabletop")}
        wanted = {}
        for name, scene in scenes.items():
            subprocess.run(command(scene, home / f"{name}.gsmap"), check=True, capture_output=True)
            wanted[name] = contents(home / f"{name}.gsmap")
        for nodes, (name, scene) in itertools.product((1, 2, 4), scenes.items()):
            cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
            for _ in range(nodes - 1):
                cluster.add_node(num_cpus=1)
            there = ["--engine", "ray", "--address", cluster.address]
            for killed in ("nothing", "a worker", "the driver"):
                out = home / f"{name}-{nodes}-{killed.split()[-1]}.gsmap"
                kills, start = 0, time.monotonic()
                while True:
                    quiet = {"stderr": subprocess.DEVNULL, "stdout": subprocess.DEVNULL}
                    run = subprocess.Popen(command(scene, out, *there), **quiet)  # type: ignore[call-overload]
                    while run.poll() is None:
                        time.sleep(0.2)
                        if killed == "a worker" and kills < 3 and (found := workers()):
                            os.kill(found[0], signal.SIGKILL)
                            kills += 1
                            time.sleep(1.0)
                        elif killed == "the driver" and time.monotonic() - start > 2.5 * (kills + 1) and kills < 8:
                            run.send_signal(signal.SIGKILL)
                            kills += 1
                            run.wait()
                    if run.returncode != -signal.SIGKILL:
                        break
                same = run.returncode == 0 and contents(out) == wanted[name]
                failed += not same
                seconds = time.monotonic() - start
                told = "same map" if same else "ANOTHER MAP"
                print(f"{name}, {nodes} nodes, killed: {killed} ({kills}): {told}, {seconds:.0f} s", flush=True)
            cluster.shutdown()
    sys.exit(failed)


if __name__ == "__main__":
    main()
