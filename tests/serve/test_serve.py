"""The map over HTTP: what it answers, what it refuses, and that its OpenAPI document tells the truth."""

from __future__ import annotations

import io
import json
import os
import shutil
import socket
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from support.query_maps import NAMES, encoders, write_map_of

pytest.importorskip("fastapi", reason="the extra 'serve' is not installed")
pytest.importorskip("uvicorn", reason="the extra 'serve' is not installed")
from openapi_schema_validator import OAS31Validator
from starlette.testclient import TestClient

from perception.cli import main
from perception.config import read_toml, settings_from
from perception.errors import InputError
from perception.io.cloud import read_cloud
from perception.map.write import read_map
from perception.query import QueryMap
from perception.serve.app import build_app
from perception.serve.engine import QueryEngine
from perception.serve.listening import check_address, is_local, listen, read_token
from perception.serve.requests import ServeSettings
from perception.serve.server import serve

TOKEN = "0123456789abcdef0123"


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_map_of(tmp_path_factory.mktemp("serve") / "a.gsmap", gaussians=900)


@pytest.fixture(scope="module")
def engine(path: Path) -> Iterator[QueryEngine]:
    with QueryEngine(path, watch=None, encoders=encoders) as engine:
        yield engine


def client_of(engine: QueryEngine, **settings: Any) -> TestClient:
    app = build_app(engine, ServeSettings(**settings))
    return TestClient(app, base_url="http://127.0.0.1:8765", raise_server_exceptions=False)


@pytest.fixture(scope="module")
def client(engine: QueryEngine) -> TestClient:
    return client_of(engine)


def refused(answer: Any, status: int, *words: str) -> None:
    """One JSON object with one clear line."""
    body = answer.json()
    assert (answer.status_code, body["status"], set(body)) == (status, status, {"error", "status"})
    assert "\n" not in body["error"] and len(body["error"]) < 300 and "Traceback" not in body["error"]
    for word in words:
        assert word in body["error"]


# -------------------------------------------------------------------- answers


def test_a_query_answers_as_the_contract_says(client: TestClient, engine: QueryEngine) -> None:
    answer = client.post("/query", json={"text": ["teapot", "lamp"], "top_k": 2, "min_score": 0}).json()
    assert set(answer) == {"results", "frame", "metric", "map_id"}
    assert (answer["frame"], answer["metric"], answer["map_id"]) == ("map", True, engine.current.map_id)
    for text, result in zip(["teapot", "lamp"], answer["results"], strict=True):
        expected = engine.current.query(text, 2, 0)
        assert result == {"text": text, "present": True, "hits": [hit.to_json() for hit in expected]}
    single = client.post("/query", json={"text": "nothing 7", "top_k": 1, "min_score": 0.9999}).json()
    assert single["results"] == [{"text": "nothing 7", "present": False, "hits": []}]


def test_a_refused_prompt_of_several_leaves_the_others_answered(client: TestClient, engine: QueryEngine) -> None:
    """What is refused has neither hits nor "present", so that no program takes it for absent."""
    texts = ["teapot", "no mug", "lamp"]
    results = client.post("/query", json={"text": texts, "top_k": 2, "min_score": 0}).json()["results"]
    for text, result in zip(texts[::2], results[::2], strict=True):
        assert result == {
            "text": text,
            "present": True,
            "hits": [h.to_json() for h in engine.current.query(text, 2, 0)],
        }
    assert set(results[1]) == {"text", "error"} and "'no mug' says what a thing is not" in results[1]["error"]
    for text in ("no mug", ["no mug"], ["no mug", "not a lamp"]):
        refused(client.post("/query", json={"text": text}), 400, "'no mug' says what a thing is not")


def test_lengths_in_a_frame_with_a_scale_are_not_told_to_be_metres(client: TestClient) -> None:
    for scale, metric in ((1.0, True), (1000.0, False)):
        frame = {"name": "base", "from_map": np.diag([scale, scale, scale, 1.0]).tolist()}
        for page, body in (("/query", {"text": "mug"}), ("/find", {}), ("/at", {"point": [0, 0, 0]})):
            assert client.post(page, json={**body, "frame": frame}).json()["metric"] is metric


