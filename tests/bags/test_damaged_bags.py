"""Bags of which bytes are wrong or missing: one line, whatever the libraries of their formats raise."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from perception.bags.frames import run_frames
from perception.bags.read import Bag, open_bag
from perception.errors import InputError

pytest.importorskip("rosbags")
from support.bag_recorder import Recorder

K = np.array([[30.0, 0, 20], [0, 30, 15], [0, 0, 1]])


def record(path: Path, kind: str) -> Path:
    """Writes a bag of photos, depth, a camera and poses; returns the file in which its messages are."""
    bag, rng = Recorder(path, kind), np.random.default_rng(0)
    for time in range(10**9, 4 * 10**9, 5 * 10**8):
        bag.info("/front/camera_info", time, (40, 30), K, [0.0] * 5)
        bag.jpeg("/front/image/compressed", time, cv2.imencode(".jpg", rng.integers(0, 255, (30, 40, 3)))[1].tobytes())
        bag.image("/front/depth", time, rng.integers(500, 900, (30, 40)).astype(np.uint16), encoding="16UC1")
        bag.transform("/tf", time, "map", "cam", np.eye(4))
        bag.imu("/imu", time, np.array([0, 0, 9.81]), np.zeros(3))
    bag.close()
    return path if path.is_file() else next(file for file in path.iterdir() if file.suffix != ".yaml")


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["ros1", "sqlite", "mcap"])
def test_any_damage_is_told_in_one_line(tmp_path: Path, kind: str) -> None:
    """Errors of rosbags, SQLite, lz4, struct and OpenCV came through from within the messages."""
    path, rng, told = tmp_path / ("a.bag" if kind == "ros1" else "a"), np.random.default_rng(1), 0
    file = record(path, kind)
    good = np.frombuffer(file.read_bytes(), np.uint8)
    for trial in range(60):
        damaged = good.copy()
        end = min(len(damaged), 4096) if trial % 3 == 2 else len(damaged)
        damaged[rng.integers(0, end, rng.choice([1, 4, 40]))] = rng.integers(0, 256)
        file.write_bytes(damaged[: rng.integers(len(damaged)) if trial % 3 == 0 else None].tobytes())
        try:
            run_frames(path, tmp_path / str(trial))
        except InputError as error:
            told += 1
            assert str(tmp_path) in str(error) and "\n" not in str(error)
            assert not (tmp_path / str(trial)).exists()
    assert told > 12


class Broken:
    """A reader that fails after its first message, as a damaged chunk makes it."""

    connections = (SimpleNamespace(topic="/a", msgtype="m"),)

    def messages(self, connections: object) -> object:
        yield self.connections[0], 1, b""
        raise SystemError("lzma: this is\nno stream")

    def deserialize(self, raw: bytes, kind: str) -> object:
        return raw


def test_whatever_a_library_raises_between_messages(tmp_path: Path) -> None:
    messages = Bag(Broken(), tmp_path / "a.bag").messages(["/a"])
    assert next(messages) == ("/a", 0, 1, b"")
    with pytest.raises(InputError, match=r"a\.bag: /a cannot be read \(lzma: this is no stream\); mend it with"):
        next(messages)


def test_messages_without_the_fields_of_their_type_and_a_full_disk(tmp_path: Path) -> None:
    """The definitions are in the bag, and may be damaged as all else; errors of writing are not the bag's."""
    record(tmp_path / "a", "mcap")
    told = r"a: holds damaged messages \(.*attribute 'header'\); record the bag again"
    with pytest.raises(InputError, match=told), open_bag(tmp_path / "a"):
        SimpleNamespace().header  # noqa: B018
    with pytest.raises(OSError, match="No space left"), open_bag(tmp_path / "a"):
        raise OSError(28, "No space left on device")


def test_a_description_with_aliases(tmp_path: Path) -> None:
    record(tmp_path / "a", "sqlite")
    described = tmp_path / "a" / "metadata.yaml"
    described.write_text("a: &a [1, 1]\nb: *a\n" + described.read_text())
    with pytest.raises(InputError, match=r"metadata\.yaml: not readable YAML \(aliases are not taken\)"):
        run_frames(tmp_path / "a", tmp_path / "out")
