"""The ROS 2 package: its messages by the types' own definitions, frame.yaml, RViz's topics, the manifests."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from perception import load_map
from perception.errors import InputError
from perception.node import answers
from perception.query import QueryMap
from perception.query.robot_pose import RobotPose
from support.node_maps import encoders, write_small_map
from support.paths import REPOSITORY

pytest.importorskip("rosbags")

from perception_ros import messages
from perception_ros.frames import FrameFile, read_frame
from rosbags.typesys import get_types_from_msg

from support.cdr import serialize, typestore

LAUNCH = REPOSITORY / "launch"
STAMP = (7, 5)
# moveit_msgs and its dependencies are not among the types of rosbags: from their repositories.
MOVEIT = {
    "object_recognition_msgs/msg/ObjectType": "string key\nstring db\n",
    "moveit_msgs/msg/CollisionObject": (
        "std_msgs/Header header\ngeometry_msgs/Pose pose\nstring id\nobject_recognition_msgs/ObjectType type\n"
        "shape_msgs/SolidPrimitive[] primitives\ngeometry_msgs/Pose[] primitive_poses\nshape_msgs/Mesh[] meshes\n"
        "geometry_msgs/Pose[] mesh_poses\nshape_msgs/Plane[] planes\ngeometry_msgs/Pose[] plane_poses\n"
        "string[] subframe_names\ngeometry_msgs/Pose[] subframe_poses\nbyte operation\n"
    ),
}


@pytest.fixture(scope="module")
def gmap(tmp_path_factory: pytest.TempPathFactory) -> QueryMap:
    path = tmp_path_factory.mktemp("maps") / "a.gsmap"
    write_small_map(path, ["red mug", "laptop"])
    return load_map(path, encoders=encoders)


def sent(kind: str, message: dict[str, Any]) -> Any:
    """A message as it arrives: through CDR by the type's definition. KeyError for a field that the type has not."""
    store = typestore()
    if kind not in store.fielddefs:
        texts = dict(MOVEIT)
        for file in (LAUNCH / "perception_msgs/msg").glob("*.msg"):
            texts[f"perception_msgs/msg/{file.stem}"] = file.read_text()
        for file in (LAUNCH / "perception_msgs/srv").glob("*.srv"):
            halves = file.read_text().split("---\n")
            names = (f"perception_msgs/srv/{file.stem}_{half}" for half in ("Request", "Response"))
            texts |= zip(names, halves, strict=True)
        for name, text in texts.items():
            store.register({name: next(iter(get_types_from_msg(text, name).values()))})
    return store.deserialize_cdr(serialize(kind, message), kind)


def test_instances_and_info_fit_the_built_types(gmap: QueryMap) -> None:
    hits = gmap.find()
    told = sent("perception_msgs/msg/InstanceArray", messages.instance_array(hits, gmap.map_id, gmap.frame, STAMP))
    assert (told.header.frame_id, told.map_id) == ("kitchen", gmap.map_id)
    assert [(one.id, one.label, one.num_points) for one in told.instances] == [(0, "red mug", 50), (10, "laptop", 50)]
    for one, hit in zip(told.instances, hits, strict=True):
        np.testing.assert_array_equal(one.covariance.reshape(3, 3), hit.covariance)
        assert [one.size.x, one.size.y, one.size.z] == list(hit.obb.extent)
        assert [one.centroid.x, one.centroid.y, one.centroid.z] == list(hit.centroid)
    info = sent("perception_msgs/msg/MapInfo", messages.map_info(gmap, Path("a.gsmap"), STAMP))
    assert (info.metric, info.gravity_known, info.num_instances, info.num_gaussians) == (True, False, 2, 120)


def test_a_collision_object_is_the_box(gmap: QueryMap) -> None:
    """Corners of the solid, by MoveIt's rule (pose of the object times that of its primitive), are the box's."""
    hit = gmap.find()[0]
    made = messages.collision_object(hit, STAMP)
    told = sent("moveit_msgs/msg/CollisionObject", made)
    (solid,), (own,) = told.primitives, told.primitive_poses
    assert (told.id, told.header.frame_id, solid.type, told.operation) == ("instance_0", "kitchen", 1, 0)
    signs = np.array(np.meshgrid(*[[-0.5, 0.5]] * 3)).reshape(3, -1).T
    corners = signs * solid.dimensions
    for pose in (own, told.pose):
        turn = Rotation.from_quat([getattr(pose.orientation, axis) for axis in "xyzw"])
        corners = turn.apply(corners) + [getattr(pose.position, axis) for axis in "xyz"]
    local = (corners - hit.obb.center) @ np.asarray(hit.obb.rotation).T / hit.obb.extent
    np.testing.assert_allclose(local, signs, atol=1e-9)
    local = (hit.points - hit.obb.center) @ np.asarray(hit.obb.rotation).T / hit.obb.extent
    assert np.abs(local).max() < 0.5 + 1e-4  # the points of the instance lie in it


def test_occupancy_grid() -> None:
    cells = np.array([[0, 100, -1], [-1, 0, 100]], np.int8)
    told = sent("nav_msgs/msg/OccupancyGrid", messages.occupancy_grid(cells, np.eye(4), 0.5, "map", STAMP))
    assert (told.info.width, told.info.height, told.info.resolution, told.info.origin.orientation.w) == (3, 2, 0.5, 1.0)
    assert told.data.tolist() == [0, 100, -1, -1, 0, 100]


