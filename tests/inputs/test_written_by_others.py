"""Models that other programs have written or changed: poses as written, or what does not go together is told."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from perception.errors import InputError
from perception.inputs.load import load_scene
from perception.photos.camera_file import camera_data, write_camera
from perception.photos.lens import lens_warnings, load_pycolmap
from perception.sfm.options import ReadOptions
from perception.types import Lens
from support.given_poses import CAMERA, NAMES, check_poses, loaded, numbers, photo, pose, transforms, workspace

TURNED = np.diag([1.0, -1.0, -1.0, 1.0])


def binary(folder: Path) -> Path:
    """The model of a workspace in binary, with the rigs and frames that COLMAP 3.12 and later write."""
    model = load_pycolmap().Reconstruction(folder / "sparse/0")
    for file in (folder / "sparse/0").iterdir():
        file.unlink()
    model.write_binary(folder / "sparse/0")
    return folder / "sparse/0"


def records(data: bytes) -> list[bytearray]:
    """The images of an images.bin, as `read_write_model.py` of COLMAP writes them, without frames."""
    at, found = 8, list[bytearray]()
    for _ in range(struct.unpack_from("<Q", data)[0]):
        end = data.index(b"\0", at + 64) + 1
        end += 8 + 24 * struct.unpack_from("<Q", data, end)[0]
        found.append(bytearray(data[at:end]))
        at = end
    return found


@pytest.mark.parametrize("ending", ["", "\n"])
def test_the_last_image_may_lack_its_line_of_points(ending: str, tmp_path: Path) -> None:
    file = workspace(tmp_path / "in") / "sparse/0/images.txt"
    file.write_text(file.read_text().rstrip("\n") + ending)
    check_poses(loaded(tmp_path / "in"))


@pytest.mark.parametrize("kind", ["bin", "txt"])
def test_a_model_without_a_file_of_points(kind: str, tmp_path: Path) -> None:
    folder = workspace(tmp_path / "in")
    model = binary(folder) if kind == "bin" else folder / "sparse/0"
    (model / f"points3D.{kind}").unlink()
    scene = loaded(folder)
    check_poses(scene)
    assert "holds 0 points; new ones are triangulated" in scene.report["warnings"][0]


@pytest.mark.parametrize("value", ["nan", "-nan(ind)", "inf", "1.#QNAN"])
def test_points_that_are_not_finite_are_left_out(value: str, tmp_path: Path) -> None:
    folder = workspace(tmp_path / "in")
    with (folder / "sparse/0/points3D.txt").open("a") as file:
        file.write(f"901 1 {value} 1 1 2 3 0\n902 0.1 0.2 0.3 1 2 3 0\n")
    points = loaded(folder).points
    assert len(points) == 61 and np.isfinite(points).all() and points[-1].tolist() == [0.1, 0.2, 0.3]


def test_sizes_with_a_decimal_point(tmp_path: Path) -> None:
    check_poses(loaded(workspace(tmp_path / "in", cameras="1 PINHOLE 64.0 48.0 60 61 32 24")))


@pytest.mark.parametrize("file", ["cameras", "images"])
def test_an_id_that_occurs_twice_is_told_with_its_line(file: str, tmp_path: Path) -> None:
    workspace(tmp_path / "in", cameras=f"{CAMERA}\n{CAMERA}" if file == "cameras" else CAMERA)
    target = tmp_path / "in/sparse/0/images.txt"
    target.write_text(target.read_text().replace("\n2 ", "\n1 ") if file == "images" else target.read_text())
    with pytest.raises(InputError, match=rf"{file}\.txt: line 4: the id 1 occurs twice$"):
        loaded(tmp_path / "in")


def test_tabs_between_values(tmp_path: Path) -> None:
    folder = workspace(tmp_path / "in")
    for file in (folder / "sparse/0").iterdir():
        file.write_text("\n".join(x if x[:1] == "#" else x.replace(" ", "\t") for x in file.read_text().split("\n")))
    check_poses(loaded(folder))


def test_poses_that_frames_contradict_are_told(tmp_path: Path) -> None:
    """A script moved the images and left the frames: COLMAP reads the poses of the frames."""
    model = binary(workspace(tmp_path / "in"))
    images = records((model / "images.bin").read_bytes())
    for image in images[:3]:
        struct.pack_into("<3d", image, 36, 1, 2, 3)
    (model / "images.bin").write_bytes(struct.pack("<Q", 8) + b"".join(images))
    scene = loaded(tmp_path / "in")
    check_poses(scene)
    (line,) = scene.report["warnings"]
    assert "images.bin: the poses of 3 of 8 images differ from those by rigs.bin and frames.bin, which are used" in line
    for name in ("rigs.bin", "frames.bin"):
        (model / name).unlink()
    moved = {view.name: view.camera_from_world[:3, 3].tolist() for view in loaded(tmp_path / "in").views}
    assert [name for name in NAMES if moved[name] == [1, 2, 3]] == NAMES[:3]


@pytest.mark.parametrize("what", ["fewer images", "no rigs", "no frames"])
def test_frames_that_do_not_go_with_the_images_are_told(what: str, tmp_path: Path) -> None:
    model = binary(workspace(tmp_path / "in"))
    if what == "fewer images":
        images = records((model / "images.bin").read_bytes())[:6]
        (model / "images.bin").write_bytes(struct.pack("<Q", 6) + b"".join(images))
    else:
        (model / f"{what[3:]}.bin").unlink()
    left = {"fewer images": "rigs.bin and frames.bin", "no rigs": "frames.bin", "no frames": "rigs.bin"}[what]
    with pytest.raises(InputError, match=f"written images.bin since, remove {left}$"):
        loaded(tmp_path / "in")


@pytest.mark.parametrize("kind", ["bin", "txt"])
def test_names_that_are_not_in_utf_8_are_told(kind: str, tmp_path: Path) -> None:
    folder = workspace(tmp_path / "in", names=[f"ö{name}" for name in NAMES])
    model = binary(folder) if kind == "bin" else folder / "sparse/0"
    file = model / f"images.{kind}"
    file.write_bytes(file.read_bytes().replace("ö".encode(), "ö".encode("latin-1")))
    with pytest.raises(InputError, match=r"photo name '\\udcf60\.png' .*U\+DCF6, so is not in UTF-8"):
        loaded(folder)


@pytest.mark.parametrize(("model", "photos"), [("dense/0/sparse", "dense/0/images"), ("dense/sparse", "dense/images")])
def test_undistorted_photos_are_those_beside_their_model(model: str, photos: str, tmp_path: Path) -> None:
    """Photos of the same names, before they were undistorted, lie in `images` above."""
    folder = workspace(tmp_path / "in", model, photos)
    for index, name in enumerate(NAMES):
        photo(folder / "images" / name, 50 + index)
    assert {view.photo.parent for view in loaded(folder).views} == {folder / photos}


@pytest.mark.parametrize("other", ["masks", "depth", "Labels"])
def test_masks_of_the_same_names_are_not_the_photos(other: str, tmp_path: Path) -> None:
    folder = workspace(tmp_path / "in", "sparse/0", "photos")
    for index, name in enumerate(NAMES):
        photo(folder / other / name, 50 + index)
    assert {view.photo.parent for view in loaded(folder).views} == {folder / "photos"}


@pytest.mark.parametrize("centre", ["0.5 0.5", "0 0"])
def test_a_principal_point_that_is_not_in_pixels_is_refused(centre: str, tmp_path: Path) -> None:
    folder = workspace(tmp_path / "in", cameras=f"1 PINHOLE 64 48 60 61 {centre}")
    with pytest.raises(InputError, match=r"its principal point is \(.*\), expected pixels, about \(32, 24\)"):
        loaded(folder)


def test_a_principal_point_of_photos_of_another_size_is_told(tmp_path: Path) -> None:
    """Without w and h nothing says that the photos were made smaller."""
    data = transforms(tmp_path)
    (tmp_path / "transforms.json").write_text(json.dumps({k: v for k, v in data.items() if k not in ("w", "h")}))
    for index, name in enumerate(NAMES):
        photo(tmp_path / "images" / name, index, (32, 24))
    (line,) = loaded(tmp_path).report["warnings"]
    assert "principal point (32, 24) lies far from the middle" in line


@pytest.mark.parametrize("centre", [0, 0.5])
def test_a_camera_file_with_its_principal_point_in_the_corner_is_refused_at_once(centre: float, tmp_path: Path) -> None:
    for index, name in enumerate(NAMES):
        photo(tmp_path / "in" / name, index)
    data = camera_data("x", (64, 48), "plumb_bob", [60, 0, centre, 0, 60, centre, 0, 0, 1], [0.0] * 5)
    write_camera(tmp_path / "camera.yaml", data)
    with pytest.raises(InputError, match=r"expected pixels, about \(32, 24\)"):
        load_scene(tmp_path / "in", ReadOptions(tmp_path / "work", camera=tmp_path / "camera.yaml"))
    assert not (tmp_path / "work").exists()


def test_photos_that_are_listed_twice_are_told_in_one_line(tmp_path: Path) -> None:
    data = transforms(tmp_path / "in")
    data["frames"] += data["frames"]
    (tmp_path / "in" / "transforms.json").write_text(json.dumps(data))
    scene = loaded(tmp_path / "in")
    check_poses(scene)
    told = "8 photos, such as 0.png, are listed more than once; the first pose is used"
    assert scene.report["warnings"] == [told]


def test_resized_photos_are_told_in_one_line(tmp_path: Path) -> None:
    folder = workspace(tmp_path / "in", cameras="1 PINHOLE 128 96 120 122 64 48")
    scene = loaded(folder)
    check_poses(scene)
    assert scene.report["warnings"] == ["photos of 64×48, camera 128×96: intrinsics scaled"]


@pytest.mark.parametrize(
    ("lens", "folds"),
    [
        (Lens("SIMPLE_RADIAL", (60.0, 32.0, 24.0, -0.3), 64, 48), False),
        (Lens("SIMPLE_RADIAL", (60.0, 32.0, 24.0, -3.0), 64, 48), True),
        # r (1 + 0.2 r² − 0.6 r⁴) falls from r² = 0.1 + √(0.01 + 1 / 3), about r = 0.82, on
        (Lens("RADIAL", (500.0, 320.0, 240.0, 0.2, -0.6), 640, 480), False),
        (Lens("RADIAL", (400.0, 320.0, 240.0, 0.2, -0.6), 640, 480), True),
        (Lens("FULL_OPENCV", (517, 517, 319, 255, 0.262, -0.953, -0.005, 0.003, 1.163, 0, 0, 0), 640, 480), False),
        (Lens("OPENCV_FISHEYE", (200.0, 200.0, 320.0, 240.0, 0.01, 0.0, 0.0, 0.0), 640, 480), False),
        (Lens("PINHOLE", (60.0, 60.0, 32.0, 24.0), 64, 48), False),
    ],
)
def test_distortion_that_folds_is_told(lens: Lens, folds: bool) -> None:
    assert ["folds" in line for line in lens_warnings(lens)] == [True] * folds


def test_poses_of_a_model_that_look_away_from_its_points_are_refused(tmp_path: Path) -> None:
    """As with world_from_camera in a model: all is behind the cameras."""
    file = workspace(tmp_path / "in") / "sparse/0/images.txt"
    for index in range(8):
        file.write_text(file.read_text().replace(numbers(pose(index)), numbers(TURNED @ pose(index))))
    with pytest.raises(InputError, match="no photo sees any of its 60 points"):
        loaded(tmp_path / "in")


def test_points_that_poses_look_away_from_are_not_used(tmp_path: Path) -> None:
    """As with OpenCV's axes in a transforms.json. Features, which these photos lack, tell if poses are wrong."""
    data = transforms(tmp_path / "in")
    for frame in data["frames"]:
        frame["transform_matrix"] = (np.array(frame["transform_matrix"]) @ TURNED).tolist()
    (tmp_path / "in" / "transforms.json").write_text(json.dumps(data))
    told = loaded(tmp_path / "in").report["warnings"]
    assert any("0.00% of its points lie in the view of some photo" in each for each in told)


