"""The lifecycle node of the ROS 2 package and a real rclpy client (another Python, see .ci/run)."""

from __future__ import annotations

import json
import os
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from perception import load_map
from perception.map.write import write_map
from perception.query.robot_pose import where_to_stand
from support.box_rooms import FURNISHED, map_of
from support.node_maps import encoders, write_small_map
from support.paths import REPOSITORY, SUPPORT, TESTS

DOMAIN = 20 + (os.getpid() + 100) % 200
ROS_PYTHON = os.environ.get("PERCEPTION_RCLPY_PYTHON", "")
PREFIX = os.environ.get("PERCEPTION_MSGS_PREFIX", "")
WAIT = 90

pytestmark = pytest.mark.skipif(
    not ROS_PYTHON, reason="PERCEPTION_RCLPY_PYTHON names no Python with rclpy; see .ci/run"
)


def started(script: str, *words: object, prefix: str = PREFIX) -> subprocess.Popen[str]:
    """A script in the Python with rclpy. prefix: that of the built perception_msgs; "": plain messages only."""
    paths = [REPOSITORY, TESTS, REPOSITORY / "launch/perception"]
    environment = {**os.environ, "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", "ROS_DOMAIN_ID": str(DOMAIN)}
    if prefix:
        paths += Path(prefix).glob("lib/python3*/site-packages")
        environment["LD_LIBRARY_PATH"] = f"{prefix}/lib:{os.environ.get('LD_LIBRARY_PATH', '')}"
    environment["PYTHONPATH"] = os.pathsep.join(map(str, paths))
    return subprocess.Popen(
        [ROS_PYTHON, str(SUPPORT / script), *map(str, words)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment,
    )


@pytest.fixture(scope="module")
def map_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("lifecycle") / "a.gsmap"
    write_small_map(path, ["red mug", "laptop"])
    return path


@pytest.fixture(scope="module", params=["plain", "built"])
def walk(map_path: Path, request: pytest.FixtureRequest) -> Iterator[tuple[dict[str, Any], bool]]:
    """What a client found on its walk through the states of a node, and whether perception_msgs was there."""
    built = request.param == "built"
    if built and not PREFIX:
        pytest.skip("PERCEPTION_MSGS_PREFIX names no prefix with perception_msgs; .ci/run builds it")
    out, prefix = map_path.parent / f"{request.param}.json", PREFIX if built else ""
    words = ["--ros-args", "-p", f"map:={map_path}", "-p", "discovery_seconds:=0.3", "-r", f"__ns:=/{request.param}"]
    node = started("lifecycle_process.py", *words, prefix=prefix)
    client = started("rclpy_lifecycle.py", request.param, "laptop", out, prefix=prefix)
    try:
        assert client.wait(WAIT) == 0, client.communicate()
    finally:
        node.terminate()
        errors = node.communicate(timeout=WAIT)[1]
    assert node.returncode == 0, errors
    assert ("perception_msgs is installed" in errors) == built
    yield json.loads(out.read_text()), built


def test_a_query_in_each_state(walk: tuple[dict[str, Any], bool], map_path: Path) -> None:
    found, built = walk
    ids = [hit.instance_id for hit in load_map(map_path, encoders=encoders).query("laptop")]
    states = ["unconfigured", "inactive", "active", "inactive", "active", "inactive", "unconfigured", "inactive"]
    states += ["active", "finalized"]
    answers = [ids if state == "active" else "closed" for state in states]
    ways = 2 if built else 1
    assert [row[1:] for row in found["rows"]] == [
        [state, *[answer] * ways] for state, answer in zip(states, answers, strict=True)
    ]


def test_latched_topics_parameters_and_unknown_frames(walk: tuple[dict[str, Any], bool], map_path: Path) -> None:
    found, built = walk
    gmap = load_map(map_path, encoders=encoders)
    assert found["heard"]["map/markers"] == 1 + 2 * len(gmap.instances)
    if built:
        assert found["heard"]["map/info"] == [gmap.map_id, True, "kitchen"]
        assert found["heard"]["map/instances"] == [[0, "red mug"], [10, "laptop"]]
        assert found["unknown frame"] == ["unknown_frame", "frame_id: found 'moon', expected kitchen"]
    assert found["parameters"] == [
        ["map", True, []],
        ["workers", True, [[1, 64]]],
        ["timeout", True, [[0.001, 3600.0]]],
    ]


def test_rviz_finds_every_topic_with_its_type_in_the_graph(walk: tuple[dict[str, Any], bool]) -> None:
    found, built = walk
    config = yaml.safe_load((REPOSITORY / "launch/perception/rviz/perception.rviz").read_text())
    kinds = {"Map": "nav_msgs/msg/OccupancyGrid", "PointCloud2": "sensor_msgs/msg/PointCloud2"}
    kinds["MarkerArray"] = "visualization_msgs/msg/MarkerArray"
    for one in config["Visualization Manager"]["Displays"]:
        if "Topic" in one:
            name = one["Topic"]["Value"].replace("/perception/", f"/{'built' if built else 'plain'}/")
            assert found["topics"][name] == [kinds[one["Class"].rpartition("/")[2]]], name


def test_where_to_stand_by_the_service(tmp_path: Path) -> None:
    """The pose is the library's, in the frame that was asked for; what is wrong is told."""
    if not PREFIX:
        pytest.skip("PERCEPTION_MSGS_PREFIX names no prefix with perception_msgs; .ci/run builds it")
    write_map(tmp_path / "a.gsmap", map_of(FURNISHED))
    turn = Rotation.from_euler("z", 0.5)
    parent = {"parent": "site", "child": "home", "translation": [1, 2, 0], "rotation": turn.as_quat().tolist()}
    (tmp_path / "frame.yaml").write_text(yaml.safe_dump(parent))
    values = {"map": tmp_path / "a.gsmap", "frame_file": tmp_path / "frame.yaml", "autostart": "true"}
    words = [word for name, value in values.items() for word in ("-p", f"{name}:={value}")]
    node = started("lifecycle_process.py", "--ros-args", *words, "-r", "__ns:=/standing")
    client = started("rclpy_stand.py", "standing", tmp_path / "out.json", 2, "", "site", "moon")
    try:
        assert client.wait(WAIT) == 0, client.communicate()
    finally:
        node.terminate()
        node.communicate(timeout=WAIT)
    own, site, moon, thin, unknown = json.loads((tmp_path / "out.json").read_text())
    stand = where_to_stand(load_map(tmp_path / "a.gsmap", encoders=encoders), 2, distance=0.75)
    assert (own["error"], own["frame"], site["frame"]) == ("", "home", "site")
    np.testing.assert_allclose(own["position"], stand.position, atol=1e-6)
    np.testing.assert_allclose(own["distance"], stand.distance, atol=1e-6)
    np.testing.assert_allclose(site["position"], turn.apply(stand.position) + np.array([1, 2, 0]), atol=1e-6)
    for told, before in ((own, Rotation.identity()), (site, turn)):
        ahead = Rotation.from_quat(told["orientation"]).apply([1, 0, 0])
        np.testing.assert_allclose(ahead, before.apply(stand.map_from_robot[:3, 0]), atol=1e-6)
    errors = [(one["error"], one["message"]) for one in (moon, thin, unknown)]
    assert [kind for kind, _ in errors] == ["unknown_frame", "bad_input", "unknown_instance"]
    assert all(word in text for word, (_, text) in zip(("moon", "radius is -1.0", "instance 99"), errors, strict=True))


def test_a_node_that_starts_itself_ends_with_2_on_bad_input(tmp_path: Path) -> None:
    node = started("lifecycle_process.py", "--ros-args", "-p", f"map:={tmp_path}/none", "-p", "autostart:=true")
    errors = node.communicate(timeout=WAIT)[1]
    assert node.returncode == 2 and "none: no map lies there" in errors
