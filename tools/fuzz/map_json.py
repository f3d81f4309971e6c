"""The JSON files of a map and of a store, edited at random places, read by every command that opens a map."""

from __future__ import annotations

import contextlib
import io
import json
import os
import shutil
import sys
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from unittest.mock import patch

import numpy as np

from fuzz.core import Dice
from fuzz.targets import in_memory
from perception.errors import InputError
from support.color_encoder import ColorEncoder
from support.paths import MAPS

_ODD = (
    None, True, False, 0, -1, 1, 2, 3, 1.5, -0.0, 2**31, 2**31 - 1, 2**63, -(10**400), 1e15, 1e308, 5e-324, "", "a",
    "1", "\x00", "\x1b[31m\n", "\ud800", "é\u2028", "../a", "a" * 5000, [], [[]], [0], [0] * 3, [1e300] * 3, [0] * 5000,
    {}, {"": {}}, {"a\n": None}, float("nan"), float("inf"), "@1e999", "@deep", "@digits", np.eye(3).tolist(),
    np.zeros((4, 4)).tolist(), [["a"]], "auto", "none", "clip:", "nothing:such",
)  # fmt: skip
"""What takes the place of a value; those with @ are written as JSON that Python cannot hold."""
_RAW = {"@1e999": "1e999", "@deep": "[" * 3000 + "]" * 3000, "@digits": "9" * 5000}
_PROMPTS = ("lime", "grandma's cup", '"MUG"', "lime next to the strawberry", "ocean above the lime", "a big thing")


def edited(dice: Dice, value: Any) -> Any:
    """`value` with one part replaced, left out, said twice, moved into another, or under another key."""
    if not isinstance(value, (list, dict)) or not value or dice.below(8) == 0:
        return dice.pick(_ODD)
    changed: Any = value.copy()
    key = dice.pick(list(value)[:256] if isinstance(value, dict) else range(min(len(value), 256)))
    kind = dice.below(16)
    if kind == 0:
        del changed[key]
    elif kind == 1:
        changed[key] = [value[key]] * (1 + dice.below(3))
    elif kind == 2 and isinstance(value, list):
        changed[key:key] = [value[key]] * (1 + 40 * dice.below(2))
    elif kind == 2:
        changed[dice.pick(("", "x", "\ud800\n", *value))] = dice.pick(_ODD)
    else:
        changed[key] = edited(dice, value[key])
    return changed


def as_text(value: Any) -> str:
    """JSON, with what is named by @ in its place."""
    text = json.dumps(value)
    for name, raw in _RAW.items():
        text = text.replace(f'"{name}"', raw)
    return text


