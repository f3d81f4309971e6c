"""Reads topics and messages of a bag with the optional package `rosbags`, and decodes sensor_msgs' images."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from heapq import merge
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from perception.errors import InputError, missing_extra
from perception.io.documents import brief, read_yaml, refusing
from perception.photos.decode import read_picture

IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
TRANSFORMS = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
ODOMETRY, IMU = "nav_msgs/msg/Odometry", "sensor_msgs/msg/Imu"
DEPTH_TRANSPORT = "compressedDepth"
METADATA = "metadata.yaml"
_READ = (*IMAGES, CAMERA_INFO, *TRANSFORMS, ODOMETRY, IMU)


class Recorded(NamedTuple):
    """A message, its number among those of its topic, and the time in ns at which it was recorded."""

    topic: str
    number: int
    time: int
    message: Any


class Bag:
    """An open bag. topics: message type by topic. strict: a message that cannot be used is an InputError; otherwise it
    is left out, and `left_out` has the reasons by topic and number."""

    def __init__(self, reader: Any, path: Path, strict: bool = False) -> None:
        self._reader, self.path, self.strict = reader, path, strict
        self.left_out = dict[str, dict[int, str]]()
        self.topics: dict[str, str] = {connection.topic: connection.msgtype for connection in reader.connections}

    def of_type(self, *types: str) -> list[str]:
        """Topics whose messages are of one of `types`, sorted."""
        return sorted(topic for topic, kind in self.topics.items() if kind in types)

    def chosen(self, topics: list[str], wanted: str | None, what: str, option: str) -> str:
        """The wanted one of `topics`, or the only one. InputError where it is not there, or there are several."""
        if wanted is not None and wanted not in topics:
            raise InputError(f"{self.path}: has no {what} topic '{wanted}'; found {', '.join(topics) or 'none'}")
        if wanted is None and len(topics) > 1:
            raise InputError(f"{self.path}: holds several {what} topics, choose one with {option}: {', '.join(topics)}")
        return wanted or topics[0]

    def messages(self, topics: list[str]) -> Iterator[Recorded]:
        """All messages in order of time but those that are cut, and images without data.
        InputError where the bag is damaged between messages."""
        chosen = [c for c in self._reader.connections if c.topic in topics]
        if not chosen:
            return
        counts = dict.fromkeys(topics, 0)
        with refusing(f"{self.path}: {', '.join(topics)} cannot be read ({{why}}); {_RECOVER}"):
            for connection, time, raw in self._reader.messages(connections=chosen):
                topic, number = connection.topic, counts[connection.topic]
                counts[topic] += 1
                try:
                    message = self._reader.deserialize(raw, connection.msgtype)
                except Exception as error:  # of struct, NumPy or rosbags, by where it is cut
                    self.leave_out(topic, number, f"cannot be read ({brief(error)})")
                    continue
                if connection.msgtype in IMAGES and len(message.data) == 0:
                    self.leave_out(topic, number, "holds no data")
                    continue
                yield Recorded(topic, number, time, message)

    def decoded(
        self, topic: str, decode: Callable[[Any, str], np.ndarray], numbers: set[int] | None = None
    ) -> Iterator[tuple[Recorded, np.ndarray]]:
        """The messages of an image topic (with `numbers` only these) and their images; those that `decode` refuses are
        left out. InputError if it refuses all."""
        refused, used = None, False
        for one in self.messages([topic]):
            if numbers is None or one.number in numbers:
                try:
                    image = decode(one.message, f"{self.path}: {topic}")
                except InputError as error:
                    refused = refused or error
                    self.leave_out(topic, one.number, str(error).removeprefix(f"{self.path}: {topic}: "))
                    continue
                used = True
                yield one, image
        if refused and not used:
            raise refused

    def leave_out(self, topic: str, number: int, why: str) -> None:
        """Notes that a message is not used; InputError if the bag is read strictly."""
        if self.strict:
            raise InputError(f"{self.path}: {topic}: message {number}: {why}; without --strict it is left out")
        self.left_out.setdefault(topic, {})[number] = why

    def lines(self) -> list[str]:
        """What was left out, a line for each topic."""
        return [
            f"{topic}: {len(found)} messages left out, the first number {min(found)}: {found[min(found)]}"
            for topic, found in self.left_out.items()
        ]


_EXPECTED = "ROS 1's .bag, or ROS 2 messages in .db3 or .mcap (`rosbags-convert` makes these of a .bag)"
_RECOVER = "mend it with `mcap recover`, `ros2 bag reindex` or `rosbag reindex`, or record it again"
_WAL = "-wal"
"""Ends the name of SQLite's write-ahead log."""