def test_a_parameter_of_another_page_is_refused(client: TestClient) -> None:
    refused(client.post("/query?at=0", json={"text": "mug"}), 400, "at", "map_id")
    refused(client.get("/instances?top_k=3"), 400, "top_k", "map_id, at")
    refused(client.post("/reload?map_id=x", json={}), 400, "map_id", "none")
    assert client.get("/instances?at=0").status_code == client.get("/health?now=1").status_code == 200


def test_an_instance_is_served_whatever_its_id(tmp_path: Path) -> None:
    """Ids are 0 to 2³¹ − 1 (docs/formats.md)."""
    path = write_map_of(tmp_path / "m.gsmap", gaussians=90, first_id=2**31 - 9)
    with QueryEngine(path, watch=None, encoders=encoders) as engine:
        client = client_of(engine)
        listed = [hit["instance_id"] for hit in client.get("/instances").json()["hits"]]
        assert listed[-1] == 2**31 - 1
        assert all(client.get(f"/instances/{i}").json()["instance_id"] == i for i in listed)
        assert client.get(f"/instances/{listed[-1]}/points?format=ply").status_code == 200


def test_filters_and_frames_pass_through(client: TestClient, engine: QueryEngine) -> None:
    where = {"region": {"min": [1.5, -0.5, -1], "max": [2.5, 0.5, 1]}, "min_size": 0.1}
    answer = client.post("/query", json={"text": "mug", "min_score": 0, "where": where}).json()
    assert [hit["instance_id"] for hit in answer["results"][0]["hits"]] == [2]
    lifted = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 10], [0, 0, 0, 1]]
    frame = {"name": "base", "from_map": lifted}
    hits = client.post("/nearest", json={"near": [1, 1, 10], "top_k": 2, "frame": frame}).json()
    assert hits["frame"] == "base" and hits["hits"][0]["instance_id"] == 4
    assert np.allclose(hits["hits"][0]["centroid"], [1, 1, 10], atol=0.05)
    at = client.post("/at", json={"point": [2, 1, 0]}).json()
    assert [hit["instance_id"] for hit in at["hits"]] == [5]
    assert client.post("/at", json={"point": [2, 1, 50]}).json()["hits"] == []
    corners = {"min": [-0.5, -0.5, -9], "max": [0.5, 2.5, 9]}
    found = client.post("/find", json={"where": {"region": corners, "share": 1}}).json()
    assert [hit["instance_id"] for hit in found["hits"]] == [0, 3, 6]
    turned = {"center": [1, 1, 0], "extent": [1, 1, 1], "rotation": [[0, 1, 0], [-1, 0, 0], [0, 0, 1]]}
    found = client.post("/find", json={"where": {"region": turned}}).json()
    assert [hit["instance_id"] for hit in found["hits"]] == [4]
    assert len(client.get("/instances").json()["hits"]) == 9


def test_points_come_as_the_gaussians_lie(client: TestClient, path: Path, tmp_path: Path) -> None:
    gmap = read_map(path)
    expected = gmap.means[gmap.instance_ids == 3]
    answer = client.get("/instances/3/points?format=ply")
    (tmp_path / "points.ply").write_bytes(answer.content)
    cloud = read_cloud(tmp_path / "points.ply")
    assert np.array_equal(cloud.points, expected) and set(cloud.labels["instance_id"]) == {3}
    answer = client.get("/instances/3/points")
    with np.load(io.BytesIO(answer.content), allow_pickle=False) as arrays:
        assert np.array_equal(arrays["points"], expected) and arrays["points"].dtype == np.float32
        assert str(arrays["map_id"]) == answer.headers["X-Map-Id"]


def test_a_pinned_map_that_was_replaced_is_a_conflict(tmp_path: Path) -> None:
    path = write_map_of(tmp_path / "a.gsmap", gaussians=300)
    with QueryEngine(path, watch=None, encoders=encoders) as engine:
        client = client_of(engine)
        first = client.post("/query", json={"text": "mug"}).json()["map_id"]
        assert client.get(f"/instances/0/points?map_id={first}").status_code == 200
        assert client.post("/reload", json={}).json() == {"changed": False, "map_id": first}
        write_map_of(path, NAMES[:2], gaussians=100, seed=3)
        answer = client.post("/reload", json={}).json()
        assert answer["changed"] and answer["map_id"] != first
        refused(client.get(f"/instances/0/points?map_id={first}"), 409, first)
        shutil.rmtree(path)
        refused(client.post("/reload", json={}), 400, "gone")
        assert client.get("/health").json()["status"] == "degraded"
        assert client.post("/query", json={"text": "mug"}).json()["results"][0]["present"]


