"""Runs the query node: one process that serves a map until it is stopped."""

from __future__ import annotations

import contextlib
import importlib.util
import signal
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from perception.errors import InputError
from perception.node.config import NodeConfig
from perception.node.core import Core
from perception.node.ros import RosTransport
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

    InputError when the map cannot be used, rclpy cannot be imported, or another node of this name is running.
    encoders: see QueryEngine.
    """
    if importlib.util.find_spec("rclpy") is None:
        raise InputError("node: rclpy cannot be imported; install ROS 2 and source its setup file")
    with contextlib.closing(RosTransport(config)) as transport, _engine(path, config, encoders) as engine:
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
