"""The node's logic, independent of the transport: prompts to the engine, replies to topics and services.

An answer on the topics is four messages with the same stamp, unique to the answer; the JSON message contains the
prompt's id and text. An answer of the service goes to its caller only. So each answer can be matched to its prompt.
"""

from __future__ import annotations

import json
import threading
import time
from collections import Counter
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass
from typing import Any, Protocol

from perception.errors import InputError
from perception.io.documents import refusing
from perception.node import answers
from perception.node.config import NodeConfig
from perception.node.localise import Localising
from perception.query import QueryMap
from perception.serve.bodies import QueryBody, parse
from perception.serve.engine import QueryEngine
from perception.serve.requests import MAX_BYTES, EngineBusy, EngineClosed, Reply, Request, error_json, error_line

_SHOWN = 80  # characters of a prompt in an error
_LONGEST_ID = 200  # characters


@dataclass(frozen=True)
class Question:
    """One prompt. identity: an id chosen by the client, returned with the answer. points: the service returns points
    instead of the JSON."""

    request: Request
    identity: str | None = None
    points: bool = False


def read_questions(data: str) -> list[Question]:
    """The questions in a prompt: one for a plain text, one per text of a JSON object. InputError when malformed."""
    size = len(data.encode("utf-8", "surrogatepass"))
    if size > MAX_BYTES:
        raise InputError(f"prompt: has {size} bytes, expected at most {MAX_BYTES}")
    if not data.lstrip().startswith("{"):
        return [Question(Request(data))]
    with refusing("prompt: begins like JSON but is none ({why})"):
        value = json.loads(data)
    identity, want = value.pop("id", None), value.pop("want", "hits")
    if identity is not None and not (isinstance(identity, str) and len(identity) <= _LONGEST_ID):
        raise InputError(f"prompt: id is to be a text of at most {_LONGEST_ID} characters")
    if want not in ("hits", "points"):
        raise InputError(f"prompt: want is {str(want)[:_SHOWN]!r}, expected hits or points")
    return [Question(request, identity, want == "points") for request in parse(QueryBody, value).requests()]


def identity_of(data: str) -> str | None:
    """The id of a rejected prompt, when it can be parsed, so that the client can match the error; else None."""
    if len(data) > MAX_BYTES:
        return None
    try:
        identity = json.loads(data).get("id")
    except (ValueError, AttributeError, RecursionError):
        return None
    return identity if isinstance(identity, str) and len(identity) <= _LONGEST_ID else None


Message = dict[str, Any]
_MOST_NAMES = 32


class Transport(Protocol):
    """What the core uses of `ros.RosTransport`. `publish` is called from any thread and does not raise for a slow or
    absent reader. The health message contains `warnings` (present problems) and `figures` (counts)."""

    def publish(self, topic: answers.Channel, message: Message) -> None: ...

    def warnings(self) -> list[str]: ...

    def figures(self) -> dict[str, Any]: ...


