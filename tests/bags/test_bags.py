"""Bags of all three kinds, written here, through `perception frames` into what the mapper reads."""

from __future__ import annotations

import json
import os
import tracemalloc
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from perception.bags.frames import FrameOptions, run_frames
from perception.bags.poses import Poses
from perception.bags.read import decode_image
from perception.cli import main
from perception.config import load_config
from perception.errors import InputError
from perception.geometry import inverse_se3
from perception.inputs.transforms import read_frames
from perception.photos.camera_file import read_camera
from perception.photos.video import Chooser
from perception.pipeline.mapping import build_map

pytest.importorskip("rosbags")
from support.bag_recorder import Recorder

DATA = os.environ.get("PERCEPTION_DATA")
K = np.array([[80.0, 0, 63.0], [0, 82.0, 47.0], [0, 0, 1]])
D = [-0.1, 0.02, 0.001, -0.002, 0.003]


def pose(angle: float, shift: float) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_euler("zyx", [angle, 0.3 * angle, -0.2]).as_matrix()
    matrix[:3, 3] = [shift, -shift / 2, 0.4]
    return matrix


def photo(number: int, blur: float = 0.0) -> np.ndarray:
    """A textured wall, seen 16 pixels farther to the right with each number."""
    wall = np.random.default_rng(0).integers(0, 255, (24, 200), np.uint8)
    wall = cv2.GaussianBlur(cv2.resize(wall, (1600, 192), interpolation=cv2.INTER_CUBIC), (0, 0), 1.5)
    part = wall[:96, 16 * number : 16 * number + 128]
    part = cv2.GaussianBlur(part, (0, 0), blur) if blur else part
    return np.ascontiguousarray(np.repeat(part[..., None], 3, axis=2))


BASE_FROM_CAM = pose(0.7, 0.1)
TIMES = [10**9 * 5 + 200_000_000 * i for i in range(12)]


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["ros1", "sqlite", "mcap"])
def test_images_camera_and_poses_come_through(tmp_path: Path, kind: str) -> None:
    path = tmp_path / ("drive.bag" if kind == "ros1" else "drive")
    bag = Recorder(path, kind)
    bag.transform("/tf_static", TIMES[0], "base", "cam", BASE_FROM_CAM)
    bag.info("/front/camera_info", TIMES[0], (128, 96), K, D)
    for i, time in enumerate(TIMES):
        bag.transform("/tf", time - 50_000_000, "odom", "base", pose(0.1 * i, 0.2 * i))  # before and after, not at
        bag.image("/front/image_raw", time, photo(i))
        bag.transform("/tf", time + 50_000_000, "odom", "base", pose(0.1 * i + 0.02, 0.2 * i + 0.04))
    bag.transform("/tf", TIMES[0], "map", "odom", np.eye(4))
    bag.transform("/tf", TIMES[-1] + 10**9, "map", "odom", np.eye(4))
    bag.close()
    source = next(path.glob("*.mcap")) if kind == "mcap" else path  # a lone .mcap too

    facts, text = run_frames(source, tmp_path / "out")
    assert facts["images"] == 12 and 4 <= facts["chosen"] <= 12
    lens = read_camera(tmp_path / "out" / "camera.yaml")
    np.testing.assert_allclose(lens.params, [80, 82, 63.5, 47.5, *D[:4], D[4], 0, 0, 0])
    frames = json.loads((tmp_path / "out" / "transforms.json").read_text())
    # map is known at both ends only, too far apart to interpolate, so odom is the world.
    assert frames["world_frame"] == "odom" and facts["with_pose"] == facts["chosen"]
    for name, camera_from_world, _ in read_frames(tmp_path / "out" / "transforms.json"):
        number = int(Path(name).stem)
        base = inverse_se3(camera_from_world) @ inverse_se3(BASE_FROM_CAM)
        want = pose(0.1 * number + 0.01, 0.2 * number + 0.02)  # halfway between the samples around it
        np.testing.assert_allclose(base, want, atol=2e-4)
        written = cv2.imread(str(tmp_path / "out" / name))
        np.testing.assert_array_equal(written, photo(number))  # raw images are kept exactly
    assert "perception map" in text