# ------------------------------------------------------------------- document


def test_the_document_is_valid_and_lists_every_route(engine: QueryEngine) -> None:
    app = build_app(engine, ServeSettings())
    described = app.openapi()
    from openapi_spec_validator import validate  # loads much

    validate(described)
    routes = {(route.path, method.lower()) for route in app.routes for method in route.methods - {"HEAD"}}  # type: ignore[attr-defined]
    paths = {(path, method) for path, item in described["paths"].items() for method in item}
    assert routes - paths == {("/openapi.json", "get")} and paths <= routes


def test_requests_that_the_document_describes_are_answered(client: TestClient) -> None:
    described = client.get("/openapi.json").json()
    frame = {"name": "base", "from_map": np.eye(4).tolist()}
    box = {"region": {"min": [0, 0, 0], "max": [1, 1, 1]}, "near": [0, 0, 0], "within": 9.0, "labels": ["x"]}
    asked = [
        ("/query", {"text": "mug", "top_k": 2, "min_score": None, "where": None, "frame": frame}),
        ("/query", {"text": ["mug", "lamp"], "where": box}),
        ("/find", {}),
        ("/nearest", {"near": np.eye(4).tolist(), "top_k": 3}),
        ("/at", {"point": [0, 0, 0]}),
        ("/reload", {}),
    ]
    for url, body in asked:
        operation = described["paths"][url]["post"]
        if "requestBody" in operation:
            schema = operation["requestBody"]["content"]["application/json"]["schema"]
            whole = {**schema, "components": described["components"]}
            assert [error.message for error in OAS31Validator(whole).iter_errors(body)] == []
        assert client.post(url, json=body).status_code == 200


# ------------------------------------------------------------------ bad input


@pytest.mark.parametrize(
    ("body", "word"),
    [
        (b"", "JSON"),
        (b"{", "JSON"),
        (b"\xff\xfe", "JSON"),
        (b"[" * 30_000, "JSON"),
        (b'{"text": NaN}', "text"),
        (b"3", "object"),
        (b"{}", "required"),
        (b'{"text": ""}', "at least 1 character"),
        (b'{"text": "  "}', "empty"),
        (b'{"text": 3}', "text"),
        (b'{"text": []}', "at least 1 item"),
        (b'{"text": ["mug", null]}', "text"),
        (b'{"text": "mug", "top_k": 0}', "top_k"),
        (b'{"text": "mug", "top_k": 1e3}', "top_k"),
        (b'{"text": "mug", "top_k": true}', "top_k"),
        (b'{"text": "mug", "min_score": "high"}', "min_score"),
        (b'{"text": "mug", "colour": "red"}', "colour"),
        (b'{"text": "mug", "where": 3}', "where"),
        (b'{"text": "mug", "where": {"region": {}}}', "region"),
        (b'{"text": "mug", "where": {"region": {"min": [0, 0], "max": [1, 1]}}}', "region"),
        (b'{"text": "mug", "where": {"region": {"min": ["a", 0, 0], "max": [1, 1, 1]}}}', "region"),
        (b'{"text": "mug", "where": {"region": {"min": [0, 0, 1e400], "max": [1, 1, 1]}}}', "finite"),
        (b'{"text": "mug", "where": {"within": 1}}', "near"),
        (b'{"text": "mug", "where": {"labels": {"a": 1}}}', "labels"),
        (b'{"text": "mug", "frame": "base"}', "frame"),
        (b'{"text": "mug", "frame": {"name": "b", "from_map": [[1]]}}', "frame"),
        (f'{{"text": "mug", "frame": {{"name": "", "from_map": {np.eye(4).tolist()}}}}}'.encode(), "frame.name"),
    ],
)
def test_bad_bodies_are_told_in_one_line(client: TestClient, body: bytes, word: str) -> None:
    refused(client.post("/query", content=body, headers={"Content-Type": "application/json"}), 400, word)


