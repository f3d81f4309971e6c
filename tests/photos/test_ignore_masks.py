"""Masks of pixels to ignore, and clouds to start from: read, named, and kept away from features; bad ones refused."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from perception.errors import InputError
from perception.geometry import inverse_se3
from perception.inputs.load import load_scene
from perception.io.cloud import write_cloud
from perception.photos.ignore_masks import load_weight, read_mask
from perception.photos.lens import load_pycolmap
from perception.photos.scene_file import load_saved_scene, save_scene
from perception.sfm.options import ReadOptions
from perception.types import PointCloud
from support.aimed import look_at

OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def made(folder: Path, **first: object) -> Path:
    """Three textured 160×120 photos around the origin, with a transforms.json; first: keys of the first frame."""
    frames = []
    for index in range(3):
        texture = np.random.default_rng(index).integers(0, 255, (30, 40, 3), np.uint8)
        (folder / "rgb").mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(folder / "rgb" / f"{index}.png"), cv2.resize(texture, (160, 120)))
        pose = inverse_se3(look_at(np.array([index - 1.0, -3.0, 1.0]), np.zeros(3), np.array([0, 0, 1.0]))) @ OPENGL
        frames.append({"file_path": f"rgb/{index}.png", "transform_matrix": pose.tolist()})
    frames[0] |= first
    data = {"fl_x": 120.0, "w": 160, "h": 120, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(data))
    return folder


def left_black(path: Path, width: int = 160, height: int = 120) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    mask = np.full((height, width), 255, np.uint8)
    mask[:, : width // 2] = 0
    cv2.imwrite(str(path), mask)
    return path


def test_black_or_transparent_is_ignored_at_any_resolution(tmp_path: Path) -> None:
    half = np.repeat([0, 255], [80, 80])[None].repeat(120, axis=0)
    for size in ((160, 120), (80, 60), (320, 240)):
        np.testing.assert_array_equal(read_mask(left_black(tmp_path / "m.png", *size), 160, 120), half)
    clear = np.full((120, 160, 4), 255, np.uint8)
    clear[:, :80, 3] = 0
    deep = np.where(half > 0, 1, 0).astype(np.uint16)  # 16 bits, 1 = used
    for image in (clear, deep, cv2.merge([deep * 0, deep, deep * 0])):
        cv2.imwrite(str(tmp_path / "m.png"), image)
        np.testing.assert_array_equal(read_mask(tmp_path / "m.png", 160, 120), half)


def test_masks_of_a_folder_and_of_transforms_reach_features_and_weights(tmp_path: Path) -> None:
    left_black(tmp_path / "s" / "masks" / "own.png")
    folder = made(tmp_path / "s", mask_path="masks/own.png")
    left_black(tmp_path / "given" / "1.png", 80, 60)
    scene = load_scene(folder, ReadOptions(tmp_path / "work", masks=tmp_path / "given"))
    own, given, none = scene.views
    assert (own.mask, given.mask, none.mask) == (folder / "masks/own.png", tmp_path / "given/1.png", None)
    half = np.repeat([0.0, 1.0], [40, 40])[None].repeat(60, axis=0)
    np.testing.assert_array_equal(load_weight(own, 80, 60), half)
    assert load_weight(none, 80, 60) is None
    assert "masks: 50.0% of the pixels of 2 of 3 photos are ignored" in scene.report["notes"]
    db = load_pycolmap().Database.open(next((tmp_path / "work").glob("features-*")) / "database.db")
    left = [(db.read_keypoints(image.image_id)[:, 0] < 80).sum() for image in db.read_all_images()]
    db.close()
    assert left[0] == left[1] == 0 and left[2] > 20
    save_scene(tmp_path / "kept", scene)
    kept = load_saved_scene(tmp_path / "kept")
    assert kept is not None and [view.mask for view in kept.views] == [view.mask for view in scene.views]


@pytest.mark.parametrize("left", [0, 1])
def test_a_photo_that_is_ignored_nearly_completely_is_left_out(tmp_path: Path, left: int) -> None:
    """One pixel of a photo is lost when it is trained smaller: its PSNR was NaN, which ended the training."""
    folder = made(tmp_path / "s")
    (tmp_path / "given").mkdir()
    for name in ("0.png", "1.png", "2.png"):
        mask = np.full((120, 160), 0 if name == "1.png" else 255, np.uint8)
        mask[7, 7:][:left] = 255
        cv2.imwrite(str(tmp_path / "given" / name), mask)
    write_cloud(tmp_path / "c.ply", PointCloud(np.zeros((1, 3))))
    scene = load_scene(folder, ReadOptions(tmp_path / "work", masks=tmp_path / "given", init_points=tmp_path / "c.ply"))
    assert [view.name for view in scene.views] == ["0.png", "2.png"]
    assert scene.report["left_out"][0]["name"] == "1.png"
    assert scene.report["left_out"][0]["why"].endswith("ignores all but 5e-05 of the pixels" if left else "all pixels")
    for name in ("0.png", "2.png"):
        cv2.imwrite(str(tmp_path / "given" / name), np.zeros((120, 160), np.uint8))
    with pytest.raises(InputError, match="inverted"):
        load_scene(folder, ReadOptions(tmp_path / "work", masks=tmp_path / "given", init_points=tmp_path / "c.ply"))


def test_a_cloud_to_start_from_replaces_the_points(tmp_path: Path) -> None:
    folder = made(tmp_path / "s")
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (200, 3))
    points[7] = np.nan
    colors = np.random.default_rng(1).integers(0, 255, (200, 3), np.uint8)
    write_cloud(tmp_path / "lidar.ply", PointCloud(points, colors))
    scene = load_scene(folder, ReadOptions(tmp_path / "work", init_points=tmp_path / "lidar.ply"))
    keep = np.arange(200) != 7
    np.testing.assert_array_equal(scene.points, points[keep])
    np.testing.assert_array_equal(scene.point_colors, colors[keep])
    assert not list((tmp_path / "work").glob("features-*")) and "lidar" in scene.report["points_from"]


@pytest.mark.parametrize(
    ("what", "words"),
    [
        ("no folder", "no such folder of masks"),
        ("other names", "holds no mask for any of the 3 photos"),
        ("shape", "the mask is 100×100, its photo 160×120"),
        ("damaged", "not a readable mask"),
        ("missing", "mask 'gone.png' does not exist"),
        ("behind", "no photo sees any of its 1 points"),
        ("infinite", "none of the 1 points has finite"),
        ("photos", "goes with an input that has poses"),
    ],
)
def test_bad_masks_and_clouds_are_one_line(tmp_path: Path, what: str, words: str) -> None:
    folder = made(tmp_path / "s", **({"mask_path": "gone.png"} if what == "missing" else {}))
    masks, points = {"no folder": tmp_path / "gone", "missing": None}.get(what, tmp_path / "given"), tmp_path / "c.ply"
    size = (100, 100) if what == "shape" else (160, 120)
    left_black(tmp_path / "given" / ("x.png" if what == "other names" else "0.png"), *size)
    if what == "damaged":
        (tmp_path / "given" / "0.png").write_bytes(b"no image")
    y, z = -9.0 if what == "behind" else 0.0, np.inf if what == "infinite" else 0.0
    write_cloud(points, PointCloud(np.array([[0.0, y, z]])))
    source = folder / "rgb" if what == "photos" else folder
    with pytest.raises(InputError, match=words) as caught:
        load_scene(source, ReadOptions(tmp_path / "w", masks=masks, init_points=points))
    assert "\n" not in str(caught.value)
