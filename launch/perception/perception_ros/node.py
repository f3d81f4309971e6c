"""`ros2 run perception node --ros-args -p map:=site.gsmap`: a map as a lifecycle node.

configure loads the map, activate answers, deactivate ends that, cleanup frees the map. Topics and services exist in
every state; while the node is not active, a prompt is answered with an error of the kind `closed` that names the state.
"""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import replace
from pathlib import Path
from typing import Any

import rclpy
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.signals import SignalHandlerOptions

from perception.errors import InputError
from perception.node import answers
from perception.node.config import NodeConfig, node_config
from perception.node.core import Core
from perception.node.ros import RosTransport, fill, message_class, spin, stop_on_signals
from perception.query import Frame, QueryMap
from perception.query.floor_grid import floor_grid
from perception.query.requests import TOP
from perception.query.robot_pose import RobotPose, where_to_stand
from perception.serve.engine import QueryEngine
from perception.serve.requests import AnswerTimeout, EngineBusy, EngineClosed, Reply, Request, UnknownFrame, error_kind
from perception_ros import messages
from perception_ros.frames import FrameFile, read_frame

BAD_INPUT = 2
CELL = 0.05  # side of a cell of the floor plan, metres
TEXTS = {
    "map": "the map directory",
    "frame_file": "frame.yaml, where the map lies in the robot's world; empty: no transform is published",
    "photos": "folder where the map's photos may be read beside its own, to localise images",
}
SETTINGS = ("workers", "queue_size", "timeout", "map_points", "watch", "discovery_seconds")
SWITCHES = {"autostart": "whether the node configures and activates itself"}


class PlacedEngine(QueryEngine):
    """A query engine whose map lies in the child frame of a frame file."""

    def __init__(self, path: Path, frames: FrameFile | None, **settings: Any) -> None:
        self._frames = frames
        super().__init__(path, **settings)

    def open_map(self) -> QueryMap:
        gmap = super().open_map()
        return gmap if self._frames is None else self._frames.placed(gmap)


class Gate:
    """The engine as `Core` uses it: that of the configured map while the node is active, else EngineClosed."""

    def __init__(self) -> None:
        self.engine: QueryEngine | None = None
        self.state = "unconfigured"
        self._listeners: list[Callable[[QueryMap], None]] = []

    def on_reload(self, listener: Callable[[QueryMap], None]) -> None:
        self._listeners.append(listener)

    def hold(self, engine: QueryEngine) -> None:
        """Takes an engine, whose reloads the listeners hear."""
        for listener in self._listeners:
            engine.on_reload(listener)
        self.engine, self.state = engine, "inactive"

    def release(self) -> None:
        """Closes the engine; what waits ends with EngineClosed."""
        engine, self.engine, self.state = self.engine, None, "unconfigured"
        if engine is not None:
            engine.close()

    def _active(self) -> QueryEngine:
        engine = self.engine
        if engine is None or self.state != "active":
            raise EngineClosed(f"the node is {self.state}; activate it")
        return engine

    @property
    def current(self) -> QueryMap:
        return self._active().current

    def submit(self, request: Request) -> Future[Any]:
        return self._active().submit(request)

    def run(self, work: Callable[[QueryMap], Any]) -> Future[Any]:
        return self._active().run(work)

    def reload(self) -> bool:
        if self.engine is None:
            raise InputError(f"the node is {self.state}; configure it")
        return self.engine.reload()

    def health(self) -> dict[str, Any]:
        engine = self.engine
        facts = {} if engine is None else engine.health()
        return facts if self.state == "active" else {**facts, "problem": f"the node is {self.state}"}


