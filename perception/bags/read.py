"""Reads topics and messages of a bag with the optional package `rosbags`, and decodes sensor_msgs' images."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from perception.errors import InputError, missing_extra
from perception.io.documents import brief, read_yaml, refusing
from perception.photos.decode import read_picture

IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
TRANSFORMS = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
ODOMETRY = "nav_msgs/msg/Odometry"
DEPTH_TRANSPORT = "compressedDepth"
METADATA = "metadata.yaml"


class Bag:
    """An open bag. topics: message type by topic."""

    def __init__(self, reader: Any, path: Path) -> None:
        self._reader, self.path = reader, path
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

    def messages(self, topics: list[str]) -> Iterator[tuple[str, int, Any]]:
        """(topic, recording time in ns, message) in order of time. InputError where the bag is damaged."""
        chosen = [c for c in self._reader.connections if c.topic in topics]
        if not chosen:
            return
        with refusing(f"{self.path}: a message on {', '.join(topics)} cannot be read ({{why}}); record the bag again"):
            for connection, time, raw in self._reader.messages(connections=chosen):
                yield connection.topic, time, self._reader.deserialize(raw, connection.msgtype)


def camera_of(topic: str) -> tuple[str, bool]:
    """(its camera_info, whether its images are rectified) of an image topic, as ROS's image_pipeline names them:
    /front/image_rect_color/compressed has /front/camera_info, and is rectified."""
    for transport in ("/compressed", f"/{DEPTH_TRANSPORT}"):
        topic = topic.removesuffix(transport)
    namespace, _, image = topic.rpartition("/")
    return f"{namespace}/camera_info", "rect" in image.partition("_")[2]


@contextmanager
def open_bag(path: Path) -> Iterator[Bag]:
    """Opens a ROS 1 .bag, a ROS 2 bag folder (SQLite or MCAP) or an .mcap file. InputError if it is none of these."""
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise missing_extra("rosbags", "ros") from error
    if not path.exists():
        raise InputError(f"{path}: no such bag; expected a .bag, an .mcap, or the folder of a ROS 2 bag")
    if (path / METADATA).is_file():
        read_yaml(path / METADATA, "the description of a ROS 2 bag")  # the library's reader takes aliases
    with refusing(f"{path}: is no bag that can be read ({{why}}); expected ROS 1, ROS 2 or MCAP"):
        store = None if path.suffix == ".bag" else get_typestore(Stores.LATEST)  # old ROS 2 bags lack definitions
        reader = AnyReader([path], default_typestore=store)
        reader.open()
    try:
        yield Bag(reader, path)
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
    if not hasattr(message, "encoding"):
        what = f"compressed image of format '{message.format}' (jpeg, png are)"
        return read_picture(bytes(message.data), where, what, cv2.IMREAD_COLOR)
    encoding = str(message.encoding)
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


def encoded(message: Any, picture: np.ndarray) -> tuple[str, bytes]:
    """(suffix, bytes) of an image file: a compressed message is written unchanged, others as PNG."""
    if not hasattr(message, "encoding"):
        data = bytes(message.data)
        if data[:2] == b"\xff\xd8":
            return ".jpg", data
        if data[:4] == b"\x89PNG":
            return ".png", data
    return ".png", cv2.imencode(".png", picture)[1].tobytes()
