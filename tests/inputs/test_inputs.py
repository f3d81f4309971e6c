"""Inputs: exact poses out of files written here, pixels against pycolmap and closed forms, and every bad input."""

import errno
import json
import sqlite3
import threading

import cv2
import numpy as np
import pytest
from PIL import Image

from perception.errors import InputError
from perception.geometry import align_similarity, inverse_se3
from perception.inputs import readers
from perception.inputs.load import load_scene, photo_sizes
from perception.inputs.transforms import read_frames
from perception.io import atomic
from perception.io.atomic import atomic_directory, atomic_file, recover
from perception.photos.camera_file import read_camera
from perception.photos.decode import load_photo, read_photo, scaled_K, scaled_size, warp_labels
from perception.photos.lens import camera_from_lens, load_pycolmap, pinhole_from_lens
from perception.photos.views import make_view
from perception.posed import triangulate
from perception.progress import Progress
from perception.sfm import pairs
from perception.sfm.options import ReadOptions
from perception.types import Lens, Scene, View
from support.aimed import look_at
from support.rotations import rotation_from_quaternion

DISTORTED = Lens("OPENCV", (90.0, 91.0, 49.0, 41.0, 0.06, -0.05, 0.001, -0.002), 100, 80)


def picture(path, mode="RGB", size=(60, 40), seed=0, **options):
    array = np.random.default_rng(seed).integers(0, 255, (size[1], size[0], 3), dtype=np.uint8)
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(array).convert(mode).save(path, **options)
    return array


def pinhole_view(path, size=(60, 40)):
    K = np.array([[50.0, 0, size[0] / 2], [0, 50.0, size[1] / 2], [0, 0, 1]])
    return View(path.name, path, K, *size, np.eye(4))


def write_transforms(folder, count=3, **changes):
    frames = []
    for index in range(count):
        picture(folder / "images" / f"{index}.png", seed=index)
        pose = inverse_se3(look_at(np.array([index, -3.0, 1.0]), np.zeros(3), np.array([0, 0, 1.0])))
        frames.append({"file_path": f"images/{index}.png", "transform_matrix": pose @ np.diag([1, -1, -1, 1])})
    data = {"w": 60, "h": 40, "fl_x": 50.0, "fl_y": 51.0, "cx": 29.0, "cy": 21.0, "frames": frames, **changes}
    file = folder / "transforms.json"
    file.write_text(json.dumps(data, default=lambda matrix: matrix.tolist()))
    return file, data


def test_similarity_alignment_recovers_a_known_transform():
    rng = np.random.default_rng(1)
    b = rng.normal(size=(20, 3))
    rotation = rotation_from_quaternion(np.array([0.9, 0.1, -0.3, 0.2]))
    scale, found, shift = align_similarity(2.5 * b @ rotation.T + [1, 2, 3], b)
    assert scale == pytest.approx(2.5)
    np.testing.assert_allclose(found, rotation, atol=1e-12)
    np.testing.assert_allclose(shift, [1, 2, 3], atol=1e-12)


def test_transforms_poses_and_intrinsics_survive(tmp_path, monkeypatch):
    file, data = write_transforms(tmp_path, frames_note="x")
    data["frames"][1]["fl_x"] = 70.0
    data["frames"].append({"file_path": "images/gone.png", "transform_matrix": np.eye(4)})
    file.write_text(json.dumps(data, default=lambda matrix: matrix.tolist()))
    scene = load_scene(tmp_path, ReadOptions(tmp_path / "work"))
    assert [view.name for view in scene.views] == ["0.png", "1.png", "2.png"]
    assert scene.report["left_out"][0]["name"] == "images/gone.png"
    assert [view.K[0, 0] for view in scene.views] == [50.0, 70.0, 50.0]
    for index, view in enumerate(scene.views):
        expected = look_at(np.array([index, -3.0, 1.0]), np.zeros(3), np.array([0, 0, 1.0]))
        np.testing.assert_allclose(view.camera_from_world, expected, atol=1e-12)
    assert scene.report["points_from"] == "random" and scene.report["warnings"]  # noise photos: nothing matches
    assert len(scene.points) == triangulate.FALLBACK_POINTS and not scene.metric


def test_transforms_angle_gives_the_focal_length(tmp_path):
    file, _ = write_transforms(tmp_path, fl_x=None, fl_y=None, camera_angle_x=2 * np.arctan(0.5))
    assert read_frames(file)[0][2].params[:2] == pytest.approx((60.0, 60.0))


