"""Truth of path-traced training worlds against closed form: a plate above a floor, seen from straight above."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from training.furnished import finish

WIDTH, HEIGHT, FOCAL = 64, 48, 50.0
EYE, PLATE, HALF = 2.0, 0.5, 0.3  # heights, and half the plate's side


def square(half: float, height: float) -> np.ndarray:
    return np.array([(x * half, y * half, height) for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))], np.float32)


@pytest.fixture
def world(tmp_path: Path) -> Path:
    folder = tmp_path / "furnished_1"
    (folder / "images").mkdir(parents=True)
    faces = np.array([(0, 1, 2), (0, 2, 3), (4, 5, 6), (4, 6, 7)])
    points = np.concatenate([square(0.8, 0), square(HALF, PLATE)])
    np.savez(folder / "surface.npz", points=points, faces=faces, ids=np.array([1, 1, 2, 2], np.uint16))
    pose = np.eye(4)
    pose[2, 3] = EYE
    instances = [{"id": 1, "name": "floor", "is_stuff": True}, {"id": 2, "name": "plate", "is_stuff": False}]
    about = {"focal": FOCAL, "size": [WIDTH, HEIGHT], "poses": [pose.tolist()], "instances": instances}
    (folder / "cameras.json").write_text(json.dumps(about))
    cv2.imwrite(str(folder / "images" / "0000.png"), np.full((HEIGHT, WIDTH, 3), 100, np.uint8))
    return folder


def test_depth_ids_and_noise_of_a_plate_above_a_floor(world: Path) -> None:
    pytest.importorskip("open3d")
    finish(world)
    columns, rows = np.meshgrid(np.arange(WIDTH) + 0.5 - WIDTH / 2, np.arange(HEIGHT) + 0.5 - HEIGHT / 2)
    far = np.maximum(np.abs(columns), np.abs(rows)) / FOCAL
    expected = np.where(far * (EYE - PLATE) < HALF, 2, np.where(far * EYE < 0.8, 1, 0))
    depth = np.select([expected == 2, expected == 1], [EYE - PLATE, EYE], 0)
    assert len(np.unique(expected)) == 3
    np.testing.assert_array_equal(cv2.imread(str(world / "masks_gt/0000.png"), cv2.IMREAD_UNCHANGED), expected)
    np.testing.assert_array_equal(cv2.imread(str(world / "depth/0000.png"), cv2.IMREAD_UNCHANGED), 1000 * depth)
    photo = cv2.imread(str(world / "images/0000.jpg"), cv2.IMREAD_GRAYSCALE)
    assert abs(photo.mean() - 100) < 0.5 and 0.4 < photo.std() < 1.2
    assert json.loads((world / "transforms.json").read_text())["fl_x"] == FOCAL
    assert [entry["is_stuff"] for entry in json.loads((world / "scene.json").read_text())["instances"]] == [True, False]


def test_without_the_renders_it_says_what_to_run(tmp_path: Path) -> None:
    pytest.importorskip("open3d")
    with pytest.raises(ValueError, match=r"furnished_7: not there; run tools/training/blender_worlds\.py"):
        finish(tmp_path / "furnished_7")
