"""Depth images of a bag: decoded to metres, registered to the photos, and paired with them by time."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from perception.bags.cameras import depth_camera
from perception.bags.poses import Poses
from perception.bags.read import (
    DEPTH_TRANSPORT,
    IMAGES,
    Bag,
    first_frame,
    first_message,
    frame_of,
    kind_of,
    raw_rows,
    stamp_of,
)
from perception.errors import InputError
from perception.photos.decode import read_picture
from perception.photos.depth import measured
from perception.photos.lens import camera_from_lens, rescale_lens, same_aspect
from perception.types import Lens

APART = 0.03
"""Greatest time in seconds between a photo and its depth image: one frame at 30 Hz."""
MILLIMETRES, LARGEST = 1000.0, 65534
"""Stored units per metre, and the largest: 65535 means saturated to many programs."""
_SAME_LENS = 0.01
"""Largest distance, relative to the sides of the picture, between the pixels in which two lenses see the same place for
which depth in the photos' frame counts as registered."""
_HEADER = struct.Struct("<iff")
"""Begins a message of compressedDepth: the format, a and b, of which 32FC1 stores v = a / depth + b as PNG."""
_PNG = b"\x89PNG\r\n\x1a\n"
_NAMED = ("aligned", "registered")
_TYPES = {"16UC1": "u2", "mono16": "u2", "16SC1": "i2", "32FC1": "f4", "64FC1": "f8", "mono8": "u1", "8UC1": "u1"}
_DEPTH = ("16UC1", "16SC1", "32FC1", "64FC1")
"""Encodings of nothing but depth; pictures share the others."""


def depth_topics(bag: Bag) -> list[str]:
    """Topics of depth images, by their first message: see `_holds_depth`."""
    firsts = ((topic, first_message(bag, topic)) for topic in bag.of_type(*IMAGES))
    return [topic for topic, first in firsts if first is not None and _holds_depth(topic, first)]


def _holds_depth(topic: str, message: Any) -> bool:
    """Whether an image is encoded as depth is, or has one channel and a topic that is named depth."""
    kind = kind_of(message)
    if DEPTH_TRANSPORT in kind or topic.endswith(DEPTH_TRANSPORT) or kind.startswith(_DEPTH):
        return True
    if "depth" not in topic.lower() or hasattr(message, "encoding"):
        return "depth" in topic.lower() and kind in _TYPES
    try:
        return read_picture(bytes(message.data), topic, "image").ndim == 2
    except InputError:
        return False


def choose_depth(bag: Bag, topics: list[str], wanted: str | None, frame: str) -> str | None:
    """The depth topic to use for photos in tf frame `frame`; None when there is none, or `wanted` is "none".
    Preferred: in the photos' frame, then named aligned or registered, then not compressed."""
    if wanted == "none" or not (topics or wanted):
        return None
    if wanted in bag.of_type(*IMAGES):
        return wanted

    def rank(topic: str) -> tuple[bool, bool, bool]:
        other = first_frame(bag, topic) != frame
        return other, not any(word in topic for word in _NAMED), topic.endswith(DEPTH_TRANSPORT)

    ranks = {topic: rank(topic) for topic in topics}
    best = topics if wanted else [topic for topic in topics if ranks[topic] == min(ranks.values())]
    return bag.chosen(best, wanted, "depth", "--depth")


def decode_depth(message: Any, where: str) -> np.ndarray:
    """Depth [h, w] float32 in metres, 0 = nothing measured. 16-bit images hold millimetres, floats metres (REP 118)."""
    kind, data, at = kind_of(message), bytes(message.data), 0
    what = f"depth image of format '{kind}'; expected png of one channel"
    if hasattr(message, "encoding"):
        if kind not in _TYPES:
            raise InputError(f"{where}: depth is encoded as '{kind}'; expected 16UC1 (mm) or 32FC1 (m)")
        dtype = np.dtype(_TYPES[kind]).newbyteorder(">" if message.is_bigendian else "<")
        image = raw_rows(message, dtype.itemsize, where).view(dtype)
    else:
        at = _HEADER.size if data.startswith(_PNG, _HEADER.size) else 0  # whatever the format is named
        image = read_picture(data[at:], where, what)
    if image.dtype.itemsize == 1:
        found = f"holds 8 bits per pixel (format '{kind}'), which is a picture and no depth"
        raise InputError(f"{where}: {found}; record depth as 16UC1 or 32FC1, raw or by {DEPTH_TRANSPORT}")
    if kind.startswith("32FC1") and image.dtype.kind != "f":
        if not at:
            raise InputError(f"{where}: 32FC1 is stored as whole numbers of an unknown unit; record {DEPTH_TRANSPORT}")
        _, a, b = _HEADER.unpack_from(data)
        with np.errstate(divide="ignore", invalid="ignore"):
            image = np.where(image > 0, a / (image.astype(np.float32) - b), 0).astype(np.float32)
    if image.ndim != 2:
        raise InputError(f"{where}: not a readable {what}")
    return measured(image) / np.float32(1 if image.dtype.kind == "f" else MILLIMETRES)


