"""Crops of instances from photos: cut where the thing is, and only from files that may be shown."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from perception.map.write import read_map, write_map
from perception.photos.view_json import StoredView
from perception.query import load_map
from perception.query.crops import PhotoOutside, best_crop, photos_outside
from support.query_maps import encoders, write_map_of


def write_photo_map(path: Path, photo: str, beside: str | None = None) -> Path:
    """A map of one instance that says its photo is the file `photo`, or `beside` relative to the map."""
    write_map_of(path, ["square"], gaussians=50)
    gmap = read_map(path)
    gmap.views = [StoredView("00000.jpg", Path(photo), np.eye(3), 160, 100, np.eye(4), photo_beside=beside)]
    gmap.language["view_boxes"] = np.array([[100, 40, 130, 60]], np.int32)
    write_map(path, gmap)
    stored = read_map(path).views[0]
    assert isinstance(stored, StoredView) and stored.photo_beside == beside
    return path


def picture(file: Path) -> Path:
    file.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.full((100, 160, 3), 128, np.uint8)).save(file)
    return file


def shown(path: Path, photos: Path | None = None) -> bool:
    """Whether the photo is read; PhotoOutside says that it may not be."""
    try:
        return best_crop(load_map(path, encoders=encoders), 0, photos=photos) is not None
    except PhotoOutside:
        assert photos_outside(load_map(path), photos)
        return False


def test_the_best_photo_is_cut_around_its_box(tmp_path: Path) -> None:
    """A red square on a grey photo; the crop must hold it, centred, and be gone when the photo is."""
    photo = np.full((100, 160, 3), 128, np.uint8)
    photo[40:60, 100:130] = (255, 0, 0)
    Image.fromarray(photo).save(tmp_path / "p.png")
    gmap = load_map(write_photo_map(tmp_path / "a.gsmap", str(tmp_path / "p.png")), encoders=encoders)
    crop = best_crop(gmap, 0, 64, tmp_path)
    assert crop is not None
    picture = crop.astype(int)
    height, width = picture.shape[:2]
    assert max(height, width) <= 64
    red = (picture[..., 0] > 200) & (picture[..., 1] < 80)
    rows, columns = np.nonzero(red)
    assert abs(rows.mean() - height / 2) < 2 and abs(columns.mean() - width / 2) < 2
    assert 0.3 < red.mean() < 0.9
    (tmp_path / "p.png").unlink()
    assert best_crop(gmap, 0, 64, tmp_path) is None


def test_a_received_map_cannot_have_a_private_file_shown(tmp_path: Path) -> None:
    private = picture(tmp_path / "private/secret.png")
    path = write_photo_map(tmp_path / "a.gsmap", str(private))
    assert not shown(path, path)
    assert not shown(path, picture(tmp_path / "photos/other.png").parent)
    assert shown(path, private.parent) and shown(path, tmp_path) and not shown(path)
    other = write_photo_map(tmp_path / "b.gsmap", "gone.png", "../private/secret.png")
    assert not shown(other, other)


def test_photos_below_the_map_are_shown_and_links_out_of_it_are_not(tmp_path: Path) -> None:
    private = picture(tmp_path / "private/secret.png")
    path = write_photo_map(tmp_path / "a.gsmap", str(tmp_path / "a.gsmap/photos/p.png"))
    picture(path / "photos/p.png")
    assert shown(path) and photos_outside(load_map(path)) is None
    (tmp_path / "link.gsmap").symlink_to(path)
    assert shown(tmp_path / "link.gsmap")
    (path / "photos/p.png").unlink()
    (path / "photos/p.png").symlink_to(private)
    assert not shown(path) and shown(path, private.parent)
    other = write_photo_map(tmp_path / "b.gsmap", f"{tmp_path}/b.gsmap/../private/secret.png")
    assert not shown(other, other)


@pytest.mark.parametrize("photo", ["/dev/zero", "a" * 5000, "", "/proc/self/environ", "~/.ssh/id_rsa"])
def test_what_is_no_photo_is_not_found(tmp_path: Path, photo: str) -> None:
    assert not shown(write_photo_map(tmp_path / "a.gsmap", photo), Path("/"))


def test_a_fifo_is_no_photo(tmp_path: Path) -> None:
    """Opening one would wait for a writer that never comes."""
    path = write_photo_map(tmp_path / "a.gsmap", str(tmp_path / "a.gsmap/pipe.png"))
    os.mkfifo(path / "pipe.png")
    assert not shown(path, path)
