"""Label folders and the store: what is refused, what is warned of, and what survives a second run."""

from __future__ import annotations

from pathlib import Path, PurePosixPath

import cv2
import numpy as np
import pytest

from perception.errors import InputError
from perception.masks import MaskSource, label_folder, make_source
from perception.masks.compute import SEGMENTATION, compute_masks, load_segmentation
from perception.masks.label_files import label_file, load_labels, write_labels
from perception.photos import decode as photos
from perception.types import Lens, View
from support.progress import Told

WIDTH, HEIGHT = 24, 16


def view(name: str, lens: Lens | None = None) -> View:
    return View(name, Path("absent") / name, np.eye(3), WIDTH, HEIGHT, np.eye(4), lens)


@pytest.fixture(autouse=True)
def no_undistortion(monkeypatch):
    """These photos are pinhole images at training size, so labels pass through unchanged."""
    monkeypatch.setattr(photos, "warp_labels", lambda view, labels, width, height: labels)


@pytest.fixture
def folder(tmp_path):
    rng = np.random.default_rng(0)
    for stem, dtype in (("a", np.uint8), ("b", np.uint16)):
        top = np.iinfo(dtype).max + 1
        cv2.imwrite(str(tmp_path / f"{stem}.png"), rng.integers(0, top, (HEIGHT, WIDTH)).astype(dtype))
    return tmp_path


def photo(_: View) -> np.ndarray:
    return np.zeros((HEIGHT, WIDTH, 3), np.uint8)


def test_labels_of_8_and_16_bit_arrive_unchanged(folder):
    source = make_source(f"labels:{folder}")
    views = [view("a.jpg"), view("b.jpg")]
    assert source.check(views) == []
    for item in views:
        expected = cv2.imread(str(folder / item.name.replace("jpg", "png")), cv2.IMREAD_UNCHANGED)
        labels = source.label_image(item, photo(item))
        assert labels.dtype == np.int32
        np.testing.assert_array_equal(labels, expected)


@pytest.mark.parametrize("colors", [200, 12, 3, 2])
def test_palette_indices_are_the_labels(tmp_path, colors):
    """Of few colours Pillow writes 4, 2 and 1 bit."""
    from PIL import Image

    indices = np.arange(HEIGHT * WIDTH, dtype=np.uint8).reshape(HEIGHT, WIDTH) % colors
    image = Image.fromarray(indices, "P")
    image.putpalette(list(np.random.default_rng(1).integers(0, 256, 3 * colors)))
    image.save(tmp_path / "a.png")
    source = make_source(f"labels:{tmp_path}")
    source.check([view("a.jpg")])
    np.testing.assert_array_equal(source.label_image(view("a.jpg"), photo(view("a.jpg"))), indices)


@pytest.mark.parametrize("name", ["../secret.jpg", "/etc/secret.jpg", "a/../../secret.jpg"])
def test_label_images_are_read_and_written_below_their_folder_only(tmp_path, name):
    """The names come from a COLMAP model or a map of somebody else."""
    inside = tmp_path / "labels"
    inside.mkdir()
    for file in (tmp_path / "secret.png", inside / "secret.png"):
        cv2.imwrite(str(file), np.ones((HEIGHT, WIDTH), np.uint8))
    with pytest.raises(InputError, match="photo name"):
        make_source(f"labels:{inside}").check([view(name)])
    with pytest.raises(InputError, match="photo name"):
        compute_masks([view(name)], Counting(), photo, inside)
    assert sorted(p.name for p in tmp_path.rglob("*.png")) == ["secret.png", "secret.png"]


def test_a_folder_without_label_images_is_refused_when_the_source_is_made(tmp_path):
    (tmp_path / "notes.txt").write_text("no labels yet")
    with pytest.raises(InputError, match="holds no PNG"):
        make_source(f"labels:{tmp_path}")


