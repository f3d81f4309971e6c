"""The MCP server as a process, asked by the SDK's own client, which validates every answer against its schema."""

from __future__ import annotations

import asyncio
import base64
import contextlib
import json
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Awaitable, Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

pytest.importorskip("mcp.client", reason="the extra 'mcp' is not installed")
import httpx2
from jsonschema import Draft202012Validator
from mcp import Client, MCPError, StdioServerParameters
from mcp.client.streamable_http import streamable_http_client
from PIL import Image

from perception.cli import main
from perception.map.write import read_map, write_map
from perception.photos.view_json import StoredView
from perception.query import load_map
from perception.serve.engine import QueryEngine
from perception.serve.mcp import TOOLS, make_server
from support.box_rooms import map_of
from support.processes import hears_ctrl_c, server
from support.query_maps import NAMES, encoders, write_map_of
from support.synthetic_map import grid

TOKEN = "0123456789abcdef0123"
HEAD = (
    "import sys; from pathlib import Path; from support.query_maps import encoders; import perception.serve.mcp as m\n"
)
STDIO = HEAD + "from perception import cli\nserve = m.serve_stdio\n"
STDIO += "m.serve_stdio = lambda path, photos: serve(path, encoders, photos)\n"
STDIO += "sys.argv.insert(1, 'mcp')\ncli.run()\n"
BUSY = "import time, perception.serve.localise as p\nfrom concurrent.futures import ThreadPoolExecutor as Pool\n"
BUSY += "p.Localiser = lambda *_, **__: list(Pool(1).map(time.sleep, [600]))\n"
HTTP = HEAD + "from perception.serve.requests import ServeSettings\n"
HTTP += "m.serve_http(Path(sys.argv[1]), ServeSettings(port=0, token=sys.argv[2] or None, timeout=60), encoders)\n"
RED = 4


def write_seen_map(path: Path, photo: Path | None, metric: bool = True, first_id: int = 0) -> Path:
    """Nine balls seen by one camera 5 m below them that looks up; the Gaussians of number RED are red."""
    write_map_of(path, gaussians=900, first_id=first_id)
    gmap = read_map(path)
    pose = np.eye(4)
    pose[:3, 3] = [-1, -1, 5]  # the middle ball lies on the optical axis
    K = np.array([[200.0, 0, 160], [0, 200, 120], [0, 0, 1]])
    missing = path / "missing.png"
    gmap.views = [
        StoredView(f"{k:05}.jpg", photo or missing, K, 320, 240, pose, photo_bytes=None) for k in range(len(NAMES))
    ]
    centres = (grid(len(NAMES)) + pose[:3, 3]) @ K.T
    centres = centres[:, :2] / centres[:, 2:]
    gmap.language["view_boxes"] = np.round(np.concatenate([centres - 12, centres + 12], axis=1)).astype(np.int32)
    own = gmap.instance_ids == first_id + RED
    gmap.sh[own] = 0
    gmap.sh[own, 0] = [1.7, -1.7, -1.7]
    gmap.opacity_logits[own] = 4
    gmap.info["metric"] = metric
    write_map(path, gmap)
    return path


