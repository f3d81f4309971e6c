"""Every way in which a prompt reaches a map, as functions of the prompt, on a map with labels, prints and places."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from perception.map.write import read_map, write_map
from perception.node.core import read_questions
from perception.query import QueryMap, load_map
from perception.query.indexing import index_maps
from perception.serve.bodies import QueryBody, parse
from perception.serve.mcp import Find
from perception.viewer.panel import escaped
from perception.viewer.session import Session
from support.query_maps import encoders, write_map_of

PRINTS = ("OAT MILK", "BIRDS of the north", "Tomato soup, 500 g", "HONEY")


def write_spoken_map(path: Path) -> Path:
    """A metric map with gravity, in which some instances have labels and printed texts."""
    write_map_of(path, gaussians=300)
    gmap = read_map(path)
    gmap.info["gravity"] = {"direction": [0, 0, -1], "source": "test", "standard_error_deg": 1.0}
    gmap.info["instances"] = {"texts": "test"}
    for entry, text in zip(gmap.instances, PRINTS, strict=False):
        entry["texts"] = [{"text": text, "score": 0.9}]
    gmap.instances[-1]["label"] = "grandma's drum"
    write_map(path, gmap)
    return path


def query_paths(folder: Path) -> dict[str, Callable[[str], object]]:
    """By name: what answers a prompt there, or raises InputError. folder: an empty one, which holds the maps."""
    path = write_spoken_map(folder / "a.gsmap")
    index_maps(folder / "all.store", [path, write_map_of(folder / "b.gsmap", gaussians=200)], encoders=encoders)
    gmap, store = (load_map(folder / name, encoders=encoders) for name in ("a.gsmap", "all.store"))
    session = Session(path)
    session._loaded().encoders = encoders

    def served(text: str) -> object:
        asked = parse(QueryBody, {"text": text}).requests()
        return [request.answered(gmap).to_json() for request in asked]

    def node(text: str) -> object:
        return [question.request.answered(gmap).to_json() for question in read_questions(text)]

    def viewer(text: str) -> object:
        return session.ask(text), escaped(session.question)

    def names(opened: QueryMap) -> Callable[[str], object]:
        return lambda text: opened.query(text)

    tool = {"mcp": lambda text: parse(Find, {"text": text}).answered(gmap, None)}
    return {"python": names(gmap), "store": names(store), "serve": served, "node": node, "viewer": viewer, **tool}
