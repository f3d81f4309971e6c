"""What stays in the picture while the camera moves: known things pasted over pictures of a camera that moves."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from perception.photos import still
from perception.photos.ignore_masks import read_mask
from perception.photos.still import still_pixels, with_still
from perception.progress import QUIET

SIZE = (240, 320)


@pytest.fixture(scope="module")
def wall() -> np.ndarray:
    """[900, 1200] uint8: a large wall with texture of all sizes."""
    rng = np.random.default_rng(0)
    layers = (rng.normal(0, 1, (900 // s + 1, 1200 // s + 1)).astype(np.float32) for s in (4, 12, 40, 150))
    total = sum(cv2.resize(layer, (1200, 900), interpolation=cv2.INTER_CUBIC) for layer in layers)
    return np.clip(128 + 35 * total, 0, 255).astype(np.uint8)


def walk(wall: np.ndarray, count: int, seed: int = 1, reach: float = 1.0) -> np.ndarray:
    """`count` windows of the wall [N, 240, 320], anywhere; reach: share of the wall over which they lie."""
    rng = np.random.default_rng(seed)
    at = (rng.uniform(0, reach, (count, 2)) * (900 - 240, 1200 - 320)).astype(int)
    return np.stack([wall[y : y + 240, x : x + 320] for y, x in at])


def pads(pictures: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two textured pads in the upper corners, as of a gripper: the pictures and the truth."""
    truth, texture = np.zeros(SIZE, bool), np.random.default_rng(9).integers(10, 90, SIZE).astype(np.uint8)
    truth[:80, :60] = truth[:90, -70:] = True
    return np.where(truth, cv2.GaussianBlur(texture, (0, 0), 1.0), pictures), truth


