"""Photos: decodes them upright as 8-bit RGB, undistorts and downscales them to a view's pinhole camera."""

from __future__ import annotations

import io
import math
import os
import struct
import threading
import warnings
from collections.abc import MutableMapping
from pathlib import Path
from stat import S_ISREG
from typing import Any

import cv2
import numpy as np
from PIL import Image, ImageFile, ImageOps, TiffImagePlugin, UnidentifiedImageError

from perception.errors import InputError, missing_extra
from perception.io.documents import refusing
from perception.photos.lens import warp_grid
from perception.types import Lens, View

HEIF_SUFFIXES = frozenset({".heic", ".heif", ".hif"})
_HEIF_BRANDS, _OTHERS = (b"heic", b"heix", b"heim", b"heis", b"mif1", b"msf1"), (b"\xff\xd8", b"\x89PNG")
"""Bytes 8 to 12 of HEIC, and how JPEG and PNG begin: phones and chats give files each other's endings."""
SUFFIXES = HEIF_SUFFIXES | {".jpg", ".jpeg", ".jpe", ".jfif", ".png", ".tif", ".tiff", ".bmp", ".webp", ".avif"}
LARGE_PIXELS = 200_000_000
"""Photos of more pixels are read at 1/2, 1/4 or 1/8 of their size; `photo_size` returns the reduced size."""
MOST_DECODED = 400_000_000
"""Maximum number of pixels to decode; JPEG is decoded at the reduced size, other formats at full size."""
_DENSEST = 8 * 1032
"""Most pixels that a byte of a file in one of _BOUNDED can hold: deflate's densest code, at one bit a pixel."""
_BOUNDED = ("PNG", "JPEG", "MPO", "BMP", "GIF")
_PNG_END = b"IEND\xaeB`\x82"
_REDUCED = ("JPEG", "MPO")
"""Formats that are decoded at a reduced size."""
# These libraries report damaged files on the standard error; here an InputError does.
cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
warnings.filterwarnings("ignore", category=UserWarning, module="PIL")


def photo_size(path: Path, as_stored: bool = False) -> tuple[int, int]:
    """(width, height) of what read_photo returns, from the header: large photos reduced."""
    with open_photo(path) as image:
        tags = getattr(image, "tag_v2", {})  # depending on its version, Pillow has rotated the size of a TIFF
        width, height = int(tags.get(0x0100, image.width)), int(tags.get(0x0101, image.height))
        size = reduced_size(width, height, _reduction(image))
        turned = exif_of(image, path).get(ORIENTATION) in (5, 6, 7, 8)  # other values do not swap the sides
        return size[::-1] if turned and not as_stored else size


def orientation(path: Path) -> int:
    """EXIF's orientation of the photo, 1 to 8; 1 where it is missing or another number."""
    with open_photo(path) as image:
        found = exif_of(image, path).get(ORIENTATION)
        return found if found in _BACK else 1