def write_full_map(path: Path, photos: Path) -> None:
    """The newest released map, with every section that map.json may have, texts and groups."""
    from perception.language.description import InstanceDescription, from_arrays, to_arrays
    from perception.map.map import prefixed
    from perception.map.write import read_map, write_map
    from perception.photos.view_json import stored_view

    gmap = read_map(MAPS / "v2.gsmap")
    gmap.instances[0]["texts"] = [{"text": "MUG", "score": 0.9}]
    row = np.ones(3, np.float32) / np.sqrt(3)
    described = InstanceDescription(row, row[None], np.zeros((24, 4), np.float32), ["0.png"], [(0, 0, 9, 9)])
    groups = {"of": np.array([0, 0, -1], np.int32), "scores": np.array([0.8], np.float32)}
    gmap.groups = {**groups, **prefixed(to_arrays([described], "color-test"))}
    gmap.views = [stored_view(with_photo(view, photos), path, view.held_out) for view in gmap.views]
    report = {"left_out": [{"name": "9.png", "why": "blurred"}], "warnings": ["few points"], "input": "photos"}
    depth = {"unit": "m", "median": 0.01, "tolerance": 0.05, "close": 0.9}
    gmap.info |= {
        "scene": report, "masks": {"warnings": []}, "instances": {"texts": "reader"}, "seconds": {"total": 9.0, "a": 1},
        "training": {"iterations": 10, "seconds": 5.0, "pairs": 1000, "profile": {"a": 1.0}, "decisions": ["grown"]},
        "peak_memory_mib": 100, "depth": {"views": 3, "measured": 0.5}, "map_from_input": np.eye(4).tolist(),
        "scale": {"metres_per_unit": 1.0, "standard_error": 0.01, "source": "a board"},
        "gravity": {"direction": [0.0, 1.0, 0.0], "standard_error_deg": 1.0, "source": "walls"},
        "quality": {**gmap.info["quality"], "depth": depth},
    }  # fmt: skip
    spot = {key: gmap.instances[2][key] for key in ("centroid", "obb")}
    gone = {"state": "removed", "confidence": 0.9, "first_seen": 0, "last_seen": 0, "last_looked_for": 2}
    gone["past"] = [{"until": 0, "transform": np.eye(4).tolist(), **spot}, {"until": 1, "transform": None, **spot}]
    for entry in gmap.instances[:2]:
        entry |= {"state": "unchanged", "confidence": 1.0, "first_seen": 1, "last_seen": 2, "past": [gone["past"][0]]}
    gmap.instances.append({**gmap.instances[2], **gone, "id": 40, "num_gaussians": 0})
    gmap.language = to_arrays([*from_arrays(gmap.language)[0], described], "color-test")
    gmap.groups["of"] = np.append(gmap.groups["of"], np.int32(-1))
    means, ids = np.zeros((3, 3), np.float32), np.array([40, 40, gmap.instances[0]["id"]], np.int32)
    gmap.past = {"means": means, "ids": ids, "until": np.array([0, 1, 0], np.int32)}
    visit = {"time": "2026-11-25T19:41:58Z", "input": "photos", "photos": 3}
    gmap.info["visits"] = [visit, {**visit, "time": None}, visit]
    write_map(path, gmap)


def with_photo(view: Any, photos: Path) -> Any:
    """The view with its photo in `photos`, and nothing recorded of it."""
    from dataclasses import fields

    from perception.types import View

    return View(**{f.name: getattr(view, f.name) for f in fields(View)} | {"photo": photos / view.name})


# ------------------------------------------------------------------ what opens a map


def _command(*words: str) -> Callable[[Path], None]:
    """One command line; m: the map, s: the store, new/: where new files go."""

    def run(folder: Path) -> None:
        from perception.cli import main

        names = {"m": "a.gsmap", "s": "all.store", "p": "photos", "c": "cloud.ply"}
        told, failed = io.StringIO(), io.StringIO()
        placed = {word: folder / names.get(word, word) for word in words if word in names or word.startswith("new/")}
        line = [str(placed.get(word, word)) for word in words]
        with contextlib.redirect_stdout(told), contextlib.redirect_stderr(failed):
            code = main([*line, "--json"])
        if code == 2:
            raise InputError(failed.getvalue().removeprefix("error: ").rstrip("\n"))
        assert code == 0, (code, failed.getvalue())
        json.loads(told.getvalue(), parse_constant=_no_number)
        with contextlib.redirect_stdout(io.TextIOWrapper(io.BytesIO(), "utf-8")), contextlib.redirect_stderr(failed):
            if words[0] in ("info", "query", "changes"):
                main(line)

    run.__name__ = " ".join(words)
    return run


def _no_number(name: str) -> Any:
    raise AssertionError(f"{name} in an answer")


