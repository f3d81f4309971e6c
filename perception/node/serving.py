"""Runs the query node: one process that serves a map until it is stopped."""

from __future__ import annotations

import contextlib
import importlib.util
import signal
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from perception.errors import InputError, missing_extra
from perception.node.config import NodeConfig
from perception.node.core import Core
from perception.query import QueryEngine

if TYPE_CHECKING:
    from perception.language.base import Encoder


def serve_node(
    path: str | Path,
    config: NodeConfig,
    stop: threading.Event,
    log: Callable[[str], None] = lambda _: None,
    encoders: Callable[[str], Encoder | None] | None = None,
) -> dict[str, Any]:
    """Serves the map at `path` until `stop` is set; returns the engine's health figures.

    InputError when the map or the network cannot be used, or when another node of this name is running.
    encoders: see QueryEngine.
    """
    kind = transport_kind(config)
    with contextlib.closing(_make(kind, config)) as transport, _engine(path, config, encoders) as engine:
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
            f"serving {path} (map {held.map_id}, {len(held.instances)} instances) by {kind}, domain "
            f"{config.domain_id}, as /{config.namespace}"
        )
        transport.serve(core, stop)
        return engine.health()


def _engine(path: str | Path, config: NodeConfig, encoders: Callable[[str], Encoder | None] | None) -> QueryEngine:
    return QueryEngine(
        path,
        workers=config.workers,
        queue_size=config.queue_size,
        timeout=config.timeout,
        watch=config.watch,
        encoders=encoders,
    )


@contextlib.contextmanager
def stop_on_signals() -> Iterator[threading.Event]:
    """An event that SIGINT and SIGTERM set, for an orderly stop; after SIGINT it ends in KeyboardInterrupt."""
    stop, interrupted = threading.Event(), threading.Event()

    def end(number: int, _: object) -> None:
        if number == signal.SIGINT:
            interrupted.set()
        stop.set()

    before = {number: signal.signal(number, end) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    if interrupted.is_set():
        raise KeyboardInterrupt


def transport_kind(config: NodeConfig) -> str:
    """The transport, dds or rclpy. InputError with the remedy when it is not installed."""
    if config.transport != "dds" and importlib.util.find_spec("rclpy") is not None:
        return "rclpy"
    if config.transport == "rclpy":
        raise InputError("node: rclpy cannot be imported; source ROS 2's setup file, or take --transport dds")
    for package in ("cyclonedds", "rosbags"):
        if importlib.util.find_spec(package) is None:
            raise missing_extra(package, "ros")
    return "dds"


def _make(kind: str, config: NodeConfig) -> Any:
    if kind == "rclpy":
        from perception.node.ros import RosTransport

        return RosTransport(config)
    from perception.node.dds import DdsTransport

    return DdsTransport(config)
