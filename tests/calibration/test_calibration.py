"""Calibration of cameras that are known exactly, from rendered boards; refusals; the file read by others."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import yaml
from PIL import Image

from perception.calibration.board import Board, Detection
from perception.calibration.calibrate import _pictures, best_model, distinct_views, run_calibration
from perception.calibration.solve import NAMES, project, solve
from perception.cli import main
from perception.errors import InputError
from perception.photos.camera_file import camera_info, lens_of, read_camera
from perception.photos.lens import camera_from_lens
from support.board_pictures import KnownCamera, board_views, render_board

pytestmark = pytest.mark.slow

CHARUCO = Board("charuco", (8, 11), 0.02, 0.015)
CAMERAS = {
    "pinhole": KnownCamera("pinhole", np.array([520, 525, 330.5, 228.2, -0.25, 0.09, 0.001, -0.0007, 0]), (640, 480)),
    "fisheye": KnownCamera("fisheye", np.array([230, 231, 322.3, 236.1, -0.02, 0.005, -0.003, 0.0005]), (640, 480)),
}


@pytest.fixture(scope="module", params=["pinhole", "fisheye"])
def pictures(request, tmp_path_factory) -> tuple[KnownCamera, Path]:
    camera = CAMERAS[request.param]
    folder = tmp_path_factory.mktemp("boards") / "photos"
    make_boards(folder, CHARUCO, camera, 12, 2.0)
    return camera, folder


def make_boards(folder: Path, board: Board, camera: KnownCamera, count: int, noise: float) -> None:
    """Writes `count` pictures of the board; noise in grey levels."""
    folder.mkdir(parents=True)
    reach = 0.8 if board.kind == "charuco" else 0.4
    for number, pose in enumerate(board_views(board, camera, count, reach=reach)):
        cv2.imwrite(str(folder / f"{number:03d}.png"), render_board(board, camera, pose, number, noise))


def perfect_views(camera: KnownCamera, count: int, noise: float = 0.0, seed: int = 0) -> list[Detection]:
    """Corners by projection alone, without pictures."""
    rng = np.random.default_rng(seed)
    grid = np.stack(np.meshgrid(np.arange(1, 8), np.arange(1, 11)), axis=-1).reshape(-1, 2) * 0.02
    points = np.hstack([grid, np.zeros((70, 1))])
    views = []
    for number, pose in enumerate(board_views(CHARUCO, camera, count, reach=0.4)):
        pixels = project(camera.model, camera.values, pose, points)[0]
        views.append(Detection(str(number), points, pixels + rng.normal(0, noise, pixels.shape)))
    return views


def test_the_known_camera_is_found_within_what_is_claimed(pictures, tmp_path) -> None:
    camera, folder = pictures
    out = tmp_path / "camera.yaml"
    text = run_calibration(folder, out, CHARUCO, "auto")[1]
    facts = json.loads((tmp_path / "camera.json").read_text())
    assert facts["model"] == camera.model and facts["reprojection_error_px"] < 0.3
    for name, true in zip(NAMES[camera.model], camera.values, strict=True):
        row = facts["parameters"].get(name)
        if row is None:  # k3 of a lens that has none
            assert name == "k3" and true == 0
            continue
        assert abs(row["value"] - true) < 5 * row["sigma"], name
        assert f"{name} " in text
    assert facts["parameters"]["fx"]["sigma"] < 0.003 * camera.values[0]
    # What matters is where things are seen, but for a turn of the camera, which poses take up: to a pixel.
    rays = np.stack(np.meshgrid(np.linspace(-0.5, 0.5, 9), np.linspace(-0.38, 0.38, 9)), axis=-1).reshape(-1, 2)
    points = np.hstack([rays, np.ones((81, 1))])
    found = np.array([facts["parameters"].get(n, {"value": 0.0})["value"] for n in NAMES[camera.model]])
    apart = (
        project(camera.model, found, np.zeros(6), points)[0]
        - project(camera.model, camera.values, np.zeros(6), points)[0]
    )
    assert np.linalg.norm(apart - apart.mean(axis=0), axis=1).max() < 1.0


def test_the_file_means_to_the_mapper_what_opencv_means(pictures, tmp_path) -> None:
    camera, folder = pictures
    run_calibration(folder, tmp_path / "c.yaml", CHARUCO, camera.model)
    lens = read_camera(tmp_path / "c.yaml")
    assert lens.model in (("OPENCV_FISHEYE",) if camera.model == "fisheye" else ("OPENCV", "FULL_OPENCV"))
    data = yaml.safe_load((tmp_path / "c.yaml").read_text())
    K = np.array(data["camera_matrix"]["data"]).reshape(3, 3)
    distortion = np.array(data["distortion_coefficients"]["data"])
    rng = np.random.default_rng(1)
    points = np.hstack([rng.uniform(-0.4, 0.4, (50, 2)), np.ones((50, 1))])
    zero = np.zeros(3)
    if camera.model == "fisheye":
        want = cv2.fisheye.projectPoints(points[:, None], zero, zero, K, distortion)[0]
    else:
        want = cv2.projectPoints(points[:, None], zero, zero, K, distortion)[0]
    got = camera_from_lens(lens).img_from_cam(points)
    np.testing.assert_allclose(got, want[:, 0] + 0.5, atol=1e-6)  # COLMAP's pixel centres lie at +0.5


@pytest.mark.parametrize("model", ["pinhole", "fisheye"])
def test_exact_corners_give_the_exact_camera(model) -> None:
    camera = CAMERAS[model]
    solution = best_model(perfect_views(camera, 8), camera.size)
    assert solution.model == model and solution.rms < 1e-4
    np.testing.assert_allclose(solution.values, camera.values, rtol=1e-3, atol=1e-3)


def test_uncertainty_is_opencvs_and_outliers_are_left_out() -> None:
    camera = CAMERAS["pinhole"]
    views = perfect_views(camera, 10, noise=0.2)
    solution = solve("pinhole", views, camera.size)
    assert not solution.free[8]  # k3 cannot be told from 0
    points = [v.board_points.astype(np.float32) for v in views]
    pixels = [v.pixels.astype(np.float32) for v in views]
    out = cv2.calibrateCameraExtended(points, pixels, camera.size, None, None, flags=cv2.CALIB_FIX_K3)
    theirs = [out[1][0, 0], out[1][1, 1], out[1][0, 2], out[1][1, 2], *out[2].ravel()[:4]]
    np.testing.assert_allclose(solution.values[:8], theirs, rtol=2e-3, atol=2e-4)
    np.testing.assert_allclose(solution.sigmas[:8], out[5].ravel()[:8], rtol=0.05)
    for view in views[:3]:
        view.pixels[4] += [14, -9]
    again = solve("pinhole", views, camera.size)
    assert sum(len(v.pixels) for v in again.views) == 70 * 10 - 3
    np.testing.assert_allclose(again.values[:4], solution.values[:4], atol=0.3)


def test_uncertainty_of_the_fisheye_is_its_spread() -> None:
    camera = CAMERAS["fisheye"]
    solutions = [solve("fisheye", perfect_views(camera, 8, noise=0.3, seed=s), camera.size) for s in range(12)]
    spread = np.std([s.values for s in solutions], axis=0, ddof=1)
    claimed = np.mean([s.sigmas for s in solutions], axis=0)
    assert ((spread / claimed > 0.5) & (spread / claimed < 1.8)).all()  # 12 draws tell a deviation to within 21 %


def test_a_checkerboard_and_a_video(tmp_path) -> None:
    board, camera = Board("checkerboard", (9, 7), 0.03), CAMERAS["pinhole"]
    make_boards(tmp_path / "photos", board, camera, 8, 1.0)
    run_calibration(tmp_path / "photos", tmp_path / "a.yaml", board, "pinhole")
    values = np.array(read_camera(tmp_path / "a.yaml").params[:4]) - [0, 0, 0.5, 0.5]
    np.testing.assert_allclose(values, camera.values[:4], atol=6)

    video = cv2.VideoWriter(str(tmp_path / "v.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 10, (640, 480))
    for path in sorted((tmp_path / "photos").iterdir()):
        for _ in range(3):  # held still: three frames are one view
            video.write(cv2.imread(str(path)))
    video.release()
    result, _ = run_calibration(tmp_path / "v.avi", tmp_path / "b.yaml", board, "pinhole")
    assert result["pictures_looked_at"] == 24 and len(result["views"]) <= 8
    assert result["parameters"]["fx"]["value"] == pytest.approx(values[0], abs=6)


def test_too_few_too_alike_and_never_seen(pictures, tmp_path, capsys) -> None:
    camera, folder = pictures
    out = str(tmp_path / "c.yaml")

    def told(source: Path, *more: str) -> str:
        assert main(["calibrate", str(source), "-o", out, *more]) == 2
        line = capsys.readouterr().err.strip()
        assert "\n" not in line and not (tmp_path / "c.yaml").exists()
        return line

    few = tmp_path / "few"
    few.mkdir()
    for path in sorted(folder.iterdir())[:3]:
        (few / path.name).write_bytes(path.read_bytes())
    assert "at least 5 different views" in told(few)
    for number in range(6):  # the same three again
        (few / f"again{number}.png").write_bytes(sorted(folder.iterdir())[number % 3].read_bytes())
    assert "of them different; at least 5" in told(few)

    alike = tmp_path / "alike"
    alike.mkdir()
    for number in range(8):  # moved, never tilted
        far = 0.3 if camera.model == "pinhole" else 0.15
        pose = np.array([0.0, 0, 0, -0.1 + 0.02 * (number % 3), -0.12 + 0.02 * (number // 3), far])
        cv2.imwrite(str(alike / f"{number}.png"), render_board(CHARUCO, camera, pose, number))
    assert "too alike" in told(alike)

    blank = tmp_path / "blank"
    blank.mkdir()
    cv2.imwrite(str(blank / "a.png"), np.full((480, 640), 128, np.uint8))
    assert "no charuco of 8x11 squares" in told(blank)
    assert "no checkerboard of 9x6" in told(blank, "--board", "checkerboard", "--squares", "9x6")
    cv2.imwrite(str(blank / "b.png"), np.full((40, 40), 128, np.uint8))
    assert "at one size" in told(blank)
    (blank / "b.png").write_bytes(b"no picture")
    assert "b.png" in told(blank)
    (tmp_path / "empty").mkdir()
    assert "no photos" in told(tmp_path / "empty")
    (tmp_path / "v.mp4").write_bytes(b"no video")
    assert "not a readable video" in told(tmp_path / "v.mp4")
    assert "no such file" in told(tmp_path / "nowhere")
    assert "--squares" in told(folder, "--squares", "eight")
    assert "--dictionary" in told(folder, "--dictionary", "9X9_1")
    assert "--marker" in told(folder, "--marker", "0.5")


def test_refined_corners_lie_where_the_board_is() -> None:
    camera = CAMERAS["pinhole"]
    coarse, fine = [], []
    for number, pose in enumerate(board_views(CHARUCO, camera, 4)):
        picture = render_board(CHARUCO, camera, pose, number)
        found = CHARUCO.detect("x", picture)
        assert found is not None
        true = project("pinhole", camera.values, pose, found.board_points)[0]
        fine.append(np.linalg.norm(found.pixels - true, axis=1))
        corners = np.asarray(CHARUCO._detectors[0][1])
        pixels, ids = CHARUCO._detectors[0][0].detectBoard(picture)[:2]
        true = project("pinhole", camera.values, pose, corners[ids.ravel()])[0]
        coarse.append(np.linalg.norm(pixels.reshape(-1, 2) - true, axis=1))
    assert np.median(np.concatenate(fine)) < 0.03 < np.median(np.concatenate(coarse))


def test_distinct_views_are_those_that_moved() -> None:
    camera = CAMERAS["pinhole"]
    views = perfect_views(camera, 3)
    shaken = [Detection("s", v.board_points, v.pixels + 2.0) for v in views]
    assert distinct_views([*views, *shaken], 640) == views


def test_a_board_of_more_markers_than_its_dictionary_has() -> None:
    assert Board.from_text("charuco:10x10:0.03:0.022:4X4_50").squares == (10, 10)
    with pytest.raises(InputError, match="has 50 markers, a board of 12x9 squares needs 54"):
        Board.from_text("charuco:12x9:0.03:0.022:4X4_50")
    with pytest.raises(InputError, match="expected KIND:COLSxROWS"):
        Board.from_text("charuco:10x10:0.03:0.022:4X4_50:0.5")


@pytest.mark.parametrize(
    "text", ["checkerboard:3x9:0.02", "charuco:3x4:0.02", "charuco:8x11:inf", "charuco:8x11:1e300"]
)
def test_a_board_that_is_never_found_is_refused(text: str) -> None:
    """OpenCV refuses checkerboards of 2 corners a row, and numbers beyond float32; 6 corners are too few here."""
    with pytest.raises(InputError, match="too small or too large; expected"):
        Board.from_text(text)
    for smallest in ("checkerboard:4x4:0.02", "charuco:3x5:0.02"):
        assert Board.from_text(smallest).detect("grey", np.full((120, 160), 128, np.uint8)) is None


def test_photos_of_one_name_in_two_folders_are_told_apart(tmp_path) -> None:
    """Their names are the keys of the report's views."""
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        Image.new("L", (60, 40)).save(tmp_path / name / "0.png")
    assert [name for name, _ in _pictures(tmp_path)] == ["a/0.png", "b/0.png"]


