"""Given poses are read wherever programs leave them and however they spell the photos: the very poses as written.
What is wrong with one photo leaves that one out."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from perception.config import PhotoConfig
from perception.errors import InputError
from perception.gaussians.photos import split_scene
from perception.inputs.load import input_files, load_scene, photo_sizes
from perception.inputs.readers import other_inputs, reader_of
from perception.io.cloud import read_cloud, write_cloud
from perception.masks.label_folder import LabelFolder
from perception.photos.ignore_masks import mask_of
from perception.photos.lens import load_pycolmap
from perception.photos.scene_file import load_saved_scene, save_scene
from perception.sfm.options import ReadOptions
from perception.types import PointCloud
from support.given_poses import CAMERA, NAMES, SIZE, check_poses, loaded, photo, transforms, workspace, write_model

PLACES = [
    ("sparse/0", "images"),
    ("sparse", "images"),
    ("sparse/0/0", "images"),
    (".", "."),
    (".", "images"),
    ("colmap/sparse/0", "images"),
    ("sparse/0", "input"),
    ("distorted/sparse/0", "input"),
    ("dslr/colmap", "dslr/resized"),
    ("sparse/0", "."),
]


@pytest.mark.parametrize(("model", "photos"), PLACES)
def test_a_model_is_read_wherever_programs_leave_it(model: str, photos: str, tmp_path: Path) -> None:
    scene = loaded(workspace(tmp_path / "in", model, photos))
    assert scene.report["input"] == "colmap"
    check_poses(scene)
    assert photo_sizes(tmp_path / "in").sizes == [SIZE] * 8
    assert {tmp_path / "in" / model / "images.txt", tmp_path / "in" / photos / "3.png"} <= set(
        input_files(tmp_path / "in")
    )


def test_undistorted_and_distorted_photos_keep_to_their_models(tmp_path: Path) -> None:
    """As the script of 3D Gaussian splatting leaves them: the same names in `input` and `images`."""
    folder = workspace(tmp_path / "in", "sparse/0", "images")
    workspace(folder, "distorted/sparse/0", "input")
    scene = loaded(folder)
    assert {view.photo.parent.name for view in scene.views} == {"images"}
    assert any("sparse/0 (8 photos) is used, not distorted/sparse/0" in line for line in scene.report["warnings"])
    shutil.rmtree(folder / "sparse")
    assert {view.photo.parent.name for view in loaded(folder).views} == {"input"}


def test_a_model_without_its_photos_is_named_and_not_passed_over(tmp_path: Path) -> None:
    folder = workspace(tmp_path / "in", "colmap/sparse/0")
    for index, name in enumerate(NAMES):
        (folder / "images" / name).unlink()
        photo(folder / "images" / f"other{index}.png", index)
    with pytest.raises(InputError, match=r"colmap/sparse/0: none of the 8 photos"):
        loaded(folder)


def test_two_inputs_the_preferred_one_is_read_and_the_other_named(tmp_path: Path) -> None:
    folder = workspace(tmp_path / "in")
    transforms(folder, fl_x=70)
    scene = loaded(folder)
    check_poses(scene)
    assert "not read: transforms.json" in scene.report["notes"][0] and "order" in scene.report["notes"][0]
    assert loaded(folder / "transforms.json").views[0].K[0, 0] == 70


@pytest.mark.parametrize("name", ["transforms_all.json", "poses.json", "images/transforms.json", "images/cameras.json"])
def test_any_json_with_frames_is_read(name: str, tmp_path: Path) -> None:
    transforms(tmp_path / "in")
    (tmp_path / "in" / "transforms.json").rename(tmp_path / "in" / name)
    check_poses(loaded(tmp_path / "in"))


def test_blenders_parts_are_one_scene_whose_test_part_is_held_out(tmp_path: Path) -> None:
    data = transforms(tmp_path / "in", prefix="./images/")
    (tmp_path / "in" / "transforms.json").unlink()
    for part, chosen in (("train", slice(0, 5)), ("test", slice(5, 7)), ("val", slice(7, 8))):
        frames = [{**frame, "file_path": frame["file_path"][:-4]} for frame in data["frames"][chosen]]
        (tmp_path / "in" / f"transforms_{part}.json").write_text(json.dumps({**data, "frames": frames}))
    scene = loaded(tmp_path / "in")
    check_poses(scene)
    save_scene(tmp_path / "kept", scene)
    for each in (scene, load_saved_scene(tmp_path / "kept")):
        assert each is not None
        _, training, held = split_scene(each, PhotoConfig())
        assert [view.name for view in held] == NAMES[5:] and len(training) == 5
    assert split_scene(scene, PhotoConfig(holdout=0))[2] == []
    alone = load_scene(tmp_path / "in" / "transforms_test.json", ReadOptions(tmp_path / "w", poses="keep"))
    assert [view.held_out for view in alone.views] == [False, False]


def test_one_posed_photo_is_a_scene_of_random_points(tmp_path: Path) -> None:
    data = transforms(tmp_path)
    del data["ply_file_path"]
    (tmp_path / "transforms.json").write_text(json.dumps({**data, "frames": data["frames"][:1]}))
    scene = loaded(tmp_path)
    check_poses(scene, [0])
    assert scene.report["points_from"] == "random" and "0 points could be triangulated" in scene.report["warnings"][-1]


def test_a_listed_cloud_of_another_frame_is_not_used(tmp_path: Path) -> None:
    """Exports of other programs give points that were not moved with the cameras."""
    data = transforms(tmp_path)
    cloud = read_cloud(tmp_path / data["ply_file_path"])
    write_cloud(tmp_path / data["ply_file_path"], PointCloud(cloud.points + 1e4, cloud.colors))
    scene = loaded(tmp_path)
    check_poses(scene)
    told = f"{data['ply_file_path']}: 0.00% of its points lie in the view of some photo"
    assert any(told in each for each in scene.report["warnings"]) and scene.points.max() < 1e3


def test_nerfstudios_lists_are_the_held_out_set(tmp_path: Path) -> None:
    transforms(
        tmp_path, train_filenames=[f"images/{n}" for n in NAMES[:6]], test_filenames=["images/6.png", "images/7.png"]
    )
    held = split_scene(loaded(tmp_path), PhotoConfig())[2]
    assert [view.name for view in held] == NAMES[6:]


def test_poses_stored_column_by_column_are_refused(tmp_path: Path) -> None:
    """The rotation would be the inverse, and all cameras in one place."""
    data = transforms(tmp_path / "in")
    data["frames"] = [{**f, "transform_matrix": np.transpose(f["transform_matrix"]).tolist()} for f in data["frames"]]
    (tmp_path / "in" / "transforms.json").write_text(json.dumps(data))
    with pytest.raises(InputError, match=r"0.png has the last row -1 -3 1 1, expected 0 0 0 1; is it stored column"):
        loaded(tmp_path / "in")


def test_a_frame_without_its_pose_is_left_out(tmp_path: Path) -> None:
    data = transforms(tmp_path)
    del data["frames"][3]["transform_matrix"]
    data["frames"][5] = None
    (tmp_path / "transforms.json").write_text(json.dumps(data))
    scene = loaded(tmp_path)
    check_poses(scene, [0, 1, 2, 4, 6, 7])
    assert [entry["name"] for entry in scene.report["left_out"]] == ["images/3.png", "frame 5"]
    with pytest.raises(InputError, match=r"transforms\.json: frame 3 lacks"):
        loaded(tmp_path, strict=True)


LISTED: list[tuple[str, Callable[[str], str]]] = [
    ("backslash", lambda name: f"images\\{name}"),
    ("dot and backslash", lambda name: f".\\images\\{name}"),
    ("other case", lambda name: f"Images/{name[:-4]}.PNG"),
    ("no suffix", lambda name: f"images/{name[:-4]}"),
    ("a path on another machine", lambda name: f"C:\\Users\\me\\in\\images\\{name}"),
    ("a path of another user", lambda name: f"/home/other/in/images/{name}"),
]


@pytest.mark.parametrize("spelled", [spelled for _, spelled in LISTED], ids=[name for name, _ in LISTED])
def test_photos_are_there_whatever_system_wrote_their_names(spelled: Callable[[str], str], tmp_path: Path) -> None:
    data = transforms(tmp_path / "in")
    data["frames"] = [{**f, "file_path": spelled(n)} for f, n in zip(data["frames"], NAMES, strict=True)]
    (tmp_path / "in" / "transforms.json").write_text(json.dumps(data))
    check_poses(loaded(tmp_path / "in"))


@pytest.mark.parametrize("suffix", [".txt", ".bin"])
@pytest.mark.parametrize("spelled", ["cam 1\\{}", "CAM 1/{}", "cam 1/{}"])
def test_names_of_models_hold_blanks_backslashes_and_other_case(spelled: str, suffix: str, tmp_path: Path) -> None:
    folder = workspace(tmp_path / "in", names=[f"cam 1/{name}" for name in NAMES])
    write_model(folder / "sparse/0", [spelled.format(name) for name in NAMES])
    if suffix == ".bin":
        model = load_pycolmap().Reconstruction(write_model(tmp_path / "plain"))
        for index, image in model.images.items():
            image.name = spelled.format(NAMES[index - 1])
        for file in (folder / "sparse/0").iterdir():
            file.unlink()
        model.write_binary(folder / "sparse/0")
    scene = loaded(folder)
    check_poses(scene)
    assert [view.name for view in scene.views] == [f"cam 1/{name}" for name in NAMES]


@pytest.mark.parametrize(
    "spelled", ["C:\\scan\\images\\cam\\{}", "/home/me/cam/{}", "../../cam/{}", "{elsewhere}/cam/{}"]
)
def test_names_of_models_that_lead_elsewhere_are_the_photos_below(spelled: str, tmp_path: Path) -> None:
    folder = workspace(tmp_path / "in", names=[f"cam/{name}" for name in NAMES])
    elsewhere = workspace(tmp_path / "elsewhere", names=[f"cam/{name}" for name in NAMES]) / "images"
    write_model(folder / "sparse/0", [spelled.format(name, elsewhere=elsewhere) for name in NAMES])
    scene = loaded(folder)
    check_poses(scene)
    assert [view.photo for view in scene.views] == [folder / "images/cam" / name for name in NAMES]


def test_a_damaged_model_beside_a_good_one_is_not_used_and_named(tmp_path: Path) -> None:
    folder = workspace(tmp_path / "in")
    images = write_model(folder / "sparse/1", NAMES[:3]) / "images.txt"
    images.write_text(images.read_text().replace("1 ", "x ", 1))
    scene = loaded(folder)
    check_poses(scene)
    assert any(f"{images}: line" in line and "not used" in line for line in scene.report["warnings"])
    (folder / "sparse/0").rename(folder / "sparse/2")
    with pytest.raises(InputError, match=r"images.txt: line"):
        loaded(folder)


def test_a_photo_belongs_to_the_image_of_its_very_name(tmp_path: Path) -> None:
    folder = workspace(tmp_path / "in")
    write_model(folder / "sparse/0", ["3.PNG", *NAMES[1:]])
    scene = loaded(folder)
    check_poses(scene, list(range(1, 8)))
    assert [entry["name"] for entry in scene.report["left_out"]] == ["3.PNG"]


def test_of_a_photo_that_a_model_holds_twice_the_first_pose_is_used(tmp_path: Path) -> None:
    folder = workspace(tmp_path / "in")
    write_model(folder / "sparse/0", [*NAMES[:7], NAMES[2]])
    scene = loaded(folder)
    check_poses(scene, list(range(7)))
    assert [(e["name"], "more than once" in e["why"]) for e in scene.report["left_out"]] == [("2.png", True)]
    with pytest.raises(InputError, match=r"1 of 8 photos cannot be used .*more than once"):
        loaded(folder, strict=True)


def test_a_camera_that_colmap_does_not_know_is_told_with_its_line(tmp_path: Path) -> None:
    for camera in ("1 PINHOLE 64 48 60 61 32", "1 ODD 64 48 60 61 32 24"):
        folder = workspace(tmp_path / "in", cameras=camera)
        with pytest.raises(InputError, match=r"cameras.txt: line 3: camera 1 .*not.* known to COLMAP") as caught:
            loaded(folder)
        assert "\n" not in str(caught.value)


def test_masks_and_labels_are_there_in_other_case(tmp_path: Path) -> None:
    scene = loaded(workspace(tmp_path / "in"))
    for name in NAMES:
        photo(tmp_path / "masks" / f"{name[:-4]}.PNG")
        Image.fromarray(np.ones(SIZE[::-1], np.uint8)).save(tmp_path / f"{name[:-4]}.PNG")
    assert mask_of(tmp_path / "masks", "3.png") == tmp_path / "masks" / "3.PNG"
    assert LabelFolder(tmp_path).check(scene.views) == []


@pytest.mark.parametrize("coded", ["utf-8-sig", "utf-16"])
def test_byte_order_marks(coded: str, tmp_path: Path) -> None:
    folder = workspace(tmp_path / "in")
    for file in (folder / "sparse/0").iterdir():
        file.write_bytes(file.read_text().encode(coded))
    check_poses(loaded(folder))
    data = json.dumps(transforms(tmp_path / "json"))
    (tmp_path / "json" / "transforms.json").write_bytes(data.encode(coded))
    check_poses(loaded(tmp_path / "json"))


@pytest.mark.parametrize("file", ["cameras", "images", "points3D"])
def test_decimal_commas_are_told(file: str, tmp_path: Path) -> None:
    folder = workspace(tmp_path / "in", cameras="1 PINHOLE 64 48 60.5 61.5 32.0 24.0")
    target = folder / "sparse/0" / f"{file}.txt"
    target.write_text(target.read_text().replace(".png", "@").replace(".", ",").replace("@", ".png"))
    with pytest.raises(InputError, match=rf"{file}\.txt.*decimal comma") as caught:
        loaded(folder)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("number", ["1.0", "nan", "1e400"])
@pytest.mark.parametrize("file", ["cameras", "images"])
def test_ids_that_are_no_whole_numbers_are_told(file: str, number: str, tmp_path: Path) -> None:
    target = workspace(tmp_path / "in") / "sparse/0" / f"{file}.txt"
    target.write_text(re.sub("^1 ", f"{number} ", target.read_text(), flags=re.MULTILINE))
    with pytest.raises(InputError, match=rf"{file}\.txt: line \d+: the id '{number}' is no whole number"):
        loaded(tmp_path / "in")


@pytest.mark.parametrize("value", ["nan", "-nan(ind)", "1.#QNAN", "inf"])
@pytest.mark.parametrize("what", ["camera", "pose"])
def test_one_camera_that_is_not_finite_is_left_out(what: str, value: str, tmp_path: Path) -> None:
    folder = workspace(tmp_path / "in", cameras=f"{CAMERA}\n2 PINHOLE 64 48 {value} {value} 32 24")
    check_poses(loaded(folder))  # no photo has camera 2
    images = folder / "sparse/0/images.txt"
    rows = images.read_text().splitlines()
    fields = rows[7].split(" ")
    fields[8 if what == "camera" else 5] = "2" if what == "camera" else value
    images.write_text("\n".join([*rows[:7], " ".join(fields), *rows[8:]]) + "\n")
    scene = loaded(folder)
    check_poses(scene, [0, 1, 2, 4, 5, 6, 7])
    (entry,) = scene.report["left_out"]
    assert entry["name"] == "3.png" and "not finite" in entry["why"]
    assert ("cameras.txt: camera 2" if what == "camera" else "images.txt") in entry["why"]
    with pytest.raises(InputError, match=r"1 of 8 photos .*3\.png.*not finite"):
        loaded(folder, strict=True)


@pytest.mark.slow
@pytest.mark.parametrize("what", ["camera", "pose"])
def test_the_same_in_a_binary_model(what: str, tmp_path: Path) -> None:
    pycolmap = load_pycolmap()
    pycolmap.set_random_seed(0)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_frames_per_rig, options.num_rigs, options.num_cameras_per_rig = 6, 2, 1
    truth = pycolmap.synthesize_dataset(options)
    (tmp_path / "sparse").mkdir(parents=True)
    truth.write_binary(tmp_path / "sparse")
    for image in truth.images.values():
        camera = truth.cameras[image.camera_id]
        photo(tmp_path / "images" / image.name, size=(camera.width, camera.height))
    file = tmp_path / "sparse" / ("cameras.bin" if what == "camera" else "images.bin")
    data, first = bytearray(file.read_bytes()), 8 + (24 if what == "camera" else 4)
    data[first : first + 8] = np.float64(np.nan).tobytes()
    file.write_bytes(data)
    scene = loaded(tmp_path)
    number = int.from_bytes(data[8:12], "little")
    out = [i.name for i in truth.images.values() if number == (i.camera_id if what == "camera" else i.image_id)]
    assert sorted(entry["name"] for entry in scene.report["left_out"]) == sorted(out) and out
    assert len(scene.views) == len(truth.images) - len(out) and scene.report["mean_reprojection_error_px"] < 1
    for view in scene.views:
        expected = truth.find_image_with_name(view.name).cam_from_world().matrix()
        np.testing.assert_allclose(view.camera_from_world[:3], expected, atol=1e-9)


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ('{"frames": [{"file_path": "a.png", "pose": []}]}', "frame 0 lacks file_path or transform_matrix"),
        ('{"frames": [{"file_path": "a.png", "transform_matrix": []},]}', "not readable JSON"),
        ('{"frames": []}', "is empty"),
    ],
)
def test_json_with_frames_that_cannot_be_read_says_why(text: str, why: str, tmp_path: Path) -> None:
    photo(tmp_path / "images" / "a.png")
    (tmp_path / "transforms_train.json").write_text(text)
    (tmp_path / "settings.json").write_text('{"frames": 3}')
    reader = reader_of(tmp_path)
    assert reader.name == "photos"
    (line,) = other_inputs(tmp_path, reader)
    assert f"{tmp_path / 'transforms_train.json'}" in line and why in line and "\n" not in line


def test_poses_of_other_programs_are_named(tmp_path: Path) -> None:
    for index, name in enumerate(NAMES):
        photo(tmp_path / "in" / "images" / name, index)
    (tmp_path / "in" / "poses_bounds.npy").write_bytes(b"x")
    write_model(tmp_path / "in" / "sparse" / "0")
    lines = other_inputs(tmp_path / "in", reader_of(tmp_path / "in"))
    assert len(lines) == 1 and "not read: poses_bounds.npy" in lines[0]
    (line,) = other_inputs(tmp_path / "in" / "images", reader_of(tmp_path / "in" / "images"))
    assert f"{tmp_path / 'in' / 'sparse'} holds poses" in line


@pytest.mark.parametrize(
    "name",
    ["keyframes/cameras/0.json", "metadata.json", "odometry.csv", "images/0.xmp", "opensfm/reconstruction.json"],
)
def test_poses_of_phones_and_of_programs_in_folders_are_named(name: str, tmp_path: Path) -> None:
    """Polycam, Record3D, Stray Scanner, RealityScan, ODM."""
    photo(tmp_path / "images" / "0.png")
    (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / name).write_text("{}")
    (line,) = other_inputs(tmp_path, reader_of(tmp_path))
    assert f"read as photos; not read: {name} (" in line


def test_a_transforms_json_in_a_folder_below_is_named(tmp_path: Path) -> None:
    transforms(tmp_path / "scan")
    (line,) = other_inputs(tmp_path, reader_of(tmp_path))
    assert (
        line
        == f"{tmp_path / 'scan/transforms.json'} holds poses that are not read; give {tmp_path / 'scan'} to use them"
    )


def test_images_without_their_lines_of_points_are_refused(tmp_path: Path) -> None:
    """Every second photo was taken for points, and not told."""
    source = workspace(tmp_path)
    file = source / "sparse/0/images.txt"
    file.write_text("\n".join(line for line in file.read_text().splitlines() if line))
    with pytest.raises(InputError, match="expected its points"):
        loaded(source)
