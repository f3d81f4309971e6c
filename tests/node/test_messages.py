"""The node's messages: their bytes against other serialisers."""

from __future__ import annotations

import json
import os
import pickle
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from perception.node import answers
from perception.serve.engine import QueryEngine
from perception.serve.requests import Reply
from perception.types import OrientedBox
from support.node_maps import encoders, write_small_map
from support.paths import REPOSITORY, SUPPORT, TESTS

pytest.importorskip("rosbags")

from perception.node.answers import box_markers, detection, header, point_cloud2, pose
from support.cdr import serialize, typestore
from support.rotations import rotation_from_quaternion

STAMP = (7, 999_999_999)
REQUEST, RESPONSE = "rcl_interfaces/srv/GetParameters_Request", "rcl_interfaces/srv/GetParameters_Response"


@pytest.fixture(scope="module")
def messages(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[dict[str, Any]]]:
    """One message and more of every type the node sends or takes, as it makes them itself."""
    path = tmp_path_factory.mktemp("maps") / "a.gsmap"
    write_small_map(path, ["red mug", "Kühlschrank"])
    with QueryEngine(path, encoders=encoders, watch=None) as engine:
        full = engine.ask("red mug")
        empty = Reply(full.request, (), full.map_id, full.frame, full.metric)
        health = answers.diagnostics("perception", engine.health(), ["two nodes"], STAMP)
        whole = answers.map_cloud(engine.current, 1000, STAMP)
    told = json.dumps(answers.answer_json(full, "4"))
    return {
        "std_msgs/msg/String": [{"data": told}, {"data": ""}, {"data": "größer"}],
        "sensor_msgs/msg/PointCloud2": [whole, answers.hits_cloud(full, STAMP), answers.hits_cloud(empty, STAMP)],
        "vision_msgs/msg/Detection3DArray": [answers.hits_detections(reply, STAMP) for reply in (full, empty)],
        "visualization_msgs/msg/MarkerArray": [answers.hits_markers(reply, None, STAMP) for reply in (full, empty)],
        "diagnostic_msgs/msg/DiagnosticArray": [health],
        REQUEST: [{"names": ["red mug", "", "größer"]}, {"names": []}],
        RESPONSE: [{"values": [answers.text_value(told), answers.points_value(full), answers.points_value(empty)]}],
        "std_srvs/srv/Trigger_Request": [{}],
        "std_srvs/srv/Trigger_Response": [{"success": True, "message": "map 1"}],
    }


def test_fields_are_those_of_the_ros_types(messages: dict[str, list[dict[str, Any]]]) -> None:
    """KeyError for a field that the type has not; what is left out has the default."""
    for kind, some in messages.items():
        for data in (serialize(kind, message) for message in some):
            assert _without_gaps(kind, data) == data, kind


