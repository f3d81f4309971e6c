"""`perception export`: files read back, a recording by Foxglove's own reader and against the photos' geometry."""

from __future__ import annotations

import json
from collections import defaultdict
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from support.viewer_maps import small_map

pytest.importorskip("rosbags")
reader = pytest.importorskip("mcap.reader")
decoder = pytest.importorskip("mcap_ros2.decoder")

from perception.colors import instance_palette  # noqa: E402
from perception.errors import InputError  # noqa: E402
from perception.export import ExportOptions  # noqa: E402
from perception.geometry import look_at  # noqa: E402
from perception.io.cloud import read_cloud, write_cloud  # noqa: E402
from perception.io.store import Map, write_map  # noqa: E402
from perception.pipeline.exporting import Outputs, export_map  # noqa: E402
from perception.types import PointCloud, View  # noqa: E402

# What Foxglove's 3D panel and RViz draw by themselves.
DRAWN = {
    "/map/points": "sensor_msgs/msg/PointCloud2",
    "/map/instances": "sensor_msgs/msg/PointCloud2",
    "/map/boxes": "visualization_msgs/msg/MarkerArray",
    "/map/detections": "vision_msgs/msg/Detection3DArray",
    "/tf": "tf2_msgs/msg/TFMessage",
    "/camera/camera_info": "sensor_msgs/msg/CameraInfo",
    "/camera/image/compressed": "sensor_msgs/msg/CompressedImage",
}
K = np.array([[500.0, 0, 330], [0, 500, 235], [0, 0, 1]])