def _storage(path: Path) -> list[Path]:
    """What the reader opens: `path`, or the files of a ROS 2 bag folder whose recorder ended before it described them.
    InputError for a folder without a bag, or with several, and for SQLite's files that miss what is in their log."""
    if not path.is_dir():
        return [path]
    files = [file for file in sorted(path.iterdir()) if file.suffix in (".mcap", ".db3") and file.name[0] != "."]
    for log in (file.with_name(file.name + _WAL) for file in files):
        if log.is_file() and log.stat().st_size:
            found = f"{log}: holds messages that are not in the database yet"
            raise InputError(f'{found}; merge them: sqlite3 {log.name.removesuffix(_WAL)} "PRAGMA wal_checkpoint"')
    described = path / METADATA
    if described.is_file() and read_yaml(described, "the description of a ROS 2 bag"):  # it refuses aliases
        return [path]
    if len({re.sub(r"_\d+$", "", file.stem) for file in files}) != 1:  # a bag's files are NAME_0, NAME_1, …
        found = f"no {METADATA}, and {', '.join(file.name for file in files) or 'neither .mcap nor .db3'}"
        raise InputError(f"{path}: is no bag: it holds {found}; give one file, or `ros2 bag reindex` it")
    return files


class _Files:
    """The open files of a bag. paths: ROS 1 .bag files or one of ROS 2. Messages are read by the bag's definitions of
    their types, or by ROS's own where these are missing or wrong; those of types that are not read may be anything."""

    def __init__(self, paths: list[Path]) -> None:
        from rosbags.rosbag1 import Reader as Reader1
        from rosbags.rosbag2 import Reader as Reader2

        self.ros1 = paths[0].suffix == ".bag"
        with ExitStack() as stack:
            readers: list[Any] = [stack.enter_context((Reader1 if self.ros1 else Reader2)(path)) for path in paths]
            self.connections = [connection for reader in readers for connection in reader.connections]
            store = self._store()
            self.deserialize = store.deserialize_ros1 if self.ros1 else store.deserialize_cdr
            self.close = stack.pop_all().close

    def messages(self, connections: list[Any]) -> Iterator[tuple[Any, int, bytes]]:
        """(connection, time in ns, bytes) of all messages of `connections`, in order of time."""
        owners = {id(connection.owner): connection.owner for connection in connections}
        parts = (owner.messages([c for c in connections if c.owner is owner]) for owner in owners.values())
        return merge(*parts, key=lambda part: part[1])

    def _store(self) -> Any:
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore

        types = dict(get_typestore(Stores.ROS1_NOETIC if self.ros1 else Stores.LATEST).fielddefs)
        for name in TRANSFORMS:
            types |= get_types_from_msg("geometry_msgs/TransformStamped[] transforms", name)
        for name, connection in {c.msgtype: c for c in self.connections if c.msgtype in _READ}.items():
            with suppress(Exception):  # whatever a relay or a serial bridge wrote in place of the definition
                own, store = get_types_from_msg(connection.msgdef.data, name), get_typestore(Stores.EMPTY)
                store.register(own)
                if own[name][1] and (not self.ros1 or store.generate_msgdef(name)[1] == connection.digest):
                    types |= own
        store = get_typestore(Stores.EMPTY)
        store.register(types)
        return store


@contextmanager
def open_bag(path: Path, strict: bool = False) -> Iterator[Bag]:
    """Opens a ROS 1 .bag, a ROS 2 bag folder, or an .mcap or .db3 file. InputError if it is none of these."""
    try:
        import rosbags  # noqa: F401
    except ImportError as error:
        raise missing_extra("rosbags", "ros") from error
    if not path.exists():
        raise InputError(f"{path}: no such bag; expected a .bag, an .mcap, or the folder of a ROS 2 bag")
    with refusing(f"{path}: is no bag that can be read ({{why}}); expected {_EXPECTED}; {_RECOVER}"):
        reader = _Files(_storage(path))
    try:
        yield Bag(reader, path, strict)
    except (InputError, OSError):  # of writing: what reading raises is an InputError
        raise
    except Exception as error:  # fields of other types or without sense, in what is done with them
        raise InputError(f"{path}: holds damaged messages ({brief(error)}); record the bag again") from error
    finally:
        reader.close()


def stamp_of(message: Any) -> int:
    """Header time of a message in ns."""
    stamp = message.header.stamp
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def first_message(bag: Bag, topic: str) -> Any:
    """The first message on a topic that can be read; None if there is none: recorders keep topics that were silent."""
    return next((one.message for one in bag.messages([topic])), None)


def first_frame(bag: Bag, topic: str) -> str:
    """The tf frame of `first_message`; "" if there is none."""
    message = first_message(bag, topic)
    return "" if message is None else frame_of(message)


