"""RGB-D folders: every layout gives the poses, lenses and depth it was written with, in metres; bad ones one line."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from perception.errors import InputError
from perception.geometry import inverse_se3
from perception.inputs.layouts import open_recording
from perception.inputs.load import load_scene, photo_sizes
from perception.io.cloud import write_cloud
from perception.photos.depth import load_depth
from perception.photos.lens import camera_from_lens
from perception.sfm.options import ReadOptions
from perception.types import PointCloud, Scene
from support.rgbd_folders import COUNT, NAMED, SLOPE, pose, wall_depth, write_recording

LAYOUTS = sorted(NAMED)
CAMERA = """
image_width: 160
image_height: 120
camera_matrix: {data: [100, 0, 79.5, 0, 100, 59.5, 0, 0, 1]}
distortion_model: plumb_bob
distortion_coefficients: {data: [0, 0, 0, 0, 0]}
"""


def loaded(source: Path, folder: Path, camera: Path | None = None) -> Scene:
    """The scene, started from a cloud on the wall so that no features are needed."""
    x, y = np.meshgrid(np.linspace(-1, 1, 9), np.linspace(-1, 1, 9))
    write_cloud(folder / "c.ply", PointCloud(np.stack([x, y, 2 + SLOPE * x], axis=-1).reshape(-1, 3)))
    return load_scene(source, ReadOptions(folder / "work", init_points=folder / "c.ply", camera=camera, poses="keep"))


def number(name: str, layout: str) -> int:
    """The frame that a photo's name means."""
    digits = Path(name).name.partition(".png")[0]
    if layout == "tum":
        return round((float(digits) - 100) * 10)
    return int("".join(c for c in digits if c.isdigit())) - (layout == "redwood")


