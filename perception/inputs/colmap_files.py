"""Reads the files of a COLMAP model, binary or text, with any names, and without what is not finite.

pycolmap does not check counts and string ends, so a damaged binary file can make it loop for ever or take all memory;
of text it takes "610,0" for 610, and of "IMG 1.jpg" the first word. Here each file is read once before: damage is
reported by file and record, and what is wrong with one photo alone is replaced in a copy and left out. Layout: COLMAP's
documentation, "Output Format"; little endian. Rigs and frames came with COLMAP 3.12.
"""

from __future__ import annotations

import codecs
import math
import re
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from struct import Struct
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from perception.errors import InputError
from perception.io.documents import brief, refusing, text_of
from perception.photos.lens import load_pycolmap

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
_STILL = (1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
_NO_NUMBER = re.compile(r"[+-]?(nan|inf|\d\.?#)", re.IGNORECASE)
"""What C++ writes for numbers that are not finite: "-nan(ind)", "inf", "1.#QNAN"."""
_LETTERS = re.compile(rb"[nNiI#]")
"""Of these, in a file of numbers."""
_COMMA = "has a decimal comma; export the model again with decimal points"


@dataclass
class Model:
    """names, poses, wrong: by image id, names and poses as written, and why an image cannot be used. cameras, frames:
    what is wrong with them, by id. copies: content that pycolmap is given instead of that of the files in `path`, by
    kind. warnings: one line each."""

    path: Path
    names: dict[int, str] = field(default_factory=dict)
    poses: dict[int, Sequence[float]] = field(default_factory=dict)
    wrong: dict[int, str] = field(default_factory=dict)
    cameras: dict[int, str] = field(default_factory=dict)
    frames: dict[int, str] = field(default_factory=dict)
    copies: dict[str, bytearray] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)
    reconstruction: Any = None

    def file(self, kind: str) -> Path:
        """The file of the model that holds `kind`."""
        return self.path / f"{kind}{'.bin' if (self.path / 'images.bin').is_file() else '.txt'}"

    def judge(self, kind: str, number: int, values: Sequence[float]) -> bool:
        """Whether the parameters of a camera, or the pose of an image or a frame, are usable; notes it if not."""
        pose = kind != "cameras"
        if good := all(map(math.isfinite, values)) and (not pose or any(values[:4])):
            if kind == "images":
                self.poses[number] = values
            return good
        notes = {"cameras": self.cameras, "images": self.wrong, "frames": self.frames}[kind]
        what = f"the pose of {kind[:-1]}" if pose else "camera"
        notes[number] = f"{self.file(kind)}: {what} {number} is not finite (NaN){', or no rotation' if pose else ''}"
        return good


def read_model(path: Path) -> Model:
    """The model in folder `path`. Images that are wrong have no observations; a file of points may be missing. The
    poses of images are those of frames and rigs, where the model has these. InputError for a damaged model."""
    model = Model(path)
    absent = [file.name for file in map(model.file, ("cameras", "images")) if not file.is_file()]
    if absent:
        raise InputError(f"{path}: the sparse model lacks {', '.join(absent)}")
    checked = _checked_binary if model.file("images").suffix == ".bin" else _checked_text
    used = checked(model)
    for image_id, camera in used.items():
        if camera in model.cameras:
            model.wrong.setdefault(image_id, model.cameras[camera])
    rigged = [file.name for file in map(model.file, ("rigs", "frames")) if file.is_file()]
    changed = f"if another program has written images{model.file('images').suffix} since, remove {' and '.join(rigged)}"
    with refusing(f"{path}: not a readable COLMAP model ({{why}}){f'; {changed}' if rigged else ''}"):
        try:
            model.reconstruction = _loaded(model)
        except Exception:  # pycolmap's errors have no common class
            checked(model, bare=True)
            model.reconstruction = _loaded(model)
            model.warnings.append(f"{path}: the tracks of its points do not fit its images, and are not used")
        model.reconstruction.reg_image_ids()
    for image_id, image in model.reconstruction.images.items():
        if image.frame_id in model.frames:
            model.wrong.setdefault(image_id, model.frames[image.frame_id])
        if image_id in model.wrong:
            for index in image.get_observation_point2D_idxs():
                model.reconstruction.delete_observation(image_id, index)
    if rigged and (other := sum(_moved(image, model.poses) for image in model.reconstruction.images.values())):
        told = f"the poses of {other} of {len(model.names)} images differ from those by {' and '.join(rigged)}"
        model.warnings.append(f"{model.file('images')}: {told}, which are used; {changed}")
    return model


def _moved(image: Any, poses: dict[int, Sequence[float]]) -> bool:
    """Whether the pose of an image in its frame is not the one that is written with the image."""
    if image.image_id not in poses or not image.has_pose:
        return False
    (w, x, y, z), shift = poses[image.image_id][:4], poses[image.image_id][4:]
    pycolmap = load_pycolmap()
    written = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([x, y, z, w])), np.array(shift))
    return not np.allclose(image.cam_from_world().matrix(), written.matrix(), 1e-4, 1e-6)


