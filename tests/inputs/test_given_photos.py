"""Photos of given poses: resized, turned by EXIF, and far away from all others."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from perception.errors import InputError
from perception.frame.recentre import moved_scene, recentred
from perception.gaussians.views import TrainingView, scene_extent
from perception.geometry import camera_centres, far_from_most, inverse_se3
from perception.photos.decode import load_photo
from perception.photos.scene_file import load_saved_scene, save_scene
from perception.photos.views import without_far
from perception.types import View
from support.given_poses import (
    NAMES,
    SIZE,
    check_poses,
    loaded,
    numbers,
    photo,
    pose,
    transforms,
    workspace,
    write_model,
)

SIZES = [
    (257, 193),
    (255, 191),
    (128, 96),
    (129, 97),
    (127, 95),
    (513, 385),
    (511, 383),
    (100, 75),
    (101, 75),
    (32, 24),
]


@pytest.mark.parametrize("size", SIZES, ids=[f"{w}x{h}" for w, h in SIZES])
def test_sizes_that_other_tools_round(size: tuple[int, int], tmp_path: Path) -> None:
    width, height = size
    scene = loaded(
        workspace(tmp_path / "in", cameras=f"1 PINHOLE {width} {height} {width} {width} {width / 2} {height / 2}")
    )
    for view in scene.views:
        assert (view.width, view.height) == SIZE
        np.testing.assert_allclose(view.K[:2, 2], (32, 24))  # the centre stays the centre
        assert view.K[0, 0] == pytest.approx(64) and view.K[1, 1] == pytest.approx(width * 48 / height)


@pytest.mark.parametrize("size", [(65, 48), (64, 64), (96, 48), (48, 64)])
def test_cameras_of_another_shape_are_refused(size: tuple[int, int], tmp_path: Path) -> None:
    folder = workspace(tmp_path / "in", cameras="1 PINHOLE {} {} 60 60 32 24".format(*size))
    with pytest.raises(InputError, match=r"64×48 but its camera says"):
        loaded(folder)


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("size", [(64, 48), (48, 48)])
@pytest.mark.parametrize("suffix", [".png", ".tif"])
def test_exif_never_turns_photos_against_given_poses(
    orientation: int, size: tuple[int, int], suffix: str, tmp_path: Path
) -> None:
    exif = Image.Exif()
    exif[0x0112] = orientation
    pixels = photo(tmp_path / "images" / f"0{suffix}", 3, size, exif=exif)
    write_model(tmp_path / "sparse", [f"0{suffix}"], "1 PINHOLE {} {} 60 60 24 24".format(*size))
    (view,) = loaded(tmp_path).views
    np.testing.assert_array_equal(load_photo(view), pixels)
    save_scene(tmp_path / "kept", loaded(tmp_path))
    kept = load_saved_scene(tmp_path / "kept")
    assert kept is not None
    np.testing.assert_array_equal(load_photo(kept.views[0]), pixels)


def test_a_camera_of_the_upright_photo_takes_it_upright(tmp_path: Path) -> None:
    exif = Image.Exif()
    exif[0x0112] = 6
    pixels = photo(tmp_path / "images/0.png", 3, exif=exif)
    write_model(tmp_path / "sparse", ["0.png"], "1 PINHOLE 48 64 60 60 24 32")
    np.testing.assert_array_equal(load_photo(loaded(tmp_path).views[0]), np.rot90(pixels, -1))


@pytest.mark.parametrize("kind", ["model", "transforms"])
def test_a_camera_kilometres_away_is_left_out_and_named(kind: str, tmp_path: Path) -> None:
    far = np.eye(4)
    far[:3, 3] = 3000, -2000, 5000
    if kind == "model":
        file = workspace(tmp_path / "in") / "sparse/0/images.txt"
        file.write_text(file.read_text().replace(numbers(pose(7)), numbers(far)))
    else:
        data = transforms(tmp_path / "in")
        data["frames"][7]["transform_matrix"] = inverse_se3(far).tolist()
        (tmp_path / "in" / "transforms.json").write_text(json.dumps(data))
    scene = loaded(tmp_path / "in")
    check_poses(scene, list(range(7)))
    (entry,) = scene.report["left_out"]
    assert entry["name"] == "7.png" and "6.17e+03 units" in entry["why"]
    with pytest.raises(InputError, match=r"7\.png"):
        loaded(tmp_path / "in", strict=True)


def test_a_far_camera_that_shares_points_stays_and_spoils_no_scale(tmp_path: Path) -> None:
    scene = loaded(workspace(tmp_path / "in"))
    away = np.eye(4)
    away[:3, 3] = 3000, -2000, 5000
    far = [*scene.views[:7], replace(scene.views[7], camera_from_world=away)]
    assert without_far(far, scene.points, {"7.png"}, True, tmp_path) == (far, [])
    assert [view.name for view in without_far(far, scene.points, set(), False, tmp_path)[0]] == NAMES[:7]
    assert scene_extent([training(view) for view in far]) == scene_extent([training(view) for view in far[:7]])
    shift = np.eye(4)
    shift[:3, 3] = 367_000, 5_790_000, 40  # as of a georeferenced scene
    found = recentred(moved_scene(replace(scene, views=far), shift))
    assert np.abs(camera_centres(np.stack([view.camera_from_world for view in found.views[:7]]))).max() < 100


def training(view: View) -> TrainingView:
    nothing = torch.zeros(0)
    return TrainingView(view.name, nothing, None, nothing, torch.tensor(view.camera_from_world, dtype=torch.float32))


def test_a_fleet_of_far_cameras_and_a_drive_are_no_outliers() -> None:
    """A quarter is too many to be errors, and a path that leaves has no gap."""
    table, hall = np.random.default_rng(0).normal(0, 1, (9, 3)), np.full((4, 3), 500.0)
    assert not far_from_most(np.concatenate([table, hall])).any()
    assert far_from_most(np.concatenate([table, hall[:2]])).tolist() == [False] * 9 + [True] * 2
    drive = np.cumsum(np.r_[np.zeros(30), np.full(20, 0.5)])[:, None] * [1.0, 0, 0] + [0, 0, 0.01]
    assert not far_from_most(drive + np.random.default_rng(0).normal(0, 0.02, (50, 3))).any()
    assert not far_from_most(np.zeros((5, 3))).any() and not far_from_most(np.zeros((1, 3))).any()
