"""Photos of painted rooms with exact poses are localised, or refused where that is right."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from perception.localise.localiser import Localised, Localiser, NewPhoto, NotHere
from perception.map.map import Map
from perception.posed.bundle_adjustment import Adjusted
from perception.types import DepthImage, Lens
from support.painted_room import FOCAL, PaintedRoom, difference, pose_at, walk

NEAR = 0.003, 0.08
"""Metres and degrees: a tenth of a pixel at 2 m is 0.7 mm and 0.02°, over some hundred features far less."""


@pytest.fixture(scope="module")
def room() -> PaintedRoom:
    return PaintedRoom(0)


@pytest.fixture(scope="module")
def known(room: PaintedRoom, tmp_path_factory: pytest.TempPathFactory) -> Localiser:
    """The localiser of a map of two walls."""
    folder = tmp_path_factory.mktemp("known")
    poses = [*walk(1, 5), *walk(3, 5)]
    return Localiser(Map(views=[room.view(folder, f"{n}.png", pose) for n, pose in enumerate(poses)], info={}))


def new(room: PaintedRoom, folder: Path, poses: list[np.ndarray], prefix: str = "new") -> list[NewPhoto]:
    views = [room.view(folder, f"{prefix}{n}.png", pose) for n, pose in enumerate(poses)]
    return [NewPhoto(view.name, view.photo) for view in views]


def test_new_photos_get_their_exact_poses_and_honest_errors(
    room: PaintedRoom, known: Localiser, tmp_path: Path
) -> None:
    poses = [walk(1, 4, 0.15)[1], walk(3, 4, 0.15)[2]]
    photos = new(room, tmp_path, poses)
    found = known.answers(photos)
    for answer, truth in zip(found, poses, strict=True):
        assert isinstance(answer, Localised)
        length, degrees = difference(answer.camera_from_map, truth)
        assert length < NEAR[0] and degrees < NEAR[1]
        assert length < 6 * answer.standard_error[0] and degrees < 6 * answer.standard_error[1]
    again = known.localise([photo.photo for photo in photos])
    assert all(np.array_equal(a.camera_from_map, b.camera_from_map) for a, b in zip(found, again, strict=True))  # type: ignore[union-attr]


@pytest.mark.slow
def test_photos_of_another_room_are_named_and_the_others_localised(
    room: PaintedRoom, known: Localiser, tmp_path: Path
) -> None:
    photos = new(room, tmp_path, walk(1, 2, 0.1)) + new(PaintedRoom(5), tmp_path, walk(1, 2, 0.1), "elsewhere")
    (tmp_path / "broken.png").write_bytes(b"no picture")
    found = known.answers([*photos, NewPhoto("broken.png", tmp_path / "broken.png")])
    assert [isinstance(answer, Localised) for answer in found] == [True, True, False, False, False]
    assert [answer.name for answer in found[2:]] == ["elsewhere0.png", "elsewhere1.png", "broken.png"]
    assert all(isinstance(answer, NotHere) and "not in this map" in answer.why for answer in found[2:4])
    assert isinstance(found[4], NotHere) and "not a readable image" in found[4].why
    assert known.localise([photos[2].photo]) == [None]


@pytest.mark.slow
def test_a_photo_beside_the_map_is_reached_through_others(
    room: PaintedRoom, known: Localiser, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The map shows two walls. A turn on the spot would give no points in space, so the camera moves.
    The errors are computed once, of the last of several adjustments."""
    covariances, calls = Adjusted.covariances, list[Adjusted]()
    monkeypatch.setattr(Adjusted, "covariances", lambda found, lens: (calls.append(found), covariances(found, lens))[1])
    targets = [(3.4, 3.0), (2.0, 3.0), (0.6, 3.0), (0.0, 2.2), (0.0, 1.4), (0.0, 0.8)]
    poses = [pose_at((2.2 + 0.12 * n, 1.0 + 0.1 * (-1) ** n, 1.2), (x, y, 1.2)) for n, (x, y) in enumerate(targets)]
    photos = new(room, tmp_path, poses)
    assert known.localise([photos[-1].photo]) == [None]
    found = known.answers(photos)
    assert all(isinstance(answer, Localised) for answer in found) and len(calls) == 1
    for answer, truth in zip(found, poses, strict=True):
        length, degrees = difference(answer.camera_from_map, truth)  # type: ignore[union-attr]
        assert length < 0.03 and degrees < 0.5