def names_in(path: Path) -> list[str]:
    """The names of the images in the model in folder `path`. InputError as `read_model`."""
    model = Model(path)
    if model.file("images").suffix == ".bin":
        _heads(model, "images")
    else:
        list(_text_images(model))
    return list(model.names.values())


def _loaded(model: Model) -> Any:
    pycolmap = load_pycolmap()
    if not model.copies:
        return pycolmap.Reconstruction(model.path)
    with TemporaryDirectory() as folder:
        for kind, file in zip(_HEADS, map(model.file, _HEADS), strict=True):
            if kind in model.copies or file.is_file():
                (Path(folder) / file.name).write_bytes(model.copies.get(kind) or file.read_bytes())
        return pycolmap.Reconstruction(folder)


# ---------------------------------------------------------------------- text


def _checked_text(model: Model, bare: bool = False) -> dict[int, int]:
    """The camera of each image of a text model; fills in what is wrong, and copies where pycolmap cannot read it.
    bare: copies without observations."""
    cameras, images, frames, used = dict[int, str](), list[str](), list[str](), dict[int, int]()
    marked = False
    for start, line in _lines(model, "cameras"):
        number, kind, *rest = line.split() if len(line.split()) > 1 else (line, "")
        if not model.judge("cameras", _id(number, start, cameras), values := _numbers(rest, start)):
            rest[2:] = ["1"] * len(rest[2:])
        elif not all(text.isdigit() for text in rest[:2]):  # "640.0"
            marked, rest[:2] = True, [f"{value:.0f}" for value in values[:2]]
        found = f"camera {number} of model {brief(kind)} with {len(rest[2:])} parameters is not known to COLMAP"
        with refusing(f"{start}: {found}; expected as in its documentation, Camera Models"):
            if not load_pycolmap().Camera(model=kind, params=[1.0] * len(rest[2:])).verify_params():
                raise ValueError
        cameras[int(number)] = " ".join([number, kind, *rest])
    for start, fields, points in _text_images(model):
        image_id = _id(fields[0], start, used)
        if not model.judge("images", image_id, _numbers(fields[1:8], start)):
            fields[1:8] = map(str, _STILL)
        used[image_id] = _id(fields[8], start)
        if used[image_id] not in cameras:
            raise InputError(f"{start}: image {image_id} has camera {fields[8]}, which cameras.txt lacks")
        images += [" ".join([*fields[:9], fields[0]]), "" if bare else points]
    for start, line in _lines(model, "frames"):
        fields = line.split()
        if not model.judge("frames", _id(fields[0], start), _numbers(fields[2:9], start)):
            fields[2:9] = map(str, _STILL)
        frames.append(" ".join(fields))
    raw = {kind: model.file(kind).read_bytes() for kind in _HEADS if model.file(kind).is_file()}
    # Of a last image without a line of points pycolmap takes the frame alone.
    whole = "points3D" in raw and bool(images and images[-1])
    raw.setdefault("points3D", b"")
    if raw["points3D"].find(b",", _start(raw["points3D"])) >= 0:
        raise InputError(f"{model.file('points3D')}: {_COMMA}")
    blanks = any(re.search(r"\s", name) for name in model.names.values())
    marked |= any(not data[:1].isascii() for data in raw.values())
    marked |= _LETTERS.search(raw["points3D"], _start(raw["points3D"])) is not None
    if blanks or marked or not whole or model.wrong or model.cameras or model.frames:
        text = {kind: text_of(data, "replace") for kind, data in raw.items()}
        text |= {"cameras": "\n".join(cameras.values()), "images": "\n".join(images)}
        text |= {"frames": "\n".join(frames)} if frames else {}
        rows = [line.split() for line in text["points3D"].splitlines() if not line.startswith("#")]
        rows = [row for row in rows if not any(map(_NO_NUMBER.match, row[1:4]))]
        text["points3D"] = "\n".join(" ".join([*row[:7], "0"] if bare and row else row) for row in rows)
        model.copies = {kind: bytearray(f"{content}\n", "utf-8") for kind, content in text.items()}
    return used


def _start(data: bytes) -> int:
    """Where the first line lies that is no comment; the end for UTF-16."""
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return len(data)
    at = 3 if data.startswith(codecs.BOM_UTF8) else 0
    while data.startswith(b"#", at):
        at = data.find(b"\n", at) + 1 or len(data)
    return at


def _text_images(model: Model) -> Iterator[tuple[str, list[str], str]]:
    """(where, id to name, line of points) of each image; fills in the names."""
    lines = _lines(model, "images")
    for start, line in lines:
        fields = line.split(None, 9)
        if len(fields) < 10:
            raise InputError(f"{start}: expected an image: id, quaternion, position, camera, name; found {brief(line)}")
        model.names[_id(fields[0], start)] = fields[9]
        points = next(lines, ("", ""))[1]
        if len(points.split()) % 3:
            what = f"the line after this image holds {brief(points)}; expected its points 'x y id …', or an empty line"
            raise InputError(f"{start}: {what}")
        yield start, fields, points


