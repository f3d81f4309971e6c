"""Checks of a binary COLMAP model before pycolmap reads it.

pycolmap does not check counts and string ends, so a damaged file can make it loop forever or allocate all memory. Here
each file is read once, only ids are kept, and damage is reported by file and record.
Layout: COLMAP's documentation, "Output Format"; little endian. Rigs and frames came with COLMAP 3.12.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from pathlib import Path

from perception.errors import InputError

_PARAMS = (3, 4, 4, 5, 8, 8, 12, 5, 4, 5, 12, 16, 4, 5, 3, 4, 6, 2)
"""Number of parameters of a camera, by COLMAP's model id."""
_LONGEST_NAME = 4096


def check_binary_model(folder: Path) -> None:
    """InputError naming the first file and record that is not valid."""
    cameras = _walk(folder / "cameras.bin", _camera)
    images = _walk(folder / "images.bin", _image)
    _walk(folder / "points3D.bin", _point)
    _walk(folder / "rigs.bin", _rig)
    _walk(folder / "frames.bin", _frame)
    known = {camera for camera, _ in cameras}
    for image, camera in images:
        if camera not in known:
            raise InputError(f"{folder / 'images.bin'}: image {image} has camera {camera}, which cameras.bin lacks")


class _Reader:
    """Sequential reader of a file's bytes; ValueError when reading past the end."""

    def __init__(self, data: bytes):
        self.data, self.at = data, 0

    def take(self, layout: struct.Struct) -> tuple:
        at, self.at = self.at, self.at + layout.size
        if self.at > len(self.data):
            raise ValueError("the file is cut short")
        return layout.unpack_from(self.data, at)

    def skip(self, count: int, size: int) -> None:
        self.at += count * size
        if self.at > len(self.data):
            raise ValueError(f"it lists {count} entries, the file is cut short")

    def text(self) -> str:
        end = self.data.find(b"\0", self.at, self.at + _LONGEST_NAME)
        if end < 0:
            raise ValueError("its name has no end")
        at, self.at = self.at, end + 1
        return self.data[at:end].decode("utf-8")


_U64, _U32 = struct.Struct("<Q"), struct.Struct("<I")
_CAMERA, _IMAGE, _POINT = struct.Struct("<IiQQ"), struct.Struct("<I7dI"), struct.Struct("<Q3d3BdQ")
_FRAME, _POSE, _SENSOR = struct.Struct("<II7dI"), struct.Struct("<7d"), struct.Struct("<iI")
_DOUBLE = struct.Struct("<d")


def _walk(file: Path, record: Callable[[_Reader], tuple[int, int]]) -> list[tuple[int, int]]:
    """(id, other id) of every record; [] if the file does not exist. InputError for records with the same id."""
    if not file.is_file():
        return []
    reader, found = _Reader(file.read_bytes()), []
    try:
        (count,) = reader.take(_U64)
        for _ in range(count):
            found.append(record(reader))
        if len({first for first, _ in found}) != len(found):
            raise ValueError("an id occurs twice")
    except ValueError as error:
        what = f"what follows {len(found)} good records cannot be right ({error})"
        raise InputError(f"{file}: {what}; the model is damaged") from error
    return found


def _camera(reader: _Reader) -> tuple[int, int]:
    camera, model, width, height = reader.take(_CAMERA)
    if not 0 <= model < len(_PARAMS) or max(width, height) > 1 << 30:
        raise ValueError(f"camera {camera} of model {model} and {width}×{height} pixels")
    values = [reader.take(_DOUBLE)[0] for _ in range(_PARAMS[model])]
    if not all(map(math.isfinite, values)):
        raise ValueError(f"camera {camera} has a parameter that is not finite")
    return camera, model


def _image(reader: _Reader) -> tuple[int, int]:
    image, *pose, camera = reader.take(_IMAGE)
    name = reader.text()
    if not all(map(math.isfinite, pose)) or not any(pose[:4]):
        raise ValueError(f"the pose of {name} is not finite, or no rotation")
    reader.skip(reader.take(_U64)[0], 24)
    return image, camera


def _point(reader: _Reader) -> tuple[int, int]:
    *head, length = reader.take(_POINT)
    reader.skip(length, 8)
    return head[0], 0


def _rig(reader: _Reader) -> tuple[int, int]:
    rig, sensors = reader.take(_U32)[0], reader.take(_U32)[0]
    for number in range(sensors):
        reader.take(_SENSOR)
        if number and reader.take(struct.Struct("<B"))[0]:
            reader.take(_POSE)
    return rig, 0


def _frame(reader: _Reader) -> tuple[int, int]:
    frame, rig, *pose, sensors = reader.take(_FRAME)
    if not all(map(math.isfinite, pose)) or not any(pose[:4]):
        raise ValueError(f"the pose of frame {frame} is not finite, or no rotation")
    reader.skip(sensors, 16)
    return frame, rig
