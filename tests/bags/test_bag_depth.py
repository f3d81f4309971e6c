"""A wall recorded as a bag with depth and an IMU: `perception frames` gives its photos, depth, poses and gravity."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from perception.bags.frames import FrameOptions, run_frames
from perception.errors import InputError
from perception.geometry import inverse_se3
from perception.inputs.transforms import read_frames

pytest.importorskip("rosbags")
from support.bag_recorder import Recorder
from support.rgbd_folders import SIZE, SLOPE, matrix, picture, pose, wall_depth

COLOR, OWN, FRAMES, START, STEP_NS = (
    matrix((140.0, 141.0, 79.0, 60.5)),
    matrix((120.0, 119.0, 78.5, 58.0)),
    5,
    5 * 10**9,
    10**8,
)
DOWN = np.array([0.1, 0.97, 0.2]) / np.linalg.norm([0.1, 0.97, 0.2])


def rigid(angles: list[float], shift: list[float]) -> np.ndarray:
    result = np.eye(4)
    result[:3, :3] = Rotation.from_euler("xyz", angles).as_matrix()
    result[:3, 3] = shift
    return result


BASE_FROM_CAM, CAM_FROM_DEPTH = (
    rigid([0.3, -0.2, 0.5], [0.1, 0.0, 0.2]),
    rigid([0.01, -0.02, 0.01], [-0.025, 0.002, 0.0]),
)
BASE_FROM_IMU = rigid([0.2, 1.0, -0.4], [0.0, 0.1, 0.0])


def record(path: Path, kind: str, how: str, late: int = 4_000_000, base: str = "base", imu: bool = True) -> None:
    """The wall seen by the moving base: photos, depth as `how` says `late` ns after each, tf, camera_info, IMU."""
    rng, bag = np.random.default_rng(0), Recorder(path, kind)
    moved = how == "own frame"
    bag.transform("/tf_static", START, base, "cam", BASE_FROM_CAM)
    bag.transform("/tf_static", START, "cam", "depth_cam", CAM_FROM_DEPTH)
    bag.transform("/tf_static", START, base, "imu", BASE_FROM_IMU)
    half = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])  # ROS has pixel centres at whole numbers
    bag.info("/color/camera_info", START, SIZE, COLOR - half, [0.0] * 5)
    bag.info("/depth/camera_info", START, SIZE, (OWN if moved else COLOR) - half, [0.0] * 5)
    for index in range(FRAMES):
        time = START + index * STEP_NS
        there = pose(index)
        bag.transform("/tf", time, "map", base, there @ inverse_se3(BASE_FROM_CAM))
        bag.image("/color/image_raw", time, picture(wall_depth(COLOR, there, *SIZE)[1]))
        depth = wall_depth(OWN, there @ CAM_FROM_DEPTH, *SIZE)[0] if moved else wall_depth(COLOR, there, *SIZE)[0]
        depth[:5] = 0
        write(bag, how, time + late, depth)
    for step in range(10 * (FRAMES - 1) if imu else 0):
        time = START + step * STEP_NS // 10
        imu_from_world = inverse_se3(pose(step / 10) @ inverse_se3(BASE_FROM_CAM) @ BASE_FROM_IMU)
        force = imu_from_world[:3, :3] @ (-9.81 * DOWN) + rng.normal(0, 0.1, 3)
        bag.imu("/imu", time, force if step % 10 else force + 3.0, rng.normal(0, 0.02, 3))  # and a knock now and then
    bag.close()


def write(bag: Recorder, how: str, time: int, depth: np.ndarray) -> None:
    frame = "depth_cam" if how == "own frame" else "cam"
    units = np.round(1000 * depth).astype(np.uint16)
    topic, header = "/depth/image_raw/compressedDepth", struct.pack("<iff", 0, 10000.0, 1.0)
    if how == "metres":
        bag.image("/depth/image_raw", time, np.where(depth > 0, depth, np.nan).astype(np.float32), frame, "32FC1")
    elif how == "png":
        data = header + cv2.imencode(".png", units)[1].tobytes()
        bag.jpeg(topic, time, data, frame, "16UC1; compressedDepth png")
    elif how == "inverse":
        with np.errstate(divide="ignore"):
            inverse = np.where(depth > 0, np.round(10000 / depth + 1), 0).astype(np.uint16)
        data = header + cv2.imencode(".png", inverse)[1].tobytes()
        bag.jpeg(topic, time, data, frame, "32FC1; compressedDepth png")
    else:
        bag.image("/depth/image_raw", time, units, frame, "16UC1")


@pytest.mark.parametrize(
    ("kind", "how"),
    [("ros1", "millimetres"), ("sqlite", "metres"), ("mcap", "png"), ("mcap", "inverse")],
)
def test_photos_depth_poses_and_gravity_come_back(kind: str, how: str, tmp_path: Path) -> None:
    path = tmp_path / ("drive.bag" if kind == "ros1" else "drive")
    record(path, kind, how)
    facts, text = run_frames(path, tmp_path / "out", FrameOptions(spacing=1e-3))
    assert facts["chosen"] == facts["with_pose"] == facts["with_depth"] == FRAMES and "at most 4 ms apart" in text
    data = json.loads((tmp_path / "out" / "transforms.json").read_text())
    for frame, (name, camera_from_world, _) in zip(
        data["frames"], read_frames(tmp_path / "out" / "transforms.json"), strict=True
    ):
        index = int(Path(name).stem)
        depth, points = wall_depth(COLOR, pose(index), *SIZE)
        depth[:5] = 0
        np.testing.assert_allclose(inverse_se3(camera_from_world), pose(index), atol=1e-9)
        np.testing.assert_array_equal(cv2.imread(str(tmp_path / "out" / name)), picture(points))
        found = cv2.imread(str(tmp_path / "out" / frame["depth_file_path"]), cv2.IMREAD_UNCHANGED)
        exact = np.round(1000 * depth)
        # Inverse depth is rounded to 1 / 10000 m; half of it at 3.2 m is 0.5 mm, and the file rounds once more.
        assert found.dtype == np.uint16 and np.abs(found - exact).max() <= (1 if how == "inverse" else 0)
    assert data["depth_unit_scale_factor"] == 1e-3
    wrong = np.degrees(np.arccos(np.clip(DOWN @ data["gravity"], -1, 1)))
    assert wrong < 2 * data["gravity_std_deg"] < 2.5  # noise of 0.1 m/s² in 36 samples is 0.1°


@pytest.mark.parametrize(("base", "known"), [("base_link", True), ("spot/base_link", True), ("rig", False)])
def test_the_world_of_a_mobile_robot_without_an_imu_has_z_up(base: str, known: bool, tmp_path: Path) -> None:
    record(tmp_path / "drive", "mcap", "metres", base=base, imu=False)
    facts, text = run_frames(tmp_path / "drive", tmp_path / "out", FrameOptions(spacing=1e-3))
    data = json.loads((tmp_path / "out" / "transforms.json").read_text())
    assert data.get("gravity") == facts["gravity"] == ([0, 0, -1] if known else None)
    assert ("z of 'map' is up (REP 105), ±2.0°" in text) == known


def test_depth_of_another_camera_is_registered_to_the_photos(tmp_path: Path) -> None:
    record(tmp_path / "drive", "mcap", "own frame")
    facts, _ = run_frames(tmp_path / "drive", tmp_path / "out", FrameOptions(spacing=1e-3))
    assert facts["with_depth"] == FRAMES
    for index in range(FRAMES):
        found = cv2.imread(str(tmp_path / "out" / "depth" / f"{index:06d}.png"), cv2.IMREAD_UNCHANGED) / 1000
        height, width = found.shape
        K = np.diag([width / SIZE[0], height / SIZE[1], 1]) @ COLOR
        true, _ = wall_depth(K, pose(index), width, height)
        seen = found > 0
        assert width == int(SIZE[0] * 120 / 140) and seen[10:, 5:-5].mean() > 0.85
        # A point may lie anywhere in its pixel, so up to one pixel from the centre when depth pixels are as large.
        assert (np.abs(found - true) < 1.01 * np.abs(np.gradient(true, axis=1)) + 2e-3)[seen].all()


@pytest.mark.parametrize(
    ("options", "late", "words"),
    [
        (FrameOptions(depth="/gone"), 0, "has no depth topic '/gone'; found /depth/image_raw"),
        (FrameOptions(depth="/depth/image_raw"), 10**9, "within 0.03 s of a photo"),
        (FrameOptions(), 10**9, None),
        (FrameOptions(depth="none"), 0, None),
    ],
)
def test_depth_that_cannot_be_used(options: FrameOptions, late: int, words: str | None, tmp_path: Path) -> None:
    record(tmp_path / "drive", "mcap", "millimetres", late)
    if words is not None:
        with pytest.raises(InputError, match=words):
            run_frames(tmp_path / "drive", tmp_path / "out", options)
        assert not (tmp_path / "out").exists()
        return
    facts, text = run_frames(tmp_path / "drive", tmp_path / "out", options)
    assert facts["with_depth"] == 0 and not (tmp_path / "out" / "depth").exists()
    assert ("depth: left out" in text) == (options.depth is None)


def test_depth_of_another_shape_than_its_camera_is_left_out(tmp_path: Path) -> None:
    bag = Recorder(tmp_path / "drive", "mcap")
    for camera in ("color", "depth"):
        bag.info(f"/{camera}/camera_info", START, SIZE, COLOR, [0.0] * 5)
    for index in range(3):
        bag.image("/color/image_raw", START + index * STEP_NS, picture(wall_depth(COLOR, pose(index), *SIZE)[1]))
        cropped = np.full((SIZE[1] - 20, SIZE[0]), 2.0, np.float32)
        bag.image("/depth/image_raw", START + index * STEP_NS, cropped, "cam", "32FC1")
    bag.close()
    facts, text = run_frames(tmp_path / "drive", tmp_path / "out")
    assert facts["with_depth"] == 0 and f"its camera_info says {SIZE[0]}x{SIZE[1]}" in text
    with pytest.raises(InputError, match="an image is"):
        run_frames(tmp_path / "drive", tmp_path / "named", FrameOptions(depth="/depth/image_raw"))


def test_depth_without_the_photos_distortion_is_registered(tmp_path: Path) -> None:
    """One frame and one matrix, but depth is rectified and photos are not: rays of pixels by OpenCV."""
    bag, half = Recorder(tmp_path / "drive", "mcap"), np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    bend = [-0.35, 0.1, 0.0, 0.0, 0.0]
    bag.info("/color/camera_info", START, SIZE, COLOR - half, bend)
    bag.info("/depth/camera_info", START, SIZE, COLOR - half, [0.0] * 5)
    depth, _ = wall_depth(COLOR, np.eye(4), *SIZE)
    for index in range(3):
        bag.image("/color/image_raw", START + index * STEP_NS, picture(wall_depth(COLOR, pose(index), *SIZE)[1]))
        bag.image("/depth/image_raw", START + index * STEP_NS, depth.astype(np.float32), "cam", "32FC1")
    bag.close()
    run_frames(tmp_path / "drive", tmp_path / "out", FrameOptions(spacing=1e-3))
    found = cv2.imread(str(tmp_path / "out" / "depth" / "000001.png"), cv2.IMREAD_UNCHANGED) / 1000
    pixels = np.stack(np.meshgrid(np.arange(SIZE[0]) + 0.5, np.arange(SIZE[1]) + 0.5), axis=-1).reshape(-1, 1, 2)
    rays = cv2.undistortPoints(pixels, COLOR, np.array(bend))[:, 0].reshape(SIZE[1], SIZE[0], 2)
    true = 2 / (1 - SLOPE * rays[..., 0])  # the wall z = 2 + SLOPE x
    seen = found > 0
    assert seen.mean() > 0.7
    assert (np.abs(found - true) < 1.01 * np.abs(np.gradient(true, axis=1)) + 2e-3)[seen].all()
    assert np.abs(depth - true).max() > 0.1  # what depth as it was recorded is off by
