"""A map finds its photos from any directory and after a move, and never takes other files for them."""

from __future__ import annotations

import json
import shutil
import warnings
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

import perception
from perception.cli import main
from perception.errors import InputError
from perception.map.map import PhotosMoved
from perception.map.write import read_map, relink, verify_map, write_map
from perception.photos.view_json import stored_view
from perception.query.crops import best_crop
from perception.types import View
from support.query_maps import write_map_of

RED, BLUE = (220, 30, 30), (30, 30, 220)


def photo_of(file: Path, color: tuple[int, int, int], side: int = 64) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(file), np.full((48, side, 3), color[::-1], np.uint8))


def shown(path: Path) -> tuple[int, ...] | None:
    """The colour of the best photo of the map's one instance; None when there is none."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PhotosMoved)
        crop = best_crop(perception.load_map(path), 0, photos=Path("/"))
    return None if crop is None else tuple(int(x) for x in np.median(crop.reshape(-1, 3), axis=0))


@pytest.fixture
def path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """home/a.gsmap, made in home from photos/s/00000.png, as that directory is called there."""
    (tmp_path / "home").mkdir()
    monkeypatch.chdir(tmp_path / "home")
    photo_of(Path("photos/s/00000.png"), RED)
    gmap = read_map(write_map_of(Path("a.gsmap"), ["square"], gaussians=50))
    gmap.views = [View("s/00000.png", Path("photos/s/00000.png"), np.eye(3), 64, 48, np.eye(4))]
    gmap.language["view_names"] = np.array(["s/00000.png"])
    gmap.language["view_boxes"] = np.array([[10, 10, 40, 40]], np.int32)
    write_map(Path("a.gsmap"), gmap)
    return tmp_path / "home" / "a.gsmap"


def test_from_another_directory_the_photos_are_the_same(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Even beside a folder of the same name with other photos."""
    other = path.parents[1] / "elsewhere"
    photo_of(other / "photos" / "s" / "00000.png", BLUE)
    monkeypatch.chdir(other)
    assert shown(path) == RED


def test_photos_beside_the_map_move_with_it(path: Path) -> None:
    moved = path.parents[1] / "moved"
    path.parent.rename(moved)
    assert shown(moved / path.name) == RED


def test_a_map_that_moved_alone_still_knows_where_they_lie(path: Path) -> None:
    target = path.parents[1] / "maps" / path.name
    target.parent.mkdir()
    shutil.copytree(path, target)
    photo_of(target.parent / "photos" / "s" / "00000.png", BLUE, side=32)  # not the photo: of another size
    assert shown(target) == RED


def test_another_file_in_its_place_is_not_the_photo(path: Path) -> None:
    photo_of(path.parent / "photos" / "s" / "00000.png", BLUE, side=32)
    assert shown(path) is None


def test_what_is_missing_is_told_once(path: Path) -> None:
    shutil.rmtree(path.parent / "photos")
    gmap = perception.load_map(path)
    with pytest.warns(PhotosMoved, match=r"00000\.png: the photo is missing.*perception relink") as told:
        assert best_crop(gmap, 0, 64, Path("/")) is None and best_crop(gmap, 0, 64, Path("/")) is None
    assert len(told) == 1


