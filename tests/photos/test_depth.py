"""Depth images of photos: reading, sampling at a view's pixels against closed forms, and transforms.json."""

from __future__ import annotations

import json
import warnings
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from perception.errors import InputError
from perception.inputs.transforms import read_transforms
from perception.photos.depth import load_depth, read_depth
from perception.photos.view_json import stored_view, view_from_json, view_json
from perception.photos.views import make_view
from perception.sfm.options import ReadOptions
from perception.types import DepthImage, Lens

PINHOLE = Lens("PINHOLE", (50.0, 50.0, 32.0, 24.0), 64, 48)
BARREL = Lens("OPENCV", (50.0, 50.0, 32.0, 24.0, -0.2, 0.02, 0.0, 0.0), 64, 48)


def _wall(lens: Lens, width: int, height: int, slope: float = 0.3) -> np.ndarray:
    """Depth [height, width], millimetres, of the plane z = 2 + slope x seen by `lens` scaled to that size."""
    import pycolmap

    camera = pycolmap.Camera(model=lens.model, width=lens.width, height=lens.height, params=list(lens.params))
    camera.rescale(width, height)
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    rays = np.asarray(camera.cam_from_img(np.stack([x.ravel(), y.ravel()], 1)))[:, 0].reshape(height, width)
    return np.asarray(2000 / (1 - slope * rays))


def _view(lens: Lens, folder: Path, image: np.ndarray, own: Lens | None = None):  # type: ignore[no-untyped-def]
    photo = folder / "a.png"
    cv2.imwrite(str(photo), np.zeros((lens.height, lens.width, 3), np.uint8))
    cv2.imwrite(str(folder / "d.png"), np.round(image).astype(np.uint16))
    view = make_view("a.png", photo, lens, np.eye(4), photo)
    return replace(view, depth=DepthImage(folder / "d.png", 1e-3, own))


@pytest.mark.parametrize("lens", [PINHOLE, BARREL])
@pytest.mark.parametrize("size", [(64, 48), (128, 96), (32, 24)])
def test_depth_of_a_slanted_wall_is_sampled_at_the_pixels_of_the_pinhole(lens, size, tmp_path):
    view = _view(lens, tmp_path, _wall(lens, *size))
    found = load_depth(view, view.width, view.height)
    x = (np.arange(view.width) + 0.5 - view.K[0, 2]) / view.K[0, 0]
    true = np.broadcast_to(2 / (1 - 0.3 * x), found.shape)
    seen = found > 0
    assert seen.mean() > 0.95
    # Half a pixel of the depth image (at 32 pixels: 1/50 of the focal length) on a slope of .3, twice for distortion.
    assert np.abs(found - true)[seen].max() < 2 * 0.3 * 2.5**2 / 2 * (64 / size[0]) / 50 + 1e-3


def test_depth_of_a_camera_of_its_own(tmp_path):
    wide = Lens("PINHOLE", (25.0, 25.0, 32.0, 24.0), 64, 48)  # twice the field of view of the photo
    view = _view(PINHOLE, tmp_path, _wall(wide, 64, 48), own=wide)
    found = load_depth(view, 64, 48)
    x = (np.arange(64) + 0.5 - 32) / 50
    assert (found > 0).all()
    assert np.abs(found - 2 / (1 - 0.3 * x)).max() < 0.3 * 2.5**2 / 2 / 25 + 1e-3


def test_a_grid_of_points_between_the_sampled_pixels_is_found(tmp_path):
    """Every 8th pixel of both axes has depth, and of those every fourth or second is sampled."""
    for shift in range(4):
        image = np.zeros((192, 256))
        image[shift::8, shift::8] = _wall(PINHOLE, 256, 192)[shift::8, shift::8]
        found = load_depth(_view(PINHOLE, tmp_path, image), 64, 48)
        x = np.broadcast_to((np.arange(64) + 0.5 - 32) / 50, found.shape)
        seen = found > 0
        assert seen.mean() == 1 / 4
        assert np.abs(found - 2 / (1 - 0.3 * x))[seen].max() < 0.3 * 2.5**2 / 2 / 50 + 1e-3  # half a pixel


def test_pixels_without_depth_stay_without(tmp_path):
    image = _wall(PINHOLE, 64, 48)
    image[:10], image[10:20] = 0, 65535
    found = load_depth(_view(PINHOLE, tmp_path, image), 64, 48)
    assert (found[:20] == 0).all()
    assert (found[20:] > 0).all()
    for kind in (np.float16, np.float32, np.float64):
        np.save(tmp_path / "d.npy", np.array([[np.nan, np.inf, -1.0, 0.0, 1.5]], kind))
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            assert read_depth(tmp_path / "d.npy").tolist() == [[0, 0, 0, 0, 1.5]]


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda p: None, "no such depth image"),
        (lambda p: p.write_bytes(b"no image"), "not a readable depth image"),
        (lambda p: cv2.imwrite(str(p), np.zeros((4, 4, 3), np.uint8)), "one channel"),
        (lambda p: cv2.imwrite(str(p), np.ones((48, 64), np.uint8)), "8 bits"),
        (lambda p: cv2.imwrite(str(p), np.ones((48, 48), np.uint16)), "field of view"),
    ],
)
def test_bad_depth_is_one_clear_line(make, words, tmp_path):
    view = _view(PINHOLE, tmp_path, _wall(PINHOLE, 64, 48))
    path = tmp_path / "bad.png"
    make(path)
    with pytest.raises(InputError, match=words) as caught:
        load_depth(replace(view, depth=DepthImage(path, 1e-3)), 64, 48)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("keys", "scale"),
    [({}, 1e-3), ({"depth_unit_scale_factor": 0.5}, 0.5), ({"integer_depth_scale": 0.002}, 0.002)],
)
def test_transforms_name_depth_images_and_their_unit(keys, scale, tmp_path):
    _view(PINHOLE, tmp_path, _wall(PINHOLE, 64, 48))
    cloud = "ply\nformat ascii 1.0\nelement vertex 1\n" + "".join(f"property float {c}\n" for c in "xyz")
    (tmp_path / "c.ply").write_text(cloud + "end_header\n0 0 1\n")
    frame = {"file_path": "a.png", "depth_file_path": "d.png", "transform_matrix": np.eye(4).tolist()}
    head = {"fl_x": 50, "w": 64, "h": 48, "ply_file_path": "c.ply", **keys}
    file = tmp_path / "transforms.json"

    def read(frame: dict[str, object]):  # type: ignore[no-untyped-def]
        file.write_text(json.dumps({**head, "frames": [frame]}))
        return read_transforms(file, ReadOptions(tmp_path / "w")).views[0]

    view = read(frame)
    assert view.depth == DepthImage(tmp_path / "d.png", scale)
    assert view_from_json(json.loads(json.dumps(view_json(view)))).depth == view.depth
    assert "depth" not in view_json(stored_view(view, tmp_path))  # a received map names no file that is read
    with pytest.raises(InputError, match="no such depth image; add the file"):
        read({**frame, "depth_file_path": "missing.png"})
    with pytest.raises(InputError, match="above 0"):
        read({**frame, "integer_depth_scale": 0, "depth_unit_scale_factor": 0})