def test_what_macs_leave_beside_photos_is_no_photo(tmp_path) -> None:
    Image.fromarray(np.zeros((40, 60), np.uint8)).save(tmp_path / "a.png")
    (tmp_path / "._a.png").write_bytes(b"no photo")
    (tmp_path / "b.jpg").mkdir()
    with pytest.raises(InputError, match="found in 1 pictures"):
        run_calibration(tmp_path, tmp_path / "camera.yaml", Board("checkerboard", (7, 5), 0.03))


@pytest.mark.parametrize("turned", [1, 2])
def test_a_camera_that_was_turned_between_the_photos(turned: int, tmp_path) -> None:
    """Of a phone held over a table, EXIF tells either way up; turned by 180°, the principal point is mirrored."""
    (tmp_path / "photos").mkdir()
    for number, value in enumerate((3, 3) if turned == 2 else (1, 3)):
        exif = Image.Exif()
        exif[0x0112] = value
        Image.new("RGB", (64, 48), "grey").save(tmp_path / "photos" / f"{number}.jpg", exif=exif)
    words = "no charuco" if turned == 2 else r"1\.jpg was taken with the camera turned against 0\.jpg"
    with pytest.raises(InputError, match=words):
        run_calibration(tmp_path / "photos", tmp_path / "camera.yaml", CHARUCO)