@pytest.mark.parametrize(
    ("changes", "k"),
    [
        ({"distortion_params": [0.1, -0.05, 0.02, 0, 0.003, -0.004]}, (0.1, -0.05, 0.003, -0.004, 0.02)),
        ({"camera_model": "full_opencv", "k1": 0.1, "k4": 0.2}, (0.1, 0, 0, 0, 0, 0.2, 0, 0)),
        ({"k1": 0.1, "k4": 0.2, "k5": 0.0}, (0.1, 0, 0, 0, 0, 0.2, 0, 0)),
    ],
)
def test_distortion_of_transforms_against_opencv(changes, k, tmp_path):
    file, data = write_transforms(tmp_path, **changes)
    rays = np.array([[0.0, 0, 1], [0.3, -0.2, 1], [-0.4, 0.35, 1]])
    K = np.array([[data["fl_x"], 0, data["cx"]], [0, data["fl_y"], data["cy"]], [0, 0, 1]])
    expected = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), K, np.array(k, np.float64))[0][:, 0]
    found = camera_from_lens(read_frames(file)[0][2]).img_from_cam(rays)
    np.testing.assert_allclose(found, expected, atol=1e-9)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"w": 61}, "60×40"),
        ({"frames": []}, "empty"),
        ({"fl_x": "a"}, "fl_x"),
        ({"camera_model": "ODD"}, "ODD"),
        ({"camera_model": "OPENCV", "k1": 0.1, "k4": 0.02}, "k4 = 0.02.*r⁸"),
        ({"camera_model": "OPENCV_FISHEYE", "p1": 0.02}, "p1 = 0.02"),
        ({"camera_model": "PINHOLE", "k1": 0.1}, "k1 = 0.1"),
        ({"distortion_params": [0.1, 0.02]}, r"found \[0.1, 0.02\]"),
        ({"fl_x": 0.83, "fl_y": 1.25, "cx": 0.5, "cy": 0.5}, r"focal lengths 0.83, 1.25 .* expected 1.2 to .* pixels"),
    ],
)
def test_bad_transforms_are_one_clear_line(tmp_path, changes, words):
    file, _ = write_transforms(tmp_path, **changes)
    with pytest.raises(InputError, match=words) as error:
        load_scene(file, ReadOptions(tmp_path / "work"))
    assert "\n" not in str(error.value)


def test_one_frame_with_a_nan_pose_is_left_out(tmp_path):
    file, data = write_transforms(tmp_path)
    data["frames"][2]["transform_matrix"][0, 3] = np.nan
    file.write_text(json.dumps(data, default=lambda matrix: matrix.tolist()))
    scene = load_scene(file, ReadOptions(tmp_path / "work"))
    assert [view.name for view in scene.views] == ["0.png", "1.png"]
    assert "NaN" in scene.report["left_out"][0]["why"] and scene.report["left_out"][0]["name"] == "2.png"
    with pytest.raises(InputError, match=r"images/2.png.*NaN"):
        load_scene(file, ReadOptions(tmp_path / "strict", strict=True))


@pytest.mark.parametrize("suffix", ["bin", "txt"])
def test_colmap_workspace_round_trip(tmp_path, suffix):
    pycolmap = load_pycolmap()
    pycolmap.set_random_seed(0)
    options = pycolmap.SyntheticDatasetOptions()
    options.camera_width, options.camera_height, options.camera_params = 60, 40, [60.0, 30.0, 20.0, 0.02]
    truth = pycolmap.synthesize_dataset(options)
    sparse = tmp_path / "sparse" / "0"
    sparse.mkdir(parents=True)
    (truth.write_binary if suffix == "bin" else truth.write_text)(sparse)
    for image in truth.images.values():
        picture(tmp_path / "images" / image.name)
    (tmp_path / "transforms.json").write_text("{}")  # a workspace is read as one even if it holds more
    scene = load_scene(tmp_path, ReadOptions(tmp_path / "work"))
    assert [v.name for v in scene.views] == sorted(image.name for image in truth.images.values())
    for view in scene.views:
        expected = truth.find_image_with_name(view.name).cam_from_world().matrix()
        np.testing.assert_allclose(view.camera_from_world[:3], expected, atol=1e-9)
    assert len(scene.points) == truth.num_points3D()


def test_empty_sparse_model(tmp_path):
    picture(tmp_path / "images" / "0.png")
    (tmp_path / "sparse").mkdir()
    load_pycolmap().Reconstruction().write_text(tmp_path / "sparse")
    with pytest.raises(InputError, match="empty"):
        load_scene(tmp_path, ReadOptions(tmp_path / "work"))


