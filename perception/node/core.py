"""What the node does, whatever carries its messages: prompts to the engine, replies to topics and services.

An answer on topics is four messages with one stamp that no other answer has; the JSON among them names the prompt's
id and text. An answer of the service goes to its caller alone. So no answer can be taken for another's.
"""

from __future__ import annotations

import json
import threading
import time
from collections import Counter
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any, Protocol

from perception.errors import InputError
from perception.node import answers, channels
from perception.node.config import NodeConfig
from perception.node.questions import Question, error_json, identity_of, read_questions
from perception.query import EngineBusy, EngineClosed, QueryEngine, QueryMap, Reply

Message = dict[str, Any]
_MOST_NAMES = 32


class Transport(Protocol):
    """What the core needs of DDS or rclpy. `publish` is called from any thread and does not raise for a slow or
    absent reader; `warnings` (what is wrong now) and `figures` (counts) are told in the health message."""

    def publish(self, topic: channels.Topic, message: Message) -> None: ...

    def warnings(self) -> list[str]: ...

    def figures(self) -> dict[str, Any]: ...


class Core:
    """One map's engine behind a transport. Thread-safe."""

    def __init__(self, engine: QueryEngine, transport: Transport, config: NodeConfig) -> None:
        self._engine, self._transport, self._config = engine, transport, config
        self._stamps = _Stamps()
        self._refused: Counter[str] = Counter()
        self._sending_map = threading.Lock()
        engine.on_reload(lambda _: self._submit(self._send_map))

    def start(self) -> None:
        """Sends the cloud of the map."""
        self._submit(self._send_map)

    # ------------------------------------------------------------------ topics

    def prompt(self, data: str) -> None:
        """A prompt arrived on the topic. Returns at once; the answer follows from a thread of the engine's."""
        try:
            questions = read_questions(data)
        except InputError as error:
            self._send_error(error, data, identity_of(data))
            return
        for question in questions:
            try:
                future = self._engine.submit(question.request)
            except (EngineBusy, EngineClosed) as error:
                self._send_error(error, question.request.text, question.identity)
            else:
                future.add_done_callback(lambda done, asked=question: self._answer(asked, done))  # type: ignore[misc]

    def _answer(self, question: Question, done: Future[Reply]) -> None:
        error = done.exception()
        if error is not None:
            self._send_error(error, question.request.text, question.identity)
            return
        reply, stamp, send = done.result(), self._stamps.next(), self._transport.publish
        send(channels.POINTS, answers.hits_cloud(reply, stamp))
        send(channels.BOXES, answers.hits_detections(reply, stamp))
        send(channels.MARKS, answers.hits_markers(reply, question.identity, stamp))
        self._send_json({**answers.answer_json(reply, question.identity), "stamp": answers.stamp_json(stamp)})

    def _send_error(self, error: BaseException, text: str, identity: str | None) -> None:
        told = error_json(error, text, identity)
        self._refused[told["error"]["kind"]] += 1
        self._send_json({**told, "stamp": answers.stamp_json(self._stamps.next())})

    def _send_json(self, value: Message) -> None:
        self._transport.publish(channels.ANSWER, {"data": json.dumps(value, allow_nan=False)})

    # ---------------------------------------------------------------- services

    def query(self, names: list[str], done: Callable[[Message], None]) -> None:
        """The query service: `done` gets the response, now or later from a thread of the engine's.

        names: prompts as on the topic. values: one a name, in order, all from the same map: the JSON of the answer
        or of the error; for {"want": "points"} the points.
        """
        try:
            future = self._engine.run(lambda gmap: [self._value(gmap, name) for name in names[:_MOST_NAMES]])
        except (EngineBusy, EngineClosed) as error:
            done({"values": [self._error_value(error, name) for name in names]})
            return

        def finish(ended: Future[list[Message]]) -> None:
            error = ended.exception()
            values = [self._error_value(error, name) for name in names] if error else ended.result()
            many = InputError(f"query: {len(names)} names, expected at most {_MOST_NAMES} in one request")
            done({"values": values + [self._error_value(many, name) for name in names[len(values) :]]})

        future.add_done_callback(finish)

    def _value(self, gmap: QueryMap, name: str) -> Message:
        try:
            questions = read_questions(name)
            if len(questions) != 1:
                raise InputError("query: one text for a name; give further texts as further names")
            asked, began = questions[0], time.monotonic()
            item = asked.request
            hits = gmap.query(item.text, item.top_k, item.min_score, where=item.where, frame=item.frame)
            frame = item.frame.name if item.frame else gmap.frame
            reply = Reply(item, tuple(hits), gmap.map_id, frame, gmap.metric, time.monotonic() - began)
        except InputError as error:
            return self._error_value(error, name)
        if asked.points:
            return answers.points_value(reply)
        return answers.text_value(json.dumps(answers.answer_json(reply, asked.identity), allow_nan=False))

    def _error_value(self, error: BaseException, name: str) -> Message:
        told = error_json(error, name, identity_of(name))
        self._refused[told["error"]["kind"]] += 1
        return answers.text_value(json.dumps(told))

    def reload(self) -> Message:
        """The reload service (std_srvs/Trigger): takes the map that lies at the path now; the old one stays if bad."""
        try:
            changed = self._engine.reload()
        except InputError as error:
            return {"success": False, "message": " ".join(str(error).split())}
        identity = self._engine.current.map_id
        return {"success": True, "message": f"map {identity}" + ("" if changed else ", which was serving already")}

    # ------------------------------------------------------------ unasked for

    def send_health(self) -> None:
        """The health message: the engine's figures, what was refused here, what the transport warns of."""
        refused = {f"refused_{kind}": count for kind, count in self._refused.items()}
        facts = {**self._engine.health(), **refused, **self._transport.figures()}
        told = answers.diagnostics(self._config.namespace, facts, self._transport.warnings(), self._stamps.next())
        self._transport.publish(channels.HEALTH, told)

    def _send_map(self, gmap: QueryMap) -> None:
        if not self._config.map_points:
            return
        with self._sending_map:
            if gmap is self._engine.current:  # else a newer one is on its way
                cloud = answers.map_cloud(gmap, self._config.map_points, self._stamps.next())
                self._transport.publish(channels.MAP_CLOUD, cloud)

    def _submit(self, work: Callable[[QueryMap], None]) -> None:
        """Work on the map by the engine's threads; when they are all taken and the queue is full, here and now."""
        try:
            self._engine.run(work)
        except EngineBusy:
            work(self._engine.current)
        except EngineClosed:
            pass


class _Stamps:
    """Times of answers, (seconds, nanoseconds) of the system's clock, each later than the one before."""

    def __init__(self) -> None:
        self._last, self._lock = 0, threading.Lock()

    def next(self) -> tuple[int, int]:
        with self._lock:
            self._last = max(time.time_ns(), self._last + 1)
            return divmod(self._last, 1_000_000_000)
