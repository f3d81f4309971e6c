"""The scene graph of made rooms whose things and places are known."""

from __future__ import annotations

import json
from itertools import product
from pathlib import Path
from typing import Any

import networkx
import numpy as np
import pytest

from perception.errors import InputError
from perception.map.map import Map
from perception.query.scene_graph import scene_graph, write_graph
from perception.types import View
from support.aimed import look_at

STEP = 0.02


def box(low: tuple[float, ...], high: tuple[float, ...], faces: str = "xXyYZ") -> np.ndarray:
    """Points on the faces of a box along the axes, STEP apart: lower case for the lower face along an axis."""
    ends = np.array([low, high])
    sides = []
    for face in faces:
        axis = "xyz".index(face.lower())
        grids = [np.arange(a + STEP / 2, b, STEP) for a, b in ends.T]
        grids[axis] = ends[int(face.isupper()), axis : axis + 1]
        sides.append(np.stack(np.meshgrid(*grids), axis=-1).reshape(-1, 3))
    return np.concatenate(sides)


def hidden(points: np.ndarray, low: tuple[float, float], high: tuple[float, float]) -> np.ndarray:
    """The points without those that a thing on this rectangle hides."""
    return points[~((points[:, :2] > low) & (points[:, :2] < high)).all(axis=1)]


TABLE = hidden(box((1.0, 1.0, 0.70), (2.2, 1.8, 0.74)), (1.2, 1.2), (1.5, 1.4))
THINGS: dict[str, np.ndarray] = {
    "floor": box((0, 0, 0), (4, 3, 0), "Z"),
    "wall": box((0, 3, 0), (4, 3, 2.5), "Y"),
    "table": np.concatenate(
        [TABLE, *[box((x, y, 0.1), (x + 0.05, y + 0.05, 0.7)) for x, y in product((1.0, 2.15), (1.0, 1.75))]]
    ),
    "book": box((1.2, 1.2, 0.74), (1.5, 1.4, 0.77)),
    "mug": box((1.3, 1.25, 0.78), (1.38, 1.33, 0.88)),
    "crate": np.concatenate(
        [box((1.7, 1.2, 0.74), (2.0, 1.5, 0.85), "xXyY"), box((1.7, 1.2, 0.75), (2.0, 1.5, 0.75), "Z")]
    ),
    "apple": box((1.8, 1.3, 0.77), (1.88, 1.38, 0.84)),
    "lamp": box((2.05, 1.05, 0.75), (2.15, 1.15, 1.15)),
    "picture": box((1.0, 2.97, 1.2), (1.8, 2.98, 1.8), "y"),
    "bin": box((3.4, 0.4, 0.05), (3.7, 0.7, 0.4)),
}  # fmt: skip
EXPECTED = {
    ("table", "on", "floor"), ("book", "on", "table"), ("mug", "on", "book"), ("crate", "on", "table"),
    ("apple", "in", "crate"), ("lamp", "on", "table"), ("picture", "attached to", "wall"), ("bin", "on", "floor"),
}  # fmt: skip


def made(things: dict[str, np.ndarray], map_from_room: np.ndarray | None = None, **info: Any) -> Map:
    turn = np.eye(3) if map_from_room is None else map_from_room
    points = np.concatenate(list(things.values())) @ turn.T
    ids = np.repeat(np.arange(len(things)), [len(p) for p in things.values()]).astype(np.int32)
    count, eye = len(points), turn @ [2.0, 1.5, 1.4]
    entries = []
    for n, name in enumerate(things):
        mine = points[ids == n]
        flat = {
            "center": mine.mean(axis=0).tolist(),
            "rotation": np.eye(3).tolist(),
            "extent": np.ptp(mine, axis=0).tolist(),
        }
        entries.append({"id": n, "label": name, "score": 0.9, "centroid": mine.mean(axis=0).tolist(), "obb": flat})
    entries[2]["parts"] = [{"id": 7, "parent": 2, "score": 0.5, "centroid": [0.0, 0.0, 0.0], "obb": entries[2]["obb"]}]
    return Map(
        means=points.astype(np.float32),
        quats=np.tile(np.array([1, 0, 0, 0], np.float32), (count, 1)),
        log_scales=np.full((count, 3), np.log(1e-3), np.float32),
        opacity_logits=np.full(count, 3, np.float32),
        sh=np.zeros((count, 1, 3), np.float32),
        features=np.zeros((count, 1), np.float32),
        instance_ids=ids,
        membership=np.ones(count, np.float32),
        instances=entries,
        info={"metric": True, "gravity": {"direction": (-turn[:, 2]).tolist()}, **info},
        views=[View("a.jpg", Path("a.jpg"), np.eye(3), 64, 48, look_at(eye, eye + turn[:, 0], turn[:, 2]))],
        path=Path("room.gsmap"),
    )  # fmt: skip


