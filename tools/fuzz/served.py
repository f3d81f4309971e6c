"""What reaches the servers from outside: HTTP requests, the folder of a map that is served, the viewer's messages."""

from __future__ import annotations

import asyncio
import json
import struct
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import numpy as np

from fuzz.core import Dice
from fuzz.targets import Target, in_memory, map_store
from perception.errors import InputError

_NASTY = (
    1e308, -1e308, 1e200, 5e-324, -0.0, 10**400, 2**63, -1, 0, 1e39, None, True,
    "\ud800", "", "mug", "\x00", "a" * 1001, [], {}, [[]], [0, 0, 0], [1e308] * 3, [1e-200] * 3,
    np.eye(4).tolist(), (1e200 * np.eye(3)).tolist(), [[0, 0]] * 70,
)  # fmt: skip
"""Values that replace those of a sound request."""


def spoiled(dice: Dice, value: Any) -> Any:
    """A JSON value with one of its parts replaced, left out or said twice."""
    if not isinstance(value, (list, dict)) or not value or dice.below(6) == 0:
        return dice.pick(_NASTY)
    changed: Any = value.copy()
    key = dice.pick(list(value) if isinstance(value, dict) else range(len(value)))
    if dice.below(8) == 0:
        del changed[key]
    elif isinstance(changed, list) and dice.below(8) == 0:
        changed.insert(key, changed[key])
    else:
        changed[key] = spoiled(dice, value[key])
    return changed


class HttpTarget:
    """One request: a line METHOD PATH, header lines, an empty line, the body. It must be answered, below 500.

    Input that does not begin with a letter is decisions instead: a sound request of which a few values are spoiled.
    """

    decides = True
    memory = 1024
    words = (
        "GET /", "POST /", "query", "instances/", "/points", "?map_id=", "?format=ply", "\n\n", "host: ",
        "content-type: application/json", '"text":', '"where":', '"near":', '"region":', '"frame":',
        '"from_map":', '"\\ud800"', "1e308", "1e-308", "NaN", "[[", "]]", "null", "true", "%00", "%ff", "\\u0000",
    )  # fmt: skip

    def __init__(self) -> None:
        from perception.serve.app import build_app
        from perception.serve.engine import QueryEngine
        from perception.serve.requests import ServeSettings
        from support.query_maps import encoders, write_map_of

        self._folder = TemporaryDirectory(prefix="fuzz-")
        path = write_map_of(Path(self._folder.name, "a.gsmap"), gaussians=100)
        engine = QueryEngine(path, watch=None, encoders=encoders, timeout=60)
        self._app = build_app(engine, ServeSettings())
        self._loop = asyncio.new_event_loop()
        self._asked = [seed.partition(b"\n\n") for seed in self.seeds() if seed.startswith(b"POST")]

    def seeds(self) -> list[bytes]:
        """Requests that are answered with 200."""
        frame = {"name": "b", "from_map": np.eye(4).tolist()}
        boxes = [
            {"min": [0, 0, 0], "max": [1, 1, 1]},
            {"center": [0, 0, 0], "extent": [1, 1, 1], "rotation": np.eye(3).tolist()},
        ]
        wheres = [{"region": box, "share": 0.5, "near": [0, 0, 0], "within": 3, "labels": ["mug"]} for box in boxes]
        bodies: list[tuple[str, Any]] = [
            ("query", {"text": ["mug", "lamp"], "top_k": 2, "min_score": 0.1, "where": wheres[0], "frame": frame}),
            ("find", {"where": wheres[1]}),
            ("find", {"where": wheres[0], "frame": frame}),
            ("nearest", {"near": np.eye(4).tolist(), "top_k": 3}),
            ("at", {"point": [0, 0, 0], "max_distance": 5, "frame": frame}),
        ]
        head = "host: localhost\ncontent-type: application/json"
        asked = [f"POST /{route}\n{head}\n\n{json.dumps(body)}".encode() for route, body in bodies]
        paths = ("health", "instances", "instances/1", "instances/1/points?format=ply", "openapi.json")
        return asked + [f"GET /{path}\nhost: localhost\n\n".encode() for path in paths]

    def _decided(self, data: bytes) -> bytes:
        dice = Dice(data)
        head, _, body = dice.pick(self._asked)
        value = json.loads(body)
        for _ in range(1 + dice.below(3)):
            value = spoiled(dice, value)
        return head + b"\n\n" + json.dumps(value).encode()

    def run(self, data: bytes) -> bool:
        """True for 200."""
        if not data[:1].isalpha():
            data = self._decided(data)
        head, _, body = data.partition(b"\n\n")
        line, *headers = head.split(b"\n")
        method, _, target = line.partition(b" ")
        path, _, query = target.partition(b"?")
        scope = {
            "type": "http", "http_version": "1.1", "method": method.decode("latin-1").upper(), "scheme": "http",
            "path": path.decode("utf-8", "replace"), "raw_path": path, "query_string": query, "root_path": "",
            "headers": [(n.strip().lower(), v.strip()) for n, _, v in (one.partition(b":") for one in headers)]
            or [(b"host", b"localhost")],
            "client": ("127.0.0.1", 1), "server": ("127.0.0.1", 2),
        }  # fmt: skip
        sent: list[dict[str, Any]] = []

        async def receive() -> dict[str, Any]:
            return {"type": "http.request", "body": body, "more_body": False}

        async def send(message: dict[str, Any]) -> None:
            sent.append(message)

        self._loop.run_until_complete(self._app(scope, receive, send))
        status, told = sent[0]["status"], b"".join(message.get("body", b"") for message in sent[1:])
        if status >= 500:
            raise AssertionError(f"{status}: {told[:200]!r}")
        if (b"content-type", b"application/json") in sent[0]["headers"]:
            json.loads(told, parse_constant=_no_number)
        return bool(status == 200)