@pytest.mark.slow
def test_poses_are_those_recorded(tmp_path: Path) -> None:
    bag = Recorder(tmp_path / "drive", "mcap")
    bag.info("/camera_info", TIMES[0], (128, 96), K, [-0.02, 0.01, 0.0, 0.0], "equidistant")
    bag.transform("/tf_static", TIMES[0], "base", "cam", BASE_FROM_CAM)
    for i, time in enumerate(TIMES):
        bag.jpeg("/compressed", time, cv2.imencode(".jpg", photo(i))[1].tobytes())
        bag.odometry("/odom", time, pose(0.1 * i, 0.2 * i))
    bag.close()
    facts, _ = run_frames(tmp_path / "drive", tmp_path / "out")
    assert facts["with_pose"] == facts["chosen"] > 3 and facts["fixed_frame"] == "odom"
    for name, camera_from_world, lens in read_frames(tmp_path / "out" / "transforms.json"):
        number = int(Path(name).stem)
        want = inverse_se3(pose(0.1 * number, 0.2 * number) @ BASE_FROM_CAM)
        np.testing.assert_allclose(camera_from_world, want, atol=1e-9)
        assert lens.model == "OPENCV_FISHEYE" and lens == read_camera(tmp_path / "out" / "camera.yaml")
        kept = (tmp_path / "out" / name).read_bytes()
        assert kept == cv2.imencode(".jpg", photo(number))[1].tobytes()  # compressed images are not touched


def test_a_fixed_frame_without_poses_is_refused_and_others_are_named(tmp_path: Path) -> None:
    bag = Recorder(tmp_path / "drive", "mcap")
    bag.info("/camera_info", TIMES[0], (128, 96), K, D)
    for i, time in enumerate(TIMES[:3]):
        bag.jpeg("/compressed", time, cv2.imencode(".jpg", photo(i))[1].tobytes())
        bag.transform("/tf", time, "odom", "cam", pose(0.1 * i, 0.2 * i))
    bag.close()
    with pytest.raises(InputError, match=r"--fixed-frame odomm: frames above 'cam' are odom$"):
        run_frames(tmp_path / "drive", tmp_path / "out", FrameOptions(fixed_frame="odomm"))
    assert not (tmp_path / "out").exists()


def test_why_there_are_no_poses(tmp_path: Path) -> None:
    """Images stamped by a clock that counts from the start of the camera."""
    bag = Recorder(tmp_path / "drive", "mcap")
    bag.info("/camera_info", TIMES[0], (128, 96), K, D)
    for i, time in enumerate(TIMES[:3]):
        bag.jpeg("/compressed", time, cv2.imencode(".jpg", photo(i))[1].tobytes())
        bag.transform("/tf", time + 10**18, "odom", "cam", pose(0.1 * i, 0.2 * i))
    bag.close()
    facts, text = run_frames(tmp_path / "drive", tmp_path / "out")
    assert facts["with_pose"] == 0 and "no poses: no image lies between samples of odom" in text and "one clock" in text


def two_odometries(path: Path, tf: bool) -> Path:
    """Wheel odometry goes astray between the samples of a filter on tf, or of another odometry."""
    bag = Recorder(path, "mcap")
    bag.info("/camera_info", TIMES[0], (128, 96), K, D)
    bag.transform("/tf_static", TIMES[0], "base", "cam", BASE_FROM_CAM)
    for i, time in enumerate(TIMES):
        bag.jpeg("/compressed", time, cv2.imencode(".jpg", photo(i))[1].tobytes())
        for near in (time - 20_000_000, time + 20_000_000):
            if tf:
                bag.transform("/tf", near, "odom", "base", pose(0.1 * i, 0.2 * i))
            else:
                bag.odometry("/filtered", near, pose(0.1 * i, 0.2 * i))
        for near in (time - 10_000_000, time + 10_000_000):
            bag.odometry("/a/wheels", near, pose(0.1 * i, 0.2 * i + 1))
    bag.close()
    return path


@pytest.mark.parametrize("tf", [True, False])
@pytest.mark.parametrize("asked", [None, "/a/wheels"])
def test_poses_of_one_frame_are_those_of_one_topic_which_is_told(tf: bool, asked: str | None, tmp_path: Path) -> None:
    drive = two_odometries(tmp_path / "drive", tf)
    _, text = run_frames(drive, tmp_path / "out", FrameOptions(odometry=asked))
    first, second = ("/tf" if tf else "/filtered", "/a/wheels")[:: 1 if asked is None else -1]
    assert f"poses: 'base' by {first}, not {second} (--odometry TOPIC takes another)" in text
    for name, camera_from_world, _ in read_frames(tmp_path / "out" / "transforms.json"):
        number = int(Path(name).stem)
        want = inverse_se3(pose(0.1 * number, 0.2 * number + (0 if asked is None else 1)) @ BASE_FROM_CAM)
        np.testing.assert_allclose(camera_from_world, want, atol=1e-9)