def frame_of(message: Any) -> str:
    """The tf frame of a message."""
    return str(message.header.frame_id).lstrip("/")


def kind_of(message: Any) -> str:
    """The encoding of an Image, or the format of a CompressedImage."""
    return str(message.encoding if hasattr(message, "encoding") else message.format)


# Encoding -> (channels of the message, OpenCV's conversion to BGR or None). Bayer names differ: ROS names the first
# row's first two pixels, OpenCV the second row's second and third.
_EIGHT_BIT: dict[str, tuple[int, int | None]] = {
    "rgb8": (3, cv2.COLOR_RGB2BGR),
    "bgr8": (3, None),
    "8UC3": (3, None),
    "rgba8": (4, cv2.COLOR_RGBA2BGR),
    "bgra8": (4, cv2.COLOR_BGRA2BGR),
    "8UC4": (4, cv2.COLOR_BGRA2BGR),
    "mono8": (1, cv2.COLOR_GRAY2BGR),
    "8UC1": (1, cv2.COLOR_GRAY2BGR),
    "bayer_rggb8": (1, cv2.COLOR_BayerBG2BGR),
    "bayer_bggr8": (1, cv2.COLOR_BayerRG2BGR),
    "bayer_gbrg8": (1, cv2.COLOR_BayerGR2BGR),
    "bayer_grbg8": (1, cv2.COLOR_BayerGB2BGR),
    "yuv422": (2, cv2.COLOR_YUV2BGR_UYVY),
    "uyvy": (2, cv2.COLOR_YUV2BGR_UYVY),
    "yuv422_yuy2": (2, cv2.COLOR_YUV2BGR_YUY2),
    "yuyv": (2, cv2.COLOR_YUV2BGR_YUY2),
}


def decode_image(message: Any, where: str) -> np.ndarray:
    """An Image or CompressedImage as [H, W, 3] uint8 BGR. InputError naming `where` if it is not an 8-bit image."""
    encoding = kind_of(message)
    if not hasattr(message, "encoding"):
        what = f"compressed image of format '{encoding}' (jpeg, png are)"
        mosaic = _mosaic(message)  # the camera's pixels as they are: no EXIF rotation
        flags = cv2.IMREAD_UNCHANGED if mosaic else cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
        picture = read_picture(bytes(message.data), where, what, flags)
        if picture.dtype == np.uint16:
            picture = (picture / 257 + 0.5).astype(np.uint8)
        return np.asarray(cv2.cvtColor(picture, mosaic)) if mosaic and picture.ndim == 2 else picture[..., :3]
    if encoding not in _EIGHT_BIT:
        known = f"{', '.join(_EIGHT_BIT)} (a depth image? give another --topic)"
        raise InputError(f"{where}: images are encoded as '{encoding}'; expected one of {known}")
    channels, conversion = _EIGHT_BIT[encoding]
    rows = raw_rows(message, channels, where)
    picture = rows if channels == 1 else rows.reshape(len(rows), -1, channels)
    return picture if conversion is None else np.asarray(cv2.cvtColor(picture, conversion))


def raw_rows(message: Any, size: int, where: str) -> np.ndarray:
    """The pixels [height, width * size] uint8 of an Image without padding; size: bytes of a pixel."""
    height, width, step = int(message.height), int(message.width), int(message.step)
    data = np.frombuffer(bytes(message.data), np.uint8)
    if min(height, width) < 1 or step < width * size or data.size < step * height:
        what = f"{message.encoding}, rows of {step} bytes"
        raise InputError(f"{where}: an image of {width}x{height} ({what}) holds {data.size} bytes")
    return np.ascontiguousarray(data[: step * height].reshape(height, step)[:, : width * size])


def _mosaic(message: Any) -> int | None:
    """OpenCV's conversion of the Bayer mosaic that a CompressedImage may hold ("bayer_rggb8; png compressed "), by the
    encoding before the semicolon; None for others."""
    encoding = kind_of(message).partition(";")[0].strip().replace("16", "8")
    return _EIGHT_BIT[encoding][1] if encoding.startswith("bayer") and encoding in _EIGHT_BIT else None


def encoded(message: Any, picture: np.ndarray) -> tuple[str, bytes]:
    """(suffix, bytes) of an image file: a compressed message is written unchanged, others and mosaics as PNG."""
    if not hasattr(message, "encoding") and _mosaic(message) is None:
        data = bytes(message.data)
        if data[:2] == b"\xff\xd8":
            return ".jpg", data
        if data[:4] == b"\x89PNG":
            return ".png", data
    return ".png", cv2.imencode(".png", picture)[1].tobytes()