def test_a_place_to_stand_is_a_goal_that_looks_ahead() -> None:
    """The quaternion turns x forward to where the robot faces, on the floor of the frame."""
    robot = Rotation.from_euler("z", 2.0)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = robot.as_matrix(), [1.0, -2.0, 0.25]
    stand = RobotPose(4, pose, 0.5, 0.75, "home")
    fields = {"pose": messages.stand_pose(stand, STAMP), "distance": stand.distance, "seen": stand.seen}
    told = sent("perception_msgs/srv/WhereToStand_Response", fields)
    assert (told.error, told.distance, told.seen, told.pose.header.frame_id) == ("", 0.5, 0.75, "home")
    place, turn = told.pose.pose.position, told.pose.pose.orientation
    assert [place.x, place.y, place.z] == [1.0, -2.0, 0.25]
    ahead = Rotation.from_quat([turn.x, turn.y, turn.z, turn.w]).apply([1, 0, 0])
    np.testing.assert_allclose(ahead, [np.cos(2.0), np.sin(2.0), 0], atol=1e-12)
    np.testing.assert_allclose(stand.yaw, 2.0)


def test_frame_file_scales_the_map_and_tells_its_place(gmap: QueryMap, tmp_path: Path) -> None:
    """A point of the map, scaled, moved by the transform that is sent, lies where the parent's frame has it."""
    turn = Rotation.from_euler("xyz", [0.1, -0.4, 2.0])
    file = tmp_path / "frame.yaml"
    words = {"child": "site", "scale": 2.5, "translation": [1, 2, 3], "rotation": turn.as_quat().tolist()}
    file.write_text(yaml.safe_dump(words))
    frames = read_frame(file)
    placed, parent = frames.placed(gmap), frames.parent_frame()
    assert (placed.frame, placed.metric, placed.map_id) == ("site", True, gmap.map_id)
    (before, *_), (hit, *_) = gmap.query("laptop"), placed.query("laptop")
    np.testing.assert_allclose(hit.points, 2.5 * before.points, rtol=1e-5)
    np.testing.assert_allclose(hit.obb.extent, 2.5 * np.asarray(before.obb.extent), rtol=1e-6)
    told = sent("tf2_msgs/msg/TFMessage", messages.static_transform(parent, placed.frame, STAMP)).transforms[0]
    assert (told.header.frame_id, told.child_frame_id) == ("map", "site")
    rotation = Rotation.from_quat([getattr(told.transform.rotation, axis) for axis in "xyzw"])
    offset = [getattr(told.transform.translation, axis) for axis in "xyz"]
    there = placed.query("laptop", frame=parent)[0]
    assert there.frame == "map"
    np.testing.assert_allclose(there.centroid, rotation.apply(hit.centroid) + offset)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[1, 2]", "found list"),
        ("parent: [", "YAML"),
        ("sclae: 2", "sclae"),
        ("scale: -1", "scale"),
        ("rotation: [0, 0, 0, 2]", "length 2"),
        ("translation: [0, 0]", "translation"),
    ],
)
def test_bad_frame_files_are_told(tmp_path: Path, text: str, words: str) -> None:
    (tmp_path / "frame.yaml").write_text(text)
    with pytest.raises(InputError, match=words):
        read_frame(tmp_path / "frame.yaml")


def test_frames_of_one_name_and_maps_without_unit_are_told(gmap: QueryMap) -> None:
    with pytest.raises(InputError, match="both 'kitchen'"):
        FrameFile(parent="kitchen").placed(gmap)
    with pytest.raises(InputError, match="expected scale"):
        FrameFile().placed(QueryMap.of(gmap, info={**gmap.info, "metric": False}))


def test_the_frame_file_of_the_package_is_one() -> None:
    assert read_frame(LAUNCH / "perception/config/frame.yaml") == FrameFile(child="perception_map", scale=1.0)


def displays() -> list[dict[str, Any]]:
    config = yaml.safe_load((LAUNCH / "perception/rviz/perception.rviz").read_text())
    return config["Visualization Manager"]["Displays"]


def test_every_display_of_rviz_shows_a_topic_of_the_node() -> None:
    """RViz's display types and the message each subscribes to, from rviz_default_plugins; latched ones ask for it."""
    kinds = {"Map": "nav_msgs/msg/OccupancyGrid", "PointCloud2": "sensor_msgs/msg/PointCloud2"}
    kinds["MarkerArray"] = "visualization_msgs/msg/MarkerArray"
    topics = {f"/perception/{one.name}": one for one in (*answers.OUTPUTS, *messages.OUTPUTS)}
    shown = [one for one in displays() if not one["Class"].endswith("/TF")]
    assert len(shown) == 5 and len(displays()) == 6
    for one in shown:
        topic, kind = topics[one["Topic"]["Value"]], kinds[one["Class"].rpartition("/")[2]]
        wanted = "Transient Local" if topic.latched else "Volatile"
        assert (topic.kind, wanted) == (kind, one["Topic"]["Durability Policy"]), one["Name"]


def test_manifests_name_every_package_that_the_node_imports() -> None:
    """package.xml against the types of all channels; those of MoveIt are optional."""
    root = ElementTree.parse(LAUNCH / "perception/package.xml").getroot()
    named = {one.text for one in root.findall("exec_depend")}
    channels = (*answers.OUTPUTS, *messages.OUTPUTS, answers.PROMPT, answers.QUERY, answers.RELOAD)
    channels = (*channels, messages.FIND, messages.STAND)
    assert {one.kind.split("/")[0] for one in channels} - named == {"moveit_msgs"}
    assert root.findtext("name") == "perception"
    other = ElementTree.parse(LAUNCH / "perception_msgs/package.xml").getroot()
    assert root.findtext("version") == other.findtext("version") and other.findtext("name") == "perception_msgs"