def _lines(model: Model, kind: str) -> Iterator[tuple[str, str]]:
    """(file and line for messages, line without outer blanks) of a text file, none where there is no file. Of images
    every second line holds points and may be empty; empty lines elsewhere and comments are skipped."""
    file, head = model.file(kind), True
    text = text_of(file.read_bytes(), "surrogateescape") if file.is_file() else ""
    for number, raw in enumerate(text.split("\n"), start=1):
        line = raw.strip()
        if head and (not line or line.startswith("#")):
            continue
        head = kind != "images" or not head
        yield f"{file}: line {number}", line


def _id(text: str, start: str, taken: Collection[int] = ()) -> int:
    if not (text.isascii() and text.isdigit()):
        raise InputError(f"{start}: the id {brief(text)} is no whole number")
    if int(text) in taken:
        raise InputError(f"{start}: the id {text} occurs twice")
    return int(text)


def _numbers(fields: Sequence[str], start: str) -> list[float]:
    """The numbers, NaN for what C++ writes for it. InputError for what is no number, as with a decimal comma."""
    values = []
    for text in fields:
        try:
            values.append(float(text))
        except ValueError as error:
            if not _NO_NUMBER.match(text):
                raise InputError(f"{start}: {brief(text)} {_COMMA if ',' in text else 'is no number'}") from error
            values.append(math.nan)
    return values


# -------------------------------------------------------------------- binary


def _checked_binary(model: Model, bare: bool = False) -> dict[int, int]:
    """The camera of each image of a binary model; fills in what is wrong, and copies where pycolmap cannot read it.
    bare: copies without observations. InputError naming the first file and record that is not valid."""
    heads = {kind: _heads(model, kind, bare) for kind in _HEADS}
    known, used = {camera for camera, _ in heads["cameras"]}, dict(heads["images"])
    for image, camera in used.items():
        if camera not in known:
            raise InputError(f"{model.file('images')}: image {image} has camera {camera}, which cameras.bin lacks")
    if not model.file("points3D").is_file():
        model.copies["points3D"] = bytearray(_COUNT.pack(0))
    return used


def _heads(model: Model, kind: str, bare: bool = False) -> list[tuple[int, int]]:
    """First and last number of each record's head; [] if the file does not exist. InputError for an id that repeats."""
    file = model.file(kind)
    if not file.is_file():
        return []
    data, at, found, parts = file.read_bytes(), 0, list[tuple[int, int]](), list[slice]()

    def take(layout: Struct) -> tuple:
        skip(1, layout.size)
        return layout.unpack_from(data, at - layout.size)

    def skip(count: int, size: int) -> None:
        nonlocal at
        at += count * size
        if at > len(data):
            raise ValueError("the file is cut short")

    def replace(layout: Struct, start: int, values: Sequence[float]) -> None:
        if kind not in model.copies:
            model.copies[kind] = bytearray(data)
        layout.pack_into(model.copies[kind], start, *values)

    try:
        for _ in range(take(_COUNT)[0]):
            start, head = at, take(_HEADS[kind])
            if kind in ("images", "frames"):
                offset = 1 if kind == "images" else 2  # numbers before the pose, of four bytes
                if not model.judge(kind, head[0], head[offset : offset + 7]):
                    replace(_POSE, start + 4 * offset, _STILL)
            if kind == "cameras":
                if not 0 <= head[1] < len(_PARAMS) or max(head[2:]) > 1 << 30:
                    raise ValueError(f"camera {head[0]} of model {head[1]} and {head[2]}×{head[3]} pixels")
                layout = Struct(f"<{_PARAMS[head[1]]}d")
                if not model.judge(kind, head[0], take(layout)):
                    replace(layout, at - layout.size, [1.0] * _PARAMS[head[1]])
            elif kind == "images":
                end = data.find(b"\0", at, at + _LONGEST_NAME)
                if end < 0:
                    raise ValueError("its name has no end")
                model.names[head[0]] = data[at:end].decode("utf-8", "surrogateescape")
                skip(end + 1 - at, 1)
                parts.append(slice(start, at))
                skip(take(_COUNT)[0], 24)
            elif kind == "rigs":
                for number in range(head[1]):
                    take(_SENSOR)
                    if number and take(_FLAG)[0]:
                        take(_POSE)
            else:
                parts.append(slice(start, at - _COUNT.size))
                skip(head[-1], 8 if kind == "points3D" else 16)
            found.append((head[0], head[-1]))
        if len({head[0] for head in found}) != len(found):
            raise ValueError("an id occurs twice")
        if bare and kind in ("images", "points3D"):
            whole = bytes(model.copies.get(kind, data))
            model.copies[kind] = bytearray(whole[: _COUNT.size] + b"".join(whole[p] + _COUNT.pack(0) for p in parts))
    except ValueError as error:
        what = f"what follows {len(found)} good records cannot be right ({error})"
        raise InputError(f"{file}: {what}; the model is damaged") from error
    return found