def test_other_bad_requests_are_told_too(client: TestClient) -> None:
    refused(client.get("/nowhere"), 404, "/nowhere", "openapi")
    refused(client.get("/query"), 405, "GET")
    refused(client.get("/instances/77"), 404, "77")
    for number in ("-1", "x", "%2e%2e", "9" * 40, "٣"):
        refused(client.get(f"/instances/{number}"), 404, "instance")
    refused(client.get("/instances/1/points?format=las"), 400, "npz", "ply")
    refused(client.post("/nearest", json={}), 400, "near")
    refused(client.post("/nearest", json={"near": [0, 0]}), 400, "near")
    refused(client.post("/nearest", json={"near": [0, 0, 0], "top_k": 0}), 400, "top_k")
    refused(client.post("/at", json={"point": [0, 0, 0], "max_distance": "far"}), 400, "max_distance")
    refused(client.post("/find", json={"were": {}}), 400, "were")


def test_a_prompt_of_a_megabyte_is_too_large(client: TestClient) -> None:
    refused(client.post("/query", json={"text": "x" * 1_000_000}), 413, "65536")
    refused(client.post("/query", json={"text": "x" * 2000}), 400, "1000 characters")

    def stream() -> Iterator[bytes]:  # no Content-Length to be warned by
        for _ in range(100):
            yield b"x" * 1000

    refused(client.post("/query", content=stream(), headers={"Content-Type": "application/json"}), 413, "65536")


# --------------------------------------------------------------- who may ask


def test_without_the_token_nothing_of_the_map_is_told(engine: QueryEngine) -> None:
    client = client_of(engine, token=TOKEN, host="0.0.0.0")
    for wrong in (
        {},
        {"Authorization": f"Bearer {TOKEN[:-1]}"},
        {"Authorization": f"Basic {TOKEN}"},
        {"Authorization": "é"},
    ):
        headers = {name: value.encode("latin-1") for name, value in wrong.items()}
        for answer in (
            client.post("/query", json={"text": "mug"}, headers=headers),
            client.get("/instances/1/points", headers=headers),
            client.post("/reload", json={}, headers=headers),
        ):
            refused(answer, 401, "token")
            assert answer.headers["WWW-Authenticate"] == "Bearer"
        assert client.get("/health", headers=headers).json() == {"status": "ok"}
    good = {"Authorization": f"Bearer {TOKEN}"}
    assert client.post("/query", json={"text": "mug"}, headers=good).json()["results"][0]["present"]
    assert client.get("/health", headers=good).json()["instances"] == 9


def test_other_sites_cannot_ask_through_a_browser_on_this_machine(client: TestClient) -> None:
    for host in ("evil.example", "evil.example:8765", "127.0.0.1.evil.example", ""):
        refused(client.get("/instances", headers={"Host": host}), 403, "not this machine")
    for host in ("localhost:8765", "127.0.0.1", "[::1]:8765", "[::1]"):
        assert client.get("/instances", headers={"Host": host}).status_code == 200
    plain = {"Content-Type": "text/plain", "Origin": "http://evil.example"}
    refused(client.post("/query", content=b'{"text": "mug"}', headers=plain), 415, "application/json")
    preflight = client.options("/query", headers={"Origin": "http://evil.example"})
    assert preflight.status_code == 405 and "access-control-allow-origin" not in preflight.headers


def test_a_full_queue_and_a_slow_answer_are_told(path: Path) -> None:
    for timeout, status, told in ((0.2, 504, "0.2 s"), (60.0, 503, "waiting")):
        with QueryEngine(path, watch=None, workers=1, queue_size=1, timeout=timeout, encoders=encoders) as engine:
            client = client_of(engine)
            begun, end = threading.Event(), threading.Event()

            def work(gmap: QueryMap, begun: threading.Event = begun, end: threading.Event = end) -> None:
                begun.set()
                end.wait(30)

            engine.run(work)
            assert begun.wait(30)
            if status == 503:
                engine.submit("mug")  # fills the queue; the worker is busy until `end`
            late = client.post("/query", json={"text": "mug"})
            refused(late, status, told)
            assert late.headers.get("Retry-After") == ("1" if status == 503 else None)
            end.set()
        refused(client.post("/query", json={"text": "mug"}), 503, "closed")
        assert client.get("/health").status_code == 503