def bumper(pictures: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A plain grey bumper with a straight edge along the whole picture."""
    truth = np.zeros(SIZE, bool)
    truth[200:] = True
    return np.where(truth, np.uint8(120), pictures), truth


def drop(pictures: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A plain dark drop on the lens."""
    truth = cv2.circle(np.zeros(SIZE, np.uint8), (150, 110), 12, 1, -1) > 0
    return np.where(truth, np.uint8(30), pictures), truth


def spoiled(pictures: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """The pictures with exposures that vary by a half, noise, and JPEG compression."""
    result = []
    for picture in pictures:
        noisy = np.clip(picture * rng.uniform(0.7, 1.1) + rng.normal(0, 2, SIZE), 0, 255).astype(np.uint8)
        result.append(
            cv2.imdecode(cv2.imencode(".jpg", noisy, [cv2.IMWRITE_JPEG_QUALITY, 75])[1], cv2.IMREAD_GRAYSCALE)
        )
    return np.stack(result)


@pytest.mark.parametrize(("thing", "count"), [(pads, 5), (pads, 30), (bumper, 30), (drop, 30)])
@pytest.mark.parametrize("how", ["clean", "spoiled", "dark"])
def test_a_thing_pasted_over_moving_pictures_is_covered(wall: np.ndarray, thing, count: int, how: str) -> None:
    pictures, truth = thing(walk(wall, count))
    if how == "spoiled" and thing is pads:
        pictures = spoiled(pictures, np.random.default_rng(2))
    if how == "dark":
        pictures = pictures // 4
    found = still_pixels(pictures)
    reach = round((still.MARGIN + 0.02) * still.SIDE)
    near = cv2.dilate(truth.astype(np.uint8), np.ones((2 * reach + 1, 2 * reach + 1))) > 0
    assert found[truth].mean() > 0.97
    assert not (found & ~near).any()


def test_a_moving_camera_alone_finds_nothing(wall: np.ndarray) -> None:
    for count, seeds in ((5, 4), (8, 4), (16, 4), (40, 1)):
        for seed in range(seeds):
            assert not still_pixels(walk(wall, count, seed)).any()


def test_a_tripod_and_a_nearly_still_camera_keep_their_scene(wall: np.ndarray) -> None:
    rng = np.random.default_rng(4)
    for thing in (pads, bumper):
        stand = np.repeat(wall[None, :240, :320], 30, axis=0)
        assert not still_pixels(spoiled(thing(stand)[0], rng)).any()
    shaken = np.stack([wall[y : y + 240, x : x + 320] for y, x in rng.integers(0, 3, (30, 2))])
    assert not still_pixels(shaken).any()


def test_photos_of_one_stand_count_once(wall: np.ndarray) -> None:
    """Of a camera that stands in most photos, the scene is no more still than in one that always moves."""
    stand = np.repeat(wall[None, 300:540, 400:720], 30, axis=0)
    pictures = np.concatenate([stand, walk(wall, 12)])
    assert not still_pixels(pictures).any()
    held, truth = pads(pictures)
    assert still_pixels(held)[truth].mean() > 0.97


def test_plain_walls_and_edges_along_the_way_are_no_things() -> None:
    """A plain wall with a few small posters; and a shelf's edge along which the camera moves."""
    rng = np.random.default_rng(5)
    plain = np.full((900, 1200), 150, np.uint8)
    for y, x in rng.integers(0, 850, (25, 2)):
        plain[y : y + 40, x : x + 50] = rng.integers(0, 255, (40, 50))
    for count in (5, 8, 20, 40):
        assert not still_pixels(walk(plain, count, count)).any()
    shelf = rng.integers(0, 120, (60, 300)).astype(np.uint8)
    shelf = cv2.resize(shelf, (1200, 240))
    shelf[100:] += 120
    along = np.stack([shelf[:, x : x + 320] for x in range(0, 880, 40)])
    assert not still_pixels(along).any()


def test_what_stands_in_the_middle_is_what_the_camera_turns_around(wall: np.ndarray) -> None:
    vase = np.zeros(SIZE, bool)
    vase[70:170, 120:200] = True
    texture = cv2.GaussianBlur(np.random.default_rng(9).integers(0, 255, SIZE).astype(np.uint8), (0, 0), 1.0)
    assert not still_pixels(np.where(vase, texture, walk(wall, 20))).any()
    assert not still_pixels(np.where(vase, np.uint8(90), walk(wall, 20))).any()


def test_masks_are_by_camera_and_keep_those_of_the_user(tmp_path: Path, wall: np.ndarray) -> None:
    held, truth = pads(walk(wall, 8))
    photos, sizes = [], []
    for camera, pictures in (("held", held), ("free", walk(wall, 8, 3)), ("few", held[:4])):
        (tmp_path / camera).mkdir()
        for number, picture in enumerate(pictures):
            photos.append(tmp_path / camera / f"{number}.png")
            cv2.imwrite(str(photos[-1]), np.repeat(np.repeat(picture, 2, 0), 2, 1))
            sizes.append((640, 480))
    own = np.full((480, 640), 255, np.uint8)
    own[400:] = 0
    cv2.imwrite(str(tmp_path / "own.png"), own)
    given = [tmp_path / "own.png", *[None] * 18, tmp_path / "own.png"]
    found = with_still(photos, sizes, given, tmp_path / "masks", QUIET)
    assert found.masks[8:] == given[8:] and len(set(found.masks[1:8])) == 1
    assert with_still(photos, sizes, given, None, QUIET).masks == given
    used, both = (read_mask(found.masks[index], 640, 480)[::2, ::2] > 0 for index in (1, 0))
    assert used[~truth].mean() > 0.9 and used[truth].mean() < 0.03
    np.testing.assert_array_equal(both, used & (own[::2, ::2] > 0))
    assert found.facts["photos"] == 8 and abs(found.facts["share"] - (1 - used.mean())) < 0.01
    times = {file: file.stat().st_mtime_ns for file in (tmp_path / "masks").iterdir()}
    assert with_still(photos, sizes, given, tmp_path / "masks", QUIET).masks == found.masks
    assert times == {file: file.stat().st_mtime_ns for file in (tmp_path / "masks").iterdir()}


def test_masks_of_photos_that_are_used_as_stored_are_not_turned(wall: np.ndarray, tmp_path: Path) -> None:
    """Pillow turns a TIFF when it decodes it."""
    pictures, _ = pads(walk(wall, 12))
    for number, picture in enumerate(pictures):
        for end, options in ((".png", {}), (".tif", {"tiffinfo": {0x0112: 6}})):
            file = tmp_path / end[1:] / f"{number}{end}"
            file.parent.mkdir(exist_ok=True)
            Image.fromarray(picture).save(file, **options)
    found = []
    for kind in ("png", "tif"):
        photos = sorted((tmp_path / kind).iterdir())
        size, none = SIZE[::-1], [None] * len(photos)
        masks = with_still(photos, [size] * len(photos), none, tmp_path / "masks", QUIET, [True] * len(photos)).masks
        assert masks[0] is not None
        found.append(read_mask(masks[0], *size))
    np.testing.assert_array_equal(*found)