def registered(depth: np.ndarray, own: Lens, color: Lens, color_from_depth: np.ndarray) -> np.ndarray:
    """Depth [h, w] of lens `own` as lens `color` sees it, at a resolution at which pixels of `own` leave no gaps.
    Each measured point is moved by color_from_depth [4, 4]; where several fall on a pixel, the nearest counts."""
    height, width = depth.shape
    own = rescale_lens(own, width, height)
    scale = min(1.0, own.params[0] / color.params[0])
    color = rescale_lens(color, max(1, int(color.width * scale)), max(1, int(color.height * scale)))
    rows, columns = np.nonzero(depth)
    rays = np.asarray(camera_from_lens(own).cam_from_img(np.stack([columns + 0.5, rows + 0.5], axis=1)))[:, :2]
    z = depth[rows, columns].astype(np.float64)
    points = np.column_stack([rays * z[:, None], z]) @ color_from_depth[:3, :3].T + color_from_depth[:3, 3]
    points = points[points[:, 2] > 0]
    at = np.floor(np.asarray(camera_from_lens(color).img_from_cam(points))).astype(np.int64)
    inside = (at >= 0).all(axis=1) & (at[:, 0] < color.width) & (at[:, 1] < color.height)
    image = np.full(color.width * color.height, np.inf)
    np.minimum.at(image, at[inside, 1] * color.width + at[inside, 0], points[inside, 2])
    return np.where(np.isfinite(image), image, 0).astype(np.float32).reshape(color.height, color.width)


def write_depth(
    bag: Bag, topic: str, stamps: dict[str, int], lens: Lens, frame: str, poses: Poses, folder: Path
) -> tuple[dict[str, str], str]:
    """Writes the depth image nearest in time to each photo, 16-bit PNG in millimetres: file by photo, and a text.
    stamps: times of the photos in ns. lens, frame: of the photos. Depth of another frame or lens is registered by its
    camera_info and tf; InputError where these are missing."""
    own = depth_camera(bag, topic)
    times = {one.number: stamp_of(one.message) or one.time for one in bag.messages([topic])}
    if not times:
        raise InputError("; ".join([f"{bag.path}: {topic} holds no depth image", *bag.lines()]))
    numbers, at = np.array(list(times)), np.array(list(times.values()))
    nearest = {name: int(numbers[np.abs(at - stamp).argmin()]) for name, stamp in stamps.items()}
    apart = {name: abs(times[number] - stamps[name]) / 1e9 for name, number in nearest.items()}
    near = [name for name in stamps if apart[name] <= APART]
    if not near:
        found = f"no image of {topic} lies within {APART} s of a photo (the nearest: {min(apart.values()):.3g} s)"
        raise InputError(f"{bag.path}: {found}; give another --depth, or --depth none")
    folder.mkdir()
    written, farthest = dict[str, str](), 0
    for one, depth in bag.decoded(topic, decode_depth, {nearest[name] for name in near}):
        there, size = frame_of(one.message), depth.shape[::-1]
        if own is not None and not same_aspect(size, (own.width, own.height)):
            found = f"an image is {size[0]}x{size[1]} pixels, its camera_info says {own.width}x{own.height}"
            raise InputError(f"{bag.path}: {topic}: {found}; record depth with the camera_info of its own size")
        if there != frame or not (same_aspect(size, (lens.width, lens.height)) if own is None else _same(own, lens)):
            moved = poses.between(frame, there, times[one.number]) if frame and there else None
            if own is None or moved is None:
                lacks = "a camera_info" if own is None else f"tf from '{there}' to '{frame}'"
                raise InputError(f"{bag.path}: {topic} is not registered to the photos and lacks {lacks}")
            depth = registered(depth, own, lens, moved)
        stored = np.round(depth * MILLIMETRES)
        stored = np.where(stored <= LARGEST, stored, 0).astype(np.uint16)
        farthest = max(farthest, int(stored.max()))
        data = cv2.imencode(".png", stored)[1].tobytes()
        for name in (name for name in near if nearest[name] == one.number):
            written[name] = f"{folder.name}/{Path(name).stem}.png"
            (folder.parent / written[name]).write_bytes(data)
    if not farthest:
        found = f"{topic} measures nothing within {LARGEST / MILLIMETRES:.1f} m"
        raise InputError(f"{bag.path}: {found}; expected metres as floats or millimetres as 16 bits (REP 118)")
    most = max(apart[name] for name in written)
    return written, f"{topic}, {len(written)} of {len(stamps)} photos, at most {1000 * most:.0f} ms apart"


def _same(a: Lens, b: Lens) -> bool:
    """Whether two lenses see the same, at any resolution, with the same distortion."""
    size = np.array([b.width, b.height])
    pixels = np.stack(np.meshgrid(*[np.linspace(0.1, 0.9, 5)] * 2), axis=-1).reshape(-1, 2) * size
    rays = np.asarray(camera_from_lens(b).cam_from_img(pixels)).reshape(-1, 2)
    seen = np.asarray(
        camera_from_lens(rescale_lens(a, b.width, b.height)).img_from_cam(np.c_[rays, np.ones(len(rays))])
    )
    return bool((np.abs(seen - pixels) < _SAME_LENS * size).all())
