"""Headers that claim more than their file holds, archives that unpack without end, names that lead out of a folder."""

from __future__ import annotations

import io
import re
import struct
import tracemalloc
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image

from perception.bags.depth import decode_depth
from perception.bags.read import decode_image
from perception.errors import InputError
from perception.evaluate.images import read_rgb
from perception.io.arrays import map_npy, read_npz
from perception.masks.label_files import read_labels, stored_key
from perception.onnx.sessions import open_session, side_files
from perception.photos import decode
from perception.photos.decode import photo_size, read_photo, why_left_out
from perception.photos.depth import read_depth
from perception.photos.ignore_masks import read_mask


def refused(reader: Any, *arguments: Any, match: str = "") -> None:
    with pytest.raises(InputError, match=match) as told:
        reader(*arguments)
    assert "\n" not in str(told.value)


# ------------------------------------------------------------------ pictures


def png(width: int, height: int) -> bytes:
    def chunk(name: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))

    head = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    rows = chunk(b"IDAT", zlib.compress(bytes(100)))
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + rows + chunk(b"IEND", b"")


def other(kind: str, width: int, height: int) -> bytes:
    """A picture of 8 × 6 pixels whose header says otherwise."""
    held = io.BytesIO()
    Image.new("L", (8, 6), 7).save(held, kind)
    content = bytearray(held.getvalue())
    if kind == "JPEG":
        struct.pack_into(">HH", content, content.index(b"\xff\xc0") + 5, height, width)
    elif kind == "BMP":
        struct.pack_into("<ii", content, 18, width, height)
    else:  # entries of 12 bytes: tag, type, count, value
        for tag, value in ((256, width), (257, height), (278, height)):
            found = [at for at in range(len(content) - 12) if content[at : at + 2] == struct.pack("<H", tag)]
            at = next(at for at in found if content[at + 2 : at + 8] in (b"\3\0\1\0\0\0", b"\4\0\1\0\0\0"))
            struct.pack_into("<HHII", content, at, tag, 4, 1, value)
    return bytes(content)


def in_a_message(decoder: Callable[[Any, str], Any], kind: str) -> Callable[[Path], Any]:
    return lambda file: decoder(SimpleNamespace(data=file.read_bytes(), format=kind), str(file))


READERS: dict[str, Callable[[Path], Any]] = {
    "photo": read_photo,
    "depth": read_depth,
    "mask": lambda file: read_mask(file, 8, 6),
    "evaluated": read_rgb,
    "labels": read_labels,
    "message": in_a_message(decode_image, "jpeg"),
    "depth message": in_a_message(decode_depth, "16UC1; png"),
}


@pytest.mark.parametrize("reader", READERS)
@pytest.mark.parametrize("kind", ["PNG", "JPEG", "BMP", "TIFF"])
@pytest.mark.parametrize("size", [(60000, 60000), (19000, 20000)])
def test_a_header_takes_no_memory_for_what_the_file_does_not_hold(
    tmp_path: Path, reader: str, kind: str, size: tuple[int, int]
) -> None:
    """cv2.error for more than 2**30 pixels, a gigabyte taken below that."""
    import resource

    file = tmp_path / f"a.{kind.lower()}"
    file.write_bytes(png(*size) if kind == "PNG" else other(kind, *size))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    refused(READERS[reader], file, match=re.escape(file.name))
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 50 << 10  # KiB
    assert why_left_out(file) is not None and stored_key(file) is None


def test_a_progressive_jpeg_takes_no_memory_for_what_it_does_not_hold(tmp_path: Path) -> None:
    """libjpeg keeps the coefficients of a whole one, also where it is decoded at an eighth of its size."""
    import resource

    held = io.BytesIO()
    Image.new("RGB", (8, 6), "red").save(held, "JPEG", progressive=True)
    content = bytearray(held.getvalue())
    struct.pack_into(">HH", content, content.index(b"\xff\xc2") + 5, 19000, 19000)
    file = tmp_path / "a.jpg"
    file.write_bytes(content)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    assert "cannot hold" in str(why_left_out(file))
    refused(photo_size, file, match="cannot hold")
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 50 << 10  # KiB


