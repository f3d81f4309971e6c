"""The node's logic without a network: answers, back-pressure, time-outs, order of messages, unique stamps."""

from __future__ import annotations

import json
import shutil
import threading
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from perception import load_map
from perception.errors import InputError
from perception.node import answers, ros
from perception.node.config import NodeConfig, node_config
from perception.node.core import Core
from perception.serve.engine import QueryEngine
from support.node_maps import WordEncoder, encoders, write_small_map

LABELS = ["red mug", "laptop", "banana", "Kühlschrank"]


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
        self.messages: list[tuple[answers.Channel, dict[str, Any]]] = []
        self.news = threading.Condition()

    def publish(self, topic: answers.Channel, message: dict[str, Any]) -> None:
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
            return [json.loads(message["data"]) for topic, message in self.messages if topic is answers.ANSWER]

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


def test_health_is_told_while_refusals_are_counted(served: tuple[Core, Heard, GatedEncoder, QueryEngine]) -> None:
    core, heard, _, _ = served

    class Growing(Counter[str]):
        def items(self) -> Any:
            for pair in super().items():
                self["from another thread"] += 1
                yield pair

    core._refused = Growing(bad_input=3)
    core.send_health()
    assert {"key": "refused_bad_input", "value": "3"} in heard.messages[-1][1]["status"][0]["values"]


def test_a_map_whose_box_is_none_answers_with_an_error(tmp_path: Path) -> None:
    path, heard = tmp_path / "a.gsmap", Heard()
    write_small_map(path, ["red mug"])
    entries = json.loads((path / "instances.json").read_text())
    entries["instances"][0]["obb"]["rotation"][2] = [0, 0, -1]  # a mirror
    (path / "instances.json").write_text(json.dumps(entries))
    with QueryEngine(path, watch=None, encoders=lambda _: WordEncoder()) as engine:
        Core(engine, heard, NodeConfig()).prompt('{"text": "red mug", "id": "a"}')
        (told,) = heard.answers(1)
    assert (told["id"], told["error"]["kind"], len(heard.messages)) == ("a", "failed", 1)


def test_a_call_that_takes_too_long_is_answered_with_errors(
    served: tuple[Core, Heard, GatedEncoder, QueryEngine], monkeypatch: pytest.MonkeyPatch
) -> None:
    core, _, encoder, _ = served
    monkeypatch.setattr(ros, "_EXTRA_SECONDS", 0.0)
    monkeypatch.setattr(ros, "fill", lambda response, values: response | values)
    transport = ros.RosTransport(None, NodeConfig(timeout=0.001))
    names = ["red mug", '{"text": "laptop", "id": "b"}']
    values = transport._query(core, SimpleNamespace(names=names), {})["values"]
    encoder.gate.set()
    told = [json.loads(value["string_value"]) for value in values]
    assert [(one["id"], one["error"]["kind"]) for one in told] == [(None, "timeout"), ("b", "timeout")]


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
    assert topic is answers.MAP_CLOUD and cloud["width"] == 25
    rows = np.frombuffer(cloud["data"].tobytes(), [("xyz", "<f4", 3), ("rgb", "<u4"), ("id", "<i4")])
    np.testing.assert_array_equal(rows["xyz"], means)


@pytest.fixture(scope="module")
def map_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("served") / "a.gsmap"
    write_small_map(path, LABELS)
    return path


@pytest.fixture
def free(map_path: Path) -> Iterator[tuple[Core, Heard]]:
    """A node whose encoder answers at once."""
    heard = Heard()
    with QueryEngine(map_path, workers=4, watch=None, encoders=encoders) as engine:
        yield Core(engine, heard, NodeConfig()), heard


def asked(core: Core, *names: str | dict[str, Any]) -> list[Any]:
    """The service's answers: JSON objects, and for points the rows [P, 4] of instance id, x, y, z."""
    done, replies = threading.Event(), []

    def finish(reply: dict[str, Any]) -> None:
        replies.append(reply)
        done.set()

    core.query([name if isinstance(name, str) else json.dumps(name) for name in names], finish)
    assert done.wait(20)
    return [
        json.loads(value["string_value"]) if value["type"] == 4 else value["double_array_value"].reshape(-1, 4)
        for value in replies[0]["values"]
    ]