def test_an_odometry_that_gives_no_pose_of_the_camera_is_refused(tmp_path: Path) -> None:
    drive = two_odometries(tmp_path / "drive", tf=True)
    with pytest.raises(InputError, match="no odometry topic '/vio'; found /a/wheels"):
        run_frames(drive, tmp_path / "out", FrameOptions(odometry="/vio"))
    bag = Recorder(tmp_path / "apart", "mcap")
    bag.info("/camera_info", TIMES[0], (128, 96), K, D)
    for i, time in enumerate(TIMES[:3]):
        bag.jpeg("/compressed", time, cv2.imencode(".jpg", photo(i))[1].tobytes())
        bag.transform("/tf", time, "map", "cam", np.eye(4))
        bag.odometry("/wheels", time, np.eye(4))
    bag.close()
    with pytest.raises(InputError, match=r"--odometry /wheels: it has no pose of 'cam' or a frame above it \(map\)"):
        run_frames(tmp_path / "apart", tmp_path / "out", FrameOptions(odometry="/wheels"))


@pytest.mark.parametrize("topic", ["/cam/image_rect", "/cam/image_rect_color/compressed", "/cam/image_raw/compressed"])
def test_rectified_images_take_the_camera_of_rectified_images(tmp_path: Path, topic: str) -> None:
    """image_pipeline's names: camera_info holds K and D of the raw images, and P of the rectified ones."""
    bag = Recorder(tmp_path / "drive", "mcap")
    bag.info("/cam/camera_info", TIMES[0], (128, 96), K, D)
    for i, time in enumerate(TIMES[:3]):
        bag.jpeg(topic, time, cv2.imencode(".jpg", photo(i))[1].tobytes())
    bag.close()
    plain, text = run_frames(tmp_path / "drive", tmp_path / "out")
    assert (
        plain["with_pose"] == 0
        and "leads to 'cam'" in text
        and "--camera" in text
        and not (tmp_path / "out" / "transforms.json").exists()
    )
    params = np.array(read_camera(tmp_path / "out" / "camera.yaml").params)
    if "rect" in topic:  # the recorder writes P = .9 K
        np.testing.assert_allclose(
            params[:4], 0.9 * (np.array([80, 82, 63.5, 47.5]) - [0, 0, 0.5, 0.5]) + [0, 0, 0.5, 0.5]
        )
        assert not params[4:].any()
    else:
        np.testing.assert_allclose(params[4:8], D[:4])


def test_a_quaternion_of_zeros_is_left_out_and_told(tmp_path: Path) -> None:
    """As tf2 ignores it; messages that nobody filled in hold zeros."""
    bag = Recorder(tmp_path / "drive", "mcap")
    bag.info("/camera_info", TIMES[0], (128, 96), K, D)
    kinds = ("Vector3", "Quaternion", "Transform", "TransformStamped")
    vector, quaternion, change, stamped = (bag.type(f"geometry_msgs/msg/{kind}") for kind in kinds)
    unset = change(vector(5.0, 0.0, 0.0), quaternion(0.0, 0.0, 0.0, 0.0))
    for i, time in enumerate(TIMES[:4]):
        bag.jpeg("/compressed", time, cv2.imencode(".jpg", photo(i))[1].tobytes())
        bag.transform("/tf", time, "odom", "cam", pose(0.1 * i, 0.2 * i))
        empty = stamped(bag.header(time - 10_000_000, "odom"), "cam", unset)
        bag.write("/tf", "tf2_msgs/msg/TFMessage", time, bag.type("tf2_msgs/msg/TFMessage")([empty]))
    bag.close()
    facts, text = run_frames(tmp_path / "drive", tmp_path / "out", FrameOptions(spacing=1e-3))
    assert facts["with_pose"] == 4 and "/tf: 4 messages left out" in text and "no rotation" in text
    for name, camera_from_world, _ in read_frames(tmp_path / "out" / "transforms.json"):
        number = int(Path(name).stem)
        np.testing.assert_allclose(inverse_se3(camera_from_world), pose(0.1 * number, 0.2 * number), atol=1e-9)