def tracked(folder: Path, write: str = "write_text") -> Any:
    """A workspace in which each photo sees each point where it is."""
    pycolmap, path = load_pycolmap(), workspace(folder) / "sparse/0"
    model = pycolmap.Reconstruction(path)
    for image_id, image in model.images.items():
        seen = [image.project_point(model.points3D[number].xyz) for number in sorted(model.points3D)]
        image.points2D = pycolmap.Point2DList([pycolmap.Point2D(xy) for xy in seen])
        for index, number in enumerate(sorted(model.points3D)):
            model.add_observation(number, pycolmap.TrackElement(image_id, index))
    for file in path.iterdir():
        file.unlink()
    getattr(model, write)(path)
    for file in [*path.glob("rigs.*"), *path.glob("frames.*")]:
        file.unlink()
    return model


def test_observations_far_from_their_points_are_told(tmp_path: Path) -> None:
    """First each photo sees each point where it is; then all points move by half a unit."""
    model = tracked(tmp_path / "in")
    report = loaded(tmp_path / "in").report
    assert report["warnings"] == [] and report["mean_reprojection_error_px"] < 1e-6
    for point in model.points3D.values():
        point.xyz = np.add(point.xyz, (0.5, 0, 0))
    model.write_text(tmp_path / "in/sparse/0")
    report = loaded(tmp_path / "in").report
    assert report["mean_reprojection_error_px"] > 2
    assert any("poses, cameras and points do not belong together" in line for line in report["warnings"])


