"""Folders of photos as people have them: odd names, links, leftovers, doubles, damage, formats; and traversal names."""

from __future__ import annotations

import builtins
import io
import json
import os
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image, TiffImagePlugin

from perception.errors import InputError
from perception.inputs.load import load_scene
from perception.io.documents import safe_name
from perception.photos import decode as photos_module
from perception.photos.decode import photo_size, read_photo, why_left_out
from perception.photos.folder import choose_photos, list_photos, view_name
from perception.photos.lens import load_pycolmap
from perception.photos.views import fit_lens
from perception.sfm.database import build_features
from perception.sfm.features import _camera_key
from perception.sfm.options import ReadOptions
from perception.types import Lens
from support.aimed import look_at
from support.progress import Told


def texture(seed: int, size: tuple[int, int] = (160, 120)) -> np.ndarray:
    """Smooth random blobs [h, w, 3] uint8, which SIFT and corner tracking find something in."""
    import cv2

    coarse = np.random.default_rng(seed).integers(0, 255, (size[1] // 6, size[0] // 6, 3), dtype=np.uint8)
    return cv2.resize(coarse, size, interpolation=cv2.INTER_CUBIC)


def save(path: Path, seed: int, size: tuple[int, int] = (160, 120), **options: object) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(texture(seed, size)).save(path, **options)
    return path


def relative(folder: Path) -> list[str]:
    return [path.relative_to(folder).as_posix() for path in list_photos(folder)]


def test_maps_work_folders_and_frames_below_the_photos_are_no_photos(tmp_path: Path) -> None:
    """Label images of an interrupted run were taken for photos."""
    for name in ("a.png", "old.gsmap/x.png", "old.gsmap.work/masks/a.png.png", "k.frames/1.png", ".h/b.png", "s/c.png"):
        save(tmp_path / name, 0)
    (tmp_path / "k.frames" / "frames.json").write_text("{}")
    assert relative(tmp_path) == ["a.png", "s/c.png"]
    assert relative(tmp_path / "k.frames") == ["1.png"]  # given itself, it is a folder of photos


def test_linked_folders_are_followed_once(tmp_path: Path) -> None:
    """Photos behind a linked folder were not found."""
    save(tmp_path / "elsewhere" / "1.png", 0)
    save(tmp_path / "photos" / "real" / "0.png", 1)
    for name, target in (("a", tmp_path / "elsewhere"), ("b", tmp_path / "elsewhere"), ("loop", tmp_path / "photos")):
        (tmp_path / "photos" / name).symlink_to(target)
    (tmp_path / "photos" / "again").symlink_to(tmp_path / "photos" / "real")
    assert relative(tmp_path / "photos") == ["a/1.png", "real/0.png"]


NAMES = ["#first.png", "line\nend.png", "blank and tab\t.png", os.fsdecode(b"latin\xe9.png"), "%41.png", "plain.png"]


def test_any_file_name_keeps_its_matches(tmp_path: Path) -> None:
    """A name that begins with "#" lost all matches, one with a line end or bytes that are no UTF-8 ended the run."""
    wide = texture(0, (640, 240))
    for index, name in enumerate(NAMES):
        Image.fromarray(wide[:, 40 * index : 40 * index + 320]).save(tmp_path / name)
    chosen = choose_photos(tmp_path, True, Told())
    assert len(set(chosen.names)) == len(NAMES)
    assert {safe_name(name, "test") for name in chosen.names} == set(chosen.names)
    expected = {"#first.png", "line%0Aend.png", "blank and tab%09.png", "latin%E9.png", "%41.png", "plain.png"}
    assert set(chosen.names) == expected
    store = build_features(chosen.photos, [None] * len(NAMES), ReadOptions(tmp_path / "work"))
    db = load_pycolmap().Database.open(store.database)
    pairs, geometries = db.read_two_view_geometries()
    matched = {
        image
        for pair, geometry in zip(pairs, geometries, strict=True)
        if len(geometry.inlier_matches) > 0
        for image in load_pycolmap().pair_id_to_image_pair(pair)
    }
    assert len(matched) == len(NAMES)
    db.close()


def test_escaped_names_do_not_collide(tmp_path: Path) -> None:
    save(tmp_path / "a%0A.png", 0)
    save(tmp_path / "a\n.png", 1)
    assert len(set(choose_photos(tmp_path, True, Told()).names)) == 2
    assert view_name(tmp_path / "a%\n.png", tmp_path) == "a%25%0A.png"


def test_a_broken_photo_is_left_out_and_told(tmp_path: Path) -> None:
    """One truncated photo among many refused them all."""
    for index in range(4):
        save(tmp_path / f"{index}.jpg", index)
    data = (tmp_path / "2.jpg").read_bytes()
    (tmp_path / "2.jpg").write_bytes(data[: len(data) // 2])
    chosen = choose_photos(tmp_path, False, Told())
    assert chosen.names == ["0.jpg", "1.jpg", "3.jpg"]
    assert [entry["name"] for entry in chosen.left_out] == ["2.jpg"] and "damaged" in chosen.left_out[0]["why"]
    assert any(note.startswith("warning: 1 of 4 photos cannot be read") for note in chosen.notes)
    with pytest.raises(InputError, match=r"2\.jpg: the picture is damaged"):
        choose_photos(tmp_path, True, Told())


def test_bursts_and_copies_keep_one_photo(tmp_path: Path) -> None:
    from PIL import ImageFilter

    wide = Image.fromarray(texture(0, (300, 100))).resize((900, 300), Image.Resampling.BICUBIC)
    for index, shift in enumerate((0, 1, 1, 60, 120)):  # 1 and 2 follow 0 within a pixel; 2 is the sharper copy of 1
        picture = wide.crop((shift, 0, shift + 300, 300))
        picture = picture.filter(ImageFilter.GaussianBlur(1)) if index in (0, 1) else picture
        picture.save(tmp_path / f"{index}.png")
    wide.crop((60, 0, 360, 300)).save(tmp_path / "copy of 3.png")
    chosen = choose_photos(tmp_path, True, Told())
    assert chosen.names == ["2.png", "3.png", "4.png"]
    assert {entry["name"]: entry["why"].split()[-1] for entry in chosen.left_out} == {
        "0.png": "2.png",
        "1.png": "2.png",
        "copy of 3.png": "3.png",
    }
    assert any(note.startswith("3 of 6 photos are doubles") for note in chosen.notes)


def test_panoramas_are_left_out_and_blurred_photos_told(tmp_path: Path) -> None:
    from PIL import ImageFilter

    for index in range(4):
        save(tmp_path / f"{index}.png", index, (320, 240))
    save(tmp_path / "pano.png", 9, (900, 240))
    Image.fromarray(texture(8, (320, 240))).filter(ImageFilter.GaussianBlur(6)).save(tmp_path / "soft.png")
    chosen = choose_photos(tmp_path, True, Told())
    assert chosen.left_out[0]["name"] == "pano.png" and "900×240" in chosen.left_out[0]["why"]
    assert "soft.png" in chosen.names
    assert any("blurred" in note and note.endswith("soft.png") for note in chosen.notes)


def test_wide_cameras_are_no_panoramas(tmp_path: Path) -> None:
    for index in range(4):
        save(tmp_path / f"{index}.png", index, (620, 188))
    assert len(choose_photos(tmp_path, True, Told()).photos) == 4


@pytest.mark.parametrize("folder", ["masks", "depth_8bit", "a/Masks"])
def test_masks_beside_the_photos_are_no_photos(folder: str, tmp_path: Path) -> None:
    for index, name in enumerate(("1", "2.jpg", "other")):
        save(tmp_path / "images" / f"{Path(name).stem}.jpg", index)
        save(tmp_path / folder / f"{name}.png", 10 + index)
    save(tmp_path / folder / "alone.png", 20)
    chosen = choose_photos(tmp_path, True, Told())
    assert sorted(chosen.names) == sorted([f"{folder}/alone.png", *(f"images/{n}.jpg" for n in ("1", "2", "other"))])
    assert any("3 of 7 photos are by their folders masks" in note for note in chosen.notes)


def test_photos_in_folders_of_like_names_stay(tmp_path: Path) -> None:
    for index, folder in enumerate(("wide", "normal", "unmasked", "segment_2")):
        save(tmp_path / folder / "IMG_1.jpg", index)
    assert len(choose_photos(tmp_path, True, Told()).names) == 4


def test_folders_of_the_system_hold_no_photos(tmp_path: Path) -> None:
    """Synology keeps a thumbnail of each photo in a folder of the photo's name, and what was deleted in #recycle."""
    for name in ("a.jpg", "@eaDir/a.jpg/SYNOPHOTO_THUMB_XL.jpg", "#recycle/b.jpg", "$RECYCLE.BIN/c.jpg", "#1.jpg"):
        save(tmp_path / name, 0)
    assert relative(tmp_path) == ["#1.jpg", "a.jpg"]


def all_around(turn: float, size: tuple[int, int] = (640, 320)) -> np.ndarray:
    """What a camera of all directions sees of waves of light from far away, equirectangular, [h, w, 3] uint8."""
    longitude, latitude = np.meshgrid(
        2 * np.pi * (np.arange(size[0]) + 0.5) / size[0] + turn, np.pi * ((np.arange(size[1]) + 0.5) / size[1] - 0.5)
    )
    rays = np.stack([np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)], 2)
    waves = np.random.default_rng(0).normal(0, 6, (12, 3))
    light = np.sin(rays @ waves.T).sum(axis=2)
    return np.repeat((128 + 25 * light).clip(0, 255).astype(np.uint8)[..., None], 3, axis=2)


def test_photos_of_all_directions_are_panoramas_where_nothing_says_so(tmp_path: Path) -> None:
    """Frames of a 360° camera have no GPano; photos of 2:1 that end anywhere stay."""
    for index in range(6):
        picture = Image.fromarray(all_around(index))
        picture.save(tmp_path / f"{index}.png")
        picture.crop((0, 0, 480, 240)).save(tmp_path / f"cut{index}.png")
    assert [left["name"] for left in choose_photos(tmp_path, True, Told()).left_out] == []  # half of them: no
    for index in range(6):
        (tmp_path / f"cut{index}.png").unlink()
    left = choose_photos(tmp_path, True, Told()).left_out
    assert [entry["name"] for entry in left] == [f"{index}.png" for index in range(6)]
    assert all("a panorama (640×320)" in entry["why"] for entry in left)


def test_videos_beside_photos_are_told(tmp_path: Path) -> None:
    for index in range(3):
        save(tmp_path / f"IMG_{index}.jpg", index)
    for name in ("IMG_0.MOV", "IMG_1.mov", "kitchen.mp4"):
        (tmp_path / name).write_bytes(b"x")
    (note,) = choose_photos(tmp_path, True, Told()).notes
    assert note.startswith("3 videos beside the photos are not read, 2 of them belong to Live Photos")


def test_photos_above_the_limit_are_reduced_alike_everywhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Photos over Pillow's limit were refused as unreadable."""
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 10_000)  # refused above twice as many
    monkeypatch.setattr(photos_module, "LARGE_PIXELS", 20_000)
    for name, options in (("a.jpg", {"quality": 95}), ("a.png", {})):
        exif = Image.Exif()
        exif[0x0112] = 6
        file = save(tmp_path / name, 0, (301, 203), exif=exif, **options)
        assert why_left_out(file) is None
        photo = read_photo(file)
        assert photo_size(file) == (102, 151) == photo.shape[1::-1]
        if name == "a.png":
            whole = np.rot90(texture(0, (301, 203)), -1)[:300, :202].astype(float)
            means = whole.reshape(150, 2, 101, 2, 3).mean((1, 3))
            assert np.abs(photo[:150, :101] - means).max() <= 1
    lens = Lens("PINHOLE", (200.0, 200.0, 101.5, 150.5), 203, 301)
    scaled = fit_lens(lens, file, as_stored=False)
    assert scaled is not None and (scaled.width, scaled.height) == (102, 151)
    assert scaled.params[0] == pytest.approx(200 * 102 / 203)
    monkeypatch.setattr(photos_module, "MOST_DECODED", 50_000)
    assert "301×203 pixels" in str(why_left_out(tmp_path / "a.png"))
    assert why_left_out(tmp_path / "a.jpg") is None  # JPEG is decoded at the smaller size


def test_turned_photos_are_staged_with_their_very_pixels(tmp_path: Path) -> None:
    """They went through JPEG once more."""
    exif = Image.Exif()
    exif[0x0112], exif[0x010F] = 6, "Apple"
    exif.get_ifd(0x8769)[0xA405] = 26
    for index in range(3):
        save(tmp_path / f"{index}.jpg", index, exif=exif, quality=90)
    save(tmp_path / "3.png", 3)
    photos = list_photos(tmp_path)
    told = Told()
    store = build_features(photos, [None] * 4, ReadOptions(tmp_path / "work", progress=told))
    for photo, name in zip(photos, store.names, strict=True):
        np.testing.assert_array_equal(np.asarray(Image.open(store.image_root / name)), read_photo(photo))
    assert [update[1:] for update in told.updates if "turning" in update[0]] == [(1, 3), (2, 3), (3, 3)]
    db = load_pycolmap().Database.open(store.database)
    (focal,) = {camera.params[0] for camera in db.read_all_cameras() if camera.has_prior_focal_length}
    db.close()
    assert focal == pytest.approx(26 / 43.27 * np.hypot(160, 120), rel=0.05)


def test_heic_is_read(tmp_path: Path) -> None:
    """HEIC was ignored without a word."""
    heif = pytest.importorskip("pillow_heif")
    heif.register_heif_opener()
    exif = Image.Exif()
    exif[0x0112] = 6
    file = save(tmp_path / "IMG_1.HEIC", 0, (160, 128), exif=exif, quality=95)
    assert list_photos(tmp_path) == [file] and why_left_out(file) is None
    assert photo_size(file) == read_photo(file).shape[1::-1]
    upright = np.asarray(Image.open(file).convert("RGB")).astype(int)
    assert np.abs(read_photo(file) - upright).max() == 0
    file.write_bytes(file.read_bytes()[:500])
    assert why_left_out(file) is not None


def test_photos_of_given_poses_are_staged_as_stored(tmp_path: Path) -> None:
    exif = Image.Exif()
    exif[0x0112] = 3
    photos = [save(tmp_path / name, 0, exif=exif) for name in ("0.jpg", "1.tif")]
    lens = Lens("PINHOLE", (100.0, 100.0, 80.0, 60.0), 160, 120)
    options, masks = ReadOptions(tmp_path / "work"), [save(tmp_path / "mask.png", 1), None]
    for as_stored in ([True, True], [False, False]):
        store = build_features(photos, [lens, lens], options, masks, posed=True, as_stored=as_stored)
        for photo, name in zip(photos, store.names, strict=True):
            staged = np.asarray(Image.open(store.image_root / name)).astype(int)
            expected = texture(0) if as_stored[0] else texture(0)[::-1, ::-1]
            assert np.abs(staged - expected).mean() < 12, photo


@pytest.mark.parametrize("kind", ["HEIF", "WEBP", "PNG", "TIFF", "AVIF"])
def test_pictures_under_a_wrong_ending_are_read(kind: str, tmp_path: Path) -> None:
    if kind == "HEIF":
        pytest.importorskip("pillow_heif").register_heif_opener()
    file = tmp_path / "IMG_1.jpg"
    Image.fromarray(texture(0, (160, 128))).save(file, format=kind, quality=95)
    assert why_left_out(file) is None and photo_size(file) == (160, 128)
    assert np.abs(read_photo(file).astype(int) - texture(0, (160, 128))).mean() < 12  # the loss of the codecs


def test_a_jpeg_called_heic_needs_no_reader_of_heic(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import sys

    monkeypatch.setitem(sys.modules, "pillow_heif", None)
    Image.fromarray(texture(0)).save(tmp_path / "IMG_1.HEIC", format="JPEG")
    assert photo_size(tmp_path / "IMG_1.HEIC") == (160, 120)


@pytest.mark.parametrize("folder", ["images_2", "images_4", "images_8", "thumbnails"])
def test_smaller_copies_beside_the_photos_are_doubles(folder: str, tmp_path: Path) -> None:
    share = {"images_4": 4, "images_8": 8}.get(folder, 2)
    for index in range(4):
        whole = Image.open(save(tmp_path / "images" / f"{index}.jpg", index, (270, 481), quality=95))
        (tmp_path / folder).mkdir(exist_ok=True)
        whole.resize((270 // share, 481 // share), Image.Resampling.BOX).save(tmp_path / folder / f"{index}.png")
    chosen = choose_photos(tmp_path, False, Told())
    assert chosen.names == [f"images/{index}.jpg" for index in range(4)]
    assert all("the same picture as images/" in entry["why"] for entry in chosen.left_out)
    assert "4 of 8 photos are doubles" in chosen.notes[0]


def test_undistorted_and_original_photos_of_one_size_are_doubles(tmp_path: Path) -> None:
    """As Polycam keeps them, and ODM under another ending; what two cameras of a rig see stays."""
    import cv2

    K = np.array([[160, 0, 80], [0, 160, 60], [0, 0, 1.0]])
    for index in range(4):
        save(tmp_path / "images" / f"{index}.jpg", index)
        undistorted = cv2.undistort(texture(index), K, np.array([0.01, 0, 0, 0]))
        for copy in (f"corrected_images/{index}.jpg", f"undistorted/images/{index}.jpg.png"):
            (tmp_path / copy).parent.mkdir(parents=True, exist_ok=True)
            Image.fromarray(undistorted).save(tmp_path / copy)
        save(tmp_path / "right" / f"{index}.jpg", 100 + index)
    chosen = choose_photos(tmp_path, True, Told())
    assert len(chosen.names) == 8 and sum(name.startswith("right/") for name in chosen.names) == 4
    assert all("a double: the same picture as" in entry["why"] for entry in chosen.left_out)


def test_photos_of_one_name_that_show_different_things_all_stay(tmp_path: Path) -> None:
    """As of two cameras: of equal size, or of another size and another view."""
    save(tmp_path / "left" / "0.png", 0)
    Image.fromarray(np.roll(texture(0), 3, axis=1)).save(save(tmp_path / "right" / "0.png", 1))
    save(tmp_path / "small" / "0.png", 2, (80, 60))
    assert choose_photos(tmp_path, False, Told()).names == ["left/0.png", "right/0.png", "small/0.png"]


def test_heic_without_its_reader_names_the_line_that_installs_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import sys

    monkeypatch.setitem(sys.modules, "pillow_heif", None)
    for index in range(3):
        save(tmp_path / f"{index}.jpg", index)
    (tmp_path / "IMG_1.HEIC").write_bytes(b"x")
    chosen = choose_photos(tmp_path, False, Told())
    assert chosen.names == ["0.jpg", "1.jpg", "2.jpg"]
    assert any('pip install ".[heic]"' in note for note in chosen.notes)
    for index in range(3):
        (tmp_path / f"{index}.jpg").unlink()
    with pytest.raises(InputError, match=r'pip install "\.\[heic\]"'):
        load_scene(tmp_path, ReadOptions(tmp_path / "work"))


@pytest.mark.parametrize("name", ["../outside.png", "/outside.png", "a/../../outside.png"])
def test_a_colmap_image_name_that_leaves_the_folder_leads_nowhere(tmp_path: Path, name: str) -> None:
    """Its label image was written beside the photo of somebody else."""
    save(tmp_path / "outside.png", 0)
    save(tmp_path / "scene" / "images" / "a" / "x.png", 1)
    sparse = tmp_path / "scene" / "sparse" / "0"
    sparse.mkdir(parents=True)
    path = name.replace("/outside", f"{tmp_path}/outside") if name.startswith("/") else name
    (sparse / "cameras.txt").write_text("1 PINHOLE 160 120 100 100 80 60\n")
    (sparse / "images.txt").write_text(f"1 1 0 0 0 0 0 3 1 {path}\n\n2 1 0 0 0 1 0 3 1 a/x.png\n\n")
    (sparse / "points3D.txt").write_text("")
    scene = load_scene(tmp_path / "scene", ReadOptions(tmp_path / "work"))
    assert [view.photo for view in scene.views] == [tmp_path / "scene/images/a/x.png"]
    assert [Path(entry["name"]).name for entry in scene.report["left_out"]] == ["outside.png"]


def test_transforms_names_stay_below_the_folder_that_holds_all_photos(tmp_path: Path) -> None:
    """A path with ".." inside gave a view name that left the folder."""
    frames = []
    for index, place in enumerate(("scene/a.png", "scene/x/../../outside/b.png", "scene/x/c.png")):
        save(tmp_path / Path(os.path.normpath(place)), index)
        pose = np.linalg.inv(look_at(np.array([index, -3.0, 1.0]), np.zeros(3), np.array([0, 0, 1.0])))
        frames.append({"file_path": str(Path(place).relative_to("scene")), "transform_matrix": pose.tolist()})
    file = tmp_path / "scene" / "transforms.json"
    file.write_text(json.dumps({"fl_x": 100, "w": 160, "h": 120, "frames": frames}))
    scene = load_scene(file, ReadOptions(tmp_path / "work"))
    assert sorted(view.name for view in scene.views) == ["outside/b.png", "scene/a.png", "scene/x/c.png"]


def test_damaged_photos_with_given_poses_are_left_out(tmp_path: Path) -> None:
    frames = []
    for index in range(3):
        save(tmp_path / f"{index}.png", index)
        pose = np.linalg.inv(look_at(np.array([index, -3.0, 1.0]), np.zeros(3), np.array([0, 0, 1.0])))
        frames.append({"file_path": f"{index}.png", "transform_matrix": pose.tolist()})
    (tmp_path / "transforms.json").write_text(json.dumps({"fl_x": 100, "w": 160, "h": 120, "frames": frames}))
    (tmp_path / "1.png").write_bytes((tmp_path / "1.png").read_bytes()[:900])
    scene = load_scene(tmp_path, ReadOptions(tmp_path / "work"))
    assert [view.name for view in scene.views] == ["0.png", "2.png"]
    assert [entry["name"] for entry in scene.report["left_out"]] == ["1.png"]
    with pytest.raises(InputError, match=r"1\.png: the picture is damaged"):
        load_scene(tmp_path, ReadOptions(tmp_path / "strict", strict=True))


def test_a_fifo_is_no_photo(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.jpg")
    with pytest.raises(InputError, match="not a readable image"):
        read_photo(tmp_path / "pipe.jpg")


def test_a_photo_that_hangs_holds_up_no_other(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As on a mount whose server is gone: the file is there, and opening it waits."""
    hung, sound = save(tmp_path / "hung.png", 1), save(tmp_path / "sound.png", 2)
    begun, end, opened = threading.Event(), threading.Event(), builtins.open

    def hanging(file: Any, *rest: Any, **named: Any) -> Any:
        if os.fspath(file) == str(hung):
            begun.set()
            end.wait(600)
        return opened(file, *rest, **named)

    monkeypatch.setattr(builtins, "open", hanging)
    monkeypatch.setattr(io, "open", hanging)
    readers = [threading.Thread(target=read_photo, args=(path,), daemon=True) for path in (hung, sound)]
    readers[0].start()
    assert begun.wait(60)
    readers[1].start()
    readers[1].join(300)  # of a moment's work, on a busy machine
    assert not readers[1].is_alive()
    end.set()
    readers[0].join(60)


def test_grey_photos_of_16_bit_are_told_apart(tmp_path: Path) -> None:
    """All of their thumbnails were white, so that one of them was kept."""
    for index in range(5):
        deep = texture(index)[..., 0].astype(np.uint16) * 200 + 2000
        Image.fromarray(deep).save(tmp_path / f"{index}.png")
    assert len(choose_photos(tmp_path, True, Told()).names) == 5


@pytest.mark.parametrize("mode", ["F", "LAB"])
def test_pictures_that_are_no_photos_are_left_out(mode: str, tmp_path: Path) -> None:
    for index in range(4):
        save(tmp_path / f"{index}.jpg", index)
    Image.new(mode, (160, 120)).save(tmp_path / "x.tif")
    chosen = choose_photos(tmp_path, False, Told())
    assert len(chosen.names) == 4 and [entry["name"] for entry in chosen.left_out] == ["x.tif"]
    assert "convert it to RGB" in str(why_left_out(tmp_path / "x.tif"))
    with pytest.raises(InputError, match="convert it to RGB"):
        read_photo(tmp_path / "x.tif")


def test_a_zoom_of_0_over_0_is_one_camera(tmp_path: Path) -> None:
    """Pillow reads it as NaN, which equals nothing: each photo had a camera of its own."""
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0xA404] = TiffImagePlugin.IFDRational(0, 0)
    for index in range(3):
        save(tmp_path / f"{index}.jpg", index, exif=exif)
    assert len({_camera_key(tmp_path / f"{index}.jpg") for index in range(3)}) == 1


def test_a_camera_without_pixels_fits_no_photo(tmp_path: Path) -> None:
    assert fit_lens(Lens("PINHOLE", (60.0, 60.0, 0.0, 0.0), 0, 0), save(tmp_path / "a.png", 0), False) is None


def test_features_are_made_anew_where_a_mask_is_of_another_photo(tmp_path: Path) -> None:
    photos = [save(tmp_path / name, 0) for name in ("0.jpg", "1.jpg")]
    mask = tmp_path / "mask.png"
    Image.new("L", (160, 120)).save(mask)
    for masks in ([mask, None], [None, mask]):
        store = build_features(photos, [None, None], ReadOptions(tmp_path / "work"), masks)
        staged = [np.asarray(Image.open(store.folder / "masks" / f"{name}.png")) for name in store.names]
        assert [bool(picture.any()) for picture in staged] == [given is None for given in masks]