def test_interpolation_and_gaps() -> None:
    poses = Poses()
    poses.add("world", "base", 0, pose(0.0, 0.0))
    poses.add("world", "base", 400_000_000, pose(0.0, 1.0))
    poses.add("world", "base", 2_000_000_000, pose(0.0, 2.0))
    poses.add("elsewhere", "base", 0, pose(1.0, 9.0))  # a second parent is not believed
    poses.add("base", "cam", 0, np.eye(4), static=True)
    quarter = inverse_se3(poses.camera_from_world("world", "/cam", 100_000_000))
    np.testing.assert_allclose(quarter[:3, 3], [0.25, -0.125, 0.4])
    assert poses.camera_from_world("world", "cam", 1_000_000_000) is None  # 1.6 s without a sample
    assert poses.camera_from_world("world", "cam", 2_100_000_000) is None  # after the last
    assert poses.camera_from_world("nowhere", "cam", 0) is None
    assert poses.path("cam")[-1] == "world"


def test_the_poses_of_a_long_drive_take_little_memory() -> None:
    """Of an hour with 30 frames at 50 Hz, 5 million samples: not a gigabyte."""
    poses, one, count = Poses(), pose(0.1, 0.2), 20_000
    tracemalloc.start()
    for number in range(count):
        poses.add("world", "base", number * 10**7, one)
    held = tracemalloc.get_traced_memory()[0] / count
    tracemalloc.stop()
    assert held < 150  # 13 numbers of 8 bytes, and room to grow
    np.testing.assert_allclose(inverse_se3(poses.camera_from_world("world", "base", 5 * 10**10)), one)


def test_sharp_and_spaced() -> None:
    chooser = Chooser(spacing=0.4)
    still = [photo(0)] * 5
    moving = [photo(i, blur=2.0 if i % 2 else 0.0) for i in range(1, 13)]
    for picture in still + moving:
        chooser.show(picture)
    chosen = chooser.chosen(100)
    assert sum(number < 5 for number in chosen) <= 1  # standing still is one view
    moved = [number - 4 for number in chosen if number >= 5]
    assert all(number % 2 == 0 for number in moved) and len(moved) >= 3  # the sharp ones
    assert len(chooser.chosen(3)) <= 3
    assert Chooser().chosen(10) == []


@pytest.mark.parametrize(
    ("encoding", "channels", "conversion"),
    [("rgb8", 3, cv2.COLOR_BGR2RGB), ("bgra8", 4, cv2.COLOR_BGR2BGRA), ("mono8", 1, cv2.COLOR_BGR2GRAY)],
)
def test_encodings_with_padded_rows(encoding: str, channels: int, conversion: int) -> None:
    picture = np.random.default_rng(1).integers(0, 255, (6, 5, 3), np.uint8)
    raw = cv2.cvtColor(picture, conversion).reshape(6, 5 * channels)
    padded = np.hstack([raw, np.zeros((6, 3), np.uint8)])
    step = 5 * channels + 3
    message = SimpleNamespace(encoding=encoding, height=6, width=5, step=step, data=padded.tobytes())
    want = picture if channels > 1 else np.repeat(raw[..., None], 3, axis=2)
    np.testing.assert_array_equal(decode_image(message, "x"), want)
    message.data = padded.tobytes()[:-4]
    with pytest.raises(InputError, match="holds"):
        decode_image(message, "x")