def test_service_gives_what_the_map_gives(free: tuple[Core, Heard], map_path: Path) -> None:
    gmap = load_map(map_path, encoders=encoders)
    for text in LABELS:
        facts, rows = asked(free[0], text, {"text": text, "want": "points"})
        hits = gmap.query(text)
        assert facts["hits"] == [hit.to_json() for hit in hits]
        assert (facts["text"], facts["frame"], facts["metric"], facts["map_id"]) == (text, "kitchen", True, gmap.map_id)
        np.testing.assert_array_equal(rows[:, 1:].astype(np.float32), np.concatenate([hit.points for hit in hits]))
        assert rows[:, 0].tolist() == [hit.instance_id for hit in hits for _ in hit.points]
    assert asked(free[0], "zebra")[0]["present"] is False


def test_topics_give_what_the_map_gives(free: tuple[Core, Heard], map_path: Path) -> None:
    core, heard = free
    hits = load_map(map_path, encoders=encoders).query("laptop", 2, 0.0)
    core.prompt('{"text": "laptop", "top_k": 2, "min_score": 0, "id": "mine"}')
    (facts,) = heard.answers(1)
    points, detections, markers = (message for _, message in heard.messages[:3])
    assert facts["id"] == "mine" and facts["hits"] == [hit.to_json() for hit in hits]
    xyz = np.frombuffer(points["data"].tobytes(), [("xyz", "<f4", 3), ("id", "<i4"), ("score", "<f4")])["xyz"]
    np.testing.assert_array_equal(xyz, np.concatenate([hit.points for hit in hits]))
    assert points["header"]["frame_id"] == "kitchen"
    found = detections["detections"]
    assert [(one["id"], one["results"][0]["hypothesis"]["class_id"]) for one in found] == [
        (str(hit.instance_id), "laptop") for hit in hits
    ]
    center = found[0]["bbox"]["center"]["position"]
    np.testing.assert_allclose([center[axis] for axis in "xyz"], hits[0].obb.center)
    assert [mark.get("action", 0) for mark in markers["markers"]] == [3, 0, 0, 0, 0]


