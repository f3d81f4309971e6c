"""The DDS transport of the node, without ROS 2: CycloneDDS with ROS 2's conventions."""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Callable
from typing import Any

from perception.io.cdr import deserialize, serialize
from perception.node import channels
from perception.node.channels import Service, Topic
from perception.node.config import NodeConfig
from perception.node.core import Core, Message
from perception.node.participant import Participant, Reader

_LOOK_SECONDS = 0.1
"""Longest wait for messages before the clock is checked."""
_NS = 1_000_000_000


class DdsTransport:
    """The node's DDS writers and readers. `serve` blocks; the other methods may be called from any thread."""

    def __init__(self, config: NodeConfig) -> None:
        self._config = config
        self._participant = Participant(config.domain_id, config.network)
        self._figures: Counter[str] = Counter()
        self._answer_name = f"rt/{channels.ANSWER.path(config.namespace)}"

    def others(self) -> int:
        """The number of other nodes of this name that are discovered within `discovery_seconds`."""
        end = time.monotonic() + self._config.discovery_seconds
        while time.monotonic() < end and not self._participant.writers_elsewhere(self._answer_name):
            time.sleep(0.02)
        return self._participant.writers_elsewhere(self._answer_name)

    def open(self) -> None:
        """Creates the node's writers and readers."""
        space = self._config.namespace
        self._writers = {
            topic: self._participant.writer(f"rt/{topic.path(space)}", topic.kind, latched=topic.latched)
            for topic in channels.OUTPUTS
        }
        self._replies = {
            service: self._participant.writer(f"rr/{service.path(space)}Reply", f"{service.kind}_Response", headed=True)
            for service in channels.SERVICES
        }
        self._prompts = self._participant.reader(f"rt/{channels.PROMPT.path(space)}", channels.PROMPT.kind)
        self._requests = {
            service: self._participant.reader(
                f"rq/{service.path(space)}Request", f"{service.kind}_Request", headed=True
            )
            for service in channels.SERVICES
        }

    def publish(self, topic: Topic, message: Message) -> None:
        """Sends a message; unless latched, it is not serialised when there is no reader."""
        writer = self._writers[topic]
        if topic.latched or writer.readers:
            writer.write(serialize(topic.kind, message))

    def warnings(self) -> list[str]:
        """Present problems, one text each."""
        others = self._participant.writers_elsewhere(self._answer_name)
        return [f"{others} other node(s) answer on {self._config.namespace}"] if others else []

    def figures(self) -> dict[str, Any]:
        """Counts since the start."""
        writers = [*self._writers.values(), *self._replies.values()]
        given_up = sum(writer.given_up for writer in writers)
        return {"malformed": self._figures["malformed"], "given_up_for_slow_readers": given_up}

    def close(self) -> None:
        """Leaves the network."""
        self._participant.close()

    def serve(self, core: Core, stop: threading.Event) -> None:
        """Passes received messages to the core and publishes health messages, until `stop` is set."""
        waiting = self._participant.wait_set([self._prompts, *self._requests.values()])
        due = time.monotonic()
        while not stop.is_set():
            waiting.wait(int(_LOOK_SECONDS * _NS))
            for data, _ in self._prompts.take():
                message = self._read(channels.PROMPT.kind, data)
                if message is not None:
                    core.prompt(message["data"])
            self._take_requests(core)
            if time.monotonic() >= due:
                due = time.monotonic() + self._config.health_seconds
                core.send_health()

    def _take_requests(self, core: Core) -> None:
        for data, caller in _arrived(self._requests[channels.QUERY]):
            message = self._read(f"{channels.QUERY.kind}_Request", data)
            if message is not None:
                core.query(message["names"], self._reply_to(channels.QUERY, caller))
        for data, caller in _arrived(self._requests[channels.RELOAD]):
            if self._read(f"{channels.RELOAD.kind}_Request", data) is not None:
                reply = self._reply_to(channels.RELOAD, caller)
                # In its own thread: opening a map would delay other requests.
                threading.Thread(target=_reload, args=(core, reply), daemon=True).start()

    def _reply_to(self, service: Service, caller: tuple[int, int]) -> Callable[[Message], None]:
        kind, writer = f"{service.kind}_Response", self._replies[service]

        def reply(response: Message) -> None:
            writer.write(serialize(kind, response), caller)

        return reply

    def _read(self, kind: str, data: bytes) -> Message | None:
        try:
            return deserialize(kind, data)
        except ValueError:
            self._figures["malformed"] += 1
            return None


def _reload(core: Core, reply: Callable[[Message], None]) -> None:
    reply(core.reload())


def _arrived(reader: Reader) -> list[tuple[bytes, tuple[int, int]]]:
    return [(data, caller or (0, 0)) for data, caller in reader.take()]