def test_folders_that_are_no_scene(tmp_path):
    for read in (lambda path: load_scene(path, ReadOptions(tmp_path / "work")), photo_sizes):
        for name in ("gone", "gone.json", "gone.mp4"):
            with pytest.raises(InputError, match=f"{name}: no such file or folder; expected a folder of photos"):
                read(tmp_path / name)
    (tmp_path / "photos").mkdir()
    with pytest.raises(InputError, match="no photos"):
        load_scene(tmp_path / "photos", ReadOptions(tmp_path / "work"))
    for bag in ("drive.bag", "drive/drive_0.mcap", "old/old_0.db3"):
        (tmp_path / bag).parent.mkdir(exist_ok=True)
        (tmp_path / bag).write_bytes(b"")
        for source in {tmp_path / bag, (tmp_path / bag).parent} - {tmp_path}:
            with pytest.raises(InputError, match=r"is a ROS bag; .* perception frames"):
                load_scene(source, ReadOptions(tmp_path / "work"))
    picture(tmp_path / "photos" / "a.png")
    picture(tmp_path / "photos" / "b.png", seed=1)
    (tmp_path / "photos" / "a.bag").write_bytes(b"")  # beside photos
    with pytest.raises(InputError, match="at least 3"):
        load_scene(tmp_path / "photos", ReadOptions(tmp_path / "work"))
    picture(tmp_path / "photos" / "c.png", seed=2)
    with pytest.raises(InputError, match="could be registered"):
        load_scene(tmp_path / "photos", ReadOptions(tmp_path / "work"))
    camera = tmp_path / "camera.yaml"
    camera.write_text(CAMERA)
    with pytest.raises(InputError, match="camera file says 100×80"):
        load_scene(tmp_path / "photos", ReadOptions(tmp_path / "work", camera=camera))
    camera.write_text(CAMERA.replace("100", "241").replace("80", "161"))  # the photos are a quarter, rounded down
    with pytest.raises(InputError, match="could be registered"):
        load_scene(tmp_path / "photos", ReadOptions(tmp_path / "work", camera=camera))
    data = (tmp_path / "photos" / "c.png").read_bytes()
    (tmp_path / "photos" / "c.png").write_bytes(data[: len(data) // 2])
    with pytest.raises(InputError, match=r"c.png.*(truncated|damaged)"):
        load_scene(tmp_path / "photos", ReadOptions(tmp_path / "work"))


def test_a_camera_file_is_scaled_to_the_largest_photos_and_turned_ones_are_told(tmp_path, monkeypatch):
    sizes = {"a_pano.jpg": (200, 40), "b_small/1.jpg": (25, 20), "c/1.jpg": (50, 40), "c/2.jpg": (50, 40)}
    for number, (name, size) in enumerate(sizes.items()):
        exif = Image.Exif()
        exif[0x0112] = 3 if name == "c/2.jpg" else 1
        picture(tmp_path / "photos" / name, size=size, seed=number, exif=exif)
    (tmp_path / "camera.yaml").write_text(CAMERA)
    used = []

    def scene_of(folder, options):
        used.append(options.lens)
        views = [pinhole_view(folder / name, size) for name, size in sizes.items() if name[0] == "c"]
        views.append(pinhole_view(folder / "c/1.jpg"))
        return Scene(views, np.zeros((0, 3)), np.zeros((0, 3), np.uint8), report={"warnings": [], "seconds": {}})

    monkeypatch.setattr(readers, "reconstruct", scene_of)
    scene = load_scene(tmp_path / "photos", ReadOptions(tmp_path / "work", camera=tmp_path / "camera.yaml"))
    # The camera of 100 × 80 at half its size; the file counts pixels from the centre of the first one.
    assert used[0].params[:4] == pytest.approx((45, 45.5, (48.5 + 0.5) / 2, (40.5 + 0.5) / 2))
    (told,) = scene.report["warnings"]
    assert "1 of 3 photos, such as 2.jpg, were taken with the camera turned" in told


CAMERA = """
image_width: 100
image_height: 80
camera_matrix: {rows: 3, cols: 3, data: [90, 0, 48.5, 0, 91, 40.5, 0, 0, 1]}
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [0.06, -0.05, 0.001, -0.002, 0]}
"""


def test_camera_file_against_opencv(tmp_path):
    (tmp_path / "camera.yaml").write_text(CAMERA)
    lens = read_camera(tmp_path / "camera.yaml")
    assert lens == DISTORTED
    ray = np.array([[0.2, -0.1, 1.0]])
    K = np.array([[90, 0, 48.5], [0, 91, 40.5], [0, 0, 1]])
    expected, _ = cv2.projectPoints(ray, np.zeros(3), np.zeros(3), K, np.array([0.06, -0.05, 0.001, -0.002, 0]))
    np.testing.assert_allclose(camera_from_lens(lens).img_from_cam(ray)[0], expected[0, 0] + 0.5, atol=1e-9)


def test_a_camera_file_without_distortion_says_that_it_is_missing(tmp_path):
    (tmp_path / "camera.yaml").write_text(CAMERA.partition("distortion_coefficients")[0])
    with pytest.raises(InputError, match="14 distortion_coefficients, found no list of them"):
        read_camera(tmp_path / "camera.yaml")


@pytest.mark.parametrize("data", ["90, 0, 0, 0, 91, 0, 48.5, 40.5, 1", "90, 3, 48.5, 0, 91, 40.5, 0, 0, 1"])
def test_a_camera_matrix_by_columns_or_with_skew_is_refused(data, tmp_path):
    (tmp_path / "camera.yaml").write_text(CAMERA.replace("90, 0, 48.5, 0, 91, 40.5, 0, 0, 1", data))
    with pytest.raises(InputError, match=f"row by row, found {data.replace(',', '')}"):
        read_camera(tmp_path / "camera.yaml")


def test_exif_grey_sixteen_bit_and_alpha(tmp_path):
    exif = Image.Exif()
    exif[0x0112] = 6
    upright = picture(tmp_path / "turned.png", exif=exif)
    np.testing.assert_array_equal(read_photo(tmp_path / "turned.png"), np.rot90(upright, -1))
    deep = (np.arange(2400).reshape(40, 60) * 27).astype(np.uint16)
    Image.fromarray(deep).save(tmp_path / "deep.png")
    expected = np.repeat(np.floor(deep / 257 + 0.5).astype(np.uint8)[..., None], 3, 2)
    np.testing.assert_array_equal(read_photo(tmp_path / "deep.png"), expected)
    rgba = np.full((40, 60, 4), 200, np.uint8)
    rgba[:20, :, 3] = 0
    rgba[20:, :, 3] = 255
    Image.fromarray(rgba).save(tmp_path / "alpha.png")
    photo = read_photo(tmp_path / "alpha.png")
    assert photo[:20].max() == 0 and photo[20:].min() == 200
    picture(tmp_path / "grey.png", mode="L")
    assert np.ptp(read_photo(tmp_path / "grey.png"), axis=2).max() == 0


def test_undistortion_equals_pycolmap(tmp_path):
    y, x = np.mgrid[:80, :100]
    array = np.stack([128 + 100 * np.sin(x / 9), 128 + 100 * np.cos(y / 8), 2 * x + y / 2], axis=2).astype(np.uint8)
    Image.fromarray(array).save(tmp_path / "a.png")
    view = make_view("a.png", tmp_path / "a.png", DISTORTED, np.eye(4), tmp_path)
    pycolmap = load_pycolmap()
    bitmap = pycolmap.Bitmap.from_array(array)
    expected, _ = pycolmap.undistort_image(pycolmap.UndistortCameraOptions(), bitmap, camera_from_lens(DISTORTED))
    difference = np.abs(load_photo(view).astype(int) - expected.to_array())
    assert difference.max() <= 3 and difference.mean() < 0.6  # what is smooth is so by any interpolation


@pytest.mark.parametrize("side", [200, 97])
def test_undistortion_keeps_what_is_sharp(side, tmp_path):
    """Oracle: waves of four to twelve pixels of the result, whose value on the ray of each pixel is known."""
    lens = Lens("SIMPLE_RADIAL", (180.0, 100.0, 80.0, -0.02), 200, 160)
    view = make_view("a.png", tmp_path / "a.png", lens, np.eye(4), tmp_path)
    width, height = scaled_size(view, side)

    def seen(x, y):  # by x/z, y/z
        waves = [(0.25, 0.0), (0.0, 0.25), (0.12, 0.11), (0.08, -0.03)]  # periods in a pixel of the result
        scale = 180 * width / view.width
        return 128 + 28 * sum(np.cos(2 * np.pi * scale * (a * x + b * y)) for a, b in waves)

    fine = 4  # a pixel of the photo is a mean
    ys, xs = (np.mgrid[: 160 * fine, : 200 * fine] + 0.5) / fine
    rays = camera_from_lens(lens).cam_from_img(np.stack([xs.ravel(), ys.ravel()], axis=1))
    stored = seen(rays[:, 0], rays[:, 1]).reshape(160, fine, 200, fine).mean(axis=(1, 3))
    Image.fromarray(np.repeat(np.rint(stored).astype(np.uint8)[..., None], 3, 2)).save(tmp_path / "a.png")
    K = scaled_K(view, width, height)
    ys, xs = np.mgrid[:height, :width] + 0.5
    inside = (np.arange(8) + 0.5) / 8 - 0.5
    parts = [seen((xs + x - K[0, 2]) / K[0, 0], (ys + y - K[1, 2]) / K[1, 1]) for x in inside for y in inside]
    expected = np.mean(parts, axis=0)[3:-3, 3:-3]
    error = load_photo(view, side)[3:-3, 3:-3, 0] - expected
    assert error.std() < 0.08 * expected.std()  # .13 and .16 by linear interpolation


def test_labels_sample_the_pixel_that_the_lens_sees(tmp_path):
    view = make_view("a.png", tmp_path / "a.png", DISTORTED, np.eye(4), tmp_path)
    labels = np.arange(8000, dtype=np.int32).reshape(80, 100) + 1
    warped = warp_labels(view, labels, 30, 24)
    K = scaled_K(view, 30, 24)
    for column, row in ((0, 0), (29, 23), (12, 7)):
        ray = np.array([[*((np.array([column, row]) + 0.5 - K[:2, 2]) / K.diagonal()[:2]), 1.0]])
        x, y = camera_from_lens(DISTORTED).img_from_cam(ray)[0]
        assert warped[row, column] == labels[int(y), int(x)]
    with pytest.raises(InputError, match="100×80"):
        warp_labels(view, labels[:-1], 30, 24)


def test_scaled_photo_keeps_the_true_ratios(tmp_path):
    picture(tmp_path / "a.png", size=(61, 41))
    view = pinhole_view(tmp_path / "a.png", (61, 41))
    small = load_photo(view, 30)
    assert small.shape == (20, 30, 3)
    K = scaled_K(view, 30, 20)
    assert K[0, 2] == pytest.approx(15.0) and K[1, 2] == pytest.approx(10.0)
    assert pinhole_from_lens(DISTORTED)[1] <= 100


def test_mutual_matches_count_the_planted_ones():
    rng = np.random.default_rng(0)
    a, b = rng.integers(0, 256, (2, 40, 128)).astype(np.uint8)
    b[:7] = a[10:17]
    votes = pairs.coarse_votes([a, b], [np.arange(2)] * 2, Progress(quiet=True))
    assert votes.toarray().tolist() == [[0, 7], [7, 0]]


def test_atomic_writes_leave_old_or_new(tmp_path):
    target = tmp_path / "map"
    with atomic_directory(target) as new:
        (new / "a").write_text("old")
    with pytest.raises(RuntimeError), atomic_directory(target) as new:
        (new / "a").write_text("half")
        raise RuntimeError
    assert (target / "a").read_text() == "old"
    with pytest.raises(InputError, match="disk is full"), atomic_file(tmp_path / "f") as new:
        new.write_text("x")
        raise OSError(errno.ENOSPC, "No space left on device")
    for library in (sqlite3.OperationalError, RuntimeError):  # pycolmap's
        with pytest.raises(InputError, match=r"f: the disk is full"), atomic_directory(tmp_path / "f"):
            raise library("database or disk is full")
    with atomic_directory(target) as new:
        (new / "a").write_text("new")
    assert (target / "a").read_text() == "new"
    target.rename(tmp_path / ".map.old-999999999-abcdef01")  # killed between the two renames
    (tmp_path / ".map.new-999999999-abcdef02").mkdir()
    recover(target)
    assert (target / "a").read_text() == "new"
    assert [path.name for path in tmp_path.iterdir()] == ["map"]


@pytest.mark.slow
@pytest.mark.parametrize("exchange", [True, False])
def test_a_swapped_folder_is_old_or_new_and_never_gone(tmp_path, monkeypatch, exchange):
    target, done, seen = tmp_path / "map", threading.Event(), set()
    if not exchange:
        monkeypatch.setattr(atomic, "exchange", lambda a, b: False)

    def write(text):
        with atomic_directory(target) as new:
            (new / "a").write_text(text)
            (new / "b").write_text(text)

    def watch():
        while not done.is_set():
            seen.add(target.exists())

    write("0")
    reader = threading.Thread(target=watch)
    reader.start()
    last = 199 if exchange else 9  # without an exchange nothing is asked of the moments in between
    for number in range(1, last + 1):
        write(str(number))
    done.set()
    reader.join()
    assert (target / "a").read_text() == (target / "b").read_text() == str(last)
    assert [path.name for path in tmp_path.iterdir()] == ["map"]
    if exchange:  # the other way has its instant without a folder, as its documentation says
        assert seen == {True}
