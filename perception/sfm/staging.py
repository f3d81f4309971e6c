"""Photos prepared for pycolmap: upright, in a format that it reads, with numbers as names.

pycolmap ignores EXIF rotation and reads few formats. Its name lists cannot contain blanks, line ends, a leading "#" or
bytes that are not UTF-8.
"""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from PIL import Image

from perception.machine import cores
from perception.photos.decode import CAMERA_FOLDER, LARGE_PIXELS, ORIENTATION, exif_of, open_photo, read_photo
from perception.progress import Progress

_PLAIN = {"JPEG": ".jpg", "MPO": ".jpg", "PNG": ".png"}
"""Formats that pycolmap reads as they are (MPO: a JPEG followed by further images)."""
_MAKE_AND_MODEL = (0x010F, 0x0110)
_FOCAL_LENGTH = (0x920A, 0xA405, 0xA20E, 0xA20F, 0xA210)
"""EXIF tags: focal length in mm, the same for 35 mm film, resolution of the focal plane in x and y and its unit."""


def stage_photos(
    folder: Path, photos: list[Path], progress: Progress, as_stored: Sequence[bool] | None = None
) -> list[str]:
    """Fills the new `folder`; returns the names there, in the order of `photos`, which is also their sorted order.
    Upright JPEG and PNG are linked. Others are written as PNG, which keeps the pixels of every 8-bit format (16 bits
    become 8), with the EXIF data on the focal length, by several threads. as_stored: of each photo, whether its EXIF
    rotation is not applied; None applies it to all."""
    folder.mkdir()
    names, converted = [], []
    stored = as_stored or [False] * len(photos)
    for index, photo in enumerate(photos):
        with open_photo(photo) as image:
            plain = (stored[index] or exif_of(image, photo).get(ORIENTATION, 1) == 1) and image.mode in ("RGB", "L")
            small = image.width * image.height <= LARGE_PIXELS
            suffix = _PLAIN.get(image.format or "") if plain and small else None
        names.append(f"{index:06d}{suffix or '.png'}")
        if suffix is None:
            converted.append((photo, folder / names[-1], stored[index]))
        else:
            try:
                (folder / names[-1]).symlink_to(photo.resolve())
            except OSError:  # a file system without symbolic links
                shutil.copyfile(photo, folder / names[-1])
    with ThreadPoolExecutor(min(4, cores())) as pool:
        for done, _ in enumerate(pool.map(_convert, *zip(*converted, strict=True)) if converted else (), start=1):
            progress.update("poses: turning and converting photos", done, len(converted))
    return names


def _convert(photo: Path, target: Path, as_stored: bool) -> None:
    kept = Image.Exif()
    with open_photo(photo) as image:
        exif = exif_of(image, photo)
        kept.update({tag: exif[tag] for tag in _MAKE_AND_MODEL if tag in exif})
        lens = exif_of(image, photo, CAMERA_FOLDER)
        kept.get_ifd(CAMERA_FOLDER).update({tag: lens[tag] for tag in _FOCAL_LENGTH if tag in lens})
    Image.fromarray(read_photo(photo, as_stored)).save(target, compress_level=1, exif=kept)
