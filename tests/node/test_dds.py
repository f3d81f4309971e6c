"""The node over DDS, in a process of its own, asked from this one on the loopback."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from perception import load_map
from perception.errors import InputError
from support.node_maps import encoders, write_small_map
from support.paths import REPOSITORY, SUPPORT

pytest.importorskip("cyclonedds")
pytest.importorskip("rosbags")

from perception.io.cdr import deserialize, serialize
from perception.node import channels
from perception.node.config import NodeConfig, node_config
from perception.node.participant import Participant
from support.node_client import NodeClient, cloud_rows

DOMAIN = 20 + os.getpid() % 200
LABELS = ["red mug", "laptop", "banana", "Kühlschrank"]
WAIT = 90.0


def start(path: Path, namespace: str, *pairs: str) -> subprocess.Popen[str]:
    """A node process that is serving, or has said why it does not."""
    settings = ["transport=dds", f"namespace={namespace}", f"domain={DOMAIN}", "network=localhost", "watch=0.05"]
    settings += ["health_seconds=0.1", "discovery_seconds=0.3", *pairs]
    node = subprocess.Popen(
        [sys.executable, str(SUPPORT / "node_process.py"), str(path), *settings],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=path.parent,
    )
    assert node.stdout is not None
    node.stdout.readline()
    return node


def end(node: subprocess.Popen[str]) -> None:
    node.kill()
    node.communicate()


def client(namespace: str, retry: float = 1.0) -> NodeClient:
    made = NodeClient(NodeConfig(namespace=namespace, domain=DOMAIN, network="localhost"), retry)
    made.wait_for_node(WAIT)
    return made


@pytest.fixture(scope="module")
def map_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("served") / "a.gsmap"
    write_small_map(path, LABELS)
    return path


@pytest.fixture(scope="module")
def asker(map_path: Path) -> Iterator[NodeClient]:
    node = start(map_path, "steady")
    made = client("steady")
    yield made
    made.close()
    end(node)


def take_until(reader: Any, kind: str, fits: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
    limit = time.monotonic() + WAIT
    while time.monotonic() < limit:
        for data, _ in reader.take():
            message = deserialize(kind, data)
            if fits(message):
                return message
        time.sleep(0.02)
    raise AssertionError(f"no such {kind} came")


def health_values(message: dict[str, Any]) -> dict[str, str]:
    return {pair["key"]: pair["value"] for pair in message["status"][0]["values"]}


def test_service_gives_what_the_map_gives(asker: NodeClient, map_path: Path) -> None:
    gmap = load_map(map_path, encoders=encoders)
    for text in LABELS:
        facts, rows = asker.query([text, {"text": text, "want": "points"}], WAIT)
        hits = gmap.query(text)
        assert isinstance(facts, dict) and facts["hits"] == [hit.to_json() for hit in hits]
        assert (facts["text"], facts["frame"], facts["metric"], facts["map_id"]) == (text, "kitchen", True, gmap.map_id)
        assert isinstance(rows, np.ndarray)
        np.testing.assert_array_equal(rows[:, 1:].astype(np.float32), np.concatenate([hit.points for hit in hits]))
        assert rows[:, 0].tolist() == [hit.instance_id for hit in hits for _ in hit.points]
    assert asker.query(["zebra"], WAIT)[0]["present"] is False


def test_topics_give_what_the_map_gives(asker: NodeClient, map_path: Path) -> None:
    hits = load_map(map_path, encoders=encoders).query("laptop", 2)
    answer = asker.ask({"text": "laptop", "top_k": 2, "id": "mine"}, WAIT)
    assert answer.facts["id"] == "mine" and answer.facts["hits"] == [hit.to_json() for hit in hits]
    assert answer.points is not None and answer.detections is not None and answer.markers is not None
    rows = cloud_rows(answer.points)
    xyz = np.stack([rows[axis] for axis in "xyz"], axis=1)
    np.testing.assert_array_equal(xyz, np.concatenate([hit.points for hit in hits]))
    assert answer.points["header"]["frame_id"] == "kitchen"
    assert answer.points["header"]["stamp"] == answer.facts["stamp"] == answer.detections["header"]["stamp"]
    found = answer.detections["detections"]
    assert [(one["id"], one["results"][0]["hypothesis"]["class_id"]) for one in found] == [
        (str(hit.instance_id), "laptop") for hit in hits
    ]
    center = found[0]["bbox"]["center"]["position"]
    np.testing.assert_allclose([center[axis] for axis in "xyz"], hits[0].obb.center)
    assert [mark["action"] for mark in answer.markers["markers"]] == [3, 0, 0, 0, 0]


def test_filters_and_frames_travel(asker: NodeClient) -> None:
    box = {"center": [1.0, 0, 0], "rotation": np.eye(3).tolist(), "extent": [1.0, 2, 2]}
    moved = [[1, 0, 0, 5], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
    asked = {"text": "laptop", "top_k": 9, "frame": {"name": "base", "from_map": moved}}
    plain, there = asker.query(["laptop", asked], WAIT)
    assert there["frame"] == "base"
    np.testing.assert_allclose(there["hits"][0]["centroid"][0], plain["hits"][0]["centroid"][0] + 5)
    inside = asker.query([{"text": "laptop", "top_k": 9, "where": {"region": box}}], WAIT)[0]
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
def test_bad_prompts_are_answered_with_the_reason(asker: NodeClient, prompt: str, words: str) -> None:
    told = asker.query([prompt, "laptop"], WAIT)
    assert told[0]["error"]["kind"] == "bad_input" and words in told[0]["error"]["message"]
    assert len(told[0]["text"]) <= 81 and told[1]["present"]


def test_bad_prompts_on_the_topic_are_answered_too(asker: NodeClient) -> None:
    answer = asker.ask({"text": "", "id": "empty one"}, WAIT)
    assert answer.facts["error"]["kind"] == "bad_input" and answer.facts["id"] == "empty one"
    answer = asker.ask({"text": "x", "nonsense": 1, "id": "odd one"}, WAIT)
    assert "nonsense" in answer.facts["error"]["message"]


def test_malformed_messages_are_survived(asker: NodeClient) -> None:
    seat = Participant(DOMAIN, "localhost")
    prompts = seat.writer("rt/steady/prompt", channels.PROMPT.kind)
    requests = seat.writer("rq/steady/queryRequest", f"{channels.QUERY.kind}_Request", headed=True)
    health = seat.reader("rt/diagnostics", channels.HEALTH.kind)
    while not (prompts.readers and requests.readers and health.writers):
        time.sleep(0.01)
    rng = np.random.default_rng(1)
    good = serialize(f"{channels.QUERY.kind}_Request", {"names": ["mug"]})
    bad = [b"\0\1\0\0" + rng.bytes(int(n)) for n in rng.integers(1, 3000, 20)]
    huge = b"\0\1\0\0\xff\xff\xff\x7f" + bytes(5_000_000)
    for data in (*bad, huge, b"\0\1\0\0\4\0\0\0\xff\xfe\xff\0"):
        prompts.write(data)
        requests.write(data, (1, 1))
    requests.write(good)  # without the header, as rmw_fastrtps sends it
    # CycloneDDS drops what does not fit the type's structure; a text that is no UTF-8 comes through to us.
    told = take_until(health, channels.HEALTH.kind, lambda m: int(health_values(m)["malformed"]) >= 1)
    assert told["status"][0]["level"] == 0 and health_values(told)["failed"] == "0"
    assert asker.query(["laptop"], WAIT)[0]["present"]
    seat.close()


def test_answers_of_many_askers_are_never_crossed(asker: NodeClient) -> None:
    wrong: list[object] = []

    def ask(n: int) -> None:
        own = NodeClient(NodeConfig(namespace="steady", domain=DOMAIN, network="localhost"))
        own.wait_for_node(WAIT)
        for i in range(20):
            text = LABELS[(n + i) % len(LABELS)]
            told = own.query([text], WAIT)[0] if i % 2 else own.ask({"text": text, "top_k": 1}, WAIT).facts
            if told["text"] != text or told["hits"][0]["label"] != text:
                wrong.append(told)
        own.close()

    threads = [threading.Thread(target=ask, args=(n,)) for n in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(2 * WAIT)
        assert not thread.is_alive()
    assert not wrong


def test_late_comers_get_the_cloud_of_the_map(asker: NodeClient, map_path: Path) -> None:
    seat = Participant(DOMAIN, "localhost")
    reader = seat.reader("rt/steady/map/points", channels.MAP_CLOUD.kind, latched=True)
    rows = cloud_rows(take_until(reader, channels.MAP_CLOUD.kind, lambda m: True))
    gmap = load_map(map_path, encoders=encoders)
    np.testing.assert_array_equal(np.stack([rows[axis] for axis in "xyz"], axis=1), gmap.means)
    np.testing.assert_array_equal(rows["instance_id"], gmap.instance_ids)
    seat.close()


def test_second_node_of_that_name_is_refused(asker: NodeClient, map_path: Path) -> None:
    second = start(map_path, "steady", "discovery_seconds=5")
    _, told = second.communicate(timeout=WAIT)
    assert second.returncode == 1 and "1 other node(s) serve 'steady'" in told and "--namespace" in told


def test_unusable_network_is_told_in_one_line(tmp_path: Path, map_path: Path) -> None:
    node = start(map_path, "lost", "network=nosuchif0")
    _, told = node.communicate(timeout=WAIT)
    assert node.returncode == 1 and "network nosuchif0" in told and "Traceback" not in told


@pytest.mark.slow
def test_node_ends_in_order_when_asked(map_path: Path) -> None:
    node = start(map_path, "brief")
    node.send_signal(signal.SIGTERM)
    assert node.wait(WAIT) == 0
    end(node)


@pytest.mark.slow
def test_clients_recover_from_a_node_killed_under_load(map_path: Path) -> None:
    node = start(map_path, "mortal")
    answered, failures, stop = [0], [], threading.Event()

    def ask() -> None:
        own = client("mortal", retry=0.3)
        while not stop.is_set():
            try:
                told = own.query([LABELS[answered[0] % 4]], WAIT)[0]
                assert told["present"]
                answered[0] += 1
            except Exception as error:
                failures.append(error)
                return
        own.close()

    def wait_for_more() -> None:
        goal = answered[0] + 30
        while answered[0] < goal and thread.is_alive():
            time.sleep(0.01)

    thread = threading.Thread(target=ask)
    thread.start()
    try:
        wait_for_more()
        end(node)  # not asked: dead at once, in the middle of whatever it does
        node = start(map_path, "mortal")
        wait_for_more()
    finally:
        stop.set()
        thread.join(2 * WAIT)
        end(node)
    assert not failures and answered[0] >= 60


@pytest.mark.slow
def test_map_replaced_under_load_answers_come_from_one_or_the_other(tmp_path: Path) -> None:
    path, other = tmp_path / "live.gsmap", tmp_path / "b.gsmap"
    write_small_map(path, LABELS, seed=0)
    write_small_map(other, LABELS, seed=5)
    truth = {}
    for one in (path, other):
        opened = load_map(one, encoders=encoders)
        truth[opened.map_id] = {text: [hit.to_json() for hit in opened.query(text)] for text in LABELS}
    new_id = opened.map_id
    node = start(path, "moving")
    asked = client("moving")
    seat = Participant(DOMAIN, "localhost")
    cloud = seat.reader("rt/moving/map/points", channels.MAP_CLOUD.kind, latched=True)
    health = seat.reader("rt/diagnostics", channels.HEALTH.kind)
    try:
        seen: set[str] = set()
        limit = time.monotonic() + WAIT
        while new_id not in seen and time.monotonic() < limit:
            told = asked.query(LABELS, WAIT)
            assert len({one["map_id"] for one in told}) == 1  # one request, one map
            assert [one["hits"] for one in told] == [truth[told[0]["map_id"]][text] for text in LABELS]
            if not seen:
                write_small_map(path, LABELS, seed=5)
            seen.add(told[0]["map_id"])
        assert seen == truth.keys()
        take_until(cloud, channels.MAP_CLOUD.kind, lambda m: bool(cloud_rows(m)["z"].mean() > 4))
        shutil.rmtree(path)
        told = take_until(health, channels.HEALTH.kind, lambda m: m["status"][0]["level"] == 1)
        assert "live.gsmap" in told["status"][0]["message"]
        assert asked.query(["banana"], WAIT)[0]["hits"] == truth[new_id]["banana"]
        assert asked.ask("banana", WAIT).facts["hits"] == truth[new_id]["banana"]
    finally:
        asked.close()
        seat.close()
        end(node)


def test_reload_service_says_what_it_did(tmp_path: Path) -> None:
    path = tmp_path / "r.gsmap"
    write_small_map(path, LABELS)
    node = start(path, "manual", "watch=3600")
    seat = Participant(DOMAIN, "localhost")
    kind = channels.RELOAD.kind
    requests = seat.writer("rq/manual/reloadRequest", f"{kind}_Request", headed=True)
    replies = seat.reader("rr/manual/reloadReply", f"{kind}_Response", headed=True)
    while not (requests.readers and replies.writers):
        time.sleep(0.01)

    def reload() -> dict[str, Any]:
        requests.write(serialize(f"{kind}_Request", {}), (3, 4))
        return take_until(replies, f"{kind}_Response", lambda _: True)

    try:
        assert reload()["success"] and "serving already" in str(reload()["message"])
        write_small_map(path, LABELS[:2], seed=9)
        told = reload()
        assert told["success"] and told["message"] == f"map {load_map(path).map_id}"
        (path / "map.json").write_text("{")
        told = reload()
        assert not told["success"] and "map.json" in told["message"]
    finally:
        seat.close()
        end(node)


def test_bad_settings_name_themselves() -> None:
    for key, value in (("namespace", "a b"), ("transport", "carrier pigeon"), ("domain", 300), ("timeout", 0)):
        with pytest.raises(InputError, match=key):
            node_config({key: value})


def test_the_example_gets_an_answer(asker: NodeClient) -> None:
    env = {**os.environ, "ROS_DOMAIN_ID": str(DOMAIN), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    command = [sys.executable, str(REPOSITORY / "examples" / "ask_a_node.py"), "laptop", "steady"]
    ended = subprocess.run(command, env=env, capture_output=True, text=True, timeout=WAIT, check=False)
    assert ended.returncode == 0, ended.stderr
    assert json.loads(ended.stdout)["hits"] == asker.query(["laptop"], WAIT)[0]["hits"]


def test_json_of_answers_is_plain(asker: NodeClient) -> None:
    assert json.loads(json.dumps(asker.query(["laptop"], WAIT)))[0]["text"] == "laptop"
