"""`perception localise` on a small map: its answers, its file, and one line for what it cannot use."""

from __future__ import annotations

import contextlib
import io
import json
import shutil
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image

import perception
from perception.cli import main
from perception.config import MapConfig
from perception.errors import InputError
from perception.frame.recentre import moved
from perception.inputs.transforms import in_map_frame, lens_values, read_frames, read_transforms
from perception.localise.photos import new_photos
from perception.map.files import MapFiles
from perception.map.map import Map
from perception.map.write import read_map, write_map
from perception.photos.camera_file import camera_data
from perception.photos.lens import camera_from_lens
from perception.photos.still import with_still
from perception.photos.view_json import frame_facts
from perception.pipeline.optimise import Run
from perception.progress import QUIET
from perception.sfm.options import ReadOptions
from perception.types import Lens
from perception.visits.scene import visit_scene
from support.painted_room import FOCAL, PaintedRoom, difference, walk, write_room_map
from support.splat_rooms import room_columns, write_room

TRUTH = walk(1, 4, 0.15)[1:3]
LENS = Lens("PINHOLE", (150.0, 150.0, 100.0, 75.0), 200, 150)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A map, its photos, new ones of the same room and of another."""
    folder = tmp_path_factory.mktemp("command")
    room, other = PaintedRoom(0), PaintedRoom(5)
    write_room_map(folder / "a.gsmap", room, walk(1, 5), folder / "photos")
    for n, pose in enumerate(TRUTH):
        room.view(folder / "new", f"{n}.png", pose)
    other.view(folder / "other", "elsewhere.png", TRUTH[0])
    return folder


def told(capsys: pytest.CaptureFixture[str], *arguments: object) -> dict[str, Any]:
    assert main(["localise", *map(str, arguments), "--json"]) == 0
    return dict(json.loads(capsys.readouterr().out))


@pytest.fixture(scope="module")
def localised(folder: Path) -> dict[str, Any]:
    """What is told of the new photos and the other; out.json has their poses."""
    photos = [folder / "new", folder / "other/elsewhere.png", "-o", folder / "out.json"]
    with contextlib.redirect_stdout(io.StringIO()) as out:
        assert main(["localise", str(folder / "a.gsmap"), *map(str, photos), "--json"]) == 0
    return dict(json.loads(out.getvalue()))


def test_poses_as_json_and_as_a_file_in_the_maps_frame(folder: Path, localised: dict[str, Any]) -> None:
    facts = localised
    assert [(photo["name"], photo["localised"]) for photo in facts["photos"]] == [
        ("0.png", True), ("1.png", True), ("elsewhere.png", False),
    ]  # fmt: skip
    assert (facts["frame"], facts["metric"], facts["rendered"]) == ("map", True, [])
    frames = read_frames(folder / "out.json")
    gmap = Map.open(folder / "a.gsmap")
    assert in_map_frame(folder / "out.json", gmap.info, gmap.views)
    assert [name for name, _, _ in frames] == ["new/0.png", "new/1.png"]
    for photo, (_, pose, lens), truth in zip(facts["photos"], frames, TRUTH, strict=False):
        assert np.allclose(pose, photo["camera_from_map"]) and lens.params[0] == 300
        assert difference(pose, truth)[0] < 0.003
        assert np.allclose(photo["position"], np.linalg.inv(truth)[:3, 3], atol=0.003)


def test_a_posed_photo_is_used_as_its_poses_mean_it(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Not turned by EXIF, as its lens is of the pixels as stored, and with its mask."""
    turned = Image.Exif()
    turned[0x0112] = 6
    Image.open(folder / "new/0.png").save(tmp_path / "0.png", exif=turned)
    cv2.imwrite(str(tmp_path / "mask.png"), np.full((300, 400), 255, np.uint8))
    frame = {"file_path": "0.png", "mask_path": "mask.png", "transform_matrix": np.eye(4).tolist()}
    lens = lens_values(Lens("PINHOLE", (FOCAL, FOCAL, 200.0, 150.0), 400, 300))
    (tmp_path / "transforms.json").write_text(json.dumps({**lens, "frames": [frame]}))
    photo = told(capsys, folder / "a.gsmap", tmp_path)["photos"][0]
    assert difference(np.array(photo["camera_from_map"]), TRUTH[0])[0] < 0.003
    assert new_photos([tmp_path], None, tmp_path, QUIET)[0].mask == tmp_path / "mask.png"