def reduced_size(width: int, height: int, factor: int) -> tuple[int, int]:
    """The size of a photo read at 1 / factor: rounded up, as Pillow's JPEG decoder and `reduce` do."""
    return -(-width // factor), -(-height // factor)


def _reduction(image: Image.Image) -> int:
    """The power of two by which a photo is reduced to at most LARGE_PIXELS; 1 for smaller photos."""
    factor = 1
    while image.width * image.height > LARGE_PIXELS * factor**2:
        factor *= 2
    return factor


_BAD_EXIF = "the photo's EXIF data are damaged; save it anew without them, or remove it"
ORIENTATION, CAMERA_FOLDER, GPS_FOLDER = 0x0112, 0x8769, 0x8825
"""EXIF tags: the rotation, and the folders of the tags on the exposure and on the position."""


def exif_of(image: Image.Image, path: Path, folder: int | None = None) -> MutableMapping[int, Any]:
    """The EXIF data of an open photo, or of a folder in them; empty if there are none. InputError if damaged."""
    with refusing(f"{path}: {_BAD_EXIF}"):
        tags = Image.Image.getexif(_without_pixels(path)) if image.format == "PNG" else image.getexif()
        return tags if folder is None else tags.get_ifd(folder)


def _without_pixels(path: Path) -> Image.Image:
    """A PNG of the chunks that may hold EXIF data: they may lie behind the pixels, and Pillow decodes all before."""
    with path.open("rb") as file:
        kept = [file.read(8)]
        while len(head := file.read(8)) == 8:
            length, kind = struct.unpack(">I4s", head)
            if kind not in (b"IHDR", b"eXIf", b"iTXt", b"tEXt", b"zTXt"):
                file.seek(length + 4, os.SEEK_CUR)
            elif len(body := file.read(length + 4)) == length + 4:
                kept += [head, body]
    return _open(io.BytesIO(b"".join(kept) + bytes(4) + _PNG_END))


def upright(image: Image.Image, path: Path) -> Image.Image:
    """An open photo rotated according to its EXIF data. Raises InputError if they are damaged."""
    with refusing(f"{path}: {_BAD_EXIF}"):  # it decodes the EXIF data and rewrites them without the rotation
        return ImageOps.exif_transpose(image)


def why_left_out(path: Path, strict: bool = False) -> str | None:
    """The error that reading the photo raises, or None; strict: raised. JPEG is read at 1/8 size: every byte."""
    try:
        with open_photo(path) as image:
            image.draft("RGB", reduced_size(*image.size, 8))
            decode(image, path)
            _refuse_kind(image, path)
    except InputError as error:
        if strict:
            raise
        return str(error)
    return None


def read_photo(path: Path, as_stored: bool = False) -> np.ndarray:
    """The photo as uint8 [h, w, 3] RGB, rotated as in EXIF unless `as_stored`; (w, h) = photo_size(path, as_stored).
    Grey is repeated to three channels, of 16 bits it becomes 8 (v / 257 rounded), palettes are expanded; transparent
    pixels are composited on black. Floating-point images are refused. HEIC needs pillow-heif (extra "heic")."""
    with open_photo(path) as image:
        factor, (width, height) = _reduction(image), image.size
        if factor > 1:
            image.draft(None, (width // factor, height // factor))  # only JPEG is decoded at a reduced size
            factor = max(1, round(factor * image.width / width))
        photo = pixels_of(image, path, as_stored)
    return photo if factor == 1 else np.array(Image.fromarray(photo).reduce(factor))


def pixels_of(image: Image.Image, path: Path, as_stored: bool = False) -> np.ndarray:
    """An open photo decoded as uint8 [h, w, 3] RGB, rotated as in EXIF unless `as_stored`; see read_photo."""
    back = _BACK.get(getattr(image, "tag_v2", {}).get(ORIENTATION, 1))  # Pillow turns a TIFF when it decodes it
    decode(image, path)
    if not as_stored:
        image = upright(image, path)
    elif back is not None:
        image = image.transpose(back)
    return to_rgb(image, path)


_BACK = {
    2: Image.Transpose.FLIP_LEFT_RIGHT,
    3: Image.Transpose.ROTATE_180,
    4: Image.Transpose.FLIP_TOP_BOTTOM,
    5: Image.Transpose.TRANSPOSE,
    6: Image.Transpose.ROTATE_90,
    7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_270,
}
"""What undoes the rotation of an upright picture, by EXIF's orientation."""


def read_grey(path: Path, as_stored: bool = False) -> np.ndarray:
    """`read_photo` as uint8 [h, w] grey."""
    return np.asarray(cv2.cvtColor(read_photo(path, as_stored), cv2.COLOR_RGB2GRAY))


def scaled_size(view: View, max_side: int | None) -> tuple[int, int]:
    """(width, height) of the view with its long side at most `max_side` pixels; None keeps the size, none grows."""
    side = max(view.width, view.height)
    if max_side is None or side <= max_side:
        return view.width, view.height
    return max(1, round(view.width * max_side / side)), max(1, round(view.height * max_side / side))


def scaled_K(view: View, width: int, height: int) -> np.ndarray:
    """Intrinsics [3, 3] float64 of the view resized to width × height: the true ratio of the sizes, per axis."""
    return np.diag([width / view.width, height / view.height, 1.0]) @ view.K


def load_photo(view: View, max_side: int | None = None) -> np.ndarray:
    """The view's picture as uint8 [h, w, 3] RGB through its ideal pinhole, (w, h) = scaled_size(view, max_side).
    The photo is downscaled by area averaging, then undistorted with cubic interpolation: between two pixels, where a
    slight distortion puts most of a photo, linear interpolation is a blur. Only the last warps are cached."""
    width, height = scaled_size(view, max_side)
    photo = _oriented(view)
    if view.lens is None:
        return _shrink(photo, width, height)
    h, w = photo.shape[:2]
    small_w = min(w, max(1, round(w * width / view.width)))
    small_h = min(h, max(1, round(h * height / view.height)))
    small = _shrink(photo, small_w, small_h)
    x, y = _grid(view, view.lens, width, height)
    map_x = x * np.float32(small_w / w) - np.float32(0.5)  # cv2 has pixel centres at integers
    map_y = y * np.float32(small_h / h) - np.float32(0.5)
    return cv2.remap(small, map_x, map_y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)


def warp_labels(view: View, labels: np.ndarray, width: int, height: int) -> np.ndarray:
    """Labels [H, W] in the photo's geometry to int32 [height, width] in the view's pinhole, nearest sampling.
    Pixels outside the photo get 0. The label image must have the photo's size (after EXIF rotation)."""
    across, down = view.photo_size
    if labels.shape != (down, across):
        found = "×".join(map(str, labels.shape[::-1]))
        raise InputError(f"{view.name}: the label image is {found}, expected {across}×{down} like the photo")
    if view.lens is None:
        return nearest(labels, width, height).astype(np.int32)
    return warped(labels, view, view.lens, width, height).astype(np.int32)


def nearest(image: np.ndarray, width: int, height: int) -> np.ndarray:
    """image [H, W] at another size [height, width]: each pixel takes the value at its centre."""
    column = ((np.arange(width) + 0.5) * image.shape[1] / width).astype(np.int64)
    row = ((np.arange(height) + 0.5) * image.shape[0] / height).astype(np.int64)
    return image[row[:, None], column[None, :]]


def warped(image: np.ndarray, view: View, lens: Lens, width: int, height: int) -> np.ndarray:
    """image [H, W] that `lens` took at the view's pose, in the view's pinhole [height, width]: the nearest pixel on
    each ray, so that no values are mixed across an edge; 0 outside of the image."""
    x, y = _grid(view, lens, width, height)
    inside = (x >= 0) & (y >= 0) & (x < image.shape[1]) & (y < image.shape[0])
    result = np.zeros((height, width), image.dtype)
    result[inside] = image[y[inside].astype(np.int64), x[inside].astype(np.int64)]
    return result


def _grid(view: View, lens: Lens, width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    K = scaled_K(view, width, height)
    return warp_grid(lens, (K[0, 0], K[1, 1], K[0, 2], K[1, 2]), width, height)


def _oriented(view: View) -> np.ndarray:
    width, height = view.photo_size
    photo = read_photo(view.photo, view.as_stored)
    if photo.shape[:2] == (height, width):
        return photo
    found = "×".join(map(str, photo.shape[1::-1]))
    raise InputError(f"{view.photo}: the photo is {found}, its camera expects {width}×{height}")


def _shrink(photo: np.ndarray, width: int, height: int) -> np.ndarray:
    if photo.shape[:2] == (height, width):
        return photo
    return cv2.resize(photo, (width, height), interpolation=cv2.INTER_AREA)


_OPENING = threading.Lock()
_HEADER = 1 << 16
"""Bytes of a file's beginning."""


def open_photo(path: Path) -> Image.Image:
    """The picture opened by Pillow, not decoded. InputError if it is missing or Pillow cannot read it."""
    with refusing(f"{path}: not a readable image; replace or remove it"):
        try:
            regular = S_ISREG(path.stat().st_mode)
        except FileNotFoundError as error:
            raise InputError(f"{path}: no such photo") from error
        if not regular:
            raise ValueError("no file")  # to open a FIFO would mean to wait for its writer
        with path.open("rb") as file:
            header = file.read(_HEADER)  # on a disk that hangs, this waits, without the lock that other photos need
        if header[8:12] in _HEIF_BRANDS or (path.suffix.lower() in HEIF_SUFFIXES and not header.startswith(_OTHERS)):
            _register_heif()
        image = _open(path)
        image.filename = ""  # which Pillow would map into memory: turned TIFFs with the sides of the upright photo
        most = math.inf if image.format in _REDUCED else None  # that of these is checked when it is known
        check_size(path, image.size, image.format, path.stat().st_size, most)
        return image


def _register_heif() -> None:
    try:
        import pillow_heif
    except ImportError as error:
        raise missing_extra("pillow-heif", "heic") from error
    pillow_heif.register_heif_opener(thumbnails=False)


def _open(source: Path | io.BytesIO) -> ImageFile.ImageFile:
    with _OPENING:  # Pillow's limit is global and lies below LARGE_PIXELS; MOST_DECODED is checked instead
        limit, Image.MAX_IMAGE_PIXELS = Image.MAX_IMAGE_PIXELS, None
        try:
            return Image.open(source)
        finally:
            Image.MAX_IMAGE_PIXELS = limit


def decode(image: Image.Image, path: Path) -> None:
    """Decodes an open picture. InputError if it is damaged, or `check_size` refuses it."""
    check_size(path, image.size, image.format, path.stat().st_size)
    with refusing(f"{path}: the picture is damaged or cut short; replace or remove it"):
        image.load()


def check_size(where: object, size: tuple[int, int], kind: str | None, held: int, most: float | None = None) -> None:
    """InputError for a header that claims more than `most` pixels (None: MOST_DECODED), or more than `held` bytes of
    that format can hold: before memory is taken for them."""
    width, height = size
    if width * height > (MOST_DECODED if most is None else most):
        raise InputError(f"{where}: {width}×{height} pixels, at most {MOST_DECODED} are read; shrink it")
    if kind in _BOUNDED and width * height > _DENSEST * held:
        raise InputError(f"{where}: {held} bytes cannot hold {width}×{height} pixels; the picture is damaged")


def read_picture(source: Path | bytes, where: object, what: str, flags: int = cv2.IMREAD_UNCHANGED) -> np.ndarray:
    """A file or the bytes of one, as OpenCV decodes it: BGR, or with its own depth and channels by IMREAD_UNCHANGED.
    InputError "`where`: not a readable `what`" for a file that is missing, of an unknown format, or damaged."""
    with refusing(f"{where}: not a readable {what}"):
        if isinstance(source, Path) and not source.is_file():
            raise ValueError("no file")
        data = source.read_bytes() if isinstance(source, Path) else source
        size, kind = _claims(data)
        check_size(where, size, kind, len(data))
        if kind in _REDUCED:  # OpenCV fills what a JPEG that is cut short lacks with grey
            with _open(io.BytesIO(data)) as image:
                image.draft("RGB", reduced_size(*size, 8))
                image.load()
        picture = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
        if picture is None:
            raise ValueError("OpenCV does not read it")
        return np.asarray(picture)


def _claims(data: bytes) -> tuple[tuple[int, int], str | None]:
    """(width, height) in a picture's header, and Pillow's name of its format. The checksums of a PNG are verified."""
    try:
        with _open(io.BytesIO(data)) as image:
            size, kind = image.size, image.format
            image.verify()
            if kind == "PNG" and _PNG_END not in data:
                raise ValueError("cut short")  # libpng would say so on the standard error
            return size, kind
    except UnidentifiedImageError:  # a TIFF of numbers that Pillow has no mode for, such as float64
        tags = TiffImagePlugin.ImageFileDirectory_v2(data[:8])
        stream = io.BytesIO(data)
        stream.seek(tags.next)
        tags.load(stream)
        return (int(tags[0x0100]), int(tags[0x0101])), "TIFF"


def _refuse_kind(image: Image.Image, path: Path) -> None:
    if image.mode in ("F", "LAB"):
        kind = "floating-point images are not photos" if image.mode == "F" else "its colours are CIE L*a*b*"
        raise InputError(f"{path}: {kind}; convert it to RGB of 8 or 16 bit")


def to_rgb(image: Image.Image, path: Path) -> np.ndarray:
    """A decoded photo as uint8 [h, w, 3]; see read_photo."""
    _refuse_kind(image, path)
    if image.mode.startswith("I"):  # 16-bit grey, as "I;16" or as 32-bit "I"
        grey = np.clip(np.asarray(image).astype(np.float64), 0, 65535)
        eight = (grey / 257 + 0.5).astype(np.uint8)
        return np.ascontiguousarray(np.repeat(eight[..., None], 3, axis=2))
    if image.mode in ("RGBA", "LA", "PA") or "transparency" in image.info:
        rgba = image.convert("RGBA")
        black = Image.new("RGBA", rgba.size, (0, 0, 0, 255))
        image = Image.alpha_composite(black, rgba)
    return np.array(image.convert("RGB"))