def test_filters_and_frames_travel(free: tuple[Core, Heard]) -> None:
    box = {"center": [1.0, 0, 0], "rotation": np.eye(3).tolist(), "extent": [1.0, 2, 2]}
    moved = [[1, 0, 0, 5], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
    plain, there, inside = asked(
        free[0],
        "laptop",
        {"text": "laptop", "top_k": 9, "frame": {"name": "base", "from_map": moved}},
        {"text": "laptop", "top_k": 9, "where": {"region": box}},
    )
    assert there["frame"] == "base"
    np.testing.assert_allclose(there["hits"][0]["centroid"][0], plain["hits"][0]["centroid"][0] + 5)
    assert [hit["instance_id"] for hit in inside["hits"]] == [10]


@pytest.mark.parametrize(
    ("prompt", "words"),
    [
        ("", "text is empty"),
        ("x" * 1_000_000, "1000000 bytes"),
        ("y" * 2000, "2000 characters"),
        ("{broken", "begins like JSON"),
        ('{"text": 5}', "valid string"),
        ('{"txt": "mug"}', "not permitted"),
        ('{"text": "mug", "want": "gold"}', "hits or points"),
        ('{"text": "mug", "id": 7}', "id is to be a text"),
        ("[" * 50_000, "characters"),
        ('{"text": ' + "[" * 5_000, "begins like JSON"),
        ('{"text": "mug", "top_k": 0}', "top_k"),
    ],
    ids=lambda value: value[:20],
)
def test_bad_prompts_are_answered_with_the_reason(free: tuple[Core, Heard], prompt: str, words: str) -> None:
    told = asked(free[0], prompt, "laptop")
    assert told[0]["error"]["kind"] == "bad_input" and words in told[0]["error"]["message"]
    assert len(told[0]["text"]) <= 81 and told[1]["present"]


def test_bad_prompts_on_the_topic_are_answered_too(free: tuple[Core, Heard]) -> None:
    core, heard = free
    core.prompt('{"text": "", "id": "empty one"}')
    core.prompt('{"text": "x", "nonsense": 1, "id": "odd one"}')
    empty, odd = sorted(heard.answers(2), key=lambda told: told["id"])
    assert empty["error"]["kind"] == "bad_input" and (empty["id"], odd["id"]) == ("empty one", "odd one")
    assert "nonsense" in odd["error"]["message"]


def test_answers_of_many_askers_are_never_crossed(free: tuple[Core, Heard]) -> None:
    core, heard = free
    wrong: list[object] = []

    def ask(n: int) -> None:
        for i in range(20):
            text = LABELS[(n + i) % len(LABELS)]
            if i % 2:
                wrong.extend(told for told in asked(core, text) if told["hits"][0]["label"] != text)
            else:
                core.prompt(json.dumps({"text": text, "top_k": 1, "id": f"{n} {i} {text}"}))

    threads = [threading.Thread(target=ask, args=(n,)) for n in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
        assert not thread.is_alive()
    told = heard.answers(40)
    assert not wrong and len({one["id"] for one in told}) == 40
    assert all(one["text"] == one["hits"][0]["label"] == one["id"].split(" ", 2)[2] for one in told)


def test_map_replaced_under_load_answers_come_from_one_or_the_other(tmp_path: Path) -> None:
    path, other = tmp_path / "live.gsmap", tmp_path / "b.gsmap"
    write_small_map(path, LABELS, seed=0)
    write_small_map(other, LABELS, seed=5)
    truth = {}
    for one in (path, other):
        opened = load_map(one, encoders=encoders)
        truth[opened.map_id] = {text: [hit.to_json() for hit in opened.query(text)] for text in LABELS}
    heard, seen = Heard(), []
    with QueryEngine(path, watch=0.02, encoders=encoders) as engine:
        core = Core(engine, heard, NodeConfig())
        limit = time.monotonic() + 60
        while opened.map_id not in seen and time.monotonic() < limit:
            told = asked(core, *LABELS)
            assert len({one["map_id"] for one in told}) == 1  # one request, one map
            assert [one["hits"] for one in told] == [truth[told[0]["map_id"]][text] for text in LABELS]
            if not seen:
                write_small_map(path, LABELS, seed=5)
            seen.append(told[0]["map_id"])
        assert set(seen) == truth.keys()

        def came(topic: answers.Channel) -> list[dict[str, Any]]:
            return [message for own, message in heard.messages if own is topic]

        with heard.news:
            assert heard.news.wait_for(lambda: bool(came(answers.MAP_CLOUD)), 20)
        rows = np.frombuffer(came(answers.MAP_CLOUD)[-1]["data"].tobytes(), [("xyz", "<f4", 3), ("rest", "<u4", 2)])
        np.testing.assert_array_equal(rows["xyz"], opened.means)
        shutil.rmtree(path)
        while engine.health()["problem"] is None and time.monotonic() < limit:
            time.sleep(0.01)
        core.send_health()
        status = came(answers.HEALTH)[-1]["status"][0]
        assert status["level"] == 1 and "live.gsmap" in status["message"]
        assert asked(core, "banana")[0]["hits"] == truth[opened.map_id]["banana"]


def test_reload_service_says_what_it_did(tmp_path: Path) -> None:
    path = tmp_path / "r.gsmap"
    write_small_map(path, LABELS)
    with QueryEngine(path, watch=None, encoders=encoders) as engine:
        core = Core(engine, Heard(), NodeConfig())
        told = core.reload()
        assert told["success"] and "serving already" in told["message"]
        write_small_map(path, LABELS[:2], seed=9)
        assert core.reload() == {"success": True, "message": f"map {load_map(path).map_id}"}
        (path / "map.json").write_text("{")
        told = core.reload()
        assert not told["success"] and "map.json" in told["message"]


def test_bad_settings_name_themselves() -> None:
    for key, value in (("namespace", "a b"), ("transport", "dds"), ("domain", 300), ("timeout", 0)):
        with pytest.raises(InputError, match=key):
            node_config({key: value})