@pytest.mark.parametrize("what", ["photos removed", "observations removed"])
@pytest.mark.parametrize("write", ["write_text", "write_binary"])
def test_tracks_that_lead_nowhere_are_not_used(write: str, what: str, tmp_path: Path) -> None:
    """Who takes photos out of images.txt, or empties its lines of points, leaves the tracks; nothing else is lost."""
    count, model = 6 if what == "photos removed" else 8, tracked(tmp_path / "in", write)
    if write == "write_text":
        file = tmp_path / "in/sparse/0/images.txt"
        rows = [row for row in file.read_text().splitlines() if not row.startswith("#")][: 2 * count]
        rows[1::2] = rows[1::2] if count == 6 else [""] * 8
        file.write_text("\n".join(rows) + "\n")
    else:
        file = tmp_path / "in/sparse/0/images.bin"
        images = records(file.read_bytes())[:count]
        images = images if count == 6 else [image[: image.index(b"\0", 64) + 1] + bytes(8) for image in images]
        file.write_bytes(struct.pack("<Q", count) + b"".join(images))
    scene = loaded(tmp_path / "in")
    check_poses(scene, list(range(count)))
    np.testing.assert_allclose(scene.points, [model.points3D[number].xyz for number in sorted(model.points3D)])
    assert any("tracks of its points do not fit its images, and are not used" in w for w in scene.report["warnings"])