class PromptTarget:
    """A prompt, asked on every way there is (`support.query_paths`) and over HTTP: answered, or refused in one line."""

    decides = False
    memory = 1024
    words = (
        " on ", " in ", " next to ", " left of ", " that says ", " with the words ", " labelled ", " reads ", " and ",
        "a", "mug", "red ", "tomato ", "grandma's drum", '"', "\xe9", ",", " ", "\t", "{", '{"text":',
        '"want":"points"',
    )  # fmt: skip

    def __init__(self) -> None:
        from support.query_paths import query_paths

        self._folder = TemporaryDirectory(prefix="fuzz-")
        self._http, self._paths = HttpTarget(), query_paths(Path(self._folder.name))

    def seeds(self) -> list[bytes]:
        """Prompts of every kind, and some that are long."""
        prompts = [
            "red mug",
            "the mug on the lamp next to the drum",
            'the book that says "OAT MILK"',
            "tea with the words A B",
        ]
        long = ["a" * 333 + "," * 667, "a on " * 199, '"' + "a" * 990, "x says " * 140, "mug " * 240]
        return [prompt.encode() for prompt in (*prompts, *long, "Mug İn the box cloſe to 책")]

    def run(self, data: bytes) -> bool:
        """True when it was answered."""
        text, refused = data.decode("utf-8", "replace")[:1100], 0
        for ask in self._paths.values():
            try:
                ask(text)
            except InputError as error:
                refused += 1
                if "\n" in str(error):
                    raise AssertionError(f"the message has more than one line: {error}") from error
        body = json.dumps({"text": text})
        head = "POST /query\nhost: localhost\ncontent-type: application/json\n\n"
        return self._http.run((head + body).encode()) and not refused


def _no_number(name: str) -> Any:
    raise AssertionError(f"{name} in an answer")


def served_map() -> Target:
    """The map folders of the target `map`, opened for questions: what is answered is JSON of finite numbers."""
    from perception.query import load_map
    from perception.query.crops import PhotoOutside, best_crop
    from perception.serve.app import encode

    target = map_store()

    def read(folder: Path, name: str) -> None:
        path = (folder / name).parent
        gmap = load_map(path, encoders=lambda spec: None)
        for hit in gmap.find():
            json.dumps([hit.to_json(), gmap.describe(hit.instance_id).to_json()], allow_nan=False)
            encode(gmap, hit.instance_id, "npz")
            with suppress(PhotoOutside):
                assert best_crop(gmap, hit.instance_id, 32, path) is None, "a photo was read, and there is none"

    target.read = read
    return target


class Control:
    """Stands for any of viser's handles: a value, callbacks, a place for other controls."""

    def __init__(self, value: Any = "", options: Any = ()) -> None:
        self.value, self.options, self.callbacks = value, options, []

    def _listen(self, callback: Any) -> None:
        self.callbacks.append(callback)

    on_click = on_submit = on_update = _listen

    def remove(self) -> None:
        self.callbacks = []

    def submit(self) -> None:
        for callback in list(self.callbacks):
            callback(SimpleNamespace(client=self))

    def add_notification(self, *_: Any, **__: Any) -> None: ...

    def __enter__(self) -> Control:
        return self

    def __exit__(self, *_: object) -> None: ...


