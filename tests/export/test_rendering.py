"""`perception render` writes below its output folder, whatever names a camera file or a received map brings."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from perception.errors import InputError
from perception.export.render import render_map
from perception.map.write import write_map
from perception.masks.label_files import label_file
from perception.types import View
from support.synthetic_map import write_synthetic_map
from support.viewer_maps import small_map

OUTSIDE = ["../outside", "a/../../outside", "..\\outside"]


def received_map(folder: Path, name: str) -> Path:
    """A map whose one stored view is called `name`."""
    path = folder / "m.gsmap"
    gmap = small_map(60)
    K = np.array([[30.0, 0, 16], [0, 30, 12], [0, 0, 1]])
    gmap.views = [View("good.jpg", Path("gone.jpg"), K, 32, 24, np.eye(4))]
    write_map(path, gmap)
    text = (path / "map.json").read_text()
    (path / "map.json").write_text(text.replace('"name": "good.jpg"', f'"name": {json.dumps(name)}'))
    return path


def camera_file(folder: Path, names: list[str]) -> Path:
    frames = [{"file_path": name, "transform_matrix": np.diag([1.0, -1, -1, 1]).tolist()} for name in names]
    head = {"fl_x": 30, "fl_y": 30, "cx": 16, "cy": 12, "w": 32, "h": 24}
    (folder / "cameras.json").write_text(json.dumps(head | {"frames": frames}))
    return folder / "cameras.json"


def files(folder: Path) -> set[str]:
    return {str(path.relative_to(folder)) for path in folder.rglob("*.png")}


@pytest.mark.parametrize("name", [*OUTSIDE, "/tmp/outside", ""])
def test_a_view_name_of_a_received_map_never_leaves_the_output_folder(name: str, tmp_path: Path) -> None:
    path = received_map(tmp_path, name)
    with pytest.raises(InputError, match=r"map\.json: views\[0\]\.name: the photo name"):
        render_map(path, tmp_path / "a" / "b", None, ["rgb"])
    assert files(tmp_path) == set()


@pytest.mark.parametrize("names", [[*OUTSIDE[1:2], "b.jpg"], ["/tmp/x.jpg", "b.jpg"], ["a/x.jpg", "a/..\\..\\y.jpg"]])
def test_a_name_in_a_camera_file_never_leaves_the_output_folder(names: list[str], tmp_path: Path) -> None:
    path = received_map(tmp_path, "a.jpg")
    with pytest.raises(InputError, match=r"cameras\.json: "):
        render_map(path, tmp_path / "out", camera_file(tmp_path, names), ["rgb", "depth"])
    assert files(tmp_path) == set()


def test_ids_that_a_picture_cannot_hold_are_told(tmp_path: Path) -> None:
    write_synthetic_map(tmp_path / "m.gsmap", ["mug", "lamp"], None, gaussians=300, first_id=65534)
    with pytest.raises(InputError, match="above 65534, beyond pictures of 16 bits"):
        render_map(tmp_path / "m.gsmap", tmp_path / "out", camera_file(tmp_path, ["a.jpg"]), ["rgb", "instances"])
    assert files(tmp_path) == set()


def test_photos_beside_the_camera_files_folder_are_rendered_below_the_output(tmp_path: Path) -> None:
    path = received_map(tmp_path, "a.jpg")
    (tmp_path / "deep").mkdir()
    cameras = camera_file(tmp_path / "deep", ["../photos/1.jpg", "../photos/left/2.jpg"])
    render_map(path, tmp_path / "deep" / "out", cameras, ["rgb"])
    assert files(tmp_path) == {"deep/out/1.png", "deep/out/left/2.png"}
    picture = cv2.imread(str(tmp_path / "deep" / "out" / "1.png"))
    assert picture is not None and picture.shape == (24, 32, 3)


@pytest.mark.parametrize("degrees", [0, 10, 20, 180])
def test_cameras_of_another_frame_are_told_by_the_photos_of_their_names(degrees: int, tmp_path: Path) -> None:
    path, turn = received_map(tmp_path, "a.jpg"), np.eye(4)
    turn[:3, :3] = Rotation.from_euler("y", degrees, degrees=True).as_matrix()
    cameras = camera_file(tmp_path, ["a.jpg", "b.jpg"])
    known = json.loads(cameras.read_text())
    for frame in known["frames"]:
        frame["transform_matrix"] = (turn @ frame["transform_matrix"]).tolist()
    cameras.write_text(json.dumps(known))
    facts, text = render_map(path, tmp_path / "out", cameras, ["rgb"])
    assert (f"turned by {degrees}°" in text) == ("warning" in facts) == (degrees > 15)
    assert "warning" not in render_map(path, tmp_path / "out2", None, ["rgb"])[0]


def test_depth_that_16_bits_do_not_hold_is_none(tmp_path: Path) -> None:
    for z, held in ((60.0, 60_000), (66.0, 0)):
        gmap = small_map(3)
        gmap.means, gmap.log_scales[:], gmap.opacity_logits[:] = np.array([[0, 0, z]] * 3, np.float32), 2.0, 9.0
        write_map(tmp_path / "m.gsmap", gmap)
        render_map(tmp_path / "m.gsmap", tmp_path / "out", camera_file(tmp_path, ["a.jpg"]), ["depth"])
        assert abs(int(cv2.imread(str(tmp_path / "out" / "a.png"), cv2.IMREAD_UNCHANGED)[12, 16]) - held) <= 1


def test_a_map_without_views_is_told(tmp_path: Path) -> None:
    gmap = small_map(20)
    gmap.views = []
    write_map(tmp_path / "m.gsmap", gmap)
    with pytest.raises(InputError, match="holds no views"):
        render_map(tmp_path / "m.gsmap", tmp_path / "out", None, ["rgb"])


def test_a_fisheye_lens_of_any_width_shows_what_a_pinhole_shows_up_to_79_degrees(tmp_path: Path) -> None:
    """r = f θ (equidistant) against tan θ; at the corners θ is 254°, whose pinhole image has no end."""
    write_map(tmp_path / "m.gsmap", small_map(400))
    path, size, focal = camera_file(tmp_path, ["a.jpg"]), 64, 64 / (2 * np.pi)
    lens = {"fl_x": focal, "fl_y": focal, "cx": 32, "cy": 32, "w": size, "h": size, "camera_model": "OPENCV_FISHEYE"}
    pictures = []
    for head in (lens, {"fl_x": 80, "fl_y": 80, "cx": 400, "cy": 400, "w": 800, "h": 800, "camera_model": "PINHOLE"}):
        path.write_text(json.dumps(json.loads(path.read_text()) | head | {"k1": 0, "k2": 0, "k3": 0, "k4": 0}))
        render_map(tmp_path / "m.gsmap", tmp_path / "out", path, ["instances"])
        pictures.append(cv2.imread(str(tmp_path / "out" / "a.png"), cv2.IMREAD_UNCHANGED))
    offset = np.stack(np.meshgrid(np.arange(size) + 0.5, np.arange(size) + 0.5), axis=-1) - 32
    angle = np.linalg.norm(offset, axis=-1) / focal
    column, row = np.moveaxis(400 + 80 * offset / (angle * focal)[..., None] * np.tan(angle)[..., None], -1, 0)
    near = angle < np.radians(75)
    expected = pictures[1][row[near].astype(int), column[near].astype(int)]
    assert (expected > 0).sum() > 20 and (pictures[0][near] == expected).mean() > 0.95
    assert not pictures[0][angle > np.radians(83)].any()


@pytest.mark.parametrize("name", [*OUTSIDE, "/tmp/outside.jpg"])
def test_a_label_image_lies_below_its_folder(name: str, tmp_path: Path) -> None:
    view = View(name, tmp_path / "photo.jpg", np.eye(3), 4, 3, np.eye(4))
    with pytest.raises(InputError, match="the photo name"):
        label_file(tmp_path / "masks", view)
    assert label_file(tmp_path, View("a/1.jpg", view.photo, view.K, 4, 3, np.eye(4))) == tmp_path / "a" / "1.jpg.png"


def test_pictures_replace_pictures_of_render_alone(tmp_path: Path) -> None:
    path, cameras = received_map(tmp_path, "a.jpg"), camera_file(tmp_path, ["a.jpg", "b.jpg"])
    for _ in range(2):
        render_map(path, tmp_path / "out", cameras, ["rgb"])
    made = sorted((tmp_path / "out").iterdir())
    before = [np.asarray(Image.open(file)) for file in made]
    assert all(Image.open(file).text == {"Software": "perception render"} for file in made)
    Image.fromarray(before[-1]).save(made[-1])
    own = made[-1].read_bytes()
    with pytest.raises(InputError, match="is no picture of this command"):
        render_map(path, tmp_path / "out", cameras, ["rgb"])
    assert made[-1].read_bytes() == own