@pytest.mark.slow
def test_equal_walls_leave_a_photo_of_one_of_them_in_doubt(tmp_path: Path) -> None:
    """Walls 0 and 1 have one paint and the others none. With paint on the others, what is beside it decides."""
    for bare, expected in (((2, 3, 4, 5), False), ((), True)):
        room = PaintedRoom(2, same=((0, 1),), bare=bare)
        folder = tmp_path / str(expected)
        poses = [*walk(0, 4), *walk(1, 4), *(walk(3, 4) if expected else [])]
        localiser = Localiser(Map(views=[room.view(folder, f"{n}.png", p) for n, p in enumerate(poses)], info={}))
        wide = pose_at((1.6, 1.0, 1.2), (4.0, 2.2 if expected else 1.4, 1.2))
        answer = localiser.answers(new(room, folder, [wide]))[0]
        assert isinstance(answer, Localised) == expected
        if isinstance(answer, Localised):
            assert difference(answer.camera_from_map, wide)[0] < 0.01
        else:
            assert "two poses fit" in answer.why


@pytest.mark.slow
def test_a_lens_is_given_or_the_maps_or_estimated(room: PaintedRoom, known: Localiser, tmp_path: Path) -> None:
    """A photo of another shape, of a camera with 0.8 times the focal length, of which nothing is known."""
    size, focal = (420, 280), 0.8 * FOCAL
    K = np.array([[focal, 0, size[0] / 2], [0, focal, size[1] / 2], [0, 0, 1]])
    truth = walk(1, 4, 0.15)[2]
    cv2.imwrite(str(tmp_path / "a.png"), room.photo(truth, K, size)[0][..., ::-1])
    estimated = known.answers([NewPhoto("a.png", tmp_path / "a.png")])[0]
    assert isinstance(estimated, Localised)
    assert estimated.lens.params[0] == pytest.approx(focal, rel=0.02)
    assert difference(estimated.camera_from_map, truth)[0] < 0.03
    lens = Lens("PINHOLE", (focal, focal, size[0] / 2, size[1] / 2), *size)
    given = known.localise([tmp_path / "a.png"], lens)[0]
    assert given is not None and given.lens == lens
    assert difference(given.camera_from_map, truth)[0] < NEAR[0]


@pytest.mark.slow
def test_measured_depth_makes_a_pose_surer_in_any_unit(room: PaintedRoom, known: Localiser, tmp_path: Path) -> None:
    truth = walk(1, 4, 0.15)[1]
    photo = new(room, tmp_path, [truth])[0]
    depth = np.round(room.photo(truth)[1] * 1000).astype(np.uint16)
    cv2.imwrite(str(tmp_path / "depth.png"), depth)
    plain = known.answers([photo])[0]
    assert isinstance(plain, Localised)
    for scale in (1e-3, 0.25):  # metres, and a unit that is none of the map's
        answer = known.answers([replace(photo, depth=DepthImage(tmp_path / "depth.png", scale))])[0]
        assert isinstance(answer, Localised)
        assert answer.standard_error[0] < plain.standard_error[0]
        assert answer.depth is not None and answer.depth.scale == pytest.approx(1e-3, rel=0.01)  # the image has mm
        assert difference(answer.camera_from_map, truth)[0] < NEAR[0]


def test_a_map_without_matches_knows_no_photo(tmp_path: Path) -> None:
    room = PaintedRoom(3)
    views = [room.view(tmp_path, "a.png", walk(0, 2)[0]), room.view(tmp_path, "b.png", walk(1, 2)[0])]
    answer = Localiser(Map(views=views, info={})).answers(new(room, tmp_path, walk(0, 3)[1:2]))[0]
    assert isinstance(answer, NotHere)


@pytest.mark.slow
def test_photos_of_all_kinds_are_read(room: PaintedRoom, known: Localiser, tmp_path: Path) -> None:
    """Another format, grey, turned by EXIF, with EXIF's focal length; black ones are no error."""
    truth = walk(1, 4, 0.15)[1]
    photo, exif, turned = Image.fromarray(room.photo(truth)[0]), Image.Exif(), Image.Exif()
    exif.get_ifd(0x8769)[0xA405], turned[0x0112] = 27, 6
    photo.save(tmp_path / "a.webp", lossless=True)
    photo.convert("L").save(tmp_path / "grey.png")
    photo.save(tmp_path / "exif.jpg", quality=95, exif=exif)
    photo.transpose(Image.Transpose.ROTATE_90).save(tmp_path / "turned.jpg", quality=95, exif=turned)
    Image.new("RGB", (400, 300)).save(tmp_path / "black.png")
    Image.new("RGB", (4, 4)).save(tmp_path / "tiny.png")
    names = ["a.webp", "exif.jpg", "grey.png", "turned.jpg", "black.png", "tiny.png"]
    found = known.localise([tmp_path / name for name in names])
    assert [answer is not None for answer in found] == [True] * 4 + [False] * 2
    for answer in found[:4]:
        assert answer is not None and difference(answer.camera_from_map, truth)[0] < NEAR[0]