def test_the_size_of_a_picture_too_large_to_be_read_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Pillow decodes a whole PNG in search of EXIF data behind the pixels."""
    monkeypatch.setattr(decode, "MOST_DECODED", 100)
    Image.new("L", (8, 6)).save(tmp_path / "a.png")
    assert photo_size(tmp_path / "a.png") == (8, 6)
    Image.new("L", (20, 6)).save(tmp_path / "a.png")
    refused(photo_size, tmp_path / "a.png", match="at most 100")


def test_the_exif_of_a_png_is_found_behind_its_pixels_without_them(tmp_path: Path) -> None:
    """Pillow decodes all pixels in search of it, which took as long as reading the photo."""
    exif, held, file = Image.Exif(), io.BytesIO(), tmp_path / "a.png"
    exif[0x0112] = 6
    picture = Image.fromarray(np.random.default_rng(0).integers(0, 255, (60, 80, 3), np.uint8))
    picture.save(held, "PNG", exif=exif)
    content = held.getvalue()
    at, pixels = content.index(b"eXIf") - 4, content.index(b"IDAT") - 4
    chunk, end = content[at:pixels], content.index(b"IEND") - 4
    file.write_bytes(content[:at] + content[pixels:end] + chunk + content[end:])
    assert photo_size(file) == read_photo(file).shape[1::-1] == (60, 80)
    assert photo_size(file, as_stored=True) == read_photo(file, as_stored=True).shape[1::-1] == (80, 60)
    picture.save(file, "PNG", exif=exif, save_all=True, append_images=[picture.rotate(180)])  # an animation
    assert photo_size(file) == read_photo(file).shape[1::-1] == (60, 80)
    file.write_bytes(content[: pixels + 1000])
    assert photo_size(file) == (60, 80)
    refused(read_photo, file, match="damaged or cut short")


@pytest.mark.parametrize("turn", [3, 6, 8])
@pytest.mark.parametrize("kind", ["L", "RGB", "RGBA", "I;16"])
def test_a_turned_tiff_is_read_upright_and_as_stored(tmp_path: Path, kind: str, turn: int) -> None:
    """Pillow maps grey and 16 bits into memory, with the sides of the upright photo."""
    grey, file = np.random.default_rng(0).integers(0, 255, (6, 8), np.uint8), tmp_path / "a.tif"
    picture = Image.fromarray(grey.astype(np.uint16) * 257) if kind == "I;16" else Image.fromarray(grey).convert(kind)
    picture.save(file, tiffinfo={0x0112: turn})
    for as_stored, expected in ((True, grey), (False, np.rot90(grey, {3: 2, 6: -1, 8: 1}[turn]))):
        np.testing.assert_array_equal(read_photo(file, as_stored), np.repeat(expected[..., None], 3, axis=2))
        assert photo_size(file, as_stored) == expected.shape[::-1]


def test_a_png_without_its_end_is_refused_in_one_line(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    Image.new("L", (20, 6)).save(tmp_path / "a.png")
    (tmp_path / "a.png").write_bytes((tmp_path / "a.png").read_bytes()[:-3])
    refused(read_depth, tmp_path / "a.png", match="not a readable")
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("reader", READERS)
def test_a_picture_that_is_cut_short_or_empty(tmp_path: Path, reader: str) -> None:
    file, held = tmp_path / "a.png", io.BytesIO()
    Image.fromarray(np.random.default_rng(0).integers(0, 255, (60, 80), np.uint8)).save(held, "PNG")
    for content in (b"", held.getvalue()[:8], held.getvalue()[:40], held.getvalue()[:2000], b"II*\0" + bytes(40)):
        file.write_bytes(content)
        refused(READERS[reader], file, match=re.escape(file.name))


def test_depth_of_any_kind_of_number_that_a_tiff_may_hold(tmp_path: Path) -> None:
    """Pillow, which tells the size, knows no TIFF of float64."""
    import cv2

    depth = np.random.default_rng(0).uniform(1, 2, (6, 8))
    for dtype in (np.float64, np.float32, np.uint16):
        cv2.imwrite(str(tmp_path / "a.tiff"), (1000 * depth).astype(dtype))
        np.testing.assert_array_equal(read_depth(tmp_path / "a.tiff"), (1000 * depth).astype(dtype).astype(np.float32))


# ------------------------------------------------------------------ arrays


def npy(head: str, body: bytes = b"", version: int = 1, length: int | None = None) -> bytes:
    packed = struct.pack("<H" if version == 1 else "<I", len(head) if length is None else length)
    return b"\x93NUMPY" + bytes([version, 0]) + packed + head.encode() + body


def zipped(content: bytes, method: int = zipfile.ZIP_DEFLATED, claims: int | None = None) -> bytes:
    """An archive of one array. claims: its size in the local header and in the central directory."""
    held = io.BytesIO()
    with zipfile.ZipFile(held, "w", method) as archive:
        archive.writestr("points.npy", content)
    whole = bytearray(held.getvalue())
    if claims is not None:
        struct.pack_into("<I", whole, 22, claims)
        struct.pack_into("<I", whole, whole.index(b"PK\x01\x02") + 24, claims)
    return bytes(whole)


def test_an_archive_is_in_memory_once(tmp_path: Path) -> None:
    """tracemalloc counts what numpy and Python allocate."""
    points = np.tile(np.arange(1000, dtype=np.float32), 6000).reshape(-1, 3)
    np.savez_compressed(tmp_path / "a.npz", points=points, turned=np.asfortranarray(points))
    tracemalloc.start()
    try:
        found = read_npz(tmp_path / "a.npz", tmp_path / "a.npz", "")
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 1.25 * 2 * points.nbytes
    for array in found.values():
        np.testing.assert_array_equal(array, points)
        assert array.flags.writeable
    assert found["turned"].flags.f_contiguous


_LARGE = "{'descr': '<f4', 'fortran_order': False, 'shape': (250000000, 3)}\n"
LYING = {
    "directory and array": zipped(npy(_LARGE, bytes(1000)), claims=3_000_000_000 + 10 + len(_LARGE)),
    "directory": zipped(npy(_LARGE.replace("250000000", "10"), bytes(120)), claims=3_000_000_000),
    "array": zipped(npy(_LARGE, bytes(1000))),
    "header": zipped(npy(_LARGE, bytes(1 << 20), version=2, length=3 << 30)),
    "long header": zipped(npy(" " * (1 << 20), version=2)),
    "lzma": zipped(npy(_LARGE.replace("250000000", "10"), bytes(120)), zipfile.ZIP_LZMA),
    "negative": zipped(npy(_LARGE.replace("250000000", "-10"), bytes(120))),
}


@pytest.mark.parametrize("lie", LYING)
def test_archives_that_claim_what_they_do_not_hold(tmp_path: Path, lie: str) -> None:
    file = tmp_path / "a.npz"
    file.write_bytes(LYING[lie])
    tracemalloc.start()
    try:
        for source in (file, file.read_bytes()):
            refused(read_npz, source, file, "make it again", match=r"a\.npz: cannot be read .*make it again")
        assert tracemalloc.get_traced_memory()[1] < 4 << 20
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("shape", ["(99999999999, 3)", "(4611686018427387904, 4)", "(-1, -3)", "(2, 3, 1, 1, 1)"])
def test_depth_arrays_that_claim_what_they_do_not_hold(tmp_path: Path, shape: str) -> None:
    file = tmp_path / "a.npy"
    file.write_bytes(npy(_LARGE.replace("(250000000, 3)", shape), bytes(12)))
    with pytest.raises(ValueError, match="bytes, 12 are there"):
        map_npy(file)
    refused(read_depth, file, match=r"a\.npy: not a readable depth image")


# ------------------------------------------------------------------ files that name others


def onnx(name: str) -> bytes:
    """As much of an ONNX file as tells where weights are."""
    size = len(name.encode())
    length = bytes([size]) if size < 128 else bytes([size & 127 | 128, size >> 7])
    return b"\x08\x07\x0a\x08location\x12" + length + name.encode()


OUTSIDE = ["/etc/hostname", "//etc/hostname", "///etc/hostname", "../x", "a/../../x", "a/..", ".."]
OUTSIDE += ["\\\\host\\x", "\\x", "C:\\x", "c:x", "..\\x", "a\\..\\..\\x", "", "/" + "a" * 200, "link", "folder/x"]


@pytest.mark.parametrize("name", OUTSIDE)
def test_weights_of_an_onnx_file_lie_beside_it(tmp_path: Path, name: str) -> None:
    from perception.models import _local

    home = tmp_path / "models"
    home.mkdir()
    (tmp_path / "x").write_bytes(b"secret")
    (home / "link").symlink_to(tmp_path / "x")
    (home / "folder").symlink_to(tmp_path)
    (home / "m.onnx").write_bytes(onnx(name))
    assert side_files(home / "m.onnx") == []
    for reader in (open_session, lambda file: _local(str(file)), lambda file: _local(str(file.parent))):
        refused(reader, home / "m.onnx", match=r"m\.onnx: its weights are in .*, outside its folder")


def test_weights_in_the_cache_of_hugging_face(tmp_path: Path) -> None:
    """There a revision's files are links to blobs."""
    blobs, home = tmp_path / "blobs", tmp_path / "snapshots" / "abc" / "onnx"
    blobs.mkdir()
    home.mkdir(parents=True)
    (blobs / "1").write_bytes(onnx("m.onnx_data"))
    (blobs / "2").write_bytes(b"weights")
    (home / "m.onnx").symlink_to(blobs / "1")
    (home / "m.onnx_data").symlink_to(blobs / "2")
    assert side_files(home / "m.onnx") == [home / "m.onnx_data"]