def test_lists_of_absolute_paths(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = write_recording(tmp_path, "tum")
    before = open_recording(source)
    for name in ("rgb", "depth"):
        file = source / f"{name}.txt"
        file.write_text(file.read_text().replace(f" {name}/", f" {source}/{name}/"))
    monkeypatch.chdir(tmp_path)
    after = open_recording(Path(source.name))
    assert [frame.name for frame in after.frames] == [frame.name for frame in before.frames]
    (source / "rgb").rename(tmp_path / "elsewhere")
    (source / "rgb.txt").write_text(
        (source / "rgb.txt").read_text().replace(f"{source}/rgb/", f"{tmp_path}/elsewhere/")
    )
    with pytest.raises(InputError, match=r"'\.\./elsewhere/100\.100000\.png' leaves its folder") as caught:
        loaded(source, tmp_path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_hidden_files_that_macos_leaves_are_passed_over(layout: str, tmp_path: Path) -> None:
    source = write_recording(tmp_path, layout)
    before = open_recording(source)
    for file in [path for path in source.rglob("*") if path.is_file()]:
        file.with_name(f"._{file.name}").write_bytes(
            b"\x00\x05\x16\x07\x00\x02\x00\x00Mac OS X" + bytes(range(128, 256))
        )
    after = open_recording(source)
    assert after.lens == before.lens and after.notes == before.notes
    for a, b in zip(before.frames, after.frames, strict=True):
        assert (a.name, a.photo, a.depth) == (b.name, b.photo, b.depth)
        np.testing.assert_array_equal(a.world_from_camera, b.world_from_camera)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_poses_lenses_and_depth_of_each_layout(layout: str, tmp_path: Path) -> None:
    source = write_recording(tmp_path, layout)
    scene = loaded(source, tmp_path)
    assert scene.metric and "metres" in scene.report["scale"]["source"]
    frames = [number(view.name, layout) for view in scene.views]
    # f / width (11 · 0.04 rad + 11 · 0.05 m / (2 to 2.5 m)) is 0.54 to 0.63 of the width: 7 or 8 stretches of 0.08.
    assert len(frames) in (7, 8) and len(set(frames)) == len(frames) and (layout != "scannet" or 5 not in frames)
    assert f"{len(frames)} of {COUNT - (layout == 'scannet')} frames chosen" in scene.report["notes"][0]
    for view, index in zip(scene.views, frames, strict=True):
        np.testing.assert_allclose(inverse_se3(view.camera_from_world), pose(index), atol=1e-6)
        true, _ = wall_depth(view.K, pose(index), view.width, view.height)
        found = load_depth(view, view.width, view.height)
        seen = found > 0
        assert seen.mean() > 0.75 and not seen[0].any()  # the top rows are 0 and saturated
        # The nearest depth pixel is half a pixel away at most (0.6 of the photo's where lenses differ); 1 mm is a unit.
        bound = 0.65 * np.abs(np.gradient(true, axis=1)) + 1e-3
        assert (np.abs(found - true) < bound)[seen].all()


def test_the_order_and_number_of_frames_do_not_depend_on_the_run(tmp_path: Path) -> None:
    source = write_recording(tmp_path, "3dmatch")
    (tmp_path / "again").mkdir()
    first, second = (loaded(source, folder) for folder in (tmp_path, tmp_path / "again"))
    assert [view.name for view in first.views] == [view.name for view in second.views]
    assert photo_sizes(source).what == f"at most {COUNT} of {COUNT} frames"


def test_published_lenses_of_tum_equal_opencv(tmp_path: Path) -> None:
    source = write_recording(tmp_path, "tum").rename(tmp_path / "freiburg1_x")
    lens = open_recording(source).lens
    ray = np.array([[0.2, -0.1, 1.0]])
    K, D = np.array([[517.3, 0, 318.6], [0, 516.5, 255.3], [0, 0, 1]]), (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)
    expected, _ = cv2.projectPoints(ray, np.zeros(3), np.zeros(3), K, np.array(D))
    assert lens is not None
    np.testing.assert_allclose(camera_from_lens(lens).img_from_cam(ray)[0], expected[0, 0] + 0.5, atol=1e-9)
    with pytest.raises(InputError, match="give --camera"):
        loaded(source.rename(tmp_path / "mine"), tmp_path)
    (tmp_path / "camera.yaml").write_text(CAMERA)
    scene = loaded(tmp_path / "mine", tmp_path, tmp_path / "camera.yaml")
    assert [view.K[0, 0] for view in scene.views] == [100.0] * len(scene.views)


def _edit(file: Path, old: str, new: str) -> None:
    file.write_text(file.read_text().replace(old, new))


def _depth(source: Path, value: int) -> None:
    for file in source.rglob("*.png"):
        image = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
        if image is not None and image.dtype == np.uint16:
            cv2.imwrite(str(file), np.full_like(image, value))


def _later(source: Path) -> None:
    rows = [line.split() for line in (source / "depth.txt").read_text().splitlines()]
    (source / "depth.txt").write_text("\n".join(f"{float(time) + 77} {name}" for time, name in rows))


def _as_replica(source: Path) -> None:
    """Photos and depth in one folder, poses in a traj.txt that is not read."""
    (source / "wall.log").rename(source / "traj.txt")
    (source / "results").mkdir()
    for folder, kind in (("image", "frame"), ("depth", "depth")):
        for file in list((source / folder).iterdir()):
            file.rename(source / "results" / f"{kind}{file.name}")
        (source / folder).rmdir()


NO_POSES = r"has depth images \((depth|results)/[\w.]+\) but no poses"
BAD = [
    ("tum", lambda s: (s / "groundtruth.txt").unlink(), "groundtruth.txt: missing"),
    ("tum", _later, "do rgb.txt and depth.txt use one clock"),
    ("tum", lambda s: (s / "groundtruth.txt").write_text("1 0 0 0 0 0 0 1"), "no photo lies between two poses"),
    ("tum", lambda s: (s / "groundtruth.txt").write_text("1 0 0 0 0 0 0 0"), "quaternion is not zero"),
    ("tum", lambda s: (s / "groundtruth.txt").write_text("1 0 x"), "expected lines of 8 numbers"),
    ("tum", lambda s: (s / "groundtruth.txt").write_text("1 nan 0 0 0 0 0 1"), "holds no pose of finite numbers"),
    ("tum", lambda s: (s / "rgb.txt").write_text("abc"), "expected lines 'time file'"),
    ("tum", lambda s: _edit(s / "groundtruth.txt", ".", ","), "has a decimal comma"),
    ("scannet", lambda s: _edit(s / "intrinsic/intrinsic_color.txt", ".", ","), "has a decimal comma"),
    ("scannet", lambda s: shutil.rmtree(s / "intrinsic"), "give --camera"),
    ("scannet", lambda s: np.savetxt(s / "intrinsic/intrinsic_color.txt", np.eye(4) * 900), "were they resized"),
    ("scannet", lambda s: np.savetxt(s / "pose/3.txt", np.eye(3)), "expected lines of 4 numbers"),
    ("scannet", lambda s: shutil.rmtree(s / "depth"), "no photo has a depth image"),
    ("7scenes", lambda s: _depth(s, 0), "hold nothing measured"),
    ("7scenes", lambda s: _depth(s, 65535), "hold nothing measured"),
    ("7scenes", lambda s: _depth(s, 2), "median depth is 0.002 m if 1000 stored units"),
    ("3rscan", lambda s: _edit(s / "_info.txt", "m_depthShift", "m_shift"), "_info.txt: expected lines 'm_calibration"),
    ("redwood", lambda s: (s / "depth/000001.png").unlink(), "12 photos in image/, 11 images in depth/"),
    ("redwood", lambda s: (s / "wall.log").write_text("0 0 1\n1 0 0 0"), "blocks of a line"),
    ("redwood", lambda s: _edit(s / "wall.log", "11 11 12\n", "11 11 12\n9 "), "blocks of a line"),
    ("redwood", lambda s: (s / "b.log").write_text("0"), "several trajectories"),
    ("redwood", lambda s: (s / "camera_intrinsic.json").write_text("{}"), "Open3D's camera intrinsics"),
    ("redwood", lambda s: (s / "wall.log").unlink(), NO_POSES),
    ("redwood", _as_replica, NO_POSES),
]


@pytest.mark.parametrize(("layout", "damage", "words"), BAD, ids=[f"{layout}: {words}" for layout, _, words in BAD])
def test_bad_recordings_are_one_line(layout: str, damage, words: str, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    source = write_recording(tmp_path, layout)
    damage(source)
    with pytest.raises(InputError, match=words) as caught:
        if words == NO_POSES:
            load_scene(source, ReadOptions(tmp_path / "work"))
        loaded(source, tmp_path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("matrix", [np.diag([-1.0, 1, 1, 1]), 2 * np.eye(4)], ids=["mirrored", "scaled"])
def test_one_frame_with_a_wrong_pose_is_left_out(matrix: np.ndarray, tmp_path: Path) -> None:
    source = write_recording(tmp_path, "scannet")
    np.savetxt(source / "pose/3.txt", matrix)
    scene = loaded(source, tmp_path)
    assert len(scene.views) >= 7 and "color/3.png" not in {view.name for view in scene.views}
    (entry,) = scene.report["left_out"]
    assert entry["name"] == "color/3.png" and "not a rigid transform" in entry["why"]
    with pytest.raises(InputError, match=r"color/3\.png is not a rigid"):
        load_scene(source, ReadOptions(tmp_path / "strict", strict=True))


def test_one_photo_of_another_shape_is_left_out(tmp_path: Path) -> None:
    source = write_recording(tmp_path, "scannet")
    names = {view.name for view in loaded(source, tmp_path).views}
    odd = source / sorted(names)[2]
    cv2.imwrite(str(odd), cv2.imread(str(odd))[:-30])  # the pattern is as sharp, so the same frames are chosen
    scene = loaded(source, tmp_path)
    assert {view.name for view in scene.views} == names - {sorted(names)[2]}
    (entry,) = scene.report["left_out"]
    assert entry["name"] == sorted(names)[2] and "but its camera says" in entry["why"]
    with pytest.raises(InputError, match="but its camera says"):
        load_scene(source, ReadOptions(tmp_path / "strict", strict=True))


@pytest.mark.parametrize("layout", ["scannet", "3dmatch", "redwood"])
def test_a_camera_file_takes_the_place_of_wrong_intrinsics(layout: str, tmp_path: Path) -> None:
    source = write_recording(tmp_path, layout)
    matrices = [*source.rglob("intrinsic_color.txt"), *source.parent.rglob("camera-intrinsics.txt")]
    for file in matrices:
        np.savetxt(file, np.eye(4) * 900)
    if not matrices:
        (source / "camera_intrinsic.json").write_text("{}")
    with pytest.raises(InputError, match=r"were they resized|Open3D's camera intrinsics"):
        loaded(source, tmp_path)
    (tmp_path / "camera.yaml").write_text(CAMERA)
    assert {view.K[0, 0] for view in loaded(source, tmp_path, tmp_path / "camera.yaml").views} == {100.0}


@pytest.mark.parametrize("layout", ["scannet", "3dmatch", "7scenes", "redwood", "tum"])
def test_a_first_photo_that_is_empty_is_left_out(layout: str, tmp_path: Path) -> None:
    source = write_recording(tmp_path, layout)
    first = open_recording(source).frames[0]
    first.photo.write_bytes(b"")
    scene = loaded(source, tmp_path)
    assert first.name in {entry["name"] for entry in scene.report["left_out"]} and len(scene.views) >= 6


def _backslashes(source: Path) -> None:
    for name in ("rgb.txt", "depth.txt"):
        _edit(source / name, "/", "\\")


def _capitals(source: Path) -> None:
    for name in ("rgb.txt", "depth.txt"):
        _edit(source / name, ".png", ".PNG")


def _marked(source: Path) -> None:
    for name in ("rgb.txt", "depth.txt", "groundtruth.txt"):
        (source / name).write_text((source / name).read_text(), encoding="utf-8-sig")


def _blanks(source: Path) -> None:
    (source / "rgb").rename(source / "my rgb")
    _edit(source / "rgb.txt", " rgb", " my rgb")


@pytest.mark.parametrize("change", [_backslashes, _capitals, _marked, _blanks])
def test_lists_of_other_systems_give_the_same_scene(change: Callable[[Path], None], tmp_path: Path) -> None:
    plain = loaded(write_recording(tmp_path, "tum"), tmp_path)
    (tmp_path / "other").mkdir()
    source = write_recording(tmp_path / "other", "tum")
    change(source)
    scene = loaded(source, tmp_path / "other")
    assert [view.photo.name for view in scene.views] == [view.photo.name for view in plain.views]
    for view, other in zip(plain.views, scene.views, strict=True):
        np.testing.assert_array_equal(view.camera_from_world, other.camera_from_world)
        assert other.depth is not None and view.depth is not None and other.depth.path.name == view.depth.path.name


@pytest.mark.parametrize("lost", ["nan nan nan 0 0 0 1", "0 0 0 0 0 0 0"])
def test_a_row_where_tracking_was_lost_and_a_photo_that_is_missing_leave_the_rest(lost: str, tmp_path: Path) -> None:
    source = write_recording(tmp_path, "tum")
    first = sorted((source / "rgb").iterdir())[0]
    first.unlink()
    rows = (source / "groundtruth.txt").read_text().splitlines()
    time = rows[-1].split()[0]
    (source / "groundtruth.txt").write_text("\n".join([*rows, f"{float(time) + 0.01} {lost}"]))
    scene = loaded(source, tmp_path)
    assert len(scene.views) >= 6 and f"rgb/{first.name}" not in {view.name for view in scene.views}


def test_phone_depth_of_another_size_and_lenses_per_frame(tmp_path: Path) -> None:
    """As Polycam, Record3D and the like are converted: 256×192 depth in millimetres beside 1920×1440 photos."""
    frames = []
    for index, focal in enumerate((1500.0, 1400.0)):
        K = np.array([[focal, 0, 960.0], [0, focal, 720.0], [0, 0, 1]])
        small = np.diag([256 / 1920, 192 / 1440, 1.0]) @ K
        depth, _ = wall_depth(small, pose(index), 256, 192)
        cv2.imwrite(str(tmp_path / f"{index}.jpg"), np.zeros((1440, 1920, 3), np.uint8))
        cv2.imwrite(str(tmp_path / f"{index}.png"), np.round(1000 * depth).astype(np.uint16))
        world = (pose(index) @ np.diag([1, -1, -1, 1])).tolist()
        lens = {"fl_x": focal, "fl_y": focal, "cx": 960, "cy": 720, "w": 1920, "h": 1440}
        frames.append(
            {"file_path": f"{index}.jpg", "depth_file_path": f"{index}.png", "transform_matrix": world, **lens}
        )
    (tmp_path / "transforms.json").write_text(json.dumps({"frames": frames}))
    scene = loaded(tmp_path, tmp_path)
    for index, view in enumerate(scene.views):
        found = load_depth(view, 800, 600)
        true, _ = wall_depth(np.diag([800 / 1920, 600 / 1440, 1.0]) @ view.K, pose(index), 800, 600)
        assert (
            np.abs(found - true) < 2 * np.abs(np.gradient(true, axis=1)) + 1e-3
        ).all()  # depth pixels are 3 times larger


def test_a_pose_that_was_lost_as_older_visual_c_writes_it(tmp_path: Path) -> None:
    source = write_recording(tmp_path, "3rscan")
    lost = " ".join(["-1.#INF"] * 3 + ["-1.#IND"])
    (source / "frame-000003.pose.txt").write_text("\n".join([lost] * 4))
    assert [number(frame.name, "3rscan") for frame in open_recording(source).frames] == [
        i for i in range(COUNT) if i != 3
    ]


def test_notes_named_info_are_no_lenses(tmp_path: Path) -> None:
    source = write_recording(tmp_path, "7scenes")
    before = open_recording(source).lens
    (source / "info.txt").write_text("taken on a rainy day\n")
    assert open_recording(source).lens == before


def test_scannets_choice_of_frames_has_its_intrinsics_beside_the_folders(tmp_path: Path) -> None:
    source = write_recording(tmp_path, "scannet")
    before = open_recording(source)
    for kind in ("color", "depth"):
        (source / f"intrinsic/intrinsic_{kind}.txt").rename(source / f"intrinsics_{kind}.txt")
    after = open_recording(source)
    assert (after.lens, after.depth_lens) == (before.lens, before.depth_lens) and after.lens is not None


@pytest.mark.parametrize("damage", ["cut", "cropped", "8 bits", "missing"])
def test_one_damaged_depth_image_is_not_used_and_named(damage: str, tmp_path: Path) -> None:
    source = write_recording(tmp_path, "redwood")
    scene = loaded(source, tmp_path)
    names = [view.name for view in scene.views]
    assert scene.views[1].depth is not None
    file = scene.views[1].depth.path
    image = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
    if damage == "cut":
        file.write_bytes(file.read_bytes()[:200])
    elif damage == "missing":
        poses = {view.name: (np.linalg.inv(view.camera_from_world) @ np.diag([1, -1, -1, 1])) for view in scene.views}
        frames = [
            {"file_path": n, "depth_file_path": n.replace("image", "depth"), "transform_matrix": m.tolist()}
            for n, m in poses.items()
        ]
        K = dict(zip(("fl_x", "fl_y", "cx", "cy"), (140.0, 141.0, 79.5, 61.0), strict=True))
        (source / "transforms.json").write_text(json.dumps({**K, "frames": frames}))
        (source / "wall.log").unlink()
        file.unlink()
    else:
        cv2.imwrite(str(file), image[:, 40:] if damage == "cropped" else (image // 256).astype(np.uint8))
    (tmp_path / "again").mkdir()
    scene = loaded(source, tmp_path / "again")
    assert [view.name.split("/")[-1] for view in scene.views] == [name.split("/")[-1] for name in names]
    assert [view.depth is None for view in scene.views] == [i == 1 for i in range(len(names))]
    assert any(f"1 depth images are not used, such as {file}: " in each for each in scene.report["warnings"])
    with pytest.raises(InputError, match=str(file)):
        load_scene(source, ReadOptions(tmp_path / "strict", strict=True))
