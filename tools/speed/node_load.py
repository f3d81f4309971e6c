"""Measures two lifecycle nodes on one network, one of them restarted four times while both answer.

python tools speed.node_load [QUERIES]

Half of the queries go to each node. After 20 and 40 % of the answers the first node is killed, after 60 and 80 % it is
asked to end; it is started again each time. Prints one JSON object: what `rclpy_load.py` counted, and the resident
memory (MiB) of both nodes at the start, after each restart and at the end. Needs PERCEPTION_RCLPY_PYTHON, a Python with
rclpy; with PERCEPTION_MSGS_PREFIX the nodes serve perception_msgs too (see .ci/run).
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from perception import load_map
from support.node_maps import encoders, write_small_map
from support.paths import REPOSITORY, TESTS

PROMPTS = ["red mug", "laptop", "banana"]
STOPS = ((0.2, signal.SIGKILL), (0.4, signal.SIGKILL), (0.6, signal.SIGTERM), (0.8, signal.SIGTERM))
SETTLE = 6.0  # seconds until a started node has loaded its map and answers


def started(script: str, *words: object, log: Path) -> subprocess.Popen[str]:
    """A script of tests/support in the Python with rclpy, its output read by the caller, its errors in `log`."""
    paths, prefix = [REPOSITORY, TESTS, REPOSITORY / "launch/perception"], os.environ.get("PERCEPTION_MSGS_PREFIX")
    environment = {**os.environ, "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", "ROS_DOMAIN_ID": str(os.getpid() % 200)}
    if prefix:
        paths += Path(prefix).glob("lib/python3*/site-packages")
        environment["LD_LIBRARY_PATH"] = f"{prefix}/lib:{os.environ.get('LD_LIBRARY_PATH', '')}"
    environment["PYTHONPATH"] = os.pathsep.join(map(str, paths))
    command = [os.environ["PERCEPTION_RCLPY_PYTHON"], str(TESTS / "support" / script), *map(str, words)]
    with log.open("a") as errors:
        return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=errors, text=True, env=environment)


def node(folder: Path, name: str) -> subprocess.Popen[str]:
    """A lifecycle node in the namespace `name` that activates itself on the map of that name."""
    values = {"map": folder / f"{name}.gsmap", "discovery_seconds": 0.3, "autostart": "true"}
    words = [word for key, value in values.items() for word in ("-p", f"{key}:={value}")]
    ros = ["--ros-args", *words, "-r", f"__ns:=/{name}"]
    return started("lifecycle_process.py", *ros, log=folder / f"{name}.log")


def memory(process: subprocess.Popen[str]) -> float:
    """Resident memory in MiB."""
    lines = Path(f"/proc/{process.pid}/status").read_text().splitlines()
    return round(next(int(line.split()[1]) for line in lines if line.startswith("VmRSS")) / 1024, 1)


def main(queries: int) -> None:
    with tempfile.TemporaryDirectory() as name:
        folder, expected = Path(name), {}
        for seed, space in enumerate(("one", "two")):
            path = folder / f"{space}.gsmap"
            write_small_map(path, PROMPTS, seed=seed)
            gmap = load_map(path, encoders=encoders)
            found = {text: [hit.instance_id for hit in gmap.query(text)] for text in PROMPTS}
            expected[space] = {"map_id": gmap.map_id, "instances": found}
        (folder / "expected.json").write_text(json.dumps(expected))
        nodes = {space: node(folder, space) for space in expected}
        log = folder / "load.log"
        time.sleep(SETTLE)
        figures = [{space: memory(process) for space, process in nodes.items()}]
        client = started("rclpy_load.py", queries // 2, folder / "expected.json", *expected, log=log)
        try:
            stops, last = list(STOPS), ""
            for last in client.stdout or ():
                if stops and last.strip().isdecimal() and int(last) >= stops[0][0] * queries:
                    nodes["one"].send_signal(stops.pop(0)[1])
                    nodes["one"].wait(30)
                    nodes["one"] = node(folder, "one")
                    time.sleep(SETTLE)
                    figures.append({space: memory(process) for space, process in nodes.items()})
            client.wait(30)
            figures.append({space: memory(process) for space, process in nodes.items()})
            counted = json.loads(last) if last.startswith("{") else {"failed": log.read_text()[-2000:]}
            print(json.dumps({**counted, "restarts": len(STOPS) - len(stops), "memory [MiB]": figures}))
        finally:
            for process in (client, *nodes.values()):
                process.terminate()
                process.wait(30)


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 10_000)
