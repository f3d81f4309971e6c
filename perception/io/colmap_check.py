"""Checks of a binary COLMAP model before pycolmap reads it.

pycolmap does not check counts and string ends, so a damaged file can make it loop forever or allocate all memory. Here
each file is read once, and damage is reported by file and record.
Layout: COLMAP's documentation, "Output Format"; little endian. Rigs and frames came with COLMAP 3.12.
"""

from __future__ import annotations

import math
from pathlib import Path
from struct import Struct

from perception.errors import InputError

_PARAMS = (3, 4, 4, 5, 8, 8, 12, 5, 4, 5, 12, 16, 4, 5, 3, 4, 6, 2)
"""Number of parameters of a camera, by COLMAP's model id."""
_LONGEST_NAME = 4096
_HEADS = {  # of a record, up to its first name or list; where a list follows at once, the last number is its length
    "cameras": Struct("<IiQQ"),  # id, model, width, height
    "images": Struct("<I7dI"),  # id, pose, camera
    "points3D": Struct("<Q3d3BdQ"),
    "rigs": Struct("<II"),
    "frames": Struct("<II7dI"),  # id, rig, pose
}
_COUNT, _FLAG, _SENSOR, _POSE = Struct("<Q"), Struct("<B"), Struct("<iI"), Struct("<7d")


def check_binary_model(folder: Path) -> None:
    """InputError naming the first file and record that is not valid."""
    heads = {kind: _heads(folder / f"{kind}.bin", kind) for kind in _HEADS}
    known = {camera for camera, _ in heads["cameras"]}
    for image, camera in heads["images"]:
        if camera not in known:
            raise InputError(f"{folder / 'images.bin'}: image {image} has camera {camera}, which cameras.bin lacks")


def _heads(file: Path, kind: str) -> list[tuple[int, int]]:
    """First and last number of each record's head; [] if the file does not exist. InputError for an id that repeats."""
    if not file.is_file():
        return []
    data, at, found = file.read_bytes(), 0, list[tuple[int, int]]()

    def take(layout: Struct) -> tuple:
        skip(1, layout.size)
        return layout.unpack_from(data, at - layout.size)

    def skip(count: int, size: int) -> None:
        nonlocal at
        at += count * size
        if at > len(data):
            raise ValueError("the file is cut short")

    try:
        for _ in range(take(_COUNT)[0]):
            head = take(_HEADS[kind])
            pose = head[1:8] if kind == "images" else head[2:9] if kind == "frames" else (1.0,)
            if not all(map(math.isfinite, pose)) or not any(pose[:4]):
                raise ValueError(f"the pose of {kind[:-1]} {head[0]} is not finite, or no rotation")
            if kind == "cameras":
                if not 0 <= head[1] < len(_PARAMS) or max(head[2:]) > 1 << 30:
                    raise ValueError(f"camera {head[0]} of model {head[1]} and {head[2]}×{head[3]} pixels")
                if not all(map(math.isfinite, take(Struct(f"<{_PARAMS[head[1]]}d")))):
                    raise ValueError(f"camera {head[0]} has a parameter that is not finite")
            elif kind == "images":
                end = data.find(b"\0", at, at + _LONGEST_NAME)
                if end < 0:
                    raise ValueError("its name has no end")
                data[at:end].decode("utf-8")
                skip(end + 1 - at, 1)
                skip(take(_COUNT)[0], 24)
            elif kind == "rigs":
                for number in range(head[1]):
                    take(_SENSOR)
                    if number and take(_FLAG)[0]:
                        take(_POSE)
            else:
                skip(head[-1], 8 if kind == "points3D" else 16)
            found.append((head[0], head[-1]))
        if len({head[0] for head in found}) != len(found):
            raise ValueError("an id occurs twice")
    except ValueError as error:
        what = f"what follows {len(found)} good records cannot be right ({error})"
        raise InputError(f"{file}: {what}; the model is damaged") from error
    return found