def _served(folder: Path) -> None:
    """What `serve`, `mcp` and `node` answer about every instance."""
    from perception.node import answers
    from perception.serve.app import build_app, encode
    from perception.serve.engine import QueryEngine
    from perception.serve.mcp import TOOLS, make_server, parse
    from perception.serve.requests import ServeSettings

    with QueryEngine(folder / "a.gsmap", watch=None, workers=1) as engine:
        build_app(engine, ServeSettings())
        make_server(engine, None)
        gmap, refused = engine.current, []
        json.dumps(engine.health(), allow_nan=False)
        ids = [int(entry["id"]) for entry in gmap.instances]
        asked: list[tuple[str, dict[str, Any]]] = [("find", {"text": text}) for text in _PROMPTS]
        asked += [
            ("what_changed", {}),
            ("find", {"text": "lime", "at": 0}),
            ("list_objects", {}),
            ("nearest", {"point": [0, 0, 0], "top_k": 3}),
        ]
        for i in ids[:4]:
            asked += [("describe", {"id": i}), ("measure", {"a": ids[0], "b": i}), ("where_to_stand", {"id": i})]
            encode(gmap, i, "npz"), encode(gmap, i, "ply")
        for name, arguments in asked:
            try:
                told, _ = parse(TOOLS[name], arguments).answered(gmap, None)
                json.dumps(told, allow_nan=False)
            except InputError as error:
                refused.append(error)
        answers.map_cloud(gmap, 1000, (0, 0))
        for text in _PROMPTS[:3]:
            with contextlib.suppress(InputError):
                reply = engine.ask(text)
                answers.hits_cloud(reply, (0, 0)), answers.hits_detections(reply, (0, 0))
                json.dumps(answers.answer_json(reply, None), allow_nan=False)


def _viewed(folder: Path) -> None:
    """What `view` does with a map: asks, picks, corrects, saves."""
    from perception.map.write import read_map
    from perception.viewer.session import Session

    path = folder / "a.gsmap"
    session = Session(path)
    editor = session.editor
    for text in _PROMPTS:
        with contextlib.suppress(InputError):
            session.ask(text)
    session.mode = "changes"
    session.ghosts(), session.colors(), session.opacities(), session.pick(np.zeros(3), np.array([0.0, 0, 1]))
    ids = [entry["id"] for entry in editor.instances]
    steps: list[Callable[[], object]] = [partial(session.crop, i) for i in ids[:3]]
    steps += [partial(editor.split, i) for i in ids[1:2]] + [partial(editor.merge, ids[:1] + ids[2:3])]
    steps += [partial(editor.rename, i, "thing") for i in ids[:1]] + [partial(editor.hide, i) for i in ids[:1]]
    steps += [partial(editor.remove, i) for i in ids[-1:]]
    for step in steps:
        with contextlib.suppress(InputError):
            step()
    editor.save()
    read_map(path)


COMMANDS: tuple[Callable[[Path], None], ...] = (
    _command("info", "m"), _command("info", "m", "--verify"), _command("query", "m", *_PROMPTS),
    _command("query", "m", "lime", "--min-score", "0", "--points", "new/p.ply"), _command("query", "s", *_PROMPTS),
    _command("query", "m", *_PROMPTS, "--at", "0"), _command("changes", "m"), _command("changes", "m", "--since", "0"),
    _command("query", "s", "lime", "--min-score", "0"), _command("index", "m", "-o", "new/new.store"),
    _command("index", "m", "-o", "s"), _command("export", "m", "-o", "new/a.ply"),
    _command("export", "m", "--points", "c", "-o", "new/a.npz"), _command("export", "m", "-o", "new/a.spz"),
    _command("export", "m", "-o", "new/a.sog"), _command("export", "m", "-o", "new/a.ply", "--granularity", "parts"),
    _command("export", "m", "-o", "new/a.ply", "--granularity", "groups"),
    _command("export", "m", "--graph", "new/g.json"),
    _command("export", "m", "--mesh", "new/m.ply", "--voxel-size", "0.1"),
    _command("export", "m", "--mesh", "new/m.ply", "--instance", "1", "--voxel-size", "0.05"),
    _command("export", "m", "--voxels", "new/v.npz", "--voxel-size", "0.1"),
    _command("render", "m", "-o", "new/r", "--what", "rgb,depth,instances,features"), _command("label", "m"),
    _command("label", "m", "1", "tall cup"), _command("label", "m", "1", "--clear"), _command("relink", "m", "p"),
    _command("upgrade", "m"), _command("upgrade", "m", "-o", "new/b.gsmap"),
    _command("report", "m", "-o", "new/r.html"),
    _command("report", "m", "-o", "new/r.html", "--ask", "lime"),
    _command("scale", "m", "--known-length", "0.3: 0, grandma's cup"),
    _command("scale", "m", "-o", "new/b.gsmap", "--known-length", "0.3: 0,0,0 0,0,1"), _served, _viewed,
)  # fmt: skip