def test_every_type_is_rosbags_serialisation_of_a_message_made_by_hand() -> None:
    """Messages built from rosbags' own classes, without our builders, give the same bytes."""
    store = typestore()
    t = store.types
    head = t["std_msgs/msg/Header"](t["builtin_interfaces/msg/Time"](*STAMP), "map")
    point, turn = t["geometry_msgs/msg/Point"], t["geometry_msgs/msg/Quaternion"]
    vector, color = t["geometry_msgs/msg/Vector3"], t["std_msgs/msg/ColorRGBA"]
    at = t["geometry_msgs/msg/Pose"](point(1.0, 2.0, 3.0), turn(0.0, 0.0, 0.0, 1.0))
    box = OrientedBox(np.array([1.0, 2, 3]), np.eye(3), np.array([0.5, 0.25, 0.125]))
    spread = np.zeros(36)
    spread[[0, 7, 14]] = 0.1, 0.2, 0.3
    hypothesis = t["vision_msgs/msg/ObjectHypothesisWithPose"](
        t["vision_msgs/msg/ObjectHypothesis"]("mug", 0.75), t["geometry_msgs/msg/PoseWithCovariance"](at, spread)
    )
    found = t["vision_msgs/msg/Detection3D"](
        head, [hypothesis], t["vision_msgs/msg/BoundingBox3D"](at, vector(0.5, 0.25, 0.125)), "10"
    )
    ours = {"header": header("map", STAMP)}
    ours["detections"] = [detection(box, "mug", 0.75, "10", ours["header"], np.diag([0.1, 0.2, 0.3]))]
    expected = {"vision_msgs/msg/Detection3DArray": (t["vision_msgs/msg/Detection3DArray"](head, [found]), ours)}

    xyz = np.array([[1, 2, 3], [4, 5, 6]], np.float32)
    rows = np.zeros(2, [("p", "<f4", 3), ("i", "<i4")])
    rows["p"], rows["i"] = xyz, [7, -1]
    field = t["sensor_msgs/msg/PointField"]
    cloud = t["sensor_msgs/msg/PointCloud2"](
        head,
        1,
        2,
        [field("x", 0, 7, 1), field("y", 4, 7, 1), field("z", 8, 7, 1), field("instance_id", 12, 5, 1)],
        False,
        16,
        32,
        np.frombuffer(rows.tobytes(), np.uint8),
        True,
    )
    columns = {**dict(zip("xyz", xyz.T, strict=True)), "instance_id": np.array([7, -1], np.int32)}
    expected["sensor_msgs/msg/PointCloud2"] = (cloud, point_cloud2(columns, "map", STAMP))

    empty_head = t["std_msgs/msg/Header"](t["builtin_interfaces/msg/Time"](0, 0), "")
    nothing = np.zeros(0, np.uint8)

    def marker(number: int, kind: int, action: int, at: Any, scale: Any, tint: Any, words: str, space: str) -> Any:
        image = t["sensor_msgs/msg/CompressedImage"](empty_head, "", nothing)
        mesh = t["visualization_msgs/msg/MeshFile"]("", nothing)
        stay = t["builtin_interfaces/msg/Duration"](0, 0)
        return t["visualization_msgs/msg/Marker"](
            head,
            space,
            number,
            kind,
            action,
            at,
            scale,
            tint,
            stay,
            False,
            [],
            [],
            "",
            image,
            [],
            words,
            "",
            mesh,
            False,
        )

    nowhere = t["geometry_msgs/msg/Pose"](point(0.0, 0.0, 0.0), turn(0.0, 0.0, 0.0, 1.0))
    marks = [
        marker(0, 0, 3, nowhere, vector(0.0, 0.0, 0.0), color(0.0, 0.0, 0.0, 0.0), "", ""),
        marker(0, 1, 0, at, vector(0.5, 0.25, 0.125), color(177 / 255, 199 / 255, 90 / 255, 0.4), "", "q"),
        marker(1, 9, 0, at, vector(0.0, 0.0, 0.05), color(1.0, 1.0, 1.0, 1.0), "mug", "q"),
    ]
    expected["visualization_msgs/msg/MarkerArray"] = (
        t["visualization_msgs/msg/MarkerArray"](marks),
        box_markers([(10, box, "mug")], "q", header("map", STAMP)),
    )
    for kind, (message, own) in expected.items():
        assert serialize(kind, own) == bytes(store.serialize_cdr(message, kind)), kind


def test_a_box_turns_by_its_pose() -> None:
    rng = np.random.default_rng(3)
    for _ in range(50):
        rotation = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        rotation *= np.sign(np.linalg.det(rotation))
        turn = pose(OrientedBox(np.zeros(3), rotation, np.ones(3)))["orientation"]
        back = rotation_from_quaternion(np.array([turn[axis] for axis in "wxyz"]))
        np.testing.assert_allclose(back, rotation.T, atol=1e-12)


def test_bytes_are_those_of_rclpy(messages: dict[str, list[dict[str, Any]]], tmp_path: Path) -> None:
    python = os.environ.get("PERCEPTION_RCLPY_PYTHON")
    if not python:
        pytest.skip("PERCEPTION_RCLPY_PYTHON names no Python with rclpy; .ci/run makes one")
    own = {kind: [serialize(kind, message) for message in some] for kind, some in messages.items()}
    (tmp_path / "in.pickle").write_bytes(pickle.dumps(messages))
    script = SUPPORT / "rclpy_bytes.py"
    paths = f"{REPOSITORY}{os.pathsep}{TESTS}"
    subprocess.run(
        [python, str(script), str(tmp_path / "in.pickle"), str(tmp_path / "out.pickle")],
        check=True,
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": paths},
        timeout=60,
    )
    theirs = pickle.loads((tmp_path / "out.pickle").read_bytes())
    assert theirs.keys() == own.keys() - {"vision_msgs/msg/Detection3DArray"}
    for kind, some in theirs.items():
        for data, mine in zip(some, own[kind], strict=True):
            # Fast CDR leaves what lay in memory between the fields, and room it did not need behind them.
            assert _without_gaps(kind, data[: len(mine)]) == mine, kind


def _without_gaps(kind: str, data: bytes) -> bytes:
    store = typestore()
    return bytes(store.serialize_cdr(store.deserialize_cdr(data, kind), kind))