def test_a_defect_is_logged_and_not_shown(
    engine: QueryEngine, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def broken(self: QueryMap, *_: Any, **__: Any) -> None:
        raise ZeroDivisionError("secret detail")

    monkeypatch.setattr(QueryMap, "find", broken)
    answer = client_of(engine).get("/instances")
    refused(answer, 500, "log")
    assert "secret" not in answer.text and "secret detail" in caplog.text


# -------------------------------------------------------------------- settings


def test_other_machines_need_a_token(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for host in ("0.0.0.0", "::", "192.168.1.5", "robot.local"):
        with pytest.raises(InputError, match="token"):
            serve(tmp_path, ServeSettings(host=host))
        check_address(host, 0, TOKEN)
    for host in ("127.0.0.1", "127.8.8.8", "::1", "localhost"):
        assert is_local(host)
    assert main(["serve", str(tmp_path), "--host", "0.0.0.0"]) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_a_token_file_must_hold_one_long_word(tmp_path: Path) -> None:
    file = tmp_path / "token"
    file.write_text(f"  {TOKEN}\n")
    assert read_token(file) == TOKEN
    for text in ("", "short", "two words of enough length", "größer" * 4, "a" * 20 + "\x00"):
        file.write_text(text, encoding="utf-8")
        with pytest.raises(InputError, match="token"):
            read_token(file)
    file.write_bytes(b"\xff" * 30)
    with pytest.raises(InputError, match="token"):
        read_token(file)
    with pytest.raises(InputError, match="token"):
        read_token(tmp_path / "none")
    os.mkfifo(tmp_path / "pipe")
    for read in (read_token, read_toml):
        with pytest.raises(InputError, match="pipe: found a named pipe, expected a regular file"):
            read(tmp_path / "pipe")


@pytest.mark.parametrize(
    "settings",
    [{"port": -1}, {"port": 70000}, {"timeout": 0}, {"workers": 0}, {"queue_size": 0}, {"watch": -1}],
)
def test_settings_out_of_range_are_refused(settings: dict[str, Any]) -> None:
    ((name, value),) = settings.items()
    with pytest.raises(InputError, match=f"{name}: found {value}, expected"):
        settings_from(ServeSettings, {name: (value, "serve")})


def test_without_the_packages_the_install_line_is_told(
    path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("perception.serve.server.importlib.util.find_spec", lambda name: None)
    assert main(["serve", str(path)]) == 2
    assert 'pip install ".[serve]"' in capsys.readouterr().err


def test_json_of_nothing_but_numbers(client: TestClient) -> None:
    """No NaN or Infinity leaves the server, whatever is asked."""
    for url in ("/instances", "/instances/0", "/health"):
        json.loads(client.get(url).text, parse_constant=lambda name: pytest.fail(name))


def test_a_name_of_several_addresses_is_that_which_the_machine_has(monkeypatch: pytest.MonkeyPatch) -> None:
    def resolve(*addresses: str) -> None:
        families = [socket.AF_INET6 if ":" in address else socket.AF_INET for address in addresses]
        found = [(family, 1, 6, "", (address, 0)) for family, address in zip(families, addresses, strict=True)]
        monkeypatch.setattr(socket, "getaddrinfo", lambda *_, **__: found)

    for addresses in (("::1", "127.0.0.1"), ("203.0.113.1", "127.0.0.1"), ("2001:db8::1", "203.0.113.1", "127.0.0.1")):
        resolve(*addresses)
        with listen("localhost", 0) as sock:
            assert sock.getsockname()[0] == "127.0.0.1"
    resolve("203.0.113.1", "2001:db8::1")
    with pytest.raises(InputError, match="host localhost: is no address of this machine"):
        listen("localhost", 0)


def test_a_port_in_use_is_told_though_another_address_of_the_name_is_free(monkeypatch: pytest.MonkeyPatch) -> None:
    with listen("127.0.0.1", 0) as busy:
        port = busy.getsockname()[1]
        found = [(socket.AF_INET, 1, 6, "", (address, port)) for address in ("127.0.0.1", "127.0.0.2")]
        monkeypatch.setattr(socket, "getaddrinfo", lambda *_, **__: found)
        with pytest.raises(InputError, match=f"port {port}: is in use"):
            listen("localhost", port)