class MapJson:
    """Decisions: a file, one to three edits, whether its checksums are made good, and a command, which must succeed
    or refuse in one line that names a file of the map."""

    decides = True
    memory = 2048
    words: tuple[str, ...] = ()

    def __init__(self) -> None:
        from perception.cli import main
        from perception.io.cloud import write_cloud
        from perception.types import PointCloud

        self._folder = TemporaryDirectory(prefix="fuzz-", dir=in_memory())
        self._good = Path(self._folder.name, "good")
        shutil.copytree(MAPS / "photos", self._good / "photos")
        write_full_map(self._good / "a.gsmap", self._good / "photos")
        rng = np.random.default_rng(0)
        write_cloud(self._good / "cloud.ply", PointCloud(rng.normal([0, 0, 3], 0.3, (50, 3))))
        with self._patched(), contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
            assert main(["index", str(self._good / "a.gsmap"), "-o", str(self._good / "all.store")]) == 0
        self._usual = {command for command in range(len(COMMANDS)) if self._run(command, lambda path: None)}

    def seeds(self) -> list[bytes]:
        """Every command on the files as they are, where it succeeds."""
        return [bytes([0, n]) for n in sorted(self._usual)]

    def run(self, data: bytes) -> bool:
        """True when the command succeeded."""
        dice = Dice(data)
        name = dice.pick(("", "map.json", "map.json", "instances.json", "store.json"))
        command = dice.below(len(COMMANDS))
        return self._run(command, partial(self._edit, dice, name) if name else lambda path: None)

    def _edit(self, dice: Dice, name: str, folder: Path) -> None:
        from perception.map.checksums import facts_of, seal

        file = folder / ("all.store" if name == "store.json" else "a.gsmap") / name
        value = json.loads(file.read_text())
        for _ in range(1 + dice.below(3)):
            value = edited(dice, value)
        file.write_text(as_text(value))
        if name == "store.json" or dice.below(8) == 0:
            return
        facts = folder / "a.gsmap" / "map.json"
        with contextlib.suppress(ValueError, TypeError, KeyError, AttributeError):
            value = value if name == "map.json" else json.loads(facts.read_text())
            if name == "instances.json":
                value["files"][name] = facts_of(file)
            if "@" not in json.dumps(value):
                facts.write_text(as_text(seal(value)))

    def _run(self, command: int, edit: Callable[[Path], None]) -> bool:
        with TemporaryDirectory(prefix="fuzz-", dir=in_memory()) as place:
            folder = Path(place, "in")
            shutil.copytree(self._good, folder)
            (folder / "new").mkdir()
            edit(folder)
            try:
                with self._patched():
                    COMMANDS[command](folder)
            except InputError as error:
                line = str(error)
                where = getattr(COMMANDS[command], "__name__", "")
                if "\n" in line or len(line) > 2000:
                    raise AssertionError(f"{where}: no short line: {line[:300]!r}") from error
                if command in getattr(self, "_usual", ()) and str(folder) not in line:
                    raise AssertionError(f"{where}: names no file: {line[:300]}") from error
                return False
            except Exception as error:
                error.add_note(f"by: {getattr(COMMANDS[command], '__name__', '')}")
                raise
        return True

    @contextlib.contextmanager
    def _patched(self) -> Iterator[None]:
        """An encoder without weights stands for all that map.json can name, but for names that there are not."""
        from perception.language import encoders
        from perception.progress import QUIET

        def make(spec: str) -> Any:
            return ColorEncoder() if spec in ("conse", "auto") else encoders.make_encoder(spec)

        options = {"encoders": make, "progress": QUIET}
        modules = ("query.map_store", "query.indexing", "serve.engine")
        with contextlib.ExitStack() as stack:
            for module in modules:
                stack.enter_context(patch(f"perception.{module}.make_encoder", make))
            stack.enter_context(patch("perception.edit.upgrade.upgrade_map.__kwdefaults__", options))
            stack.enter_context(patch.dict(os.environ))
            showing = sys.modules["warnings"].showwarning
            stack.callback(setattr, sys.modules["warnings"], "showwarning", showing)
            yield
