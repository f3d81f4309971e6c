"""Label images on disk: one compressed 16-bit PNG per photo, written atomically, each with the key of its inputs."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
from PIL import Image, PngImagePlugin

from perception.errors import InputError
from perception.io.atomic import write_file
from perception.io.documents import safe_name
from perception.photos.decode import decode, open_photo
from perception.types import View

LARGEST = 65535  # of 16 bits; where labels are larger, equal ones of two photos are of different things
_KEY = "perception-masks"
_SIGNATURE = b"\x89PNG\r\n\x1a\n"


def label_file(folder: Path, view: View) -> Path:
    """Path of a view's label image. The photo's suffix is kept, because `a.jpg` and `a.png` may both exist."""
    return folder / f"{safe_name(view.name, view.photo)}.png"


def load_labels(folder: Path, view: View) -> np.ndarray:
    """[h, w] int32 as written by compute_masks, 0 = unlabelled."""
    file = label_file(folder, view)
    if not file.is_file():
        raise InputError(f"{file}: no label image for photo {view.name}; run the masks stage again")
    width, height, *_ = read_png_header(file)  # a corrupt size field must not allocate gigabytes
    if width * height > 4 * view.width * view.height:
        raise InputError(f"{file}: {width}×{height} pixels of a smaller photo; the PNG is damaged")
    return read_labels(file)


def write_labels(file: Path, labels: np.ndarray, key: str = "") -> None:
    """labels: [h, w] integers ≥ 0. Ids that exceed 16 bit are renumbered from 1."""
    if labels.max(initial=0) > LARGEST:
        unique, inverse = np.unique(labels, return_inverse=True)
        labels = inverse.reshape(labels.shape) + int(unique[0] != 0)
    if labels.min(initial=0) < 0 or labels.max(initial=0) > LARGEST:
        raise ValueError(f"{file}: labels must lie in 0..{LARGEST}, found {labels.min()}..{labels.max()}")
    info = PngImagePlugin.PngInfo()
    info.add_text(_KEY, key)
    picture = Image.fromarray(labels.astype(np.uint16))
    write_file(file, lambda new: picture.save(new, "PNG", compress_level=4, pnginfo=info))


def stored_key(file: Path) -> str | None:
    """The key that a label image was written with; None if the file or the key cannot be read."""
    try:
        with open_photo(file) as image:
            decode(image, file)
            return str(image.info.get(_KEY))
    except InputError:
        return None


def read_png_header(file: Path) -> tuple[int, int, int, int]:
    """Width and height in pixels, bits per sample, colour type (PNG's numbers), from the first 26 bytes of the file."""
    with file.open("rb") as stream:
        head = stream.read(26)
    if len(head) < 26 or not head.startswith(_SIGNATURE):
        raise InputError(f"{file}: not a PNG; label images are PNG, 8 or 16 bit, one channel")
    width, height, bits, colour_type = struct.unpack(">IIBB", head[16:26])
    return width, height, bits, colour_type


def read_labels(file: Path) -> np.ndarray:
    """[H, W] int32. Pillow keeps palette indices, whereas OpenCV converts them to colours."""
    with open_photo(file) as image:
        decode(image, file)
        labels = np.asarray(image)
    if labels.ndim != 2 or labels.dtype.kind not in "biu":
        raise InputError(f"{file}: {labels.dtype} of shape {list(labels.shape)}; a label image has one channel")
    return labels.astype(np.int32)