class Core:
    """Connects the engine of one map to a transport. Thread-safe."""

    def __init__(self, engine: QueryEngine, transport: Transport, config: NodeConfig) -> None:
        self._engine, self._transport, self._config = engine, transport, config
        self._stamps = _Stamps()
        self._refused: Counter[str] = Counter()
        self._sending_map = threading.Lock()
        self.localising = Localising(engine, transport, config)
        engine.on_reload(lambda _: self._submit(self._send_map))

    def start(self) -> None:
        """Publishes the map's point cloud and its changes."""
        self._submit(self._send_map)

    # ------------------------------------------------------------------ topics

    def prompt(self, data: str) -> None:
        """Handles a prompt from the topic. Returns at once; a thread of the engine publishes the answer."""
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
                future.add_done_callback(lambda done, question=question: self._answer(question, done))  # type: ignore[misc]

    def _answer(self, question: Question, done: Future[Reply]) -> None:
        try:
            reply, stamp = done.result(), self._stamps.next()
            parts = {
                answers.POINTS: answers.hits_cloud(reply, stamp),
                answers.BOXES: answers.hits_detections(reply, stamp),
                answers.MARKS: answers.hits_markers(reply, question.identity, stamp),
            }
            answer = {**answers.answer_json(reply, question.identity), "stamp": answers.stamp_json(stamp)}
        except Exception as error:  # of the engine, or of a box that is none: all four messages are sent, or this
            self._send_error(error, question.request.text, question.identity)
            return
        for topic, message in parts.items():
            self._transport.publish(topic, message)
        self._send_json(answer)

    def _refusal(self, error: BaseException, text: str, identity: str | None) -> Message:
        """The JSON that is sent instead of an answer, which is counted."""
        facts = error_json(error)
        self._refused[facts["kind"]] += 1
        return {"id": identity, "text": text if len(text) <= _SHOWN else text[:_SHOWN] + "…", "error": facts}

    def _send_error(self, error: BaseException, text: str, identity: str | None) -> None:
        self._send_json({**self._refusal(error, text, identity), "stamp": answers.stamp_json(self._stamps.next())})

    def _send_json(self, value: Message, topic: answers.Channel = answers.ANSWER) -> None:
        self._transport.publish(topic, {"data": json.dumps(value, allow_nan=False)})

    # ---------------------------------------------------------------- services

    def query(self, names: list[str], done: Callable[[Message], None]) -> None:
        """The query service: calls `done` with the response, at once or later from a thread of the engine.

        names: prompts as on the topic. values: one per name, in order, all from the same map: the JSON of the answer or
        of the error; for {"want": "points"} the points.
        """
        try:
            future = self._engine.run(lambda gmap: [self._value(gmap, name) for name in names[:_MOST_NAMES]])
        except (EngineBusy, EngineClosed) as error:
            done(self.refusal(error, names))
            return

        def finish(ended: Future[list[Message]]) -> None:
            error = ended.exception()
            if error is not None:
                done(self.refusal(error, names))
                return
            many = InputError(f"query: {len(names)} names, expected at most {_MOST_NAMES} in one request")
            done({"values": [*ended.result(), *self.refusal(many, names[_MOST_NAMES:])["values"]]})

        future.add_done_callback(finish)

    def refusal(self, error: BaseException, names: list[str]) -> Message:
        """The response to a query whose names all have this error."""
        return {"values": [self._error_value(error, name) for name in names]}

    def _value(self, gmap: QueryMap, name: str) -> Message:
        try:
            questions = read_questions(name)
            if len(questions) != 1:
                raise InputError("query: one text for a name; give further texts as further names")
            question = questions[0]
            reply = question.request.answered(gmap)
        except InputError as error:
            return self._error_value(error, name)
        if question.points:
            return answers.points_value(reply)
        return answers.text_value(json.dumps(answers.answer_json(reply, question.identity), allow_nan=False))

    def _error_value(self, error: BaseException, name: str) -> Message:
        return answers.text_value(json.dumps(self._refusal(error, name, identity_of(name))))

    def reload(self) -> Message:
        """The reload service (std_srvs/Trigger): loads the map now at the path; on failure the current one stays."""
        try:
            changed = self._engine.reload()
        except InputError as error:
            return {"success": False, "message": error_line(error)}
        identity = self._engine.current.map_id
        return {"success": True, "message": f"map {identity}" + ("" if changed else ", which was serving already")}

    # ------------------------------------------------------------ health, map

    def send_health(self) -> None:
        """Publishes the health message: figures of the engine, counts of rejected prompts, transport warnings."""
        refused = {f"refused_{kind}": count for kind, count in dict(self._refused).items()}  # which grows meanwhile
        dropped = {"images_dropped": self.localising.dropped} if self.localising.dropped else {}
        facts = {**self._engine.health(), **refused, **dropped, **self._transport.figures()}
        body = answers.diagnostics(self._config.namespace, facts, self._transport.warnings(), self._stamps.next())
        self._transport.publish(answers.HEALTH, body)

    def _send_map(self, gmap: QueryMap) -> None:
        with self._sending_map:
            if gmap is not self._engine.current:  # a newer map is published soon
                return
            if self._config.map_points:
                cloud = answers.map_cloud(gmap, self._config.map_points, self._stamps.next())
                self._transport.publish(answers.MAP_CLOUD, cloud)
            if gmap.visits:
                facts = {**gmap.changes_json(), "map_id": gmap.map_id}
                self._send_json({**facts, "stamp": answers.stamp_json(self._stamps.next())}, answers.CHANGES)

    def _submit(self, work: Callable[[QueryMap], None]) -> None:
        """Runs work on the map in a thread of the engine, or in the calling thread when the request queue is full."""
        try:
            self._engine.run(work)
        except EngineBusy:
            work(self._engine.current)
        except EngineClosed:
            pass


class _Stamps:
    """Unique stamps of answers: (seconds, nanoseconds) of the system clock, strictly increasing."""

    def __init__(self) -> None:
        self._last, self._lock = 0, threading.Lock()

    def next(self) -> tuple[int, int]:
        with self._lock:
            self._last = max(time.time_ns(), self._last + 1)
            return divmod(self._last, 1_000_000_000)
