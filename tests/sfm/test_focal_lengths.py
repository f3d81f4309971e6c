"""Focal lengths that EXIF states: taken where they can be, for photos at their present size."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

from perception.photos.lens import load_pycolmap
from perception.sfm.features import camera_groups, import_photos
from perception.types import Lens

SIZE = (640, 480)
FILM, MILLIMETRES, PER_UNIT, UNIT, WIDTH, HEIGHT = 0xA405, 0x920A, 0xA20E, 0xA210, 0xA002, 0xA003
# A sensor 36 mm wide of 5472 pixels: a lens of 50 mm has 50 / 36 of the width.
SENSOR = {MILLIMETRES: 50, PER_UNIT: IFDRational(54720 * 254, 3600), UNIT: 2}


def camera_of(folder: Path, tags: dict[int, Any], size: tuple[int, int] = SIZE, lens: Lens | None = None) -> Any:
    """The camera in the database of one photo with such EXIF tags."""
    exif = Image.Exif()
    exif.get_ifd(0x8769).update(tags)
    Image.new("RGB", size, (90, 90, 90)).save(folder / "a.jpg", exif=exif)
    import_photos(folder / "d.db", folder, [folder / "a.jpg"], ["a.jpg"], [lens])
    with load_pycolmap().Database.open(folder / "d.db") as database:
        (camera,) = database.read_all_cameras()
    return camera


@pytest.mark.parametrize(
    ("tags", "share"),
    [
        ({FILM: 33}, 33 / 36),  # COLMAP reads it by the long side of 36 mm, or by the diagonal of 43 mm
        (SENSOR | {WIDTH: 5472, HEIGHT: 3648}, 50 / 36),
        (SENSOR | {UNIT: 3, PER_UNIT: IFDRational(1520, 1), WIDTH: 5472, HEIGHT: 3648}, 50 / 36),
        (SENSOR | {FILM: 50, WIDTH: 5472, HEIGHT: 3648}, 50 / 36),
    ],
)
def test_focal_lengths_of_photos_that_were_resized(tags: dict[int, Any], share: float, tmp_path: Path) -> None:
    camera = camera_of(tmp_path, tags)
    assert camera.has_prior_focal_length and camera.focal_length == pytest.approx(share * 640, rel=0.05)


def test_focal_lengths_of_photos_as_they_were_taken(tmp_path: Path) -> None:
    tags = SENSOR | {PER_UNIT: IFDRational(6400 * 254, 3600), WIDTH: 640, HEIGHT: 480}
    camera = camera_of(tmp_path, tags)
    assert camera.has_prior_focal_length and camera.focal_length == pytest.approx(50 / 36 * 640, rel=1e-3)


@pytest.mark.parametrize(
    "tags",
    [
        {FILM: 4},
        {FILM: 1},
        {FILM: 65535},
        {MILLIMETRES: 0, PER_UNIT: IFDRational(3860, 1), UNIT: 2},
        {MILLIMETRES: 50, PER_UNIT: IFDRational(0, 1), UNIT: 2},
        {MILLIMETRES: IFDRational(0, 0), PER_UNIT: IFDRational(3860, 1), UNIT: 2},
        {},
    ],
)
def test_focal_lengths_that_no_lens_has_say_nothing(tags: dict[int, Any], tmp_path: Path) -> None:
    camera = camera_of(tmp_path, tags)
    assert not camera.has_prior_focal_length and camera.focal_length == pytest.approx(1.2 * 640)


def test_a_cut_sensor_is_another_camera(tmp_path: Path) -> None:
    """Twice the zoom by the same lens: the focal length in millimetres is the same, that on film is not."""
    for index, film in enumerate((26, 52, 26)):
        exif = Image.Exif()
        exif.get_ifd(0x8769).update({MILLIMETRES: IFDRational(686, 100), FILM: film})
        Image.new("RGB", SIZE, (index, 90, 90)).save(tmp_path / f"{index}.jpg", exif=exif)
    photos = [tmp_path / f"{index}.jpg" for index in range(3)]
    groups = camera_groups(tmp_path, photos, [photo.name for photo in photos], [None] * 3)
    assert [names for names, _ in groups] == [["0.jpg", "2.jpg"], ["1.jpg"]]


def test_a_known_lens_stays(tmp_path: Path) -> None:
    camera = camera_of(tmp_path, {FILM: 33}, lens=Lens("PINHOLE", (100.0, 101.0, 320.0, 240.0), *SIZE))
    assert list(camera.params) == [100, 101, 320, 240]
