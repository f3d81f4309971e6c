"""What changed, what is gone, and the map as of an earlier visit: over HTTP, MCP and ROS, and in the viewer."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from starlette.testclient import TestClient

from perception.map.write import read_map, write_map
from perception.node.answers import CHANGES
from perception.node.config import NodeConfig
from perception.node.core import Core
from perception.query import load_map
from perception.query.indexing import index_maps
from perception.serve.app import build_app
from perception.serve.engine import QueryEngine
from perception.serve.requests import ServeSettings
from perception.viewer.session import STATE_COLORS, Session
from support.query_maps import encoders
from support.visited_map import STATES, STOOD, TIMES, ball, number, write_visited_map


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_visited_map(tmp_path_factory.mktemp("visits") / "a.gsmap")


@pytest.fixture(scope="module")
def engine(path: Path) -> Iterator[QueryEngine]:
    with QueryEngine(path, watch=None, encoders=encoders, timeout=60.0) as engine:
        yield engine


@pytest.fixture(scope="module")
def client(engine: QueryEngine) -> TestClient:
    return TestClient(build_app(engine, ServeSettings()), base_url="http://127.0.0.1:8765")


def test_http_says_what_changed(client: TestClient, engine: QueryEngine) -> None:
    answer = client.get("/changes").json()
    assert answer["changes"] == engine.current.changes() and answer["since"] == 1
    assert [visit["time"] for visit in answer["visits"]] == list(TIMES)
    since = {change["instance_id"]: change["state"] for change in client.get("/changes?since=0").json()["changes"]}
    assert since[number("mug")] == "removed" and since[number("kettle")] == "unseen"
    assert client.get("/changes?since=3").status_code == 400


def test_http_answers_with_what_is_there_and_names_what_is_gone(client: TestClient) -> None:
    answer = client.post("/query", json={"text": "mug"}).json()
    (result,) = answer["results"]
    assert (result["present"], result["hits"], len(answer["visits"])) == (False, [], 3)
    (gone,) = result["gone"]
    assert (gone["instance_id"], gone["state"], gone["since"], gone["last_seen"]) == (number("mug"), "removed", 1, 0)
    assert gone["stood"] == {"relation": "on", "other": number("shelf")}
    then = client.post("/query", json={"text": "mug", "at": 0}).json()["results"][0]
    assert [hit["instance_id"] for hit in then["hits"]] == [number("mug")] and "gone" not in then
    assert client.get(f"/instances/{number('mug')}").status_code == 404
    assert client.get(f"/instances/{number('mug')}?at=0").json()["num_points"] == len(ball("mug", 0))
    for visit, names in enumerate(STOOD):
        ids = {hit["instance_id"] for hit in client.get(f"/instances?at={visit}").json()["hits"]}
        assert ids == {number(name) for name in (*names, "shelf")}
    near = {"near": ball("banana", 1).mean(axis=0).tolist(), "at": 0}
    assert client.post("/nearest", json=near).json()["hits"][0]["instance_id"] == number("banana")
    assert client.post("/query", json={"text": "mug", "at": 3}).status_code == 400


def test_one_encoder_serves_the_scenes_of_all_visits(path: Path) -> None:
    made: list[str] = []
    gmap = load_map(path, lambda spec: made.append(spec) or encoders(spec))  # type: ignore[func-returns-value]
    assert gmap.query("lamp") and gmap.gone("mug") and gmap.at(0).query("mug") and gmap.at(1).query("lamp")
    assert made == ["hash"]


def test_tools_of_language_models_say_it_too(engine: QueryEngine) -> None:
    pytest.importorskip("mcp", reason="the extra 'mcp' is not installed")
    from perception.serve.mcp import TOOLS

    def ask(tool: str, **arguments: Any) -> Any:
        return TOOLS[tool](**arguments).answered(engine.current, None)[0]

    changed = ask("what_changed", since=0)
    assert {c["instance_id"]: c["state"] for c in changed["changes"]}[number("lamp")] == "moved"
    turned = {"name": "arm", "from_map": [[0, -2, 0, 1], [2, 0, 0, 0], [0, 0, 2, 0.5], [0, 0, 0, 1]]}
    lamp, there = (
        next(c for c in told["changes"] if c["instance_id"] == number("lamp"))
        for told in (changed, ask("what_changed", since=0, frame=turned))
    )
    for key in ("old_centroid", "new_centroid"):
        x, y, z = lamp[key]
        assert there[key] == pytest.approx([1 - 2 * y, 2 * x, 2 * z + 0.5])
    after = np.array(there["transform"]) @ [*there["old_centroid"], 1]
    assert after[:3] == pytest.approx(there["new_centroid"], abs=1e-3)
    found = ask("find", text="mug")
    assert found["hits"] == [] and [hit["instance_id"] for hit in found["gone"]] == [number("mug")]
    assert ask("find", text="lamp")["hits"][0]["state"] == "moved"
    assert [hit["instance_id"] for hit in ask("find", text="mug", at=0)["hits"]] == [number("mug")]


def test_the_node_publishes_the_changes(engine: QueryEngine) -> None:
    class Heard:
        def __init__(self) -> None:
            self.messages: list[tuple[Any, dict[str, Any]]] = []

        def publish(self, topic: Any, message: dict[str, Any]) -> None:
            self.messages.append((topic, message))

    heard = Heard()
    core = Core(engine, heard, NodeConfig(map_points=0))  # type: ignore[arg-type]
    core._send_map(engine.current)
    ((topic, message),) = heard.messages
    assert topic is CHANGES and CHANGES.latched
    told = json.loads(message["data"])
    assert told["changes"] == engine.current.changes() and told["map_id"] == engine.current.map_id


def test_the_viewer_colours_what_changed(path: Path) -> None:
    session = Session(path)
    photo, session.mode = session.colors(), "changes"
    colors, ids = session.colors(), session.editor.ids
    for name, state in STATES.items():
        own = colors[ids == number(name)]
        before = photo[ids == number(name)]
        painted = 0.4 * before + 0.6 * np.array(STATE_COLORS[state]) if state in STATE_COLORS else before
        assert np.abs(own.astype(float) - painted).max(initial=0) <= 1
    assert np.array_equal(session.ghosts(), ball("lamp", 2))  # what the newest visit found moved or gone
    session.mode = "photo"
    assert len(session.ghosts()) == 0


def test_a_store_answers_with_what_is_there_today(path: Path, tmp_path: Path) -> None:
    index_maps(tmp_path / "all.store", [path], encoders=encoders)
    store = load_map(tmp_path / "all.store", encoders)
    assert number("mug") not in {hit.instance_id for hit in store.query("mug", min_score=0.0)}
    assert store.query("lamp")[0].instance_id == number("lamp") and store.gone("mug") == []


def test_a_copy_of_the_map_keeps_its_history(path: Path, tmp_path: Path) -> None:
    write_map(tmp_path / "b.gsmap", read_map(path))
    for name in ("instances.json", "language.npz", "past.npz"):
        assert (tmp_path / "b.gsmap" / name).read_bytes() == (path / name).read_bytes()
