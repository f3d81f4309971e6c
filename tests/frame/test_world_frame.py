"""A scene in its map's frame: which world is kept, and that z is up, the unit the metre, the floor at 0."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from perception.config import FrameConfig
from perception.errors import InputError
from perception.frame.recentre import moved_scene
from perception.frame.world_frame import in_world_frame
from perception.geometry import camera_centres
from perception.inputs.transforms import read_transforms
from perception.sfm.options import ReadOptions
from perception.types import DepthImage, Scene
from support.measured_scenes import cameras, random_similarity, room_points


def room(kind: str, seed: int = 0) -> tuple[Scene, float]:
    """(a walk through a room in a random frame, metres per unit); kind: "photos" (no poses were given) or "colmap"."""
    rng = np.random.default_rng(seed)
    world, metres = random_similarity(rng)
    scene = Scene(cameras("walk", 40), room_points(rng), np.zeros((3000, 3), np.uint8), report={"input": kind})
    moved = moved_scene(scene, world)
    del moved.report["map_from_input"]
    return moved, metres


def clicked(scene: Scene) -> str:
    """--known-length of the table's edge, (−0.6, −0.4, 0.75) to (0.6, −0.4, 0.75), in all views that see it."""
    ends, parts = np.array([[-0.6, -0.4, 0.75], [0.6, -0.4, 0.75]]), []
    for view in cameras("walk", 40):
        local = ends @ view.camera_from_world[:3, :3].T + view.camera_from_world[:3, 3]
        pixels = (local @ view.K.T)[:, :2] / local[:, 2:]
        if (local[:, 2] > 0.2).all() and (pixels > 0).all() and (pixels < [640, 480]).all():
            parts.append(f"{view.name} " + " ".join(f"{x:.3f},{y:.3f}" for x, y in pixels))
    assert len(parts) >= 2
    return "1.2: " + "; ".join(parts)


def test_photos_get_a_level_frame_and_metres_where_something_tells_them() -> None:
    scene, metres = room("photos")
    level = in_world_frame(scene, FrameConfig())
    assert not level.metric and "scale" not in level.report and "map_from_input" not in level.report
    np.testing.assert_allclose(level.report["gravity"]["direction"], [0, 0, -1], atol=1e-9)
    known = in_world_frame(scene, FrameConfig(known_length=clicked(scene)))
    assert known.metric and known.report["scale"]["metres_per_unit"] == 1
    assert (
        0 < known.report["scale"]["standard_error"] < 0.02 and "known length 1.2 m" in known.report["scale"]["source"]
    )
    for found, unit in ((level, metres), (known, 1.0)):
        eyes = camera_centres(np.stack([view.camera_from_world for view in found.views])) * unit
        true = camera_centres(np.stack([view.camera_from_world for view in cameras("walk", 40)]))
        np.testing.assert_allclose(eyes[0, :2], 0, atol=1e-6)  # the origin lies below the first camera
        np.testing.assert_allclose(eyes[:, 2], true[:, 2], atol=0.05)  # 1° at 3 m
        np.testing.assert_allclose(
            np.linalg.norm(eyes - eyes[0], axis=1), np.linalg.norm(true - true[0], axis=1), rtol=0.01, atol=1e-6
        )
        ahead = found.views[0].camera_from_world[2, :3]
        assert ahead[0] > 0.5 and abs(ahead[1]) < 1e-9
    kept = in_world_frame(scene, FrameConfig(keep_world=True, known_length=clicked(scene)))
    assert np.array_equal(kept.points, scene.points) and not kept.metric
    assert kept.report["scale"]["metres_per_unit"] == pytest.approx(metres, rel=1e-3)


def test_given_poses_keep_their_world_to_the_last_bit() -> None:
    scene, metres = room("colmap", 1)
    same = in_world_frame(scene, FrameConfig())
    assert same.points is scene.points and same.views is scene.views and not same.metric
    assert "map_from_input" not in same.report and same.report["gravity"]["standard_error_deg"] < 1
    scaled = in_world_frame(scene, FrameConfig(known_length=clicked(scene)))  # a length is there to have metres
    assert scaled.metric
    np.testing.assert_allclose(scaled.points, scene.points * metres, rtol=1e-3)
    np.testing.assert_allclose(scaled.report["map_from_input"], np.diag([metres, metres, metres, 1]), rtol=1e-3)
    turned = in_world_frame(scene, FrameConfig(keep_world=False))
    np.testing.assert_allclose(turned.report["gravity"]["direction"], [0, 0, -1], atol=1e-9)
    matrix = np.array(turned.report["map_from_input"])
    np.testing.assert_allclose(scene.points @ matrix[:3, :3].T + matrix[:3, 3], turned.points, atol=1e-9)


