"""A real rclpy client (another Python, see .ci/run) asks the node."""

from __future__ import annotations

import json
import os
import subprocess
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from perception import load_map
from support.node_maps import encoders, write_small_map
from support.paths import REPOSITORY, SUPPORT, TESTS

DOMAIN = 20 + os.getpid() % 200
LABELS = ["red mug", "laptop", "banana"]
ROS_PYTHON = os.environ.get("PERCEPTION_RCLPY_PYTHON", "")
WAIT = 90

pytestmark = pytest.mark.skipif(
    not ROS_PYTHON, reason="PERCEPTION_RCLPY_PYTHON names no Python with rclpy; see .ci/run"
)


def started(script: Path, *words: object) -> subprocess.Popen[str]:
    """A script in the Python with rclpy."""
    environment = {
        **os.environ,
        "PYTHONPATH": f"{REPOSITORY}{os.pathsep}{TESTS}",
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "ROS_DOMAIN_ID": str(DOMAIN),
    }
    return subprocess.Popen(
        [ROS_PYTHON, str(script), *map(str, words)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment,
    )


def node(path: Path, namespace: str, discovery: float = 0.3) -> subprocess.Popen[str]:
    """A node process; it has written a line when it serves, nothing when it does not."""
    made = started(SUPPORT / "node_process.py", path, f"namespace={namespace}", f"discovery_seconds={discovery}")
    assert made.stdout is not None
    made.stdout.readline()
    return made


@pytest.fixture(scope="module")
def map_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("ros") / "a.gsmap"
    write_small_map(path, LABELS, points=3000)
    return path


@pytest.fixture(scope="module")
def served(map_path: Path) -> Iterator[subprocess.Popen[str]]:
    """A node of the namespace `steady`, which ends in order when it is asked to."""
    process = node(map_path, "steady")
    yield process
    process.terminate()
    assert process.wait(WAIT) == 0


@pytest.fixture(scope="module")
def heard(served: subprocess.Popen[str], map_path: Path) -> dict[str, Any]:
    """What the rclpy client heard from the node."""
    out = map_path.parent / "heard.npz"
    client = started(SUPPORT / "rclpy_client.py", "steady", out, *LABELS)
    assert client.wait(WAIT) == 0, client.communicate()
    with np.load(out) as arrays:
        return dict(arrays)


def test_topics_give_what_the_map_gives_point_for_point(heard: dict[str, Any], map_path: Path) -> None:
    gmap = load_map(map_path, encoders=encoders)
    for text in LABELS:
        hits = gmap.query(text)
        told = json.loads(str(heard[f"{text}/json"]))
        assert told["hits"] == [hit.to_json() for hit in hits]
        np.testing.assert_array_equal(heard[f"{text}/points"], np.concatenate([hit.points for hit in hits]))
        rows = [(hit.instance_id, np.float32(hit.score)) for hit in hits for _ in hit.points]
        assert list(zip(heard[f"{text}/instance_id"], heard[f"{text}/score"], strict=True)) == rows
        assert heard[f"{text}/stamp"].tolist() == [told["stamp"]["sec"], told["stamp"]["nanosec"]]
        x, w, side, _, kind, number = heard[f"{text}/markers"].T
        np.testing.assert_allclose(x[::2], [hit.obb.center[0] for hit in hits])
        np.testing.assert_allclose(side[::2], [hit.obb.extent[0] for hit in hits])
        assert (w[1::2] == 1).all() and kind.tolist() == [1, 9] * len(hits) and number.tolist() == [*range(len(kind))]


def test_latched_cloud_and_health_reach_rclpy(heard: dict[str, Any], map_path: Path) -> None:
    np.testing.assert_array_equal(heard["map"], load_map(map_path, encoders=encoders).means)
    assert str(heard["health"]) == "serving"


def test_services(heard: dict[str, Any], map_path: Path) -> None:
    gmap = load_map(map_path, encoders=encoders)
    for text in LABELS:
        hits = gmap.query(text)
        assert json.loads(str(heard[f"{text}/service"]))["hits"] == [hit.to_json() for hit in hits]
        rows = heard[f"{text}/service points"].reshape(-1, 4)
        np.testing.assert_array_equal(rows[:, 1:].astype(np.float32), np.concatenate([hit.points for hit in hits]))
    assert "bad_input" in str(heard["empty/service"])
    assert "serving already" in str(heard["reload"])


def test_the_example_gets_an_answer(served: subprocess.Popen[str], map_path: Path) -> None:
    example = started(REPOSITORY / "examples" / "ask_a_node.py", "laptop", "steady")
    out, errors = example.communicate(timeout=WAIT)
    assert example.returncode == 0, errors
    hits = load_map(map_path, encoders=encoders).query("laptop")
    assert json.loads(out)["hits"] == [hit.to_json() for hit in hits]


def test_second_node_of_that_name_is_refused(served: subprocess.Popen[str], map_path: Path) -> None:
    second = node(map_path, "steady", discovery=10)
    _, told = second.communicate(timeout=WAIT)
    assert second.returncode == 1 and "1 other node(s) serve 'steady'" in told and "--namespace" in told


@pytest.mark.slow
def test_a_client_recovers_from_a_node_killed_under_load(map_path: Path) -> None:
    first = node(map_path, "mortal")
    client = started(SUPPORT / "rclpy_asker.py", "mortal", *LABELS)
    assert client.stdout is not None
    watch = threading.Timer(2 * WAIT, client.kill)  # a client that gets no answer writes no line for good
    watch.start()
    try:
        told = [client.stdout.readline() for _ in range(20)]
        first.kill()  # not asked: dead at once, in the middle of whatever it does
        first.communicate()
        first = node(map_path, "mortal")
        told += [client.stdout.readline() for _ in range(20)]
    finally:
        watch.cancel()
        for process in (client, first):
            process.kill()
            process.communicate()
    asked, answered = zip(*(line.split("\t") for line in told), strict=True)
    assert list(asked) == [LABELS[n % len(LABELS)] for n in range(40)]
    assert [json.loads(answer)["text"] for answer in answered] == list(asked)
    assert all(json.loads(answer)["present"] for answer in answered)