@pytest.mark.parametrize("encoding", ["bayer_rggb8", "bayer_bggr8", "bayer_gbrg8", "bayer_grbg8"])
def test_bayer_mosaics_give_the_colour_back(encoding: str) -> None:
    color = np.array([40, 120, 220], np.uint8)  # BGR
    cells = dict(zip("bgr", color.tolist(), strict=True))
    pattern = encoding[6:10]
    mosaic = np.empty((16, 16), np.uint8)
    for place, letter in enumerate(pattern):
        mosaic[place // 2 :: 2, place % 2 :: 2] = cells[letter]
    message = SimpleNamespace(encoding=encoding, height=16, width=16, step=16, data=mosaic.tobytes())
    np.testing.assert_allclose(decode_image(message, "x")[4:12, 4:12].reshape(-1, 3).mean(axis=0), color, atol=1)


def test_bad_bags_are_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def told(source: Path, *more: str) -> str:
        assert main(["frames", str(source), "-o", str(tmp_path / "out"), *more]) == 2
        line = capsys.readouterr().err.strip()
        assert "\n" not in line and not (tmp_path / "out").exists()
        return line

    bag = Recorder(tmp_path / "bare", "mcap")
    for i, time in enumerate(TIMES[:3]):
        bag.image("/image", time, photo(i))
    bag.close()
    assert "has no camera_info" in told(tmp_path / "bare") and "--camera" in told(tmp_path / "bare")
    assert "no image topic '/left'" in told(tmp_path / "bare", "--topic", "/left")

    bag = Recorder(tmp_path / "odd", "sqlite")
    bag.info("/camera_info", TIMES[0], (128, 96), K, D)
    bag.image("/image", TIMES[0], photo(0)[..., 0], encoding="32FC1")
    bag.close()
    assert "encoded as '32FC1'" in told(tmp_path / "odd")

    bag = Recorder(tmp_path / "two.bag", "ros1")
    for topic in ("/left/image", "/right/image"):
        bag.image(topic, TIMES[0], photo(0))
    bag.info("/left/camera_info", TIMES[0], (64, 48), K, D)
    bag.close()
    assert "several image topics" in told(tmp_path / "two.bag")
    assert "128x96 pixels, the camera 64x48" in told(tmp_path / "two.bag", "--topic", "/left/image")

    bag = Recorder(tmp_path / "silent", "mcap")
    bag.info("/camera_info", TIMES[0], (64, 48), K, D)
    bag.close()
    assert "holds no images" in told(tmp_path / "silent")
    (tmp_path / "no.bag").write_bytes(b"not a bag at all")
    (tmp_path / "no.mcap").write_bytes(b"nor this")
    for name in ("no.bag", "no.mcap"):
        assert "is no bag" in told(tmp_path / name)
    assert "no such bag" in told(tmp_path / "nowhere")
    (tmp_path / "empty").mkdir()
    assert "is no bag" in told(tmp_path / "empty")


@pytest.mark.slow
@pytest.mark.skipif(not DATA, reason="PERCEPTION_DATA is not set")
def test_a_bag_of_the_fox_becomes_a_scene_for_the_mapper(tmp_path: Path) -> None:
    fox = Path(str(DATA)) / "fox_480"
    data = json.loads((fox / "transforms.json").read_text())
    frames = {name: (pose, lens) for name, pose, lens in read_frames(fox / "transforms.json") if (fox / name).is_file()}
    bag = Recorder(tmp_path / "fox", "mcap")
    first = next(iter(frames.values()))[1]
    fx, fy, cx, cy = first.params[:4]
    K = np.array([[fx, 0, cx - 0.5], [0, fy, cy - 0.5], [0, 0, 1]])
    bag.info(
        "/camera_info", TIMES[0], (first.width, first.height), K, [data[k] for k in ("k1", "k2", "p1", "p2")] + [0]
    )
    names = sorted(frames)[:12]
    for i, name in enumerate(names):
        time = TIMES[0] + 10**8 * i
        bag.jpeg("/image/compressed", time, (fox / name).read_bytes())
        bag.transform("/tf", time, "map", "cam", inverse_se3(frames[name][0]))
    bag.close()
    facts, _ = run_frames(tmp_path / "fox", tmp_path / "out", FrameOptions(camera_info="/camera_info", spacing=0.02))
    assert facts["with_pose"] == facts["chosen"] >= 7
    for name, camera_from_world, lens in read_frames(tmp_path / "out" / "transforms.json"):
        want, known = frames[names[int(Path(name).stem)]]
        np.testing.assert_allclose(camera_from_world, want, atol=1e-6)
        assert lens.model == known.model
        np.testing.assert_allclose(lens.params, known.params, atol=1e-6)

    quick = ["train.iterations=40", "train.budget=3000", "photos.max_side=120", "language.encoder=none"]
    gmap = build_map(tmp_path / "out", tmp_path / "fox.gsmap", load_config(None, quick))
    assert len(gmap.views) == facts["chosen"] and gmap.info["quality"]["psnr"] > 12