def test_depth_tells_a_metric_world_and_is_converted_in_another(tmp_path: Path) -> None:
    """Depth rendered from the cloud's z-buffer; the poses' unit is the metre, then 0.5 m."""
    rng = np.random.default_rng(0)
    wall = np.c_[rng.uniform(-4, 4, (4000, 2)), np.full(4000, 4.0)]
    views = []
    for number, view in enumerate(cameras("walk", 4)):
        pose = np.eye(4)
        pose[0, 3] = -0.2 * number
        cv2.imwrite(str(tmp_path / "d.png"), np.full((48, 64), 4000, np.uint16))
        views.append(replace(view, camera_from_world=pose, depth=DepthImage(tmp_path / "d.png", 0.001)))
    scene = Scene(views, wall, np.zeros((4000, 3), np.uint8), report={"input": "transforms"})
    metric = in_world_frame(scene, FrameConfig())
    assert metric.metric and metric.views is scene.views and "depth images" in metric.report["scale"]["source"]
    halved = moved_scene(scene, np.diag([2.0, 2, 2, 1]))
    halved.views = [replace(v, depth=DepthImage(tmp_path / "d.png", 0.001)) for v in halved.views]
    other = in_world_frame(halved, FrameConfig())
    assert not other.metric and other.views[0].depth is not None
    assert other.views[0].depth.scale == pytest.approx(0.002, rel=1e-3)
    assert "converted to the unit of the poses" in other.report["warnings"][-1]
    wrong = in_world_frame(replace(halved, metric=True), FrameConfig())
    assert wrong.metric and "the input states that its unit is the metre, but" in wrong.report["warnings"][-2]
    assert wrong.views[0].depth is not None and wrong.views[0].depth.scale == pytest.approx(0.002, rel=1e-3)


def test_gravity_and_unit_of_a_transforms_json(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((8, 8, 3), np.uint8))
    (tmp_path / "p.ply").write_text("ply\nformat ascii 1.0\nelement vertex 1\n" + "".join(
        f"property float {axis}\n" for axis in "xyz") + "end_header\n0 0 0\n")  # fmt: skip
    frame = {"file_path": "a.png", "transform_matrix": np.eye(4).tolist()}
    base = {"fl_x": 8, "ply_file_path": "p.ply", "frames": [frame]}

    def read(**more: object) -> Scene:
        (tmp_path / "transforms.json").write_text(json.dumps({**base, **more}))
        return read_transforms(tmp_path / "transforms.json", ReadOptions(tmp_path))

    told = read(gravity=[0, -2, 0], gravity_std_deg=0.3, metric=True)
    assert told.metric and told.report["gravity"] == {
        "direction": [0.0, -1.0, 0.0], "source": "transforms.json", "standard_error_deg": 0.3}  # fmt: skip
    assert in_world_frame(told, FrameConfig()).report["gravity"]["source"] == "transforms.json"
    assert read(gravity=[0, 0, 1]).report["gravity"]["standard_error_deg"] == 1 and not read().metric
    for wrong in ([0, 0, 0], [1, 2], "down", [0, 0, float("nan")], {"x": 1}):
        with pytest.raises(InputError, match="gravity must be three numbers"):
            read(gravity=wrong)


def test_a_length_that_cannot_be_used_is_refused() -> None:
    scene, _ = room("photos")
    for text, message in (("0: a 1,2 3,4; b 1,2 3,4", "above 0"), ("1: cup, plate", "before the map exists")):
        with pytest.raises(InputError, match=message):
            in_world_frame(scene, FrameConfig(known_length=text))
    with pytest.raises(InputError, match="board: found 'charuco', expected KIND:COLSxROWS:SQUARE"):
        in_world_frame(scene, FrameConfig(board="charuco"))


def test_cameras_that_hang_upside_down_are_told_by_the_inputs_gravity() -> None:
    scene, _ = room("colmap")
    true = in_world_frame(scene, FrameConfig()).report["gravity"]["direction"]
    turned = [replace(v, camera_from_world=np.diag([-1.0, -1, 1, 1]) @ v.camera_from_world) for v in scene.views]
    given = {"direction": true, "source": "robot", "standard_error_deg": 5.0}
    hanging = replace(scene, views=turned, report={**scene.report, "gravity": given})
    found = in_world_frame(hanging, FrameConfig())
    assert found.report["gravity"] == given and "differ by 180°" in found.report["warnings"][-1]