@pytest.fixture
def path(tmp_path: Path) -> Path:
    gmap = small_map()
    poses = [look_at(np.array([x, -1.0, 0]), np.array([0, 0, 5.0]), np.array([0, -1.0, 0])) for x in (-1.0, 0, 1.0)]
    views = []
    for i, pose in enumerate(poses):
        photo = tmp_path / f"{i}.png"
        if i < 2:  # the last photo is gone
            cv2.imwrite(str(photo), np.full((480, 1280 // 2, 3), 40 * (i + 1), np.uint8))
        views.append(View(photo.name, photo, K, 640, 480, pose))
    gmap.views = views
    gmap.instances[2]["label"] = "blue ball"
    write_map(tmp_path / "m.gsmap", gmap)
    return tmp_path / "m.gsmap"


def messages(file: Path) -> tuple[dict[str, str], dict[str, list[Any]]]:
    """(schema of each topic, its messages in order), every one decoded."""
    schemas, found = {}, defaultdict(list)
    with file.open("rb") as stream:
        for schema, channel, _, message in reader.make_reader(
            stream, decoder_factories=[decoder.DecoderFactory()]
        ).iter_decoded_messages():
            assert (channel.message_encoding, schema.encoding) == ("cdr", "ros2msg")
            schemas[channel.topic] = schema.name
            found[channel.topic].append(message)
    return schemas, found


def test_every_message_decodes_and_lies_over_the_photos(path: Path, tmp_path: Path) -> None:
    out = tmp_path / "m.mcap"
    export_map(path, out, None, ExportOptions(), Outputs())
    schemas, found = messages(out)
    assert schemas == DRAWN
    assert {topic: len(told) for topic, told in found.items()} == dict(zip(DRAWN, (1, 1, 1, 1, 3, 2, 2), strict=True))

    gmap: Map = small_map()
    points = found["/map/points"][0]
    solid = gmap.opacities >= 0.5
    rows = np.frombuffer(points.data, [("p", "<f4", 3), ("rgb", "<u4")])
    np.testing.assert_array_equal(rows["p"], gmap.means[solid])
    assert points.header.frame_id == "map"
    pixels = {}
    for n, told in enumerate(found["/tf"]):
        transform = told.transforms[0]
        assert (transform.header.frame_id, transform.child_frame_id) == ("map", "camera")
        pixels[n] = _projected(gmap.means.astype(float), transform.transform, K)
    for n, (info, image) in enumerate(
        zip(found["/camera/camera_info"], found["/camera/image/compressed"], strict=True)
    ):
        assert info.header.frame_id == image.header.frame_id == "camera"
        assert (info.width, info.height, image.format) == (640, 480, "jpeg")
        photo = cv2.imdecode(np.frombuffer(image.data, np.uint8), cv2.IMREAD_COLOR)
        assert photo is not None and photo.shape == (480, 640, 3) and abs(int(photo[0, 0, 0]) - 40 * (n + 1)) < 3
        np.testing.assert_allclose(np.array(info.p).reshape(3, 4)[:, :3], K)
        pose = look_at(np.array([n - 1.0, -1.0, 0]), np.array([0, 0, 5.0]), np.array([0, -1.0, 0]))
        own = gmap.means @ pose[:3, :3].T + pose[:3, 3]
        np.testing.assert_allclose(pixels[n], (own @ K.T)[:, :2] / own[:, 2:], atol=1e-3)
    markers = found["/map/boxes"][0].markers
    assert [marker.text for marker in markers if marker.type == 9] == ["0", "1", "blue ball"]
    assert {marker.header.frame_id for marker in markers} == {"map"}


def _projected(points: np.ndarray, transform: Any, intrinsics: np.ndarray) -> np.ndarray:
    """Pixels of points, by the transform as ROS defines it: the pose of the child in the parent, xyzw."""
    x, y, z, w = (getattr(transform.rotation, name) for name in "xyzw")
    place = np.array([getattr(transform.translation, name) for name in "xyz"])
    away = points - place
    # v' = v + 2 q × (q × v + w v), turned back: the conjugate
    axis = -np.array([x, y, z])
    own = away + 2 * np.cross(axis, np.cross(axis, away) + w * away)
    return (own @ intrinsics.T)[:, :2] / own[:, 2:]


def test_a_recording_of_a_labelled_cloud_holds_that_cloud(path: Path, tmp_path: Path) -> None:
    """The cloud's own points and colours, each labelled point in the colour that the instance has everywhere."""
    gmap = small_map()
    rng = np.random.default_rng(0)
    cloud = PointCloud(gmap.means[::3] + np.float32(0.001), rng.integers(0, 256, (200, 3)).astype(np.uint8))
    write_cloud(tmp_path / "scan.ply", cloud)
    options = ExportOptions(smooth=False, drop_noise=False)
    facts, _ = export_map(path, tmp_path / "m.mcap", tmp_path / "scan.ply", options, Outputs())
    _, found = messages(tmp_path / "m.mcap")
    rows = np.frombuffer(found["/map/points"][0].data, [("p", "<f4", 3), ("rgb", "<u4")])
    np.testing.assert_array_equal(rows["p"], cloud.points)
    np.testing.assert_array_equal(rows["rgb"] >> 8 & 255, cloud.colors[:, 1])
    rows = np.frombuffer(found["/map/instances"][0].data, [("p", "<f4", 3), ("rgb", "<u4"), ("i", "<i4")])
    assert len(rows) == facts["labelled"] == sum(row["num_points"] for row in facts["instances"].values())
    nearest = np.linalg.norm(gmap.means[:, None] - rows["p"][None], axis=2).argmin(axis=0)
    np.testing.assert_array_equal(rows["i"], gmap.instance_ids[nearest])
    np.testing.assert_array_equal(rows["rgb"] & 255, instance_palette(rows["i"])[:, 2])
    boxes = [m for m in found["/map/boxes"][0].markers if m.type == 1 and m.action == 0]
    tints = [[round(255 * value) for value in (m.color.r, m.color.g, m.color.b)] for m in boxes]
    assert tints == instance_palette(3).tolist()
    told = found["/map/detections"][0].detections
    assert [(d.id, d.results[0].hypothesis.class_id) for d in told] == [("0", "0"), ("1", "1"), ("2", "blue ball")]
    assert [d.results[0].hypothesis.score for d in told] == pytest.approx([0.2, 0.5, 0.8])
    assert [told[1].bbox.center.position.x, told[1].bbox.center.position.y] == pytest.approx([0, 0.2])


def test_all_that_was_asked_for_is_written(path: Path, tmp_path: Path) -> None:
    folder = tmp_path / "out"
    folder.mkdir()
    outputs = Outputs("instance", folder / "parts", folder / "boxes.json", folder / "submission")
    facts, table = export_map(path, folder / "out.ply", None, ExportOptions(), outputs)
    gmap = small_map()
    solid = gmap.opacities >= 0.5
    back = read_cloud(folder / "out.ply")
    np.testing.assert_array_equal(back.labels["instance_id"], gmap.instance_ids[solid])
    np.testing.assert_array_equal(back.colors, instance_palette(gmap.instance_ids[solid]))
    assert facts["points"] == solid.sum() and facts["labelled"] == (solid & (gmap.instance_ids >= 0)).sum()
    assert "blue ball" in table and json.loads(json.dumps(facts))["instances"]["2"]["label"] == "blue ball"
    assert {p.name for p in folder.iterdir()} == {"out.ply", "out.json", "parts", "boxes.json", "submission"}
    for wrong in (folder / "m.obj", folder / "m.rrd"):
        with pytest.raises(InputError, match=r"\.mcap"):
            export_map(path, wrong, None, ExportOptions(), Outputs())
    with pytest.raises(InputError, match="original or instance"):
        export_map(path, folder / "x.ply", None, ExportOptions(), Outputs("red"))