def test_missing_label_image_names_the_photo(folder):
    with pytest.raises(InputError, match=r"c\.jpg without a label image"):
        make_source(f"labels:{folder}").check([view("a.jpg"), view("c.jpg")])


def test_extra_label_image_is_a_warning(folder):
    warnings = make_source(f"labels:{folder}").check([view("a.jpg")])
    assert len(warnings) == 1 and "b.png" in warnings[0]


def test_label_images_of_photos_that_were_kept_out_are_no_surprise(folder, tmp_path_factory):
    photos = tmp_path_factory.mktemp("photos")
    for name in ("a.jpg", "b.jpg"):
        (photos / name).touch()
    cv2.imwrite(str(folder / "c.png"), np.zeros((HEIGHT, WIDTH), np.uint8))
    trained = View("a.jpg", photos / "a.jpg", np.eye(3), WIDTH, HEIGHT, np.eye(4))
    warnings = make_source(f"labels:{folder}").check([trained])
    assert len(warnings) == 1 and "c.png" in warnings[0] and "b.png" not in warnings[0]


def test_wrong_size_tells_both_sizes(folder):
    cv2.imwrite(str(folder / "a.png"), np.zeros((HEIGHT, WIDTH + 1), np.uint8))
    with pytest.raises(InputError, match=f"{WIDTH + 1}×{HEIGHT} pixels, but its photo has {WIDTH}×{HEIGHT}"):
        make_source(f"labels:{folder}").check([view("a.jpg")])


def test_size_is_that_of_the_original_photo(folder):
    lens = Lens("OPENCV", (20.0, 20.0, 12.0, 8.0, 0.1, 0.0, 0.0, 0.0), WIDTH * 2, HEIGHT * 2)
    with pytest.raises(InputError, match=f"has {WIDTH * 2}×{HEIGHT * 2}"):
        make_source(f"labels:{folder}").check([view("a.jpg", lens)])


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (np.zeros((HEIGHT, WIDTH, 3), np.uint8), "8-bit RGB image"),
        (np.zeros((HEIGHT, WIDTH, 4), np.uint8), "RGB with alpha"),
        (b"II*\0 this is a TIFF", "not a PNG"),
        (b"", "not a PNG"),
    ],
)
def test_what_is_no_label_image_is_refused(folder, content, message):
    file = folder / "a.png"
    file.write_bytes(content) if isinstance(content, bytes) else cv2.imwrite(str(file), content)
    with pytest.raises(InputError, match=message):
        make_source(f"labels:{folder}").check([view("a.jpg")])


def test_truncated_label_image(folder):
    file = folder / "b.png"
    file.write_bytes(file.read_bytes()[:80])
    source = make_source(f"labels:{folder}")
    source.check([view("b.jpg")])
    with pytest.raises(InputError, match="damaged or cut short"):
        source.label_image(view("b.jpg"), photo(view("b.jpg")))


def test_subfolders_keep_equal_stems_apart(tmp_path):
    for part, value in (("x", 1), ("y", 2)):
        (tmp_path / part).mkdir()
        cv2.imwrite(str(tmp_path / part / "0.png"), np.full((HEIGHT, WIDTH), value, np.uint8))
    source = make_source(f"labels:{tmp_path}")
    views = [view("x/0.jpg"), view("y/0.jpg")]
    source.check(views)
    assert [source.label_image(v, photo(v))[0, 0] for v in views] == [1, 2]


def test_a_photo_more_is_as_much_work_more_among_many_as_among_few(tmp_path, monkeypatch):
    """Paths that are parsed, of 300 photos less than twice those of 200."""
    cv2.imwrite(str(tmp_path / "0.png"), np.zeros((HEIGHT, WIDTH), np.uint8))
    parsed = []
    monkeypatch.setattr(label_folder, "PurePosixPath", lambda name: parsed.append(name) or PurePosixPath(name))

    def work(count):
        parsed.clear()
        with pytest.raises(InputError, match=f"and {count - 4} more without"):
            make_source(f"labels:{tmp_path}").check([view(f"{n}.jpg") for n in range(count)])
        return len(parsed)

    assert 0 < work(300) < 2 * work(200)