class MapNode(LifecycleNode):
    """The lifecycle node. encoders: see QueryEngine."""

    def __init__(self, encoders: Any = None, **options: Any) -> None:
        super().__init__("node", namespace="perception", **options)
        self._encoders = encoders
        for name, text in TEXTS.items():
            self.declare_parameter(name, "", ParameterDescriptor(description=text))
        for name in SETTINGS:
            field = NodeConfig.model_fields[name]
            self.declare_parameter(name, field.default, _descriptor(field))
        for name, text in SWITCHES.items():
            self.declare_parameter(name, False, ParameterDescriptor(description=text, read_only=True))
        self.config = NodeConfig(namespace=self.get_namespace().strip("/") or "perception")
        self._frames: FrameFile | None = None
        self._gate = Gate()
        self._transport = RosTransport(self, self.config, (*answers.OUTPUTS, *messages.OUTPUTS))
        self._transport.open()
        self._core = Core(self._gate, self._transport, self.config)  # type: ignore[arg-type]
        self._transport.listen(self._core)
        self._gate.on_reload(lambda _: self._send_map())
        services = {messages.FIND: self._find, messages.STAND: self._stand}
        try:
            kinds = {channel: message_class(channel.kind) for channel in services}
        except (ImportError, AttributeError):
            self.get_logger().info("perception_msgs is not installed: plain messages only")
        else:
            self.get_logger().info("perception_msgs is installed: its services and topics are served too")
            for channel, answer in services.items():
                self.create_service(kinds[channel], channel.name, answer, callback_group=ReentrantCallbackGroup())

    # --------------------------------------------------------------- lifecycle

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Loads the map."""
        try:
            self._configure()
        except InputError as error:
            self.get_logger().error(" ".join(str(error).split()))
            return TransitionCallbackReturn.FAILURE
        return super().on_configure(state)

    def _configure(self) -> None:
        texts = {name: self.get_parameter(name).value for name in TEXTS}
        if not texts["map"]:
            raise InputError("parameter map: is empty, expected the map directory")
        settings = {name: self.get_parameter(name).value for name in SETTINGS}
        config = node_config({**settings, "namespace": self.config.namespace}, "parameter")
        others = self._transport.others()
        if others:
            raise InputError(f"{others} other node(s) serve {self.get_namespace()} already; use another namespace")
        self._frames = read_frame(Path(texts["frame_file"])) if texts["frame_file"] else None
        engine = PlacedEngine(Path(texts["map"]), self._frames, encoders=self._encoders, **config.of_engine())
        self.config = self._transport.config = config
        self._core.localising.photos = Path(texts["photos"]) if texts["photos"] else None
        self._gate.hold(engine)
        held = engine.current
        unit = "in metres" if held.metric else "in the unit of its reconstruction, not metres; frame_file can scale it"
        self.get_logger().info(f"{texts['map']}: {len(held.instances)} instances, {unit}, frame {held.frame}")

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Answers, and publishes the map."""
        self._gate.state = "active"
        self._core.start()
        self._send_map()
        return super().on_activate(state)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Refuses new questions; those accepted are answered."""
        self._gate.state = "inactive"
        return super().on_deactivate(state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Frees the map and empties the latched topics."""
        self.release("unconfigured")
        return super().on_cleanup(state)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        self.release("finalized")
        return super().on_shutdown(state)

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """After a defect: back to unconfigured."""
        self.release("unconfigured")
        return TransitionCallbackReturn.SUCCESS

    def release(self, state: str = "finalized") -> None:
        """Frees the map and empties the latched topics."""
        if self._gate.engine is not None:
            frame = self._gate.engine.current.frame
            self._gate.release()
            self._clear(frame)
        self._gate.state = state

    # ---------------------------------------------------------------- messages

    def _send_map(self) -> None:
        """Publishes what is latched, from one map."""
        try:
            gmap = self._gate.current
        except EngineClosed:
            return
        stamp, hits = _now(), gmap.find()
        send = self._transport.publish
        send(messages.INFO, messages.map_info(gmap, Path(self.get_parameter("map").value), stamp))
        send(messages.INSTANCES, messages.instance_array(hits, gmap.map_id, gmap.frame, stamp))
        send(messages.MARKERS, messages.map_markers(hits, gmap.frame, stamp))
        send(messages.WORLD, messages.planning_scene_world(hits, stamp))
        if self._frames is not None:
            send(messages.STATIC_TF, messages.static_transform(self._frames.parent_frame(), gmap.frame, stamp))
        try:
            plan = floor_grid(gmap, CELL)
        except InputError as error:
            self.get_logger().warning(f"{messages.GRID.name} is not published: {error}")
        else:
            send(messages.GRID, messages.occupancy_grid(*plan, CELL, gmap.frame, stamp))

    def _clear(self, frame: str) -> None:
        head, send = answers.header(frame, _now()), self._transport.publish
        send(answers.MAP_CLOUD, {"header": head})
        send(messages.MARKERS, answers.box_markers([], "map", head))
        send(messages.WORLD, {})
        for topic in (messages.INFO, messages.INSTANCES, messages.GRID):
            send(topic, {"header": head})

    def _find(self, request: Any, response: Any) -> Any:
        """The service of perception_msgs/Query."""

        def answered(reply: Reply) -> dict[str, Any]:
            return {"answer": messages.instance_array(reply.hits, reply.map_id, reply.frame, _now())}

        return self._answer(response, lambda: self._gate.submit(self._request(request)), answered)

    def _stand(self, request: Any, response: Any) -> Any:
        """The service of perception_msgs/WhereToStand."""

        def ask() -> Future[Any]:
            names = ("radius", "distance", "within", "sensor_height")
            lengths = {name: value for name in names if (value := float(getattr(request, name))) != 0}
            frame = self._frame(request.frame_id)
            return self._gate.run(lambda gmap: where_to_stand(gmap, request.instance_id, **lengths, frame=frame))

        def answered(stand: RobotPose) -> dict[str, Any]:
            pose = messages.stand_pose(stand, _now())
            return {"pose": pose, "distance": stand.distance, "seen": stand.seen}

        return self._answer(response, ask, answered)

    def _answer(self, response: Any, ask: Callable[[], Future[Any]], answered: Callable[[Any], dict[str, Any]]) -> Any:
        """The response of a service: the fields of what was asked for, or the kind of the error and why."""
        try:
            fields = answered(ask().result(self.config.timeout))
        except (InputError, EngineBusy, EngineClosed, AnswerTimeout, TimeoutError) as error:
            line = " ".join(str(error).split()) or "no answer in time"
            return fill(response, {"error": error_kind(error), "message": line})
        return fill(response, fields)

    def _request(self, query: Any) -> Request:
        request = Request(query.text, query.top_k or TOP, float(query.min_score) or None)
        return replace(request, frame=self._frame(query.frame_id))

    def _frame(self, name: str) -> Frame | None:
        """The frame of this name, None for the map's own; InputError when the node does not know it."""
        own = self._gate.current.frame
        known: dict[str, Frame | None] = {"": None, own: None}
        if self._frames is not None:
            known[self._frames.parent] = self._frames.parent_frame()
        if name not in known:
            raise UnknownFrame(f"frame_id: found '{name}', expected {' or '.join(filter(None, known))}")
        return known[name]


