"""The query node on rclpy: `RosTransport` on any node, and `serve_node`, one process that serves one map."""

from __future__ import annotations

import array
import contextlib
import importlib
import importlib.util
import re
import signal
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from perception.errors import InputError
from perception.interrupts import ENDING, handled
from perception.language.base import Encoder
from perception.node import answers
from perception.node.answers import DEPTH, Channel
from perception.node.config import NodeConfig
from perception.node.core import Core, Message
from perception.serve.engine import QueryEngine
from perception.serve.requests import AnswerTimeout

_SEQUENCE = re.compile(r"(?:sequence<)?(\w+/\w+)(?:, \d+)?>?(?:\[\d+\])?")
_EXTRA_SECONDS = 1.0
"""Added to the engine's time-out for a service call: what has not begun by then fails there with a better reason."""


class RosTransport:
    """Publishers of `outputs`, subscription and services of an rclpy node, which the caller spins (`spin`)."""

    def __init__(self, node: Any, config: NodeConfig, outputs: Iterable[Channel] = answers.OUTPUTS) -> None:
        self._node, self.config, self._outputs = node, config, outputs
        self._publishers: dict[Channel, Any] = {}
        self._absent: list[str] = []

    def others(self) -> int:
        """The number of other nodes of this name that are discovered within `discovery_seconds`."""
        end = time.monotonic() + self.config.discovery_seconds
        while time.monotonic() < end and not self._answerers():
            time.sleep(0.02)
        return self._answerers()

    def _answerers(self) -> int:
        publishers = self._node.get_publishers_info_by_topic(self._node.resolve_topic_name(answers.ANSWER.name))
        return max(0, len(publishers) - (answers.ANSWER in self._publishers))

    def open(self) -> None:
        """Creates the publishers. A topic whose type is not installed (vision_msgs) is skipped; see `figures`."""
        for topic in self._outputs:
            try:
                kind = message_class(topic.kind)
            except ImportError:
                self._absent.append(f"{topic.name} is not published: {topic.kind.split('/')[0]} is not installed")
                continue
            self._publishers[topic] = self._node.create_publisher(kind, topic.name, _qos(topic.latched))

    def publish(self, topic: Channel, message: Message) -> None:
        """Sends a message; unless latched, it is not built when there is no subscriber."""
        publisher = self._publishers.get(topic)
        if publisher is not None and (topic.latched or publisher.get_subscription_count()):
            publisher.publish(fill(message_class(topic.kind)(), message))

    def warnings(self) -> list[str]:
        """Present problems, one text each."""
        others = self._answerers()
        return [f"{others} other node(s) answer on {self.config.namespace}"] if others else []

    def figures(self) -> dict[str, Any]:
        """The topics that are not published, with the reason."""
        return {"left_out": "; ".join(self._absent)} if self._absent else {}

    def listen(self, core: Core) -> None:
        """Passes received messages to the core and publishes health messages, while the node is spun."""
        from rclpy.callback_groups import MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup

        calls, node = ReentrantCallbackGroup(), self._node
        topics: dict[Channel, Callable[[Any], None]] = {
            answers.PROMPT: lambda message: core.prompt(message.data),
            answers.LOCALISE_IMAGE: core.localising.image,
            answers.LOCALISE_COMPRESSED: core.localising.image,
            answers.LOCALISE_CAMERA: core.localising.camera,
        }
        for topic, take in topics.items():
            group = MutuallyExclusiveCallbackGroup()
            node.create_subscription(message_class(topic.kind), topic.name, take, _qos(False), callback_group=group)
        services: dict[Channel, Callable[[Any, Any], Any]] = {
            answers.QUERY: lambda request, response: self._query(core, request, response),
            answers.RELOAD: lambda _, response: fill(response, core.reload()),
        }
        for service, answer in services.items():
            node.create_service(message_class(service.kind), service.name, answer, callback_group=calls)
        node.create_timer(self.config.health_seconds, core.send_health, callback_group=MutuallyExclusiveCallbackGroup())

    def _query(self, core: Core, request: Any, response: Any) -> Any:
        done, answered = threading.Event(), []

        def finish(values: Message) -> None:
            answered.append(values)
            done.set()

        names = list(request.names)
        core.query(names, finish)
        if not done.wait(self.config.timeout + _EXTRA_SECONDS):
            finish(core.refusal(AnswerTimeout(f"no answer within {self.config.timeout:g} s"), names))
        return fill(response, answered[0])