def test_relink_finds_photos_by_name_and_size(path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    new = path.parents[1] / "archive"
    (path.parent / "photos").rename(new)
    assert shown(path) is None
    before = (path / "instances.json").read_bytes()
    assert main(["relink", str(path), str(new), "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {"linked": 1, "missing": [], "differ": []}
    assert shown(path) == RED and set(verify_map(path).values()) == {"ok"}
    assert (path / "instances.json").read_bytes() == before
    deeper = path.parents[1] / "disk" / "2026" / "kitchen"
    deeper.mkdir(parents=True)
    (new / "s" / "00000.png").rename(deeper / "00000.png")
    assert relink(path, path.parents[1] / "disk")["linked"] == 1 and shown(path) == RED
    (deeper / "00000.png").rename(deeper / "00000.PNG")  # by way of a disk that does not tell them apart
    assert relink(path, path.parents[1] / "disk")["linked"] == 1 and shown(path) == RED


def test_relink_finds_the_photos_of_a_later_visit_in_its_folders(path: Path) -> None:
    """Two cameras name their photos alike; the map names those of the visit "visit1/left/1.png"."""
    gmap, visit = read_map(path), path.parents[1] / "visit"
    for side, width in (("left", 32), ("right", 40)):
        photo_of(visit / side / "1.png", BLUE, width)
        view = View(f"{side}/1.png", visit / side / "1.png", np.eye(3), width, 48, np.eye(4))
        gmap.views.append(replace(stored_view(view, path, visit=1), name=f"visit1/{view.name}"))
    gmap.info["visits"] = [{"time": None, "input": name, "photos": n} for n, name in enumerate(("a", "b"), 1)]
    write_map(path, gmap)
    visit.rename(moved := visit.with_name("moved"))
    assert relink(path, moved) == {"linked": 2, "missing": ["s/00000.png"], "differ": []}
    found = [view.photo for view in read_map(path).located_views()[1:]]
    assert found == [moved / "left" / "1.png", moved / "right" / "1.png"]


def test_relink_finds_the_photos_of_all_visits_below_one_folder(path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The visits have the same file names, so that sizes tell their photos apart; of two of one size none is taken."""
    gmap, disk = read_map(path), path.parents[1] / "disk"
    for visit, width in ((1, 200), (2, 400)):
        photo = disk / f"visit{visit}" / "images" / "00000.png"
        photo_of(photo, BLUE, width)
        view = View("00000.png", photo, np.eye(3), width, 48, np.eye(4))
        gmap.views.append(replace(stored_view(view, path, visit=visit), name=f"visit{visit}/{view.name}"))
    gmap.info["visits"] = [{"time": None, "input": str(n), "photos": 1} for n in range(3)]
    write_map(path, gmap)
    (path.parent / "photos").rename(disk / "first")
    disk.rename(moved := disk.with_name("moved"))
    assert relink(path, moved) == {"linked": 3, "missing": [], "differ": []}
    places = ("first/s", "visit1/images", "visit2/images")
    assert [view.photo for view in read_map(path).located_views()] == [moved / p / "00000.png" for p in places]
    (moved / "first").rename(moved / "again")
    shutil.copytree(moved / "again", moved / "twice")
    assert relink(path, moved) == {"linked": 2, "missing": ["s/00000.png"], "differ": []}
    assert main(["relink", str(path), str(moved)]) == 0
    told = capsys.readouterr().out.splitlines()
    assert told == [
        f"{path}: 2 photos found in {moved}",
        "1 left as they were, not found there or more than once: s/00000.png",
    ]
    photo_of(moved / "visit2/images/00000.png", RED, 300)  # edited
    for folder, linked in ((moved / "visit1/images", "visit1/00000.png"), (moved / "twice/s", "s/00000.png")):
        others = [name for name in ("s/00000.png", "visit1/00000.png", "visit2/00000.png") if name != linked]
        assert relink(path, folder) == {"linked": 1, "missing": others, "differ": []}
    (moved / "visit2/images/00000.png").rename(moved / "visit2/00000.png")
    (moved / "visit1").rename(moved / "visit2/visit1")
    assert relink(path, moved / "visit2")["differ"] == ["s/00000.png", "visit2/00000.png"]


def test_relink_tells_two_visits_photos_of_one_name_and_size_apart(path: Path) -> None:
    """By content where the photo of a visit still lies where it did, by folders, and else not at all."""
    gmap, home = read_map(path), path.parent
    photo_of(home / "later" / "s" / "00000.png", BLUE)
    view = View("s/00000.png", home / "later" / "s" / "00000.png", np.eye(3), 64, 48, np.eye(4))
    gmap.views.append(replace(stored_view(view, path, visit=1), name="visit1/s/00000.png"))
    gmap.info["visits"] = [{"time": None, "input": name, "photos": n} for n, name in enumerate(("a", "b"), 1)]
    write_map(path, gmap)
    assert len({(home / name / "s" / "00000.png").stat().st_size for name in ("photos", "later")}) == 1

    def colors() -> list[tuple[int, ...]]:
        shots = [cv2.imread(str(view.photo))[..., ::-1] for view in read_map(path).located_views()]
        return [tuple(int(x) for x in np.median(shot.reshape(-1, 3), axis=0)) for shot in shots]

    (home / "later").rename(moved := path.parents[1] / "moved")
    assert relink(path, moved) == {"linked": 1, "missing": ["s/00000.png"], "differ": []}
    assert colors() == [RED, BLUE]
    shutil.copytree(home / "photos", path.parents[1] / "copy")
    assert relink(path, path.parents[1] / "copy")["missing"] == ["visit1/s/00000.png"] and colors() == [RED, BLUE]
    shutil.rmtree(path.parents[1] / "copy")
    disk = path.parents[1] / "disk"
    for name, folder in (("photos", home / "photos"), ("moved", moved)):
        shutil.copytree(folder, disk / name)
        shutil.rmtree(folder)
    with pytest.raises(InputError, match=r"'s/00000\.png' and 'visit1/s/00000\.png', which have one name"):
        relink(path, (disk / "photos").rename(disk / "unknown"))
    (disk / "unknown").rename(disk / "copy")
    assert relink(path, disk) == {"linked": 2, "missing": [], "differ": []}
    assert colors() == [RED, BLUE]


def test_relink_refuses_a_folder_without_the_photos(path: Path) -> None:
    before = (path / "map.json").read_bytes()
    other = path.parents[1] / "other"
    photo_of(other / "s" / "00000.png", BLUE, side=32)
    for folder, words in ((other, "another size"), (path, "none of the 1 photos"), (other / "no", "is no folder")):
        with pytest.raises(InputError, match=words):
            relink(path, folder)
    assert (path / "map.json").read_bytes() == before


def test_a_map_saved_again_where_it_moved_to_keeps_its_photos(path: Path) -> None:
    moved = path.parents[1] / "moved"
    path.parent.rename(moved)
    write_map(moved / "a.gsmap", read_map(moved / "a.gsmap"))
    assert shown(moved / "a.gsmap") == RED
    write_map(moved / "deeper" / "b.gsmap", read_map(moved / "a.gsmap"))
    assert shown(moved / "deeper" / "b.gsmap") == RED
