"""Whatever JSON a client sends, sound or not, the server answers with JSON, and never with a failure of its own."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from support.query_maps import encoders, write_map_of

pytest.importorskip("fastapi", reason="the extra 'serve' is not installed")
from starlette.testclient import TestClient

from perception.serve.app import build_app
from perception.serve.engine import QueryEngine
from perception.serve.requests import ServeSettings

EXAMPLES = settings(max_examples=120, derandomize=True, deadline=None, suppress_health_check=list(HealthCheck))
SIZES = [0.0, -0.0, 1.0, 5e-324, 1e-200, 1e-9, 1e9, 1e12, -1e12, 1e38, 1e200, -1e200, 1e308, 10**400, 2**63]
NUMBERS = st.one_of(st.sampled_from(SIZES), st.floats(allow_nan=False), st.floats(-3, 3), st.integers())
TEXTS = st.one_of(
    st.sampled_from(["mug", "teapot", "\ud800", "mug\udfff", "\x00", "<b>", "a" * 1001, "", " ", "é\u2028"]),
    st.text(st.characters(codec=None), max_size=20),
)
JUNK = st.recursive(
    st.one_of(st.none(), st.booleans(), NUMBERS, TEXTS),
    lambda inner: st.one_of(st.lists(inner, max_size=4), st.dictionaries(TEXTS, inner, max_size=3)),
    max_leaves=8,
)


def rows(count: int, width: int) -> Any:
    return st.lists(st.lists(NUMBERS, min_size=width, max_size=width), min_size=count, max_size=count)


@st.composite
def similarities(draw: Any) -> list[list[float]]:
    """Rotations by quarter turns, scaled and moved by anything: transforms that are accepted, to the last digit."""
    scale, (x, y, z) = draw(NUMBERS), draw(st.tuples(NUMBERS, NUMBERS, NUMBERS))
    turn = draw(st.sampled_from([np.eye(3), [[0, 1, 0], [-1, 0, 0], [0, 0, 1]], [[0, 0, 1], [1, 0, 0], [0, 1, 0]]]))
    linear = [[scale if cell else 0.0 for cell in row] for row in np.asarray(turn, bool).tolist()]
    return [[*row, move] for row, move in zip(linear, (x, y, z), strict=True)] + [[0.0, 0.0, 0.0, 1.0]]


POINTS = st.lists(NUMBERS, min_size=3, max_size=3)
MATRICES = st.one_of(similarities(), rows(4, 4))
REGIONS = st.one_of(
    st.fixed_dictionaries({"min": POINTS, "max": POINTS}),
    st.fixed_dictionaries({"center": POINTS, "extent": POINTS}, optional={"rotation": rows(3, 3)}),
)


def fields(**kinds: Any) -> Any:
    """Objects with some of these fields, each now and then of a wrong kind."""
    return st.fixed_dictionaries({}, optional={name: st.one_of(kind, kind, JUNK) for name, kind in kinds.items()})


FRAMES = st.fixed_dictionaries({"name": TEXTS, "from_map": MATRICES})
WHERES = fields(
    region=REGIONS,
    share=NUMBERS,
    near=st.one_of(POINTS, MATRICES),
    within=NUMBERS,
    min_size=NUMBERS,
    max_size=NUMBERS,
    labels=st.one_of(TEXTS, st.lists(TEXTS, max_size=3)),
)
FILTERED = {"where": WHERES, "frame": FRAMES}
BODIES = {
    "/query": fields(text=st.one_of(TEXTS, st.lists(TEXTS)), top_k=st.integers(), min_score=NUMBERS, **FILTERED),
    "/find": fields(**FILTERED),
    "/nearest": fields(near=st.one_of(POINTS, MATRICES), top_k=st.integers(), **FILTERED),
    "/at": fields(point=POINTS, max_distance=NUMBERS, frame=FRAMES),
    "/reload": JUNK,
}


@pytest.fixture(scope="module")
def client(tmp_path_factory: pytest.TempPathFactory) -> Iterator[TestClient]:
    path: Path = write_map_of(tmp_path_factory.mktemp("serve") / "a.gsmap", gaussians=300)
    with QueryEngine(path, watch=None, encoders=encoders) as engine:
        app = build_app(engine, ServeSettings())
        yield TestClient(app, base_url="http://127.0.0.1:8765", raise_server_exceptions=False)


def answered(answer: Any) -> None:
    """Below 500, and JSON of finite numbers; a refusal is one line."""
    assert answer.status_code < 500, answer.text
    body = json.loads(answer.text, parse_constant=lambda name: pytest.fail(name))
    if answer.status_code != 200:
        assert set(body) == {"error", "status"} and "\n" not in body["error"] and len(body["error"]) < 400


@pytest.mark.slow
@pytest.mark.parametrize("route", sorted(BODIES))
def test_no_request_of_the_schema_and_near_it_fails(client: TestClient, route: str) -> None:
    @EXAMPLES
    @given(body=st.one_of(BODIES[route], BODIES[route], JUNK))
    def check(body: Any) -> None:
        answered(client.post(route, content=json.dumps(body), headers={"Content-Type": "application/json"}))

    check()


HUGE = {"name": "b", "from_map": [[1e200, 0, 0, 0], [0, 1e200, 0, 0], [0, 0, 1e200, 0], [0, 0, 0, 1]]}


@pytest.mark.parametrize(
    ("route", "body"),
    [
        ("/query", {"text": "\ud800"}),
        ("/query", {"text": "mug", "frame": {"name": "\udfff", "from_map": np.eye(4).tolist()}}),
        ("/query", {"te\ud800xt": "mug"}),
        ("/query", {"text": "mug", "where": {"labels": ["\ud800"]}}),
        ("/at", {"point": [1e200, 0, 0]}),
        ("/at", {"point": [0, 0, 1e308]}),
        ("/at", {"point": [0, 0, 0], "frame": HUGE}),
        ("/nearest", {"near": [1e308, 1e308, 1e308]}),
        ("/nearest", {"near": [0, 0, 0], "where": {"near": [1e200, 0, 0], "within": 1e308}}),
        ("/find", {"where": {"region": {"min": [-1e308, -1e308, -1e308], "max": [1e308, 1e308, 1e308]}}}),
        ("/find", {"frame": HUGE}),
    ],
)
def test_surrogates_and_huge_numbers_are_refused(client: TestClient, route: str, body: Any) -> None:
    answer = client.post(route, content=json.dumps(body), headers={"Content-Type": "application/json"})
    answered(answer)
    assert answer.status_code == 400


@EXAMPLES
@given(content=st.one_of(st.binary(max_size=200), JUNK.map(lambda value: json.dumps(value).encode()[:-1])))
@example(content=b"[" * 60_000)
@example(content=b'{"text": ' + b"9" * 50_000 + b"}")
@example(content="\ud800".encode("utf-8", "surrogatepass"))
def test_no_bytes_fail(client: TestClient, content: bytes) -> None:
    answered(client.post("/query", content=content, headers={"Content-Type": "application/json"}))


@pytest.mark.slow
@EXAMPLES
@given(path=TEXTS, query=st.dictionaries(st.sampled_from(["map_id", "format", "x"]), TEXTS))
def test_no_address_fails(client: TestClient, path: str, query: dict[str, str]) -> None:
    from urllib.parse import quote

    def quoted(text: str) -> str:
        return quote(text.encode("utf-8", "surrogatepass"), safe="")

    asked = "&".join(f"{name}={quoted(value)}" for name, value in query.items())
    for suffix in ("", "/points"):
        for name in (quoted(path), "0"):
            answer = client.get(f"/instances/{name}{suffix}?{asked}")
            assert answer.status_code < 500, answer.text