@pytest.fixture(scope="module")
def photo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Blue where RED is seen, else grey."""
    picture = np.full((240, 320, 3), 128, np.uint8)
    picture[108:132, 148:172] = (0, 0, 255)
    file = tmp_path_factory.mktemp("photo") / "p.png"
    Image.fromarray(picture).save(file)
    return file


def stdio(path: Path, *options: str) -> StdioServerParameters:
    import os

    command = ["-c", STDIO, str(path), *options]
    return StdioServerParameters(command=sys.executable, args=command, env=dict(os.environ), cwd=path.parent)


def ended(client: Client, work: Callable[[Client], Awaitable[Any]]) -> Any:
    async def run() -> Any:
        async with client:
            return await asyncio.wait_for(work(client), 60)

    return asyncio.run(run())


async def told(client: Client, name: str, **arguments: Any) -> dict[str, Any]:
    """The structured answer; the text repeats it."""
    result = await client.call_tool(name, arguments)
    assert json.loads(result.content[0].text) == result.structured_content
    assert result.is_error == ("error" in result.structured_content)
    return result.structured_content


async def kind(client: Client, name: str, **arguments: Any) -> tuple[str, str]:
    error = (await told(client, name, **arguments))["error"]
    assert "\n" not in error["message"] and len(error["message"]) < 300
    return error["kind"], error["message"]


def shown(result: Any) -> np.ndarray:
    """The picture of an answer, [h, w, 3] int RGB."""
    ((_, image),) = [(item.mime_type, item) for item in result.content if item.type == "image"]
    assert image.mime_type == "image/jpeg"
    pixels = cv2.imdecode(np.frombuffer(base64.b64decode(image.data), np.uint8), cv2.IMREAD_COLOR)
    return pixels[..., ::-1].astype(int)


def middle(picture: np.ndarray) -> np.ndarray:
    """Mean colour [3] of the middle quarter."""
    h, w = picture.shape[:2]
    return picture[3 * h // 8 : 5 * h // 8, 3 * w // 8 : 5 * w // 8].mean(axis=(0, 1))


# ---------------------------------------------------------------------- stdio


@pytest.mark.slow
def test_every_tool_over_stdio_and_a_map_replaced_under_it(tmp_path: Path, photo: Path) -> None:
    path = write_seen_map(tmp_path / "a.gsmap", photo)
    other = write_seen_map(tmp_path / "b.gsmap", photo, first_id=100)
    gmap = load_map(path, encoders=encoders)

    async def session(client: Client) -> None:
        listed = {tool.name: tool for tool in (await client.list_tools()).tools}
        assert set(listed) == set(TOOLS)
        for tool in listed.values():
            Draft202012Validator.check_schema(tool.input_schema)
            Draft202012Validator.check_schema(tool.output_schema)
            assert {"map_id", "frame", "metric", "unit", "confidence"} <= set(tool.output_schema["required"])
            assert tool.annotations.read_only_hint and tool.description

        common = {"map_id": gmap.map_id, "frame": "map", "metric": True, "unit": "m"}
        found = await told(client, "find", text="teapot", top_k=2, unit="m")
        assert {name: found[name] for name in common} == common
        expected = gmap.query("teapot", 2)
        assert [hit["instance_id"] for hit in found["hits"]] == [hit.instance_id for hit in expected]
        assert found["hits"][0]["instance_id"] == NAMES.index("teapot") and found["confidence"] == expected[0].score

        listing = await told(client, "list_objects")
        assert [hit["instance_id"] for hit in listing["hits"]] == list(range(9)) and listing["confidence"] == 0.9
        corner = {"min": [-0.5, -0.5, -1], "max": [0.5, 2.5, 1]}
        column = await told(client, "list_objects", region=corner)
        assert [hit["instance_id"] for hit in column["hits"]] == [0, 3, 6]

        near = await told(client, "nearest", point=[2, 1, 4], top_k=2)
        assert near["hits"][0]["instance_id"] == 5
        gap = np.linalg.norm(gmap.get(5).points - [2, 1, 4], axis=1).min()
        assert near["hits"][0]["distance"] == pytest.approx(gap, abs=1e-6)

        a, b = gmap.get(0), gmap.get(8)
        gaps = np.linalg.norm(a.points[:, None].astype(float) - b.points[None], axis=2)
        measured = await told(client, "measure", a=0, b=8)
        assert measured["distance"] == pytest.approx(gaps.min(), abs=1e-6) and measured["confidence"] == 0.9
        ends = np.array(measured["nearest_points"])
        assert np.linalg.norm(ends[0] - ends[1]) == pytest.approx(gaps.min(), abs=1e-6)
        assert measured["center_distance"] == pytest.approx(np.sqrt(8), abs=0.05)  # cells (0, 0) and (2, 2)

        result = await client.call_tool("describe", {"id": RED})
        told_of = result.structured_content
        assert {name: told_of[name] for name in common} == common and told_of["picture"] == "photo"
        assert {entry["instance_id"] for entry in told_of["neighbors"]} <= {1, 3, 5, 7}
        assert told_of["neighbors"][0]["gap"] == pytest.approx(gmap.describe(RED).neighbors[0].gap)
        assert np.allclose(told_of["aabb"]["min"], gmap.get(RED).points.min(axis=0))
        assert middle(shown(result)) @ [-1, -1, 2] > 300  # blue

        with pytest.raises(MCPError, match="no tool 'erase'"):
            await client.call_tool("erase", {})
        known = gmap.map_id
        path.rename(tmp_path / "old.gsmap")
        other.rename(path)
        while (await told(client, "list_objects"))["map_id"] == known:
            await asyncio.sleep(0.05)
        assert await kind(client, "describe", id=0, map_id=known) == (
            "other_map",
            f"the map is now {load_map(path).map_id}, not {known}; ask again",
        )
        assert (await kind(client, "describe", id=0))[0] == "unknown_instance"
        assert (await told(client, "describe", id=100))["instance_id"] == 100
        shutil.rmtree(path)
        assert (await told(client, "find", text="teapot"))["hits"][0]["instance_id"] == 103

    ended(Client(stdio(path, "--photos", str(photo.parent))), session)


def spoken(path: Path, first: str = "") -> subprocess.Popen[bytes]:
    process = subprocess.Popen(
        [sys.executable, "-c", first + STDIO, str(path)],
        cwd=path.parent,  # in a checkout, Python would import the sources
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        preexec_fn=hears_ctrl_c,
    )
    hello = {"protocolVersion": "2025-06-18", "capabilities": {}, "clientInfo": {"name": "t", "version": "0"}}
    send(process, {"id": 1, "method": "initialize", "params": hello})
    assert process.stdout is not None and json.loads(process.stdout.readline())["id"] == 1
    send(process, {"method": "notifications/initialized"})
    return process


def send(process: subprocess.Popen[bytes], message: dict[str, Any]) -> None:
    assert process.stdin is not None
    process.stdin.write(json.dumps({"jsonrpc": "2.0", **message}).encode() + b"\n")
    process.stdin.flush()


CALL = {"method": "tools/call", "params": {"name": "list_objects", "arguments": {}}}


@pytest.mark.slow
@pytest.mark.parametrize("how", ["closes", "vanishes", "interrupts"])
def test_the_process_ends_with_its_client(tmp_path: Path, how: str) -> None:
    """A client that ends the session, one that is gone while calls run, and Ctrl-C while nothing is asked."""
    process = spoken(write_map_of(tmp_path / "a.gsmap", gaussians=300))
    assert process.stdin is not None and process.stdout is not None
    try:
        for number in range(2, 2 if how == "interrupts" else 40):
            send(process, {"id": number, **CALL})
        if how == "interrupts":
            process.send_signal(signal.SIGINT)
        else:
            if how == "vanishes":
                process.stdout.close()
            process.stdin.close()
            if how == "closes":
                process.stdout.read()
        code = process.wait(timeout=30)
        errors = process.stderr.read().decode() if process.stderr is not None else ""
        assert code == (130 if how == "interrupts" else 0), errors
        assert "Traceback" not in errors
    finally:
        process.kill()
        with contextlib.suppress(ValueError):
            process.communicate()


@pytest.mark.slow
def test_the_process_does_not_wait_for_photos_that_are_being_read(tmp_path: Path, photo: Path) -> None:
    """By a pool of threads, for ten minutes."""
    process = spoken(write_map_of(tmp_path / "a.gsmap", gaussians=300), BUSY)
    try:
        picture = base64.b64encode(photo.read_bytes()).decode()
        send(
            process,
            {"id": 2, "method": "tools/call", "params": {"name": "localise", "arguments": {"picture": picture}}},
        )
        assert process.stdout is not None and b"photos are being read" in process.stdout.readline()
        process.communicate(timeout=60)  # closes its input
        assert process.returncode == 0
    finally:
        process.kill()


@pytest.mark.slow
def test_what_is_no_message_is_survived(tmp_path: Path) -> None:
    process = spoken(write_map_of(tmp_path / "a.gsmap", gaussians=300))
    assert process.stdin is not None and process.stdout is not None
    try:
        process.stdin.write(b"\xff\xfe not json\n[]\n{}\n" + b"x" * 200_000 + b"\n")
        huge = {"name": "find", "arguments": {"text": "mug " * 100_000}}
        send(process, {"id": 7, "method": "tools/call", "params": huge})
        while (answer := json.loads(process.stdout.readline())).get("id") != 7:
            assert "error" in answer or answer["method"].startswith("notifications/")
        assert answer["result"]["structuredContent"]["error"]["kind"] == "bad_input"
        assert len(json.dumps(answer)) < 1000
    finally:
        process.kill()
        process.communicate()


# ----------------------------------------------------------------------- HTTP


@pytest.fixture(scope="module")
def port(tmp_path_factory: pytest.TempPathFactory) -> Iterator[int]:
    """Of a server whose map has no scale, and whose photos are gone."""
    path = write_seen_map(tmp_path_factory.mktemp("http") / "a.gsmap", None, metric=False)
    with server(["-c", HTTP, str(path), ""], path.parent) as (_, number):
        yield number


def at(port: int) -> str:
    return f"http://127.0.0.1:{port}/mcp"


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["auto", "legacy"])
def test_every_tool_over_http(port: int, mode: str) -> None:
    asked = {"text": "lamp"}, {}, {"id": RED}, {"point": [0, 0, 0]}, {"a": 1, "b": 2}

    async def session(client: Client) -> None:
        for name, arguments in zip(("find", "list_objects", "describe", "nearest", "measure"), asked, strict=True):
            answer = await told(client, name, **arguments)
            assert not answer["metric"] and answer["unit"] == "unit of frame map" and 0 < answer["confidence"] <= 1

    ended(Client(at(port), mode=mode), session)


@pytest.mark.slow
def test_without_its_photos_a_map_is_rendered(port: int) -> None:
    async def session(client: Client) -> Any:
        return await client.call_tool("describe", {"id": RED})

    result = ended(Client(at(port)), session)
    assert result.structured_content["picture"] == "render"
    assert middle(shown(result)) @ [2, -1, -1] > 300  # red


@pytest.mark.slow
def test_errors_say_what_to_do(port: int) -> None:
    def frame(scale: float) -> dict[str, Any]:
        return {"name": "base", "from_map": np.diag([scale, scale, scale, 1]).tolist()}

    async def session(client: Client) -> None:
        cases: list[tuple[str, str, dict[str, Any], str]] = [
            ("no_scale", "find", {"text": "mug", "unit": "m"}, "not known to be metres"),
            ("no_scale", "measure", {"a": 0, "b": 1, "unit": "m", "frame": frame(2)}, "frame 'base'"),
            ("no_scale", "where_to_stand", {"id": 0}, "scale is not known"),
            ("unknown_frame", "nearest", {"point": [0, 0, 0], "frame": "odom"}, "found 'odom', expected 'map'"),
            ("unknown_instance", "describe", {"id": 77}, "instance 77"),
            ("unknown_instance", "measure", {"a": 0, "b": 77}, "instance 77"),
            ("other_map", "find", {"text": "mug", "map_id": "0123"}, "not 0123"),
            ("bad_input", "find", {"text": "m" * 1001}, "at most 1000 characters"),
            ("bad_input", "find", {}, "text: field required"),
            ("bad_input", "find", {"text": "mug", "topk": 3}, "topk: extra inputs"),
            ("bad_input", "nearest", {"point": [0, 0]}, "point"),
            ("bad_input", "describe", {"id": -1}, "id"),
            ("bad_input", "list_objects", {"region": {"min": [1, 1, 1], "max": [0, 0, 0]}}, "low <= high"),
            ("bad_input", "find", {"text": "mug", "frame": {"name": "x", "from_map": [[0] * 4] * 4}}, "frame 'x'"),
        ]
        for expected, name, arguments, words in cases:
            found, line = await kind(client, name, **arguments)
            assert found == expected and words in line, (name, arguments, line)
        doubled = await told(client, "measure", a=0, b=1, frame=frame(2))
        plain = await told(client, "measure", a=0, b=1, frame="map")
        assert doubled["frame"] == "base" and doubled["unit"] == "unit of frame base"
        for name in ("distance", "center_distance"):
            assert doubled[name] == pytest.approx(2 * plain[name], rel=1e-6)

    ended(Client(at(port)), session)


@pytest.mark.slow
def test_clients_that_vanish_leave_the_server_answering(port: int) -> None:
    body = json.dumps({"jsonrpc": "2.0", "id": 1, **CALL}).encode()
    head = "POST /mcp HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Type: application/json\r\nContent-Length: {}\r\n"
    head += "Accept: application/json, text/event-stream\r\nMCP-Protocol-Version: 2025-06-18\r\n\r\n"
    for size, sent in ((len(body), body), (len(body) + 50, body), (len(body), b"")):
        for _ in range(20):
            with socket.create_connection(("127.0.0.1", port)) as line:
                line.sendall(head.format(size).encode() + sent)

    async def session(client: Client) -> None:
        assert (await told(client, "find", text="drum"))["hits"][0]["instance_id"] == NAMES.index("drum")

    began = time.monotonic()
    ended(Client(at(port)), session)
    assert time.monotonic() - began < 30


@pytest.mark.slow
def test_the_rules_for_host_token_and_size_are_those_of_serve(port: int, tmp_path: Path) -> None:
    with httpx2.Client(timeout=60) as web:
        send = {"content": b"{}", "headers": {"Content-Type": "application/json"}}
        refused = web.post(at(port), content=b"{}", headers={**send["headers"], "Host": "evil.example"})
        assert refused.status_code == 403 and "not this machine" in refused.json()["error"]
        assert web.post(at(port), content=b"{}", headers={"Content-Type": "text/plain"}).status_code == 415
        large = web.post(at(port), content=b" " * (9 << 20), headers=send["headers"])
        assert large.status_code == 413 and "8388608" in large.json()["error"]
    path = write_map_of(tmp_path / "a.gsmap", gaussians=300)
    with server(["-c", HTTP, str(path), TOKEN], tmp_path) as (_, own):
        with httpx2.Client(timeout=60) as web:
            assert web.post(at(own), **send).status_code == 401

        async def session(client: Client) -> None:
            assert len((await told(client, "list_objects"))["hits"]) == 9

        for name in (f"127.0.0.1:{own}", "robot.example"):  # the second as behind a proxy
            bearer = httpx2.AsyncClient(headers={"Authorization": f"Bearer {TOKEN}", "Host": name})
            ended(Client(streamable_http_client(at(own), http_client=bearer)), session)


# ------------------------------------------------------------------ in process


def test_where_to_stand_is_before_the_middle_of_a_long_side(tmp_path: Path) -> None:
    """A crate of 1.2 × 0.4 m in the middle of a room: the place is 0.7 m off its side at y = ± 0.2 (± a cell)."""
    boxes = [([-2.0, -1.5, 0.0], [2.0, 1.5, 2.4]), ([-0.6, -0.2, 0.0], [0.6, 0.2, 0.5])]
    write_map(tmp_path / "room.gsmap", map_of(boxes))
    half = {"name": "half", "from_map": np.diag([0.5, 0.5, 0.5, 1]).tolist()}

    async def session(client: Client) -> None:
        stand = await told(client, "where_to_stand", id=1, distance=0.7, unit="m")
        x, y, z = stand["position"]
        assert abs(x) <= 0.05 and abs(abs(y) - 0.9) <= 0.05 and abs(z) < 1e-6
        assert stand["yaw"] == pytest.approx(-np.sign(y) * np.pi / 2, abs=0.05)
        assert abs(stand["distance"] - 0.7) <= 0.05 and (stand["seen"], stand["frame"]) == (1.0, "home")
        about = await told(client, "describe", id=1)
        assert {"thing": "1", "relation": "in", "other": "room 0"} in about["relations"]
        halved = await told(client, "where_to_stand", id=1, distance=0.7, frame=half)
        assert np.allclose(halved["position"], np.array(stand["position"]) / 2, atol=1e-6)
        assert halved["distance"] == pytest.approx(stand["distance"] / 2) and not halved["metric"]
        assert (await kind(client, "where_to_stand", id=1, radius=5))[0] == "bad_input"
        assert (await kind(client, "where_to_stand", id=2))[0] == "unknown_instance"

    with QueryEngine(tmp_path / "room.gsmap", watch=None) as engine:
        ended(Client(make_server(engine, None)), session)


@pytest.mark.slow
def test_a_photo_outside_of_the_map_is_sent_only_where_the_user_allows_it(
    tmp_path: Path, photo: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = write_seen_map(tmp_path / "a.gsmap", photo)

    async def session(client: Client) -> Any:
        answer = (await client.call_tool("describe", {"id": RED})).structured_content
        return answer["picture"], "--photos" in (answer["note"] or "")

    with QueryEngine(path, watch=None, encoders=encoders) as engine:
        for other in (None, tmp_path):
            assert ended(Client(make_server(engine, other)), session) == ("render", True)
        assert len(caplog.records) == 2
        assert ended(Client(make_server(engine, photo.parent)), session) == ("photo", False)
    assert ended(Client(stdio(path)), session) == ("render", True)
    assert main(["mcp", str(path), "--photos", str(photo)]) == 2  # a file


def test_a_defect_is_logged_and_not_shown(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def broken(*_: Any, **__: Any) -> None:
        raise RuntimeError("secret")

    path = write_map_of(tmp_path / "a.gsmap", gaussians=300)
    with QueryEngine(path, watch=None, encoders=encoders, queue_size=1) as engine:
        client = Client(make_server(engine, None))
        monkeypatch.setattr(engine.current, "find", broken)
        failed = ended(client, lambda client: kind(client, "list_objects"))
        assert failed == ("failed", "the server failed on this request; its log says why")
        assert "secret" in caplog.text
        engine.close()
        assert ended(Client(make_server(engine, None)), lambda client: kind(client, "find", text="mug"))[0] == "closed"


def test_bad_use_ends_with_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path = str(write_map_of(tmp_path / "a.gsmap", gaussians=300))
    for words, line in (
        ([str(tmp_path / "none")], "none"),
        ([path, "--http", "8766"], "--http: found '8766', expected HOST:PORT"),
        ([path, "--http", "127.0.0.1:http"], "port: found 'http', expected a whole number from 0 to 65535"),
        ([path, "--http", "0.0.0.0:0"], "token"),
        ([path, "--token-file", str(tmp_path / "none")], "--http HOST:PORT"),
    ):
        assert main(["mcp", *words]) == 2
        error = capsys.readouterr().err
        assert error.count("\n") == 1 and line in error
    monkeypatch.setitem(sys.modules, "mcp", None)
    monkeypatch.delitem(sys.modules, "perception.serve.mcp")
    assert main(["mcp", path]) == 2
    assert 'pip install ".[mcp]"' in capsys.readouterr().err
