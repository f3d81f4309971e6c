"""The unit of a scene against truth that is known exactly, and how often two standard errors cover it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from perception.calibration.board import Board
from perception.errors import InputError
from perception.frame.known_size import Sighting, scale_of_board, scale_of_pixels, scale_of_sightings, scale_of_tags
from perception.frame.scale import (
    Measurement,
    combined,
    earth_positions,
    known_length,
    photo_position,
    scale_of_depth,
    scale_of_gps,
    scale_of_positions,
)
from perception.geometry import camera_centres
from perception.types import DepthImage, View
from support.board_pictures import board_texture
from support.measured_scenes import cameras, estimated, painted, random_similarity, seen, tag_texture

SQUARE = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])


def poses_of(views: list[View]) -> np.ndarray:
    return np.stack([view.camera_from_world for view in views])


def tags(rng: np.random.Generator) -> tuple[Measurement | None, float]:
    """Three tags of 8 cm on a table, 0.3 pixels of corner noise."""
    true, (world, metres) = cameras("orbit", 30), random_similarity(rng)
    shapes = []
    for place in ([-0.2, 0.1, 0], [0.1, -0.1, 0], [0.0, 0.2, 0.05]):
        shapes.append(Sighting(0.08 * SQUARE, seen(true, 0.08 * SQUARE + place, 0.3, rng)))
    return scale_of_sightings(estimated(true, world, rng), shapes, 0.15, "tags"), metres


def board(rng: np.random.Generator) -> tuple[Measurement | None, float]:
    """A board of 7 × 5 corners of 3 cm seen by eight views."""
    true, (world, metres) = cameras("orbit", 8), random_similarity(rng)
    corners = 0.03 * np.array([[x, y, 0.0] for y in range(5) for x in range(7)])
    thing = Sighting(corners, seen(true, corners - [0.1, 0.06, 0], 0.2, rng))
    return scale_of_sightings(estimated(true, world, rng), [thing], 0.15, "board"), metres


def length(rng: np.random.Generator) -> tuple[Measurement | None, float]:
    """A length of 29.7 cm clicked in five photos, to a pixel and a half."""
    true, (world, metres) = cameras("orbit", 30), random_similarity(rng)
    ends = np.array([[-0.15, 0, 0.02], [0.147, 0, 0.02]])
    rays = seen(true, ends, 1.5, rng)
    rays[[n for n in range(30) if n not in (2, 6, 13, 19, 25)]] = np.nan
    thing = Sighting(np.array([[0, 0, 0], [0.297, 0, 0]]), rays)
    return scale_of_sightings(estimated(true, world, rng), [thing], 1.0, "x"), metres


def gps(rng: np.random.Generator) -> tuple[Measurement | None, float]:
    """60 photos around a house, 2.5 m of error sideways and 4 m in height, a tenth of them 50 m off."""
    world, metres = random_similarity(rng)
    angle = np.linspace(0, 5.5, 60)
    places = np.c_[40 * np.cos(angle), 30 * np.sin(angle), 2 * np.sin(3 * angle)]
    found = places + rng.normal(size=places.shape) * [2.5, 2.5, 4]
    found[rng.permutation(60)[:6]] += rng.normal(size=(6, 3)) * 50
    return scale_of_positions(places @ world[:3, :3].T + world[:3, 3], found)[0], metres


@pytest.mark.slow
@pytest.mark.parametrize(("source", "within"), [(tags, 0.01), (board, 0.01), (length, 0.01), (gps, 0.05)])
def test_scale_is_right_and_its_error_as_stated(
    source: Callable[[np.random.Generator], tuple[Measurement | None, float]], within: float
) -> None:
    """40 draws: the median error is within a share of the truth, and two standard errors cover it in nine of ten."""
    errors, stated = [], []
    for seed in range(40):
        found, true = source(np.random.default_rng(seed))
        assert found is not None
        errors.append(abs(found.metres / true - 1))
        stated.append(found.standard_error / found.metres)
    print(f"{source.__name__}: median {np.median(errors):.2%}, most {max(errors):.2%}, stated {np.median(stated):.2%}")
    assert np.median(errors) < within
    assert np.mean(np.array(errors) <= 2 * np.array(stated)) >= 0.9
    assert np.median(stated) < 4 * np.median(errors) + 1e-4  # and not by stating far too much


def test_tags_and_boards_are_found_in_photos(tmp_path: Path) -> None:
    views = cameras("orbit", 30)[::5]
    metres = 1 / 2.7
    tag = tag_texture(17)
    flat = np.diag([0.16 / 240, -0.16 / 240, 1.0, 1.0])  # texture x, y -> the table's plane, y towards the viewer
    flat[:3, 3] = [-0.1, 0.1, 0.0]
    posed = []
    for number, view in enumerate(views):
        shot = painted(view, tag, flat, tmp_path / f"{number}.png")
        pose = view.camera_from_world.copy()
        pose[:3, 3] /= metres
        posed.append(replace(shot, camera_from_world=pose))
    found = scale_of_tags(posed, 0.16)
    assert found.metres == pytest.approx(metres, rel=0.005) and "1 APRILTAG_36h11 tags of 0.16 m" in found.source
    assert abs(found.metres - metres) < 3 * found.standard_error
    with pytest.raises(InputError, match=r"board: the charuco of 6x5 .* is seen in 0 of 6 photos"):
        scale_of_board(posed, Board.from_text("charuco:6x5:0.06"))
    sheet = Board.from_text("charuco:6x5:0.06")
    flat = np.diag([0.06 / 60, -0.06 / 60, 1.0, 1.0])
    flat[:3, 3] = [-0.18, 0.15, 0.0]
    posed = [
        replace(painted(view, board_texture(sheet), flat, p.photo), camera_from_world=p.camera_from_world)
        for view, p in zip(views, posed, strict=True)
    ]
    assert scale_of_board(posed, sheet).metres == pytest.approx(metres, rel=0.005)
    with pytest.raises(InputError, match="no tag of APRILTAG_36h11"):
        scale_of_tags([replace(p, photo=_grey(tmp_path)) for p in posed], 0.16)


def test_a_tag_that_was_moved_between_two_photos_is_not_used() -> None:
    """It faces both cameras, and between its places it looks square; but the rays to its corners do not meet."""
    views = cameras("orbit", 30)[:6:5]
    places = np.array([[-0.2, -0.2], [0.25, 0.4]])
    thing = Sighting(0.08 * SQUARE, 0.12 * SQUARE[:, :2] + places[:, None])
    with pytest.raises(InputError, match="a tag: its corners cannot be triangulated"):
        scale_of_sightings(views, [thing], 0.15, "a tag")


def test_tags_are_found_beside_what_looks_like_another_family(tmp_path: Path) -> None:
    """A tag of 6X6_250 on a table; one of 4X4_50, which is tried before, rides on a robot."""
    flat = np.diag([0.16 / 240, -0.16 / 240, 1.0, 1.0])
    flat[:3, 3] = [-0.1, 0.1, 0.0]
    moving, views = tag_texture(3, 60, 10, "4X4_50"), []
    for number, view in enumerate(cameras("orbit", 30)[::8]):
        views.append(painted(view, tag_texture(17, name="6X6_250"), flat, tmp_path / f"{number}.png"))
        picture = cv2.imread(str(views[-1].photo))
        if number in (1, 2):
            top, left = (60, 60) if number == 1 else (380, 300)
            picture[top : top + 80, left : left + 80] = np.rot90(moving, number)[..., None]
            cv2.imwrite(str(views[-1].photo), picture)
    found = scale_of_tags(views, 0.16)
    assert found.metres == pytest.approx(1, rel=0.005) and "1 6X6_250 tags" in found.source
    for view in views:  # without the one on the table
        picture = cv2.imread(str(view.photo))
        picture[180:340] = 128
        cv2.imwrite(str(view.photo), picture)
    with pytest.raises(InputError, match=r"4X4_50 tags of 0\.16 m: its corners cannot be triangulated"):
        scale_of_tags(views, 0.16)


def _grey(folder: Path) -> Path:
    cv2.imwrite(str(folder / "grey.png"), np.full((480, 640), 128, np.uint8))
    return folder / "grey.png"


def test_a_length_between_pixels(tmp_path: Path) -> None:
    views = cameras("orbit", 30)
    ends = np.array([[0.0, 0.0, 0.0], [0.2, 0.1, 0.0]])
    parts = []
    for n in (3, 14, 25):
        local = ends @ views[n].camera_from_world[:3, :3].T + views[n].camera_from_world[:3, 3]
        (a, b), (c, d) = (local @ views[n].K.T)[:, :2] / local[:, 2:]
        parts.append(f"{views[n].name} {a:.2f},{b:.2f} {c:.2f},{d:.2f}")
    true = float(np.linalg.norm(ends[1]))
    found = scale_of_pixels(views, known_length(f"{2 * true}: " + "; ".join(parts)))
    assert found.metres == pytest.approx(2, rel=1e-3)  # rounding of the pixels
    with pytest.raises(InputError, match=r"'zzz\.png' is none of the 30"):
        scale_of_pixels(views, known_length("1: zzz.png 1,2 3,4; 003.png 1,2 3,4"))
    with pytest.raises(InputError, match="both ends are needed in two photos"):
        scale_of_pixels(views, known_length("1: 003.png 1,2 3,4"))
    with pytest.raises(InputError, match=r"'014\.png' has 640×480 pixels, found 300,200 and 300,480\.5; give pixels"):
        scale_of_pixels(views, known_length("1: 003.png 0,0 640,480; 014.png 300,200 300,480.5"))


def test_forms_of_a_known_length() -> None:
    assert known_length("2.03: door, my frame").names == ("door", "my frame")
    assert known_length("1: 12, 15").names == ("12", "15")
    points = known_length("1e-1: 0,0,0 -1,2,3.5").points
    assert points is not None and points.tolist() == [[0, 0, 0], [-1, 2, 3.5]]
    pixels = known_length("0.297: a b/1.jpg 100,200 300,220; 2.jpg 110,190 310,215").pixels
    assert pixels is not None and list(pixels) == ["a b/1.jpg", "2.jpg"] and pixels["2.jpg"][1].tolist() == [310, 215]
    for text in ("0: a, b", "-1: a, b", "inf: a, b"):
        with pytest.raises(InputError, match="expected a length above 0"):
            known_length(text)
    for text in (
        "nan: a, b",
        "x: a, b",
        "1",
        "1:",
        "1: a",
        "1: a, b, c",
        "1: 1,2,3 1,2,3",
        "1: a 1,2 e,4; b 1,2 3,4",
    ):
        with pytest.raises(InputError, match="METRES: LABEL, LABEL"):
            known_length(text)


def _turned_about_z(degrees: float) -> np.ndarray:
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])


def test_positions_on_the_earth_and_in_photos(tmp_path: Path) -> None:
    """A minute of latitude at 45° is 1852.2 m, one of longitude 1314.2 m (WGS84 tables: 111 132, 78 847 m a degree)."""
    start = np.array([45.0, 9.0, 100.0])
    moved = earth_positions(start + np.array([[0, 0, 0], [1 / 60, 0, 0], [0, 1 / 60, 0], [0, 0, 30]]))
    np.testing.assert_allclose(np.linalg.norm(moved, axis=1), [0, 1852.2, 1314.1, 30], atol=0.4)
    cosines = moved[1:] @ moved[1:].T / np.outer(*[np.linalg.norm(moved[1:], axis=1)] * 2)
    np.testing.assert_allclose(cosines, np.eye(3), atol=1e-3)  # north, east and up
    np.testing.assert_allclose(moved[3], 30 * np.array([0.7071, 0, 0.7071]) @ _turned_about_z(9), atol=1e-2)
    exif = Image.Exif()
    place = {1: "S", 2: (33.0, 51.0, 54.6), 3: "E", 4: (151.0, 12.0, 36.0), 5: b"\x01", 6: 12.5}
    exif.get_ifd(0x8825).update(place)
    Image.new("RGB", (8, 8)).save(tmp_path / "a.jpg", exif=exif)
    Image.new("RGB", (8, 8)).save(tmp_path / "b.jpg")
    np.testing.assert_allclose(photo_position(tmp_path / "a.jpg"), [-33.8651667, 151.21, -12.5], atol=1e-6)
    assert photo_position(tmp_path / "b.jpg") is None and photo_position(tmp_path / "none.jpg") is None
    assert scale_of_gps([replace(view, photo=tmp_path / "a.jpg") for view in cameras("orbit", 5)]) == (None, [])


def test_gps_that_cannot_tell_is_not_used() -> None:
    rng = np.random.default_rng(0)
    centres = camera_centres(poses_of(cameras("orbit", 30)))
    found, notes = scale_of_positions(centres, centres + 5 * rng.normal(size=centres.shape))  # 5 m around a table
    assert found is None and "too coarse" in notes[0]
    found, notes = scale_of_positions(0 * centres, centres)
    assert found is None and "do not fit" in notes[0]


def test_depth_images_tell_the_unit_though_points_are_hidden(tmp_path: Path) -> None:
    """A wall 2 m away; half of the points lie behind it. True depth everywhere, so the scale is exact."""
    cv2.imwrite(str(tmp_path / "d.png"), np.full((48, 64), 2000, np.uint16))
    rng, metres = np.random.default_rng(1), 0.25
    base = np.array([[50.0, 0, 32], [0, 50, 24], [0, 0, 1]])
    views = []
    for x in (-0.2, 0.0, 0.1, 0.3):
        pose = np.eye(4)
        pose[0, 3] = -x / metres
        views.append(View(f"{x}", tmp_path, base, 64, 48, pose, depth=DepthImage(tmp_path / "d.png", 0.001)))
    points = np.c_[rng.uniform(-1, 1, (600, 2)), np.full(600, 2.0)]
    points[::2, 2] += rng.uniform(0.3, 3, 300)
    found = scale_of_depth(views, points / metres)
    assert found is not None and found.metres == pytest.approx(metres, rel=1e-3)
    assert scale_of_depth([replace(view, depth=None) for view in views], points) is None
    assert scale_of_depth(views, points[:10]) is None


def test_several_measurements_are_one() -> None:
    """Weights 1 and 4 in relative precision; a contradiction leaves the most precise one and is told."""
    mean, notes = combined([Measurement(1.0, 0.02, "a"), Measurement(1.01, 0.0101, "b")])
    assert mean is not None and not notes and mean.source == "a; b"
    assert np.log(mean.metres) == pytest.approx(0.8 * np.log(1.01)) and mean.standard_error == pytest.approx(
        mean.metres / np.sqrt(50**2 + 100**2)
    )
    kept, notes = combined([Measurement(1.0, 0.02, "GPS"), Measurement(2.0, 0.01, "tag")])
    assert kept is not None and kept.source == "tag" and "contradict each other" in notes[0]
    assert combined([]) == (None, [])