def _descriptor(field: Any) -> ParameterDescriptor:
    """Description and range of a setting as a parameter's."""
    bounds = {name: getattr(one, name) for one in field.metadata for name in ("ge", "gt", "le") if hasattr(one, name)}
    made = ParameterDescriptor(description=field.description)
    low, high = bounds.get("ge", bounds.get("gt")), bounds.get("le", 2**31 - 1)
    if field.annotation is int:
        made.integer_range = [IntegerRange(from_value=low, to_value=high)]
    else:
        made.floating_point_range = [FloatingPointRange(from_value=float(low), to_value=float(high))]
    return made


def _now() -> tuple[int, int]:
    return divmod(time.time_ns(), 1_000_000_000)


def main(args: list[str] | None = None, encoders: Any = None) -> int:
    """Runs the node until SIGINT or SIGTERM; returns 2 when it starts itself and its map cannot be used."""
    rclpy.init(args=args, signal_handler_options=SignalHandlerOptions.NO)
    with stop_on_signals() as stop:
        return _run(MapNode(encoders), stop)


def _run(node: MapNode, stop: threading.Event) -> int:
    code = 0
    try:
        if node.get_parameter("autostart").value:
            done = TransitionCallbackReturn.SUCCESS
            if node.trigger_configure() != done or node.trigger_activate() != done:
                code = BAD_INPUT
                stop.set()
        spin(node, node.config, stop)
    finally:
        node.release()
        node.destroy_node()
        rclpy.shutdown()
    return code


if __name__ == "__main__":
    sys.exit(main())