class Gui:
    """viser's `gui`: remembers the controls that are made."""

    def __init__(self) -> None:
        self.controls: list[Control] = []

    def configure_theme(self, **_: Any) -> None: ...

    def __getattr__(self, name: str) -> Any:
        def add(label: Any = None, *arguments: Any, **_: Any) -> Control:
            first = arguments[0] if arguments else ""
            options = first if isinstance(first, tuple) else ()
            control = Control(options[0] if options else first, options)
            if name != "add_image":
                self.controls.append(control)
            return control

        return add


class ViewerTarget:
    """Decisions: controls are set and pressed, rays clicked, handshakes tried. InputError alone is a refusal, told in
    the page; nothing gets past the guard without the token."""

    decides = True
    memory = 1024
    words: tuple[str, ...] = ()
    _TEXTS = ("", " ", "pear", "<img src=x>", "\x00", "\ud800", "a" * 2000, "é\n*", "&#60;", "[x](y)")

    def __init__(self) -> None:
        from perception.map.files import map_signature
        from perception.map.write import read_map
        from perception.serve.listening import Guard

        self._folder = TemporaryDirectory(prefix="fuzz-", dir=in_memory())
        self._path = Path(self._folder.name, "m.gsmap")
        self._guard = Guard("127.0.0.1", "the token of this viewer")
        self._renew()
        opened = read_map(self._path)  # reading it for every input would be most of the time

        def read(path: Path) -> Any:
            return opened if map_signature(path) == self._signature else read_map(path)

        self._read = read

    def _renew(self) -> None:
        """The map as it was before an input saved another."""
        from perception.map.files import map_signature
        from perception.map.write import write_map
        from support.viewer_maps import small_map

        write_map(self._path, small_map(60))
        self._signature = map_signature(self._path)

    def seeds(self) -> list[bytes]:
        """Every kind of message once."""
        return [bytes([1, kind, 0, 0, 0, 0, 0, 0]) for kind in range(3)]

    def run(self, data: bytes) -> bool:
        """True when nothing was refused."""
        from perception.map.files import map_signature

        with patch("perception.edit.editor.read_map", self._read):
            taken = self._run(data)
        if map_signature(self._path) != self._signature:
            self._renew()
        return taken

    def _run(self, data: bytes) -> bool:
        from perception.viewer.panel import Panel
        from perception.viewer.session import Session

        dice, refused = Dice(data), []
        session, gui = Session(self._path), Gui()

        def guarded(action: Any, client: Any = None, edited: bool = False) -> None:
            try:
                action()
            except InputError as error:
                refused.append(error)
            else:
                if edited:
                    session.edited()
            panel.refresh()

        def redraw() -> None:
            assert session.colors().shape == (60, 3) and session.opacities().shape == (60,)

        server = SimpleNamespace(gui=gui, get_clients=dict)
        page = SimpleNamespace(
            session=session, server=server, guarded=guarded, redraw=redraw, show_boxes=lambda _: None, detail=""
        )
        panel = Panel(page)
        for _ in range(dice.below(8)):
            kind = dice.below(3)
            if kind == 0:
                control = dice.pick(gui.controls)
                if isinstance(control.value, str):
                    control.value = dice.pick(control.options or self._TEXTS)
                elif isinstance(control.value, bool):
                    control.value = bool(dice.below(2))
                control.submit()
            elif kind == 1:
                numbers = struct.unpack("<6f", bytes(dice.below(256) for _ in range(24)))
                ray = np.array(numbers).reshape(2, 3)
                guarded(lambda ray=ray: session.pick(ray[0], ray[1], bool(dice.below(2))))
            else:
                self._handshake(dice)
            redraw()
        return not refused

    def _handshake(self, dice: Dice) -> None:
        from websockets.datastructures import Headers
        from websockets.http11 import Request

        from perception.viewer.handshake import refusal

        values = (
            "localhost:8090",
            "http://localhost:8090",
            "[::1]:1",
            "evil",
            "perception_8090=x",
            "",
            "\xff=\xfe",
            "]",
        )
        headers = Headers()
        for _ in range(dice.below(4)):
            headers[dice.pick(("Host", "Origin", "Cookie", "Upgrade"))] = dice.pick(values)
        path = dice.pick(("/", "/?token=x", "/?websocket=ws://evil", "/%ff?%ff", "//[", "?token=%ed%a0%80"))
        assert refusal(self._guard, Request(path, headers)) is not None