@pytest.mark.slow
def test_a_photo_of_the_map_itself_from_python(folder: Path) -> None:
    gmap = perception.load_map(folder / "a.gsmap")
    picture = cv2.imread(str(folder / "new/0.png"))[..., ::-1]
    found = gmap.localise(picture)
    assert found is not None and difference(found.camera_from_map, TRUTH[0])[0] < 0.003
    assert gmap.localise(folder / "other/elsewhere.png") is None
    with pytest.raises(perception.InputError, match="expected uint8"):
        gmap.localise(picture[..., 0])
    with pytest.raises(perception.InputError, match="no such photo"):
        gmap.localise(folder / "nothing.png")


@pytest.mark.slow
def test_a_map_whose_photos_are_gone_is_rendered_and_their_new_folder_is_taken(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    moved = tmp_path / "moved"
    shutil.copytree(folder / "a.gsmap", tmp_path / "a.gsmap")
    gmap = read_map(tmp_path / "a.gsmap")
    gmap.views = [replace(view, photo=tmp_path / view.name, photo_beside=None) for view in gmap.views]  # type: ignore[call-arg]
    write_map(tmp_path / "a.gsmap", gmap)
    shutil.copytree(folder / "photos", moved)
    facts = told(capsys, tmp_path / "a.gsmap", folder / "new/0.png", "--photos", moved)
    assert facts["rendered"] == [] and facts["photos"][0]["localised"]
    (moved / "0.png").write_bytes(b"another file of that name")
    facts = told(capsys, tmp_path / "a.gsmap", folder / "new/0.png", "--photos", moved)
    assert facts["rendered"] == ["0.png"] and facts["photos"][0]["localised"]
    assert main(["localise", str(tmp_path / "a.gsmap"), str(folder / "new/0.png")]) == 2  # balls look like no wall
    error = capsys.readouterr().err.splitlines()[-1]
    assert "0.png: not in this map" in error and "; 5 photos of the map are not at hand" in error


@pytest.mark.slow
def test_what_cannot_be_used_is_told_in_one_line(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = MapFiles(folder / "a.gsmap").map_id
    (tmp_path / "broken.png").write_bytes(b"no picture")
    (tmp_path / "video.mp4").write_bytes(b"")
    write_room(tmp_path / "splat.ply", room_columns()[0])
    camera = camera_data("camera", (400, 300), "plumb_bob", [FOCAL, 0, 200, 0, FOCAL, 150, 0, 0, 1], [])
    (tmp_path / "camera.yaml").write_text(json.dumps(camera))
    (tmp_path / "empty").mkdir()
    photo, poses = folder / "new/0.png", tmp_path / "posed" / "transforms.json"
    shutil.copytree(folder / "new", tmp_path / "posed")
    frame = {"file_path": "0.png", "transform_matrix": np.eye(4).tolist(), **lens_values(LENS)}
    poses.write_text(json.dumps({"frames": [frame]}))
    for arguments, word in (
        ([folder / "other"], "elsewhere.png: not in this map"),
        ([tmp_path / "broken.png"], "broken.png"),
        ([tmp_path / "nothing.png"], "no such file"),
        ([tmp_path / "video.mp4"], "is a video"),
        ([tmp_path / "empty"], "no photos found"),
        ([tmp_path / "splat.ply"], "is a file; expected a folder of photos"),
        ([photo, "-o", photo], "write to another file"),
        ([photo, "-o", folder / "photos/0.png"], "write to another file"),
        ([tmp_path / "posed", "-o", poses], "write to another file"),
        ([photo, "--photos", tmp_path / "nowhere"], "is no folder"),
        ([photo, "--camera", tmp_path / "nowhere.yaml"], "nowhere.yaml"),
        ([tmp_path / "posed", "--camera", tmp_path / "camera.yaml"], "posed brings its own cameras"),
    ):
        assert main(["localise", str(folder / "a.gsmap"), *map(str, arguments)]) == 2
        lines = capsys.readouterr().err.strip().splitlines()
        assert word in lines[-1] and lines[-1].startswith("error: ") and "not at hand" not in lines[-1]
    assert MapFiles(folder / "a.gsmap").map_id == before and json.loads(poses.read_text()) == {"frames": [frame]}
    assert main(["localise", str(folder / "a.gsmap"), str(folder / "other"), "--json"]) == 2
    assert json.loads(capsys.readouterr().out)["photos"][0]["localised"] is False


def test_a_full_disk_is_told_before_a_library_aborts(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    usage = shutil.disk_usage(folder)
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage._replace(free=1 << 20))
    assert main(["localise", str(folder / "a.gsmap"), str(folder / "new")]) == 2
    assert f"error: {tempfile.gettempdir()}: its disk has 1 MiB free" in capsys.readouterr().err


def test_rendering_takes_such_a_file_as_in_the_maps_frame(folder: Path, tmp_path: Path) -> None:
    """The map's frame lies a kilometre from that of its input, whose cameras are moved there."""
    gmap = read_map(folder / "a.gsmap")
    far = np.eye(4)
    far[0, 3] = 1000.0
    gmap.info["map_from_input"] = far.tolist()
    write_map(tmp_path / "a.gsmap", gmap)
    frame = {"file_path": "a.png", **lens_values(LENS)}
    frame["transform_matrix"] = (np.linalg.inv(TRUTH[0]) @ np.diag([1.0, -1, -1, 1])).tolist()
    for name, head in (("of_map", {"map_id": gmap.map_id}), ("of_input", {})):
        (tmp_path / f"{name}.json").write_text(json.dumps({**head, "frames": [frame]}))
        arguments = ["--cameras", str(tmp_path / f"{name}.json"), "-o", str(tmp_path / name)]
        assert main(["render", str(tmp_path / "a.gsmap"), *arguments]) == 0
    seen = {name: cv2.imread(str(tmp_path / name / "a.png")).max() for name in ("of_map", "of_input")}
    assert seen["of_map"] > 100 and seen["of_input"] == 0


@pytest.mark.parametrize("name", ["transforms.json", "poses.json"])
def test_an_update_takes_such_a_file_as_in_the_maps_frame(folder: Path, tmp_path: Path, name: str) -> None:
    """Whatever its name is in the folder of the photos; the map's frame lies a kilometre from that of its input."""
    shutil.copytree(folder / "new", tmp_path / "new")
    gmap, far = read_map(folder / "a.gsmap"), np.eye(4)
    far[0, 3] = 1000.0
    gmap.info["map_from_input"] = far.tolist()
    pose = (np.linalg.inv(TRUTH[0]) @ np.diag([1.0, -1, -1, 1])).tolist()
    frame = {"file_path": "0.png", "transform_matrix": pose, **lens_values(LENS)}
    for head, moved_by in (({"map_id": gmap.map_id, **frame_facts(gmap.info, gmap.views)}, 0.0), ({}, 1000.0)):
        (tmp_path / "new" / name).write_text(json.dumps({**head, "frames": [frame]}))
        run = Run.begun(tmp_path / "new", MapConfig(), tmp_path, QUIET)
        (view,) = visit_scene(run, gmap, tmp_path / "b.gsmap").views
        away = np.linalg.inv(view.camera_from_world)[:3, 3] - np.linalg.inv(TRUTH[0])[:3, 3]
        assert np.allclose(away, [moved_by, 0, 0], atol=1e-6)


def test_poses_in_the_map_before_it_was_scaled_are_refused(folder: Path, tmp_path: Path) -> None:
    """They would be taken for poses in its new unit."""
    gmap, poses = Map.open(folder / "a.gsmap"), tmp_path / "poses.json"
    for scale, again in ((None, {"metric": False}), ({"metres_per_unit": 1.0}, {"scale": None})):
        info = {**gmap.info, "scale": scale}
        poses.write_text(json.dumps({"map_id": "before", **frame_facts(info, gmap.views), "frames": []}))
        assert in_map_frame(poses, info, gmap.views)
        with pytest.raises(InputError, match="another unit"):
            in_map_frame(poses, {**info, **again}, gmap.views)


@pytest.mark.usefixtures("localised")
def test_poses_in_another_map_are_refused_unless_that_is_the_input(folder: Path, tmp_path: Path) -> None:
    """Another map of the same room and unit, half a metre aside; names, corrections and updates keep the frame."""
    aside = np.eye(4)
    aside[0, 3] = 0.5
    gmap, poses = read_map(folder / "a.gsmap"), folder / "out.json"
    other = [moved(view, aside) for view in gmap.views]
    assert in_map_frame(poses, gmap.info, [*gmap.views, replace(gmap.views[0], visit=1)])  # type: ignore[call-arg]
    with pytest.raises(InputError, match=r"out\.json: is in the frame of another map; run perception localise again"):
        in_map_frame(poses, gmap.info, other)
    scene = read_transforms(poses, ReadOptions(tmp_path, cloud=(np.zeros((1, 3)), np.zeros((1, 3), np.uint8))))
    made_of_it = {**gmap.info, "scene": scene.report}
    assert not in_map_frame(poses, made_of_it, other)  # they are moved as the input was


@pytest.mark.parametrize(
    ("model", "params"),
    [
        ("SIMPLE_PINHOLE", (300.0, 200.0, 150.0)),
        ("SIMPLE_RADIAL", (300.0, 200.0, 150.0, 0.05)),
        ("OPENCV", (300.0, 310.0, 200.0, 150.0, 0.05, -0.02, 0.001, 0.002)),
        ("FULL_OPENCV", (300.0, 310.0, 200.0, 150.0, 0.05, -0.02, 0.001, 0.002, 0.01, 0.02, 0.0, 0.0)),
        ("SIMPLE_RADIAL_FISHEYE", (300.0, 200.0, 150.0, 0.05)),
        ("FISHEYE", (300.0, 310.0, 200.0, 150.0)),
    ],
)
def test_every_lens_is_written_so_that_it_sees_the_same(model: str, params: tuple[float, ...], tmp_path: Path) -> None:
    lens = Lens(model, params, 400, 300)
    frame = {"file_path": "a.png", "transform_matrix": np.eye(4).tolist(), **lens_values(lens)}
    (tmp_path / "transforms.json").write_text(json.dumps({"frames": [frame]}))
    back = read_frames(tmp_path / "transforms.json")[0][2]
    rays = np.array([[0.0, 0, 1], [0.3, -0.2, 1], [-0.5, 0.4, 1]])
    assert np.allclose(camera_from_lens(back).img_from_cam(rays), camera_from_lens(lens).img_from_cam(rays))


@pytest.mark.parametrize("model", ["FOV", "DIVISION"])
def test_a_lens_without_keys_is_refused(model: str) -> None:
    """Also where its parameter is called k, as that of another formula."""
    with pytest.raises(perception.InputError, match=f"{model} cannot be written"):
        lens_values(Lens(model, (300.0, 300.0, 200.0, 150.0, 0.5), 400, 300))


def test_posed_photos_bring_no_masks_of_what_stays_in_the_picture(folder: Path, tmp_path: Path) -> None:
    """These are found when the photos are localised, in a folder that lasts until then."""
    room, rng = PaintedRoom(0), np.random.default_rng(0)
    thing, frames = rng.integers(0, 255, (60, 120, 3), np.uint8), []
    for n, pose in enumerate(walk(1, 5, 0.15)):
        picture = room.photo(pose)[0]
        picture[-60:, 140:260] = thing
        cv2.imwrite(str(tmp_path / f"{n}.png"), picture)
        frames.append({"file_path": f"{n}.png", "transform_matrix": np.linalg.inv(pose).tolist()})
    lens = lens_values(Lens("PINHOLE", (FOCAL, FOCAL, 200.0, 150.0), 400, 300))
    (tmp_path / "transforms.json").write_text(json.dumps({**lens, "frames": frames}))
    new = new_photos([tmp_path], None, tmp_path / "work", QUIET)
    paths, sizes, none = [photo.photo for photo in new], [(400, 300)] * 5, [None] * 5
    assert [photo.mask for photo in new] == none and not (tmp_path / "work").exists()
    assert all(with_still(paths, sizes, none, tmp_path / "still", QUIET).masks)  # there is such a thing
