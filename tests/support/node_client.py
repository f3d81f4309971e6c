"""A client of the node for its tests, without ROS 2: queries over DDS, by topic or by service."""

from __future__ import annotations

import json
import os
import threading
import time
import uuid
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from perception.errors import InputError
from perception.io.cdr import deserialize, serialize
from perception.node import channels
from perception.node.config import NodeConfig
from perception.node.participant import Participant

_DOUBLE_ARRAY = 8
_NS = 1_000_000_000


@dataclass(frozen=True)
class TopicAnswer:
    """An answer received on the topics: the JSON, and the messages with the same stamp (dicts of their fields)."""

    facts: dict[str, Any]
    points: dict[str, Any] | None = None
    detections: dict[str, Any] | None = None
    markers: dict[str, Any] | None = None


class NodeClient:
    """Queries a node over DDS. One request at a time; use one client per thread. TimeoutError when no node answers.

    An unanswered request is repeated every `retry` seconds until its time-out, so a node may restart meanwhile.
    """

    def __init__(self, config: NodeConfig | None = None, retry: float = 2.0) -> None:
        self._config, self._retry = config or NodeConfig(), retry
        self._participant = Participant(self._config.domain_id, self._config.network)
        space = self._config.namespace
        query = channels.QUERY
        # DDS announces readers in the order of creation: a node that has discovered the last one has discovered all.
        self._replies = self._participant.reader(f"rr/{query.path(space)}Reply", f"{query.kind}_Response", headed=True)
        self._answers = {
            topic: self._participant.reader(f"rt/{topic.path(space)}", topic.kind)
            for topic in (channels.POINTS, channels.BOXES, channels.MARKS, channels.ANSWER)
        }
        self._requests = self._participant.writer(
            f"rq/{query.path(space)}Request", f"{query.kind}_Request", headed=True
        )
        self._prompts = self._participant.writer(f"rt/{channels.PROMPT.path(space)}", channels.PROMPT.kind)
        self._reply_wait = self._participant.wait_set([self._replies])
        self._answer_wait = self._participant.wait_set(list(self._answers.values()))
        self._identity = int.from_bytes(os.urandom(8), "little")
        self._number = 0
        self._lock = threading.Lock()

    def close(self) -> None:
        """Leaves the network."""
        self._participant.close()

    def wait_for_node(self, timeout: float = 10.0) -> None:
        """Returns once the node and this client have discovered each other; TimeoutError otherwise.

        Discovery has two directions: messages that the node sends before it has discovered our readers do not arrive.
        So an empty prompt is sent, which the node rejects; receiving this error shows that its answers arrive.
        """
        end = time.monotonic() + timeout
        readers = [self._replies, *self._answers.values()]
        while not (self._requests.readers and self._prompts.readers and all(reader.writers for reader in readers)):
            if time.monotonic() > end:
                raise TimeoutError(f"no node serves '{self._config.namespace}' on domain {self._config.domain_id}")
            time.sleep(0.01)
        self.ask({"text": ""}, max(0.1, end - time.monotonic()), retry=0.1)

    # ----------------------------------------------------------------- service

    def query(self, names: Sequence[str | dict[str, Any]], timeout: float = 10.0) -> list[dict[str, Any] | np.ndarray]:
        """Calls the service; one answer a prompt (text, or options with "text"), all from one map: the JSON, or for
        {"want": "points"} the rows [P, 4] float64 of instance id, x, y, z."""
        prompts = [name if isinstance(name, str) else json.dumps(name) for name in names]
        response = self._call({"names": prompts}, timeout)
        return [_value(value) for value in response["values"]]

    def _call(self, request: dict[str, Any], timeout: float) -> dict[str, Any]:
        with self._lock:
            data = serialize(f"{channels.QUERY.kind}_Request", request)
            numbers: set[int] = set()

            def send() -> None:
                self._number += 1
                numbers.add(self._number)
                self._requests.write(data, (self._identity, self._number))

            def found() -> dict[str, Any] | None:
                for reply, caller in self._replies.take():
                    if caller is not None and caller[0] == self._identity and caller[1] in numbers:
                        return deserialize(f"{channels.QUERY.kind}_Response", reply)
                return None

            return self._until(send, found, self._reply_wait, timeout)

    # ------------------------------------------------------------------ topics

    def ask(self, prompt: str | dict[str, Any], timeout: float = 10.0, retry: float | None = None) -> TopicAnswer:
        """Sends a prompt on the topic; returns its answer with point cloud, detections and markers."""
        asked = {"text": prompt} if isinstance(prompt, str) else dict(prompt)
        identity = asked.setdefault("id", uuid.uuid4().hex)
        data = serialize(channels.PROMPT.kind, {"data": json.dumps(asked)})
        seen: dict[channels.Topic, dict[tuple[int, int], dict[str, Any]]] = {topic: {} for topic in self._answers}
        facts: dict[str, Any] = {}

        def found() -> TopicAnswer | None:
            for topic, reader in self._answers.items():
                for data, _ in reader.take():
                    message = deserialize(topic.kind, data)
                    if topic is channels.ANSWER:
                        received = json.loads(message["data"])
                        facts.update(received if received["id"] == identity else {})
                    else:
                        seen[topic][_stamp(message)] = message
            if "error" in facts:
                return TopicAnswer(facts)
            stamp = (facts["stamp"]["sec"], facts["stamp"]["nanosec"]) if facts else None
            parts = (
                [seen[topic].get(stamp) for topic in (channels.POINTS, channels.BOXES, channels.MARKS)] if stamp else []
            )
            return TopicAnswer(facts, *parts) if parts and all(part is not None for part in parts) else None

        with self._lock:
            return self._until(lambda: self._prompts.write(data), found, self._answer_wait, timeout, retry)

    def _until(
        self,
        send: Callable[[], Any],
        found: Callable[[], Any],
        waiting: Any,
        timeout: float,
        retry: float | None = None,
    ) -> Any:
        """Calls `send` every `retry` seconds (None: the client's own) until `found` returns a value; returns it."""
        end, again = time.monotonic() + timeout, 0.0
        while True:
            now = time.monotonic()
            if now >= end:
                raise TimeoutError(f"no answer from '{self._config.namespace}' within {timeout:g} s")
            if now >= again:
                send()
                again = now + (self._retry if retry is None else retry)
            waiting.wait(int(min(end, again) * _NS) - int(now * _NS))
            answer = found()
            if answer is not None:
                return answer


def cloud_rows(message: dict[str, Any]) -> np.ndarray:
    """The points [P] of a PointCloud2 as a structured array with its fields."""
    kinds = {5: "<i4", 6: "<u4", 7: "<f4"}
    fields = message["fields"]
    layout = np.dtype(
        {
            "names": [field["name"] for field in fields],
            "formats": [kinds[field["datatype"]] for field in fields],
            "offsets": [field["offset"] for field in fields],
            "itemsize": message["point_step"],
        }
    )
    return np.frombuffer(np.asarray(message["data"], np.uint8).tobytes(), layout)


def _stamp(message: dict[str, Any]) -> tuple[int, int]:
    header = message["markers"][0]["header"] if "markers" in message else message["header"]
    return header["stamp"]["sec"], header["stamp"]["nanosec"]


def _value(value: dict[str, Any]) -> dict[str, Any] | np.ndarray:
    if value["type"] == _DOUBLE_ARRAY:
        return np.asarray(value["double_array_value"]).reshape(-1, 4)
    try:
        answer: dict[str, Any] = json.loads(value["string_value"])
    except ValueError as error:
        raise InputError("the node's answer is no JSON; is it of this version?") from error
    return answer
