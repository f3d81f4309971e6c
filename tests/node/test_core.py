"""The node's logic without a network: back-pressure, time-outs, order of messages, unique stamps."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from perception.node import channels
from perception.node.config import NodeConfig
from perception.node.core import Core
from perception.query import QueryEngine
from support.node_maps import WordEncoder, write_small_map


class GatedEncoder(WordEncoder):
    """Answers once `gate` is open, except for what the map is warmed with."""

    def __init__(self) -> None:
        self.gate, self.waiting = threading.Event(), threading.Semaphore(0)
        self.closed = False

    def encode_texts(self, texts: Sequence[str]) -> np.ndarray:
        if self.closed:
            self.waiting.release()
            assert self.gate.wait(20)
        return super().encode_texts(texts)


class Heard:
    """A transport that remembers."""

    def __init__(self) -> None:
        self.messages: list[tuple[channels.Topic, dict[str, Any]]] = []
        self.news = threading.Condition()

    def publish(self, topic: channels.Topic, message: dict[str, Any]) -> None:
        with self.news:
            self.messages.append((topic, message))
            self.news.notify_all()

    def warnings(self) -> list[str]:
        return []

    def figures(self) -> dict[str, Any]:
        return {"malformed": 3}

    def answers(self, count: int) -> list[dict[str, Any]]:
        """The first `count` JSON answers."""

        def found() -> list[dict[str, Any]]:
            return [json.loads(message["data"]) for topic, message in self.messages if topic is channels.ANSWER]

        with self.news:
            assert self.news.wait_for(lambda: len(found()) >= count, 20)
            return found()[:count]


@pytest.fixture
def served(tmp_path: Path) -> Iterator[tuple[Core, Heard, GatedEncoder, QueryEngine]]:
    path = tmp_path / "a.gsmap"
    write_small_map(path, ["red mug", "laptop"])
    encoder, heard = GatedEncoder(), Heard()
    with QueryEngine(path, workers=1, queue_size=2, watch=None, encoders=lambda _: encoder) as engine:
        encoder.closed = True
        yield Core(engine, heard, NodeConfig()), heard, encoder, engine
        encoder.gate.set()


def test_full_queue_refuses_at_once_and_forgets_nobody(served: tuple[Core, Heard, GatedEncoder, QueryEngine]) -> None:
    core, heard, encoder, _ = served
    core.prompt('{"text": "red mug", "id": "runs"}')
    assert encoder.waiting.acquire(timeout=20)  # the only worker is at it; two more may wait
    for n in range(10):
        core.prompt(json.dumps({"text": "laptop", "id": str(n)}))
    replies: list[dict[str, Any]] = []
    core.query(["laptop", "mug"], replies.append)
    busy = heard.answers(8)
    assert [(told["id"], told["error"]["kind"]) for told in busy] == [(str(n), "busy") for n in range(2, 10)]
    values = replies[0]["values"]
    assert [json.loads(value["string_value"])["error"]["kind"] for value in values] == ["busy", "busy"]
    encoder.gate.set()
    assert {told["id"] for told in heard.answers(11) if "error" not in told} == {"runs", "0", "1"}


def test_what_waited_too_long_is_told_so(served: tuple[Core, Heard, GatedEncoder, QueryEngine]) -> None:
    core, heard, _, engine = served
    engine.timeout = 0.0
    core.prompt('{"text": "red mug", "id": "a"}')
    told = heard.answers(1)[0]
    assert (told["id"], told["error"]["kind"]) == ("a", "timeout")


def test_closed_engine_is_told(served: tuple[Core, Heard, GatedEncoder, QueryEngine]) -> None:
    core, heard, encoder, engine = served
    encoder.gate.set()
    engine.close()
    core.prompt("red mug")
    assert heard.answers(1)[0]["error"]["kind"] == "closed"
    core.send_health()
    assert heard.messages[-1][1]["status"][0]["level"] == 2


def test_parts_of_an_answer_share_a_stamp_no_other_has(served: tuple[Core, Heard, GatedEncoder, QueryEngine]) -> None:
    core, heard, encoder, _ = served
    encoder.gate.set()
    for text in ("red mug", "laptop", "zebra"):
        core.prompt(text)
        heard.answers(len({text}))
    told = heard.answers(3)
    order = [topic.name for topic, _ in heard.messages]
    assert order == ["answer/points", "answer/detections", "answer/markers", "answer"] * 3
    stamps = [(one["stamp"]["sec"], one["stamp"]["nanosec"]) for one in told]
    assert stamps == sorted(set(stamps))
    for n, one in enumerate(told):
        parts = [message for _, message in heard.messages[4 * n : 4 * n + 3]]
        assert parts[0]["header"]["stamp"] == parts[1]["header"]["stamp"] == one["stamp"]
        assert parts[2]["markers"][0]["header"]["stamp"] == one["stamp"]
    assert heard.messages[8][1]["width"] == 0 and len(heard.messages[10][1]["markers"]) == 1  # zebra: not present


def test_one_request_takes_so_many_names_and_no_more(served: tuple[Core, Heard, GatedEncoder, QueryEngine]) -> None:
    core, _, encoder, _ = served
    encoder.gate.set()
    replies: list[dict[str, Any]] = []
    ended = threading.Event()
    core.query(["laptop"] * 40, lambda reply: (replies.append(reply), ended.set()))  # type: ignore[func-returns-value]
    assert ended.wait(20)
    told = [json.loads(value["string_value"]) for value in replies[0]["values"]]
    assert [("error" in one) for one in told] == [False] * 32 + [True] * 8
    assert "at most 32" in told[-1]["error"]["message"]


def test_health_tells_the_engine_and_the_transport(served: tuple[Core, Heard, GatedEncoder, QueryEngine]) -> None:
    core, heard, encoder, _ = served
    encoder.gate.set()
    core.prompt("")
    core.send_health()
    status = heard.messages[-1][1]["status"][0]
    values = {pair["key"]: pair["value"] for pair in status["values"]}
    assert (status["level"], values["refused_bad_input"], values["malformed"], values["instances"]) == (
        0,
        "1",
        "3",
        "2",
    )


def test_thinned_cloud_of_the_map(tmp_path: Path) -> None:
    path = tmp_path / "a.gsmap"
    write_small_map(path, ["red mug"], points=90, stray=10)
    heard = Heard()
    with QueryEngine(path, watch=None, encoders=lambda _: WordEncoder()) as engine:
        Core(engine, heard, NodeConfig(map_points=30)).start()
        with heard.news:
            assert heard.news.wait_for(lambda: bool(heard.messages), 20)
        topic, cloud = heard.messages[0]
        means = engine.current.means[::4]
    assert topic is channels.MAP_CLOUD and cloud["width"] == 25
    rows = np.frombuffer(cloud["data"].tobytes(), [("xyz", "<f4", 3), ("rgb", "<u4"), ("id", "<i4")])
    np.testing.assert_array_equal(rows["xyz"], means)