def spin(node: Any, config: NodeConfig, stop: threading.Event) -> None:
    """Calls the node's callbacks in threads until `stop` is set."""
    from rclpy.executors import MultiThreadedExecutor

    executor = MultiThreadedExecutor(num_threads=config.workers + 3, context=node.context)
    executor.add_node(node)
    while not stop.is_set():
        executor.spin_once(timeout_sec=0.1)
    executor.shutdown(timeout_sec=config.timeout)


@contextlib.contextmanager
def _node(config: NodeConfig) -> Iterator[Any]:
    """An rclpy node in a context of its own."""
    import rclpy
    from rclpy.signals import SignalHandlerOptions

    context = rclpy.Context()
    rclpy.init(context=context, domain_id=config.domain_id, signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node("node", namespace=f"/{config.namespace}", context=context)
    try:
        yield node
    finally:
        node.destroy_node()
        context.try_shutdown()


def fill(message: Any, values: Message) -> Any:
    """Sets the fields of a ROS message from a dict; KeyError for an unknown field."""
    kinds = message.get_fields_and_field_types()
    for name, value in values.items():
        setattr(message, name, _converted(kinds[name], getattr(message, name), value))
    return message


def _converted(kind: str, current: Any, value: Any) -> Any:
    if isinstance(value, dict):
        return fill(current, value)
    if kind == "octet":
        return bytes([value])
    if isinstance(current, array.array):  # numbers are copied as bytes, not one by one
        return array.array(current.typecode, np.asarray(value, np.dtype(current.typecode)).tobytes())
    if isinstance(value, list) and value and isinstance(value[0], dict):
        inner = _SEQUENCE.fullmatch(kind)
        if inner is None:
            raise KeyError(kind)
        made = message_class(inner[1].replace("/", "/msg/"))
        return [fill(made(), item) for item in value]
    return value


@cache
def message_class(kind: str) -> Any:
    """The Python class of `sensor_msgs/msg/PointCloud2` or `std_srvs/srv/Trigger`; ImportError when not installed."""
    package, space, name = kind.split("/")
    return getattr(importlib.import_module(f"{package}.{space}"), name)


def _qos(latched: bool) -> Any:
    from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

    return QoSProfile(
        depth=1 if latched else DEPTH,
        reliability=ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )


def serve_node(
    path: str | Path,
    config: NodeConfig,
    stop: threading.Event,
    log: Callable[[str], None] = lambda _: None,
    encoders: Callable[[str], Encoder | None] | None = None,
) -> dict[str, Any]:
    """Serves the map at `path` until `stop` is set; returns the engine's health figures.

    InputError when the map cannot be used, rclpy cannot be imported, or another node of this name is running.
    encoders: see QueryEngine.
    """
    if importlib.util.find_spec("rclpy") is None:
        raise InputError("node: rclpy cannot be imported; install ROS 2 and source its setup file")
    with _node(config) as node, QueryEngine(path, encoders=encoders, **config.of_engine()) as engine:
        transport = RosTransport(node, config)
        others = transport.others()
        if others:
            raise InputError(
                f"node: {others} other node(s) serve '{config.namespace}' on domain {config.domain_id} already; stop "
                "them, or give this one another --namespace or --domain"
            )
        transport.open()
        core = Core(engine, transport, config)
        core.start()
        held = engine.current
        log(
            f"serving {path} (map {held.map_id}, {len(held.instances)} instances) on domain {config.domain_id}, "
            f"as /{config.namespace}"
        )
        transport.listen(core)
        spin(node, config, stop)
        return engine.health()


@contextlib.contextmanager
def stop_on_signals() -> Iterator[threading.Event]:
    """An event that SIGINT and SIGTERM set, for an orderly stop; after SIGINT it ends in KeyboardInterrupt."""
    stop, interrupted = threading.Event(), threading.Event()

    def end(number: int, _: object) -> None:
        if number == signal.SIGINT:
            interrupted.set()
        stop.set()

    with handled(end, *ENDING):
        yield stop
    if interrupted.is_set():
        raise KeyboardInterrupt
