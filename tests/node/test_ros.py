"""A real rclpy client (another Python, see .ci/run) asks the node on DDS and the node on rclpy."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from perception import load_map
from support.node_maps import encoders, write_small_map
from support.paths import REPOSITORY, SUPPORT, TESTS

pytest.importorskip("cyclonedds")
pytest.importorskip("rosbags")

DOMAIN = 20 + os.getpid() % 200
LABELS = ["red mug", "laptop", "banana"]
ROS_PYTHON = os.environ.get("PERCEPTION_RCLPY_PYTHON", "")

pytestmark = pytest.mark.skipif(
    not ROS_PYTHON, reason="PERCEPTION_RCLPY_PYTHON names no Python with rclpy; see .ci/run"
)


def environment() -> dict[str, str]:
    return {
        **os.environ,
        "PYTHONPATH": f"{REPOSITORY}{os.pathsep}{TESTS}",
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "ROS_DOMAIN_ID": str(DOMAIN),
    }


@pytest.fixture(scope="module")
def asked(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, dict[str, Any]]]:
    """The map, and what the rclpy client heard from a node on each transport."""
    folder = tmp_path_factory.mktemp("ros")
    path = folder / "a.gsmap"
    write_small_map(path, LABELS, points=3000)
    heard = {}
    for transport, python in (("dds", sys.executable), ("rclpy", ROS_PYTHON)):
        settings = [f"transport={transport}", f"namespace=by_{transport}", "discovery_seconds=0.3"]
        node = subprocess.Popen(
            [python, str(SUPPORT / "node_process.py"), str(path), *settings],
            stdout=subprocess.PIPE,
            text=True,
            cwd=folder,
            env=environment(),
        )
        try:
            assert node.stdout is not None and f"by {transport}" in node.stdout.readline()
            out = folder / f"{transport}.npz"
            client = [ROS_PYTHON, str(SUPPORT / "rclpy_client.py"), f"by_{transport}", str(out), *LABELS]
            subprocess.run(client, check=True, cwd=folder, env=environment(), timeout=60)
        finally:
            node.terminate()
            assert node.wait(20) == 0
        with np.load(out) as arrays:
            heard[transport] = dict(arrays)
    return path, heard


def test_both_nodes_give_the_same_answer_point_for_point(asked: tuple[Path, dict[str, dict[str, Any]]]) -> None:
    path, heard = asked
    gmap = load_map(path, encoders=encoders)
    assert set(heard["dds"]) <= set(heard["rclpy"])
    for text in LABELS:
        points = np.concatenate([hit.points for hit in gmap.query(text)])
        for transport in heard:
            told = json.loads(str(heard[transport][f"{text}/json"]))
            assert told["hits"] == [hit.to_json() for hit in gmap.query(text)]
            np.testing.assert_array_equal(heard[transport][f"{text}/points"], points)
            assert heard[transport][f"{text}/stamp"].tolist() == [told["stamp"]["sec"], told["stamp"]["nanosec"]]
        for part in ("points", "instance_id", "score", "markers"):
            np.testing.assert_array_equal(heard["dds"][f"{text}/{part}"], heard["rclpy"][f"{text}/{part}"])


def test_latched_cloud_and_health_reach_rclpy(asked: tuple[Path, dict[str, dict[str, Any]]]) -> None:
    path, heard = asked
    gmap = load_map(path, encoders=encoders)
    for transport in heard:
        np.testing.assert_array_equal(heard[transport]["map"], gmap.means)
        assert str(heard[transport]["health"]) == "serving"


def test_service_of_the_rclpy_node(asked: tuple[Path, dict[str, dict[str, Any]]]) -> None:
    path, heard = asked
    gmap = load_map(path, encoders=encoders)
    for text in LABELS:
        hits = gmap.query(text)
        assert json.loads(str(heard["rclpy"][f"{text}/service"]))["hits"] == [hit.to_json() for hit in hits]
        rows = heard["rclpy"][f"{text}/service points"].reshape(-1, 4)
        np.testing.assert_array_equal(rows[:, 1:].astype(np.float32), np.concatenate([hit.points for hit in hits]))
    assert "bad_input" in str(heard["rclpy"]["empty/service"])
    assert "serving already" in str(heard["rclpy"]["reload"])