def relations(graph: networkx.DiGraph, names: list[str]) -> set[tuple[str, str, str]]:
    return {
        (names[a], edge["relation"], names[b])
        for a, b, edge in graph.edges(data=True)
        if isinstance(a, int) and isinstance(b, int) and edge["relation"] != "next to"
    }


def test_what_holds_what_whichever_way_the_map_lies() -> None:
    quarter = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    noise = np.random.default_rng(0)
    for turn in (np.eye(3), quarter):
        things = {name: p + noise.normal(0, 0.002, p.shape) for name, p in THINGS.items()}
        graph = scene_graph(made(things, turn))
        assert relations(graph, list(THINGS)) == EXPECTED
        kinds = dict(zip(THINGS, (graph.nodes[n]["kind"] for n in range(len(THINGS))), strict=True))
        assert kinds["floor"] == kinds["wall"] == "shell" and kinds["table"] == kinds["book"] == "support"
        assert kinds["mug"] == kinds["picture"] == "object"
        assert graph.edges["part 7", 2]["relation"] == "part of" and graph.nodes["part 7"]["kind"] == "part"


def test_next_to_is_mutual_and_on_the_same_support() -> None:
    graph, names = scene_graph(made(THINGS)), list(THINGS)
    beside = {(names[a], names[b]) for a, b, r in graph.edges(data="relation") if r == "next to"}
    assert ("crate", "lamp") in beside and all((b, a) in beside for a, b in beside)
    assert not beside & {("mug", "crate"), ("apple", "lamp"), ("table", "lamp"), ("bin", "book")}


@pytest.mark.slow
def test_rooms_are_parted_by_a_door() -> None:
    """Two rooms of 3 × 3 m and the wall between them, with a door of 0.9 m."""
    walls = [box((x, 0, 0), (x + 0.1, 3, 2.4)) for x in (0.0, 6.3)]
    walls += [box((0, y, 0), (6.4, y + 0.1, 2.4)) for y in (-0.1, 3.0)]
    walls += [box((3.15, 0, 0), (3.25, 1.05, 2.4)), box((3.15, 1.95, 0), (3.25, 3, 2.4))]
    things = {
        "floor": box((0, 0, 0), (6.4, 3, 0), "Z"),
        "walls": np.concatenate(walls),
        "bin": box((1.0, 1.0, 0.02), (1.3, 1.3, 0.4)),
        "stool": box((5.0, 1.0, 0.02), (5.3, 1.3, 0.4)),
    }
    graph = scene_graph(made(things))
    assert graph.nodes[2]["room"] != graph.nodes[3]["room"]
    open_plan = {**things, "walls": np.concatenate(walls[:4])}
    graph = scene_graph(made(open_plan))
    assert graph.nodes[2]["room"] == graph.nodes[3]["room"] == "room 0"


def test_the_graph_is_written_as_json(tmp_path: Path) -> None:
    gmap = made(THINGS)
    facts, line = write_graph(gmap, tmp_path / "graph.json")
    read = networkx.node_link_graph(json.loads((tmp_path / "graph.json").read_text()), edges="edges")
    assert networkx.utils.graphs_equal(read, scene_graph(gmap)) and facts["edges"]["on"] == 6 and "6 on" in line
    assert read.graph["metric"] is True and read.nodes[3]["label"] == "book"


@pytest.mark.filterwarnings("error")
def test_a_map_without_instances_has_an_empty_graph(tmp_path: Path) -> None:
    gmap = made(THINGS)
    gmap.instances, gmap.instance_ids = [], np.full(len(gmap), -1, np.int32)
    assert write_graph(gmap, tmp_path / "graph.json")[1].endswith("graph.json: no instance")
    assert len(networkx.node_link_graph(json.loads((tmp_path / "graph.json").read_text()), edges="edges")) == 0


def test_without_up_there_is_no_graph() -> None:
    gmap = made(THINGS, gravity=None)
    gmap.views = []
    with pytest.raises(InputError, match="which way is up is not known"):
        scene_graph(gmap)
    assert len(scene_graph(made({"thing": THINGS["mug"], "other": THINGS["bin"], "more": THINGS["book"]}))) > 3