@pytest.mark.parametrize("rectified", [False, True])
def test_a_region_of_interest_sees_what_the_sensor_sees_there(rectified: bool) -> None:
    """CameraInfo states K and P of the whole sensor; the image of a region begins at its offset."""
    values = {"k": [500, 0, 320, 0, 510, 240, 0, 0, 1], "p": [450, 0, 310, -9, 0, 460, 250, 0, 0, 0, 1, 0]}
    rays, seen = np.array([[0.1, 0.05, 1], [-0.2, 0.1, 1]]), []
    for region in ((0, 0, 0, 0), (40, 30, 320, 240), (0, 0, 640, 480)):
        roi = SimpleNamespace(**dict(zip(("x_offset", "y_offset", "width", "height"), region, strict=True)))
        values |= {"width": 640, "height": 480, "distortion_model": "plumb_bob", "d": [-0.2, 0.05, 0.001, 0.002, 0]}
        lens = lens_of(camera_info(SimpleNamespace(**values, roi=roi), rectified), "/camera_info")
        assert (lens.width, lens.height) == (region[2] or 640, region[3] or 480)
        seen.append(camera_from_lens(lens).img_from_cam(rays) + region[:2])
    np.testing.assert_allclose(seen, seen[:1] * 3, atol=1e-9)
    halves = SimpleNamespace(x_offset=0, y_offset=0, width=320, height=240)  # as some drivers state binning by two
    data = camera_info(SimpleNamespace(**values, roi=halves, binning_x=2), rectified)
    assert (data["image_width"], data["image_height"]) == (640, 480)