@pytest.mark.parametrize(
    "spec", ["", "labels:", "sam:", "builtin:photos", "auto:x", "nonsense", "labels:/no/such/folder"]
)
def test_bad_specifications(spec):
    with pytest.raises(InputError):
        make_source(spec)


class Counting(MaskSource):
    """A source that remembers what it was asked for."""

    name = "counting"

    def __init__(self, identity: str = "1", found: bool = True) -> None:
        self.identity, self.asked, self.found = identity, [], found

    def label_image(self, view, photo):
        self.asked.append(view.name)
        if not self.found:
            return np.zeros(photo.shape[:2], np.int32)
        return np.random.default_rng(len(view.name)).integers(0, 40_000, photo.shape[:2]).astype(np.int32)


def test_second_run_makes_only_what_is_missing(tmp_path):
    views = [view("a.jpg"), view("sub/bb.jpg"), view("ccc.png")]
    first = Counting()
    compute_masks(views, first, photo, tmp_path)
    label_file(tmp_path, views[1]).unlink()
    label_file(tmp_path, views[2]).write_bytes(b"half a file")
    second = Counting()
    report = compute_masks(views, second, photo, tmp_path)
    assert second.asked == ["sub/bb.jpg", "ccc.png"] and report["skipped"] == 1
    for item in views:
        np.testing.assert_array_equal(load_labels(tmp_path, item), Counting().label_image(item, photo(item)))
    assert not list(tmp_path.rglob("*.tmp"))


def test_another_source_or_size_makes_all_anew(tmp_path):
    views = [view("a.jpg")]
    compute_masks(views, Counting("1"), photo, tmp_path)
    other = Counting("2")
    compute_masks(views, other, photo, tmp_path)
    assert other.asked == ["a.jpg"]
    smaller = [View("a.jpg", views[0].photo, np.eye(3) / 2, WIDTH, HEIGHT, np.eye(4))]
    again = Counting("2")
    compute_masks(smaller, again, photo, tmp_path)
    assert again.asked == ["a.jpg"]


def test_photo_in_which_nothing_is_found_is_reported(tmp_path):
    report = compute_masks([view("a.jpg")], Counting(found=False), photo, tmp_path)
    assert report["empty"] == ["a.jpg"] and "nothing was found" in report["warnings"][0]
    assert not load_labels(tmp_path, view("a.jpg")).any()


def test_of_a_damaged_segmentation_all_masks_are_to_be_made_anew(tmp_path):
    """Beside label images that are up to date no other would be made, and the map be another."""
    (tmp_path / SEGMENTATION).write_bytes(b"PK half a file")
    with pytest.raises(InputError, match=rf"cannot be read .*; remove {tmp_path} and go on with --resume"):
        load_segmentation(tmp_path)


def test_progress_counts_every_photo(tmp_path):
    told = Told()
    compute_masks([view("a.jpg"), view("b.jpg")], Counting(), photo, tmp_path, told)
    assert [update[1:] for update in told.updates] == [(1, 2), (2, 2)]


def test_ids_beyond_16_bit_are_renumbered_without_merging(tmp_path):
    labels = np.array([[0, 70_000], [5, 1_000_000]], np.int32)
    write_labels(tmp_path / "x.jpg.png", labels)
    np.testing.assert_array_equal(load_labels(tmp_path, view("x.jpg")), [[0, 2], [1, 3]])


def test_folder_that_cannot_be_written_is_one_clear_line(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot be written"):
        write_labels(tmp_path / "file" / "a.png", np.zeros((2, 2), np.int32))


def test_auto_takes_the_sam_that_the_environment_names(tmp_path, monkeypatch):
    monkeypatch.setenv("PERCEPTION_SAM", str(tmp_path / "none.onnx"))
    with pytest.raises(InputError, match=r"none\.onnx"):
        make_source("auto")
