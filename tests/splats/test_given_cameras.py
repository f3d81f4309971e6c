"""`--cameras`: poses with and without photos, their depth of the splat, and cameras of another frame."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from perception.config import MapConfig, PhotoConfig
from perception.errors import InputError
from perception.photos.depth import load_depth
from perception.sfm.options import ReadOptions
from perception.splats.panoramas import pose_at
from perception.splats.read import Splat, read_splat
from perception.splats.scene import _cloud, _given, _with_renders, claim, drawn
from perception.types import View
from support.splat_rooms import SIDES, room_columns, write_room

WIDTH, HEIGHT, FOCAL = 64, 48, 50.0


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Splat:
    return read_splat(write_room(tmp_path_factory.mktemp("room") / "room.ply", room_columns()[0]))


def cameras_file(folder: Path, shift: float = 0.0, photos: bool = False) -> Path:
    """A transforms.json of four level cameras in the room's middle, at half its height, with photos of grey or none."""
    frames = []
    for number in range(4):
        world_from_camera = np.linalg.inv(pose_at(SIDES / 2 + [shift, 0, 0], number * np.pi / 2, 0.0, np.eye(3)))
        opengl = world_from_camera @ np.diag([1.0, -1, -1, 1])
        frames.append({"file_path": f"{number}.png", "transform_matrix": opengl.tolist()})
        if photos:
            cv2.imwrite(str(folder / f"{number}.png"), np.full((HEIGHT, WIDTH, 3), 128, np.uint8))
    about = {"fl_x": FOCAL, "fl_y": FOCAL, "cx": WIDTH / 2, "cy": HEIGHT / 2, "w": WIDTH, "h": HEIGHT}
    file = folder / "transforms.json"
    file.write_text(json.dumps({**about, "frames": frames}))
    return file


def views_of(room: Splat, cameras: Path, folder: Path) -> tuple[list[View], list[str]]:
    options = ReadOptions(folder / "sfm", cloud=_cloud(room, room.parked))
    given, _ = _given(cameras, options)
    return _with_renders(given, drawn(room, room.parked, torch.zeros(len(room), 1)), folder / "frames", WIDTH, cameras)


@pytest.mark.parametrize("photos", [False, True])
def test_given_views_have_the_depth_of_the_walls(room: Splat, tmp_path: Path, photos: bool) -> None:
    views, warnings = views_of(room, cameras_file(tmp_path, photos=photos), tmp_path)
    assert len(views) == 4
    for number, view in enumerate(views):
        depth = load_depth(view, WIDTH, HEIGHT)
        assert abs(np.median(depth[4:12, 28:36]) - SIDES[number % 2] / 2) < 0.05  # above the boxes, half a room ahead
        assert (view.photo.parent == tmp_path) == photos
        assert view.photo.is_file()
    assert bool(warnings) == photos  # grey photos are unlike the room


@pytest.mark.parametrize("kind", ["json", "colmap"])
def test_a_folder_without_its_photos_gives_its_poses(kind: str, tmp_path: Path) -> None:
    if kind == "json":
        cameras_file(tmp_path)
    else:
        sparse = tmp_path / "sparse" / "0"
        sparse.mkdir(parents=True)
        (sparse / "cameras.txt").write_text(f"1 SIMPLE_RADIAL {WIDTH} {HEIGHT} {FOCAL} {WIDTH / 2} {HEIGHT / 2} 0.01\n")
        (sparse / "points3D.txt").write_text("")
        (tmp_path / "transforms.json").write_text("{")  # not read beside a model
        (sparse / "images.txt").write_text("3 0.5 0.5 0.5 0.5 7 8 9 1 b.jpg\n\n1 1 0 0 0 1 2 3 1 a.jpg\n\n")
    views, notes = _given(tmp_path, ReadOptions(tmp_path / "sfm"))
    assert len(views) == (4 if kind == "json" else 2) and "poses without photos" in notes[0]
    if kind == "colmap":
        assert [view.lens.params[0] for view in views if view.lens] == [FOCAL, FOCAL]
        cycle = np.array([[0.0, 0, 1, 7], [1, 0, 0, 8], [0, 1, 0, 9], [0, 0, 0, 1]])  # 120° about 1, 1, 1
        expected = [np.block([[np.eye(3), np.array([[1], [2], [3]])], [np.zeros((1, 3)), 1]]), cycle]
        np.testing.assert_allclose([view.camera_from_world for view in views], expected, atol=1e-12)


def test_renders_of_another_scene_are_not_replaced(room: Splat, tmp_path: Path) -> None:
    """Their map may have been renamed since: they are its photos."""
    folder, config = tmp_path / "a.gsmap.frames", MapConfig()
    for _ in range(2):  # a run that was stopped goes on
        claim(folder, room, config)
    (folder / "virtual").mkdir()
    for other in (replace(room, means=room.means + 1), replace(room, sh=room.sh + 1)):
        with pytest.raises(InputError, match=r"a\.gsmap\.frames: is not empty"):
            claim(folder, other, config)
    with pytest.raises(InputError, match="is not empty"):
        claim(folder, room, config.model_copy(update={"photos": PhotoConfig(max_side=200)}))
    (tmp_path / "own").mkdir()
    claim(tmp_path / "own", room, config)


def test_photos_that_do_not_fit_their_cameras_are_told(tmp_path: Path) -> None:
    file = cameras_file(tmp_path, photos=True)
    for number in range(4):
        cv2.imwrite(str(tmp_path / f"{number}.png"), np.full((HEIGHT, 2 * WIDTH, 3), 128, np.uint8))
    with pytest.raises(InputError, match="is 128×48 but its camera says 64×48"):
        _given(file, ReadOptions(tmp_path / "sfm"))


def test_cameras_of_another_frame_are_refused(room: Splat, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="of another frame"):
        views_of(room, cameras_file(tmp_path, shift=40.0), tmp_path)


def test_a_folder_of_photos_is_no_model(room: Splat, tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(b"")
    with pytest.raises(InputError, match="expected a COLMAP workspace"):
        views_of(room, tmp_path, tmp_path)
