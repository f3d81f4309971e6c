"""Reads topics and messages of a bag with the optional package `rosbags`."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from perception.errors import InputError, missing_extra

IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
TRANSFORMS = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
ODOMETRY = "nav_msgs/msg/Odometry"


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
        """(topic, recording time in ns, message) in order of time. Raises InputError for a corrupt message."""
        chosen = [c for c in self._reader.connections if c.topic in topics]
        if not chosen:
            return
        for connection, time, raw in self._reader.messages(connections=chosen):
            try:
                yield connection.topic, time, self._reader.deserialize(raw, connection.msgtype)
            except Exception as error:  # the library's exceptions have no common base class
                raise InputError(f"{self.path}: a message on {connection.topic} cannot be read ({error})") from error


@contextmanager
def open_bag(path: Path) -> Iterator[Bag]:
    """Opens a ROS 1 .bag, a ROS 2 bag folder (SQLite or MCAP) or an .mcap file. InputError if it is none of these."""
    try:
        from rosbags.highlevel import AnyReader, AnyReaderError
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise missing_extra("rosbags", "ros") from error
    if not path.exists():
        raise InputError(f"{path}: no such bag; expected a .bag, an .mcap, or the folder of a ROS 2 bag")
    try:
        store = None if path.suffix == ".bag" else get_typestore(Stores.LATEST)  # old ROS 2 bags lack definitions
        reader = AnyReader([path], default_typestore=store)
        reader.open()
    except (AnyReaderError, OSError, ValueError, KeyError, AssertionError) as error:
        what = str(error) or type(error).__name__
        raise InputError(f"{path}: is no bag that can be read ({what}); expected ROS 1, ROS 2 or MCAP") from error
    try:
        yield Bag(reader, path)
    finally:
        reader.close()


def stamp_of(message: Any) -> int:
    """Header time of a message in ns."""
    stamp = message.header.stamp
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)
