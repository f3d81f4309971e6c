"""Bags as drivers and recorders leave them: depth under other names, cameras written otherwise, messages that are cut.
The photos are a known wall; depth, focal lengths and colours that come out are compared with what was recorded."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from itertools import count
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from perception.bags.depth import decode_depth
from perception.bags.frames import FrameOptions, run_frames
from perception.bags.poses import nearest_first
from perception.bags.read import decode_image, encoded
from perception.cli import main
from perception.errors import InputError
from perception.inputs.transforms import read_transforms
from perception.photos.camera_file import lens_of, read_camera
from perception.photos.views import fit_lens
from perception.sfm.options import ReadOptions

pytest.importorskip("rosbags")
from support.bag_recorder import Recorder

SIZE, K = (96, 72), np.array([[60.0, 0, 47.5], [0, 60, 35.5], [0, 0, 1]])
COLOR, DEPTH, COUNT = "/cam/color/image_raw", "/cam/depth/image_raw", 6
ALL = FrameOptions(spacing=1e-3)
MM = np.linspace(600, 3000, 96 * 72).reshape(72, 96).astype(np.uint16)
WALL = cv2.GaussianBlur(np.random.default_rng(0).integers(0, 255, (72, 96, 3)).astype(np.uint8), (0, 0), 1.5)


def photo(number: int) -> np.ndarray:
    """A wall all around, seen 5 pixels farther to the right with each number; all photos are equally sharp."""
    return np.roll(WALL, -5 * number, axis=1)


def png(image: np.ndarray) -> bytes:
    return cv2.imencode(".png", image)[1].tobytes()


def jpg(image: np.ndarray) -> bytes:
    return cv2.imencode(".jpg", image)[1].tobytes()


def record(path: Path, kind: str = "sqlite", color: Callable | None = None, depth: Callable | None = None) -> Path:
    """A bag of COUNT photos with camera_info and tf; color(bag, number, time) and depth write in place of the usual."""
    bag = Recorder(path, kind)
    for number in range(COUNT):
        time = 5 * 10**9 + number * 10**8
        bag.info("/cam/color/camera_info", time, SIZE, K, [0.0] * 5)
        bag.transform("/tf", time, "map", "cam", np.eye(4))
        (color or (lambda b, n, t: b.image(COLOR, t, photo(n))))(bag, number, time)
        if depth is not None:
            depth(bag, number, time)
    bag.close()
    return path


def depths(folder: Path) -> list[np.ndarray]:
    return [cv2.imread(str(file), cv2.IMREAD_UNCHANGED) for file in sorted((folder / "depth").glob("*.png"))]


INVERSE = png(np.round(1e4 / (MM / 1000.0) + 1).astype(np.uint16))


@pytest.mark.parametrize(
    ("kind", "data", "wrong"),
    [
        ("png", png(MM), 0),
        ("", png(MM), 0),
        ("image/png", png(MM), 0),
        ("16UC1; png compressed ", png(MM), 0),
        ("mono16; png compressed mono16", png(MM), 0),
        ("16UC1; compressedDepth png", bytes(12) + png(MM), 0),
        ("16UC1; compressedDepth", png(MM), 0),
        ("png", bytes(12) + png(MM), 0),
        ("32FC1; compressedDepth png", struct.pack("<iff", 0, 1e4, 1.0) + INVERSE, 1),
        ("32FC1; tiff compressed ", cv2.imencode(".tiff", MM.astype(np.float32) / 1000)[1].tobytes(), 0),
    ],
)
def test_a_depth_png_under_any_name_of_its_format(kind: str, data: bytes, wrong: int) -> None:
    """wrong: millimetres by which inverse depth is rounded at 3 m, where a step of 1 / 10000 m is 0.9 mm."""
    depth = decode_depth(SimpleNamespace(format=kind, data=data), "x")
    assert np.abs(1000 * depth - MM).max() <= wrong + 1e-3


@pytest.mark.parametrize(
    ("encoding", "stored"),
    [
        ("mono16", MM),
        ("16SC1", MM.astype(np.int16)),
        ("64FC1", MM / 1000.0),
    ],
)
def test_a_raw_depth_image_of_another_encoding(encoding: str, stored: np.ndarray, tmp_path: Path) -> None:
    """Without options too: 16 bits of one channel are no photo, and the topic is named depth."""
    record(tmp_path / "a", depth=lambda bag, n, t: bag.image(DEPTH, t, stored, encoding=encoding))
    for name, options in {"plain": ALL, "named": FrameOptions(COLOR, depth=DEPTH, spacing=1e-3)}.items():
        facts, _ = run_frames(tmp_path / "a", tmp_path / name, options)
        assert facts["with_depth"] == COUNT and all(np.array_equal(d, MM) for d in depths(tmp_path / name))


def test_topics_without_messages_are_not_asked_for(tmp_path: Path) -> None:
    """As `ros2 bag record -a` leaves of cameras that are off."""

    def silent(bag: Recorder, number: int, time: int) -> None:
        for topic in ("/infra/image_raw", DEPTH):
            if topic not in bag.topics:
                bag.topics[topic] = bag.writer.add_connection(topic, "sensor_msgs/msg/Image", typestore=bag.store)

    record(tmp_path / "a", depth=silent)
    facts, _ = run_frames(tmp_path / "a", tmp_path / "out", ALL)
    assert (facts["topic"], facts["chosen"], facts["depth"]) == (COLOR, COUNT, None)


def test_of_two_depth_topics_one_is_asked_for_or_the_other_named(tmp_path: Path) -> None:
    other = "/cam/depth/image_far"

    def write(topic: str) -> Callable:
        def both(bag: Recorder, number: int, time: int) -> None:
            bag.image(DEPTH, time, MM, encoding="16UC1")
            bag.image(topic, time, 2 * MM, encoding="16UC1")

        return both

    record(tmp_path / "a", depth=write(other))
    with pytest.raises(InputError, match=f"several depth topics, choose one with --depth: {other}, {DEPTH}$"):
        run_frames(tmp_path / "a", tmp_path / "out", ALL)
    assert not (tmp_path / "out").exists()
    run_frames(tmp_path / "a", tmp_path / "out", FrameOptions(depth=other, spacing=1e-3))
    assert all(np.array_equal(d, 2 * MM) for d in depths(tmp_path / "out"))
    record(tmp_path / "b", depth=write("/cam/depth/registered"))
    _, text = run_frames(tmp_path / "b", tmp_path / "better", ALL)
    assert "depth: /cam/depth/registered" in text and f"--depth TOPIC takes {DEPTH}" in text


@pytest.mark.parametrize(
    "kind", ["16UC1; jpeg compressed ", "32FC1; jpeg compressed ", "jpeg", "16UC1; png compressed ", "mono8", "8UC1"]
)
def test_depth_of_8_bits_is_refused_by_name(kind: str, tmp_path: Path) -> None:
    eight = np.clip(MM / 16, 0, 255).astype(np.uint8)

    def write(bag: Recorder, number: int, time: int) -> None:
        if kind in ("mono8", "8UC1"):
            bag.image(DEPTH, time, eight, encoding=kind)
        else:
            bag.jpeg(DEPTH, time, png(eight) if "png" in kind else jpg(eight), name=kind)

    record(tmp_path / "a", depth=write)
    facts, text = run_frames(tmp_path / "a", tmp_path / "out", ALL)
    assert facts["with_depth"] == 0 and facts["chosen"] and not (tmp_path / "out" / "depth").exists()
    assert "depth: left out" in text and "holds 8 bits per pixel" in text and kind.strip() in text
    with pytest.raises(InputError, match="holds 8 bits per pixel"):
        run_frames(tmp_path / "a", tmp_path / "named", FrameOptions(COLOR, depth=DEPTH))


def test_floats_stored_as_whole_numbers_without_their_unit_are_refused() -> None:
    with pytest.raises(InputError, match="whole numbers of an unknown unit"):
        decode_depth(SimpleNamespace(format="32FC1; png compressed ", data=png(MM)), "x")


@pytest.mark.parametrize("pattern", ["rggb", "bggr", "gbrg", "grbg"])
@pytest.mark.parametrize("bits", [8, 16])
def test_a_compressed_mosaic_gets_its_colours(pattern: str, bits: int) -> None:
    color = np.array([40, 120, 220])  # BGR
    cells = dict(zip("bgr", color.tolist(), strict=True))
    mosaic = np.empty((16, 16), np.uint8 if bits == 8 else np.uint16)
    for at, letter in enumerate(pattern):
        mosaic[at // 2 :: 2, at % 2 :: 2] = cells[letter] * (1 if bits == 8 else 257)
    message = SimpleNamespace(format=f"bayer_{pattern}{bits}; png compressed ", data=png(mosaic))
    picture = decode_image(message, "x")
    np.testing.assert_allclose(picture[4:12, 4:12].reshape(-1, 3).mean(axis=0), color, atol=1)
    suffix, data = encoded(message, picture)
    assert suffix == ".png" and cv2.imdecode(np.frombuffer(data, np.uint8), -1).shape == (16, 16, 3)
    flat = np.tile(color.astype(np.uint8), (16, 16, 1))  # a transport that converted before it compressed
    message = SimpleNamespace(format=f"bayer_{pattern}{bits}; jpeg compressed bgr8", data=png(flat))
    np.testing.assert_array_equal(decode_image(message, "x"), flat)


def test_pixels_are_those_of_the_camera_whatever_exif_says() -> None:
    exif = b"Exif\0\0MM\0*\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0\x03\0\0\0\0\0\0"  # turned by 180 degrees
    plain = jpg(photo(0))
    turned = plain[:2] + b"\xff\xe1" + struct.pack(">H", len(exif) + 2) + exif + plain[2:]
    assert not np.array_equal(cv2.imdecode(np.frombuffer(turned, np.uint8), cv2.IMREAD_COLOR), cv2.imdecode(
        np.frombuffer(plain, np.uint8), cv2.IMREAD_COLOR))  # fmt: skip
    np.testing.assert_array_equal(*(decode_image(SimpleNamespace(format="jpeg", data=d), "x") for d in (turned, plain)))


Z = (0.0,)


@pytest.mark.parametrize(
    ("model", "values", "expected"),
    [
        ("rational_polynomial", (0.1, -0.05, 0.001, 0.002, 0.01, *Z * 9), (0.1, -0.05, 0.001, 0.002, 0.01, 0, 0, 0)),
        ("rational_polynomial", (0.1, 0, 0, 0, 0.01, 0.2, 0.3, 0.4, *Z * 4), (0.1, 0, 0, 0, 0.01, 0.2, 0.3, 0.4)),
        ("plumb_bob", (0.1, -0.05, 0, 0, 0.01, *Z * 3), (0.1, -0.05, 0, 0, 0.01, 0, 0, 0)),
        ("plumb_bob", (0.1, -0.05, 0.001, 0.002), (0.1, -0.05, 0.001, 0.002)),
        ("Brown Conrady", Z * 5, ()),
        ("", (0.1, -0.05, 0, 0, 0), (0.1, -0.05, 0, 0)),
        ("", (), ()),
        ("none", (), ()),
        ("None", Z * 5, ()),
        ("Inverse Brown Conrady", Z * 5, ()),
        ("equidistant", (0.01, -0.005, 0.001, 0, 0), (0.01, -0.005, 0.001, 0)),
        ("equidistant", (), Z * 4),
        ("fisheye", (0.01, 0.02, 0.03, 0.04), (0.01, 0.02, 0.03, 0.04)),
    ],
)  # fmt: skip
def test_coefficients_that_drivers_write(model: str, values: tuple, expected: tuple, tmp_path: Path) -> None:
    bag = Recorder(tmp_path / "a", "mcap")
    bag.info("/cam/color/camera_info", 10**9, SIZE, K, list(values), model)
    for number in range(3):
        bag.image(COLOR, 10**9 + number * 10**8, photo(number))
    bag.close()
    run_frames(tmp_path / "a", tmp_path / "out", ALL)
    lens = read_camera(tmp_path / "out" / "camera.yaml")
    np.testing.assert_allclose(lens.params, (60, 60, 48, 36, *expected))
    assert lens.model.endswith("FISHEYE") == (model in ("equidistant", "fisheye"))


@pytest.mark.parametrize(
    ("model", "values", "words"),
    [
        ("rational_polynomial", (*Z * 8, 0.1, *Z * 5), "the first 8 coefficients of rational_polynomial may differ"),
        ("equidistant", (*Z * 4, 0.1), "the first 4 coefficients of equidistant"),
        ("none", (0.1, *Z * 4), "the first 0 coefficients of none"),
        ("plumb_bob", (0.1, *Z * 2), "0, 4, 5, 8, 12, 14 distortion_coefficients, found 3"),
        ("omni", Z * 4, "'omni' is not known"),
    ],
)
def test_coefficients_that_no_lens_here_has(model: str, values: tuple, words: str) -> None:
    data = {"image_width": 96, "image_height": 72, "camera_matrix": K.ravel().tolist(), "distortion_model": model}
    with pytest.raises(InputError, match=words):
        lens_of({**data, "distortion_coefficients": list(values)}, "x")


def with_camera(path: Path, topic: str, D: tuple = Z * 5, K: np.ndarray = K, P: np.ndarray | None = None) -> Path:
    """A bag of images on /oak/rgb/`topic` whose camera_info has these values; P None: all zero."""
    bag, kind = Recorder(path, "mcap"), "sensor_msgs/msg/CameraInfo"
    for number in range(3):
        time = 10**9 + number * 10**8
        roi = bag.type("sensor_msgs/msg/RegionOfInterest")(0, 0, 0, 0, False)
        matrices = {"d": np.array(D), "k": K.ravel(), "r": np.eye(3).ravel(), "p": np.zeros(12) if P is None else P}
        fixed = {"height": 72, "width": 96, "distortion_model": "plumb_bob", "binning_x": 0, "binning_y": 0}
        info = bag.type(kind)(header=bag.header(time, "cam"), roi=roi, **fixed, **matrices)
        bag.write("/oak/rgb/camera_info", kind, time, info)
        bag.image(f"/oak/rgb/{topic}", time, photo(number))
    bag.close()
    return path


@pytest.mark.parametrize("P", [None, np.full(12, np.nan)])
def test_rectified_images_whose_projection_is_not_set(P: np.ndarray | None, tmp_path: Path) -> None:
    run_frames(with_camera(tmp_path / "a", "image_rect", P=P), tmp_path / "out", ALL)
    np.testing.assert_allclose(read_camera(tmp_path / "out" / "camera.yaml").params, (60, 60, 48, 36))
    with pytest.raises(InputError, match=r"no projection matrix P.*--camera"):
        run_frames(with_camera(tmp_path / "b", "image_rect", D=(0.1, *Z * 4), P=P), tmp_path / "b_out")
    with pytest.raises(InputError, match=r"focal lengths positive.*--camera"):
        run_frames(with_camera(tmp_path / "c", "image_raw", K=np.zeros((3, 3))), tmp_path / "c_out")


@pytest.mark.parametrize(
    ("topic", "frame", "right"),
    [
        ("/depth/camera_info", "depth_cam", False),
        ("/stereo/right/camera_info", "right_cam", False),
        ("/thermal/camera_info", "", False),
        ("/cam_info", "cam", True),
        ("/depth/aligned/camera_info", "cam", True),
    ],
)
def test_intrinsics_are_those_of_the_photos_or_none(topic: str, frame: str, right: bool, tmp_path: Path) -> None:
    bag = Recorder(tmp_path / "a", "mcap")
    bag.header = lambda time, name, header=bag.header: header(time, frame if bag.of_info else name)  # type: ignore
    for number in range(3):
        bag.of_info = True  # type: ignore[attr-defined]
        bag.info(topic, 10**9 + number * 10**8, SIZE, K, [0.0] * 5)
        bag.of_info = False  # type: ignore[attr-defined]
        bag.image(COLOR, 10**9 + number * 10**8, photo(number))
    bag.close()
    if right:
        run_frames(tmp_path / "a", tmp_path / "out", ALL)
        assert read_camera(tmp_path / "out" / "camera.yaml").params[0] == 60
        return
    with pytest.raises(InputError, match=f"has no camera_info '/cam/color/camera_info' .found {topic}.*--camera-info"):
        run_frames(tmp_path / "a", tmp_path / "out")


def test_a_recording_of_librealsense(tmp_path: Path) -> None:
    """Its images lie in …/image/data and their camera in …/info/camera_info; depth is mono16, with its own lens."""
    bag = Recorder(tmp_path / "a.bag", "ros1")
    for name, focal in (("sensor_0/Depth_0", 30.0), ("sensor_1/Color_0", 60.0)):
        own = K * np.array([[focal / 60, 1, 1], [1, focal / 60, 1], [1, 1, 1]])
        bag.info(f"/device_0/{name}/info/camera_info", 10**9, SIZE, own, [0.0] * 5, "Brown Conrady")
    for number in range(3):
        time = 10**9 + number * 10**8
        bag.image("/device_0/sensor_0/Depth_0/image/data", time, MM, "0", "mono16")
        bag.image("/device_0/sensor_1/Color_0/image/data", time, photo(number), "0")
    bag.close()
    facts, _ = run_frames(tmp_path / "a.bag", tmp_path / "out", ALL)
    assert facts["topic"].endswith("Color_0/image/data")
    assert read_camera(tmp_path / "out" / "camera.yaml").params[0] == 60


def damaged(what: str) -> Callable:
    """Writes photos of which the second is damaged."""

    def write(bag: Recorder, number: int, time: int) -> None:
        if what in ("empty", "other size"):
            empty = bag.type("sensor_msgs/msg/Image")(bag.header(time, "cam"), 0, 0, "", 0, 0, np.zeros(0, np.uint8))
            if number != 1:
                bag.image(COLOR, time, photo(number))
            elif what == "empty":
                bag.write(COLOR, "sensor_msgs/msg/Image", time, empty)
            else:
                bag.image(COLOR, time, photo(number)[:20, :30])
        else:
            cut = {"empty jpeg": b"", "cut jpeg": jpg(photo(1))[:-200], "cut png": png(photo(1))[:-200]}[what]
            good = png if what == "cut png" else jpg
            bag.jpeg(f"{COLOR}/compressed", time, cut if number == 1 else good(photo(number)))

    return write


@pytest.mark.parametrize("what", ["empty", "other size", "empty jpeg", "cut jpeg", "cut png"])
def test_one_damaged_photo_is_left_out_and_named(what: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    record(tmp_path / "a", color=damaged(what))
    facts, text = run_frames(tmp_path / "a", tmp_path / "out", ALL)
    names = [int(file.stem) for file in sorted((tmp_path / "out" / "images").iterdir())]
    assert names == [0, 2, 3, 4, 5] and facts["images"] == facts["with_pose"] == COUNT - 1
    (line,) = facts["left_out"]
    assert COLOR in line and "1 messages left out, the first number 1" in line and line in text
    assert main(["frames", str(tmp_path / "a"), "-o", str(tmp_path / "no"), "--strict"]) == 2
    assert "message 1: " in (told := capsys.readouterr().err) and "--strict" in told and len(told.splitlines()) == 1
    assert not (tmp_path / "no").exists()


@pytest.mark.parametrize("bad", [0, 3])
@pytest.mark.parametrize("how", ["empty", "cut"])
def test_one_damaged_depth_image_is_left_out(bad: int, how: str, tmp_path: Path) -> None:
    def write(bag: Recorder, number: int, time: int) -> None:
        if number != bad:
            bag.jpeg(DEPTH, time, png(MM), name="16UC1; png compressed ")
        else:
            bag.jpeg(DEPTH, time, b"" if how == "empty" else png(MM)[:-300], name="16UC1; png compressed ")

    record(tmp_path / "a", depth=write)
    facts, text = run_frames(tmp_path / "a", tmp_path / "out", ALL)
    assert facts["with_depth"] == COUNT - 1 and facts["with_pose"] == COUNT and f"the first number {bad}" in text
    assert all(np.array_equal(d, MM) for d in depths(tmp_path / "out"))


@pytest.mark.parametrize("kind", ["ros1", "sqlite", "mcap"])
def test_a_message_cut_in_the_bag_and_a_pose_that_is_not_finite(kind: str, tmp_path: Path) -> None:
    path = tmp_path / ("a.bag" if kind == "ros1" else "a")

    def write(bag: Recorder, number: int, time: int) -> None:
        name = "serialize_ros1" if bag.ros1 else "serialize_cdr"
        whole = getattr(bag.store, name)
        if number == 1:
            bag.store.__dict__[name] = lambda message, kind: bytes(whole(message, kind))[:-1000]
        bag.image(COLOR, time, photo(number))
        bag.store.__dict__.pop(name, None)
        if number == 2:
            bag.transform("/tf", time + 1, "map", "cam", np.block([[np.eye(3), np.full((3, 1), np.nan)], [0, 0, 0, 1]]))

    record(path, kind, write)
    facts, _ = run_frames(path, tmp_path / "out", ALL)
    assert facts["chosen"] == facts["with_pose"] == COUNT - 1
    lines = "\n".join(facts["left_out"])
    assert f"{COLOR}: 1 messages left out, the first number 1: " in lines
    assert "/tf: 1 messages left out, the first number 3: the pose of 'cam' is not finite" in lines


@pytest.mark.parametrize("kind", ["sqlite", "mcap"])
@pytest.mark.parametrize("described", [False, True])
def test_a_folder_whose_recorder_was_killed(kind: str, described: bool, tmp_path: Path) -> None:
    record(tmp_path / "a", kind)
    (tmp_path / "a" / "metadata.yaml").unlink()
    (tmp_path / "a" / "._a_0.mcap").write_bytes(b"\0")  # as macOS leaves beside files
    if described:
        (tmp_path / "a" / "metadata.yaml").write_text("")
    facts, _ = run_frames(tmp_path / "a", tmp_path / "out", ALL)
    assert facts["chosen"] == facts["with_pose"] == COUNT


def test_folders_of_files_that_are_not_one_bag(tmp_path: Path) -> None:
    for name in ("a", "b"):
        record(tmp_path / name, "mcap")
        (tmp_path / name / f"{name}.mcap").rename(tmp_path / name / f"{name}_0.mcap")
        (tmp_path / name / "metadata.yaml").unlink()
    (tmp_path / "b" / "b_0.mcap").rename(tmp_path / "a" / "b_0.mcap")
    with pytest.raises(InputError, match=r"no metadata\.yaml, and a_0\.mcap, b_0\.mcap; give one file"):
        run_frames(tmp_path / "a", tmp_path / "out")
    (tmp_path / "a" / "b_0.mcap").rename(tmp_path / "a" / "a_1.mcap")
    assert run_frames(tmp_path / "a", tmp_path / "out", ALL)[0]["images"] == 2 * COUNT


def test_files_that_were_not_closed(tmp_path: Path) -> None:
    record(tmp_path / "a", "mcap")
    file = tmp_path / "a" / "a.mcap"
    file.write_bytes(file.read_bytes()[:-400])
    with pytest.raises(InputError, match="mcap recover"):
        run_frames(tmp_path / "a", tmp_path / "out")
    record(tmp_path / "b", "sqlite")
    (tmp_path / "b" / "b.db3-wal").write_bytes(b"pages")
    with pytest.raises(InputError, match=r"b\.db3-wal: holds messages that are not in the database yet"):
        run_frames(tmp_path / "b", tmp_path / "out")


@pytest.mark.parametrize("topic", [COLOR, "/arduino"])
@pytest.mark.parametrize("definition", ["", "Definition of a message", "float32[] \u00b0C\n=\n"])
def test_definitions_that_relays_and_serial_bridges_write(topic: str, definition: str, tmp_path: Path) -> None:
    """A definition that is empty or none, of the photos or of what nobody reads, beside the right MD5 sum."""
    bag = Recorder(tmp_path / "a.bag", "ros1")
    kind = "sensor_msgs/msg/Image" if topic == COLOR else "arduino/msg/Degrees"
    md5 = bag.store.generate_msgdef("sensor_msgs/msg/Image")[1]
    bag.topics[topic] = bag.writer.add_connection(topic, kind, msgdef=definition, md5sum=md5)
    for number in range(COUNT):
        time = 5 * 10**9 + number * 10**8
        bag.info("/cam/color/camera_info", time, SIZE, K, [0.0] * 5)
        bag.transform("/tf", time, "map", "cam", np.eye(4))
        bag.image(COLOR, time, photo(number))
    if topic != COLOR:
        bag.writer.write(bag.topics[topic], 10**9, b"\1")
    bag.close()
    facts, _ = run_frames(tmp_path / "a.bag", tmp_path / "out", ALL)
    assert facts["chosen"] == facts["with_pose"] == COUNT


def test_messages_of_mcap_that_are_not_of_ros_2(tmp_path: Path) -> None:
    record(tmp_path / "a", "mcap")
    file = tmp_path / "a.mcap"
    file.write_bytes((tmp_path / "a" / "a.mcap").read_bytes().replace(b"ros2msg", b"ros1msg"))
    with pytest.raises(InputError, match=r"'ros1msg'.*expected ROS 1's \.bag, or ROS 2 messages in \.db3 or \.mcap"):
        run_frames(file, tmp_path / "out")


@pytest.mark.parametrize("own", ["/r2", "/r1"])
def test_a_camera_has_the_poses_of_its_own_robot(own: str, tmp_path: Path) -> None:
    """Two robots with the same names of frames, each with tf below its namespace; they stand at y = 1 and y = 2."""
    bag = Recorder(tmp_path / "a", "sqlite")
    for number in range(COUNT):
        time = 5 * 10**9 + number * 10**8
        for place, robot in enumerate(("/r1", "/r2"), start=1):
            pose = np.eye(4)
            pose[1, 3] = place
            bag.info(f"{robot}/cam/camera_info", time, SIZE, K, [0.0] * 5)
            bag.image(f"{robot}/cam/image_raw", time, photo(number))
            bag.transform(f"{robot}/tf", time, "odom", "base", pose)
            bag.transform(f"{robot}/tf_static", time, "base", "cam", np.eye(4))
    bag.close()
    options = FrameOptions(topic=f"{own}/cam/image_raw", spacing=1e-3)
    facts, _ = run_frames(tmp_path / "a", tmp_path / "out", options)
    frames = json.loads((tmp_path / "out" / "transforms.json").read_text())["frames"]
    assert {frame["transform_matrix"][1][3] for frame in frames} == {float(own[2:])} and len(frames) == COUNT
    assert f"'base' by {own}/tf, not" in facts["poses_from"]


def test_topics_of_the_cameras_robot_come_first() -> None:
    topics = ["/odom", "/r1/odom", "/r2/wheel/odom", "/r2/odom", "/tf"]
    expected = [["/r2/odom"], ["/r2/wheel/odom"], ["/odom", "/tf"], ["/r1/odom"]]
    assert nearest_first(topics, "/r2/cam/image_raw") == expected


@pytest.mark.parametrize("image", [MM.astype(np.float32), np.zeros((72, 96), np.float32)])
def test_depth_that_measures_nothing_is_told(image: np.ndarray, tmp_path: Path) -> None:
    """Floats in millimetres are kilometres by REP 118, beyond what 16 bits of millimetres hold."""
    record(tmp_path / "a", depth=lambda bag, n, t: bag.image(DEPTH, t, image, "cam", "32FC1"))
    facts, _ = run_frames(tmp_path / "a", tmp_path / "out", ALL)
    assert "measures nothing within 65.5 m; expected metres as floats" in facts["depth"] and not facts["with_depth"]
    assert not (tmp_path / "out" / "depth").exists()


def test_transforms_without_a_stamp_have_the_time_of_recording(tmp_path: Path) -> None:
    bag = Recorder(tmp_path / "a", "sqlite")
    bag.header = lambda time, frame, header=bag.header: header(0, frame)
    for number in range(COUNT):
        time = 5 * 10**9 + number * 10**8
        bag.info("/cam/camera_info", time, SIZE, K, [0.0] * 5)
        bag.image("/cam/image_raw", time, photo(number))
        bag.transform("/tf", time, "map", "cam", np.block([[np.eye(3), np.full((3, 1), number)], [0, 0, 0, 1]]))
    bag.close()
    run_frames(tmp_path / "a", tmp_path / "out", ALL)
    frames = json.loads((tmp_path / "out" / "transforms.json").read_text())["frames"]
    assert [frame["transform_matrix"][0][3] for frame in frames] == list(range(COUNT))


def test_photos_have_no_pose_while_a_clock_that_was_set_back_tells_times_twice(tmp_path: Path) -> None:
    """At 10 s it is set back by 3 s: what has a stamp of 7 s to 10 s may be of before or of after. The recorder's own
    clock goes on, as where a recording that is played again is recorded."""
    bag = Recorder(tmp_path / "a", "sqlite")
    recorded, write = count(10**12), bag.writer.write
    bag.writer.write = lambda connection, time, data: write(connection, next(recorded), data)
    for number in range(160):
        time = 5 * 10**9 + number * 10**8 - (3 * 10**9 if number > 50 else 0)
        pose = np.block([[np.eye(3), np.full((3, 1), number)], [0, 0, 0, 1]])
        bag.transform("/tf", time, "map", "cam", pose)
        if number % 20 == 10:  # at 6, 8 and 10 s, and again at 9 s, 11 s, …
            bag.info("/cam/camera_info", time, SIZE, K, [0.0] * 5)
            bag.image("/cam/image_raw", time, photo(number))
    bag.close()
    facts, text = run_frames(tmp_path / "a", tmp_path / "out", ALL)
    frames = json.loads((tmp_path / "out" / "transforms.json").read_text())["frames"]
    found = {frame["stamp_ns"] // 10**9: frame["transform_matrix"][0][3] for frame in frames}
    assert found == {6: 10, 11: 90, 13: 110, 15: 130, 17: 150} and facts["chosen"] == 8
    assert "poses: none at stamps of 'cam' that came twice: its clock was set back" in text


@pytest.mark.parametrize("posed", [True, False])
def test_photos_that_are_binned_or_resized_have_the_camera_of_the_whole_sensor(posed: bool, tmp_path: Path) -> None:
    """Half as large, focal lengths are halved; without poses --camera does it."""
    record(tmp_path / "a", color=lambda bag, n, t: bag.image(COLOR, t, cv2.resize(photo(n), (48, 36))))
    facts, _ = run_frames(tmp_path / "a", tmp_path / "out", ALL)
    assert facts["chosen"] == COUNT
    if posed:
        views = read_transforms(tmp_path / "out", ReadOptions(tmp_path / "work", poses="keep", still=False)).views
        assert len(views) == COUNT and all((v.K[0, 0], v.width, v.K[0, 2]) == (30, 48, 24) for v in views)
    else:
        lens = fit_lens(read_camera(tmp_path / "out" / "camera.yaml"), tmp_path / "out/images/000000.png", False)
        assert lens is not None and (lens.params[0], lens.width) == (30, 48)
