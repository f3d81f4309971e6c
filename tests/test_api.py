"""The public names, as the package's docstring lists them: each has shapes, errors and an example that runs."""

from __future__ import annotations

import doctest
import importlib
import inspect
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("perception._core")
import perception
from perception.io.cloud import write_cloud
from perception.map.write import read_map, write_map
from perception.types import PointCloud
from support.box_rooms import FURNISHED, map_of
from support.query_maps import encoders, write_map_of

NAMES = re.findall(r"`(perception\.[\w.]+)`", perception.__doc__ or "")
RESULTS = {"Description", "Neighbor", "Reply", "RobotPose", "ExportOptions"}
"""They hold values alone and raise nothing."""
KITCHEN = ["red mug", "banana", "laptop", "teapot", "kettle", "lamp", "violin", "anchor", "drum"]
SHAPE = re.compile(r"\[[A-Z\d][A-Z\d, +]*\]")


def named(name: str) -> Any:
    module, _, own = name.rpartition(".")
    return getattr(importlib.import_module(module), own)


def documented(thing: Any) -> list[tuple[str, Any]]:
    """The thing itself, and of a class its public methods and properties."""
    if not inspect.isclass(thing):
        return [(thing.__name__, thing)]
    own = [(name, value) for name, value in vars(thing).items() if not name.startswith("_")]
    members = [(name, getattr(value, "fget", value)) for name, value in own]
    return [(thing.__name__, thing), *((name, value) for name, value in members if inspect.isfunction(value))]


@pytest.fixture(scope="module")
def maps(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """kitchen.gsmap: nine balls a metre apart; room.gsmap: boxes on a floor; scan.ply: points of the kitchen."""
    folder = tmp_path_factory.mktemp("api")
    kitchen = read_map(write_map_of(folder / "kitchen.gsmap", KITCHEN, gaussians=3000))
    write_map(folder / "room.gsmap", map_of(FURNISHED))
    write_cloud(folder / "scan.ply", PointCloud(kitchen.means[kitchen.instance_ids >= 0][:900].astype(np.float64)))
    return folder


def test_the_list_is_whole() -> None:
    """What the package and `perception.query` offer is on it, and what README and the recipes import."""
    offered = {f"perception.{name}" for name in perception.__all__ if name != "__version__"}
    query = importlib.import_module("perception.query")
    offered |= {f"perception.query.{name}" for name in query.__all__ if name != "load_map"}
    assert offered <= set(NAMES) and len(NAMES) == len(set(NAMES))
    text = (Path(__file__).parents[1] / "docs/recipes.md").read_text(encoding="utf-8")
    listed = {name.rpartition(".")[2] for name in NAMES}
    used = re.findall(r"^ *from perception[\w.]* import (.+)$", text, re.M)
    assert used and {name for line in used for name in line.split(", ")} <= listed


@pytest.mark.parametrize("name", NAMES)
def test_shapes_and_errors_are_told(name: str) -> None:
    thing = named(name)
    failure = inspect.isclass(thing) and issubclass(thing, Exception)
    for own, value in documented(thing):
        text = inspect.getdoc(value)
        assert text, f"{name}: {own} has no docstring"
        if failure:
            continue
        signature = inspect.signature(value)
        arrays = [p.name for p in signature.parameters.values() if re.search("ndarray|Tensor", str(p.annotation))]
        takes = bool(arrays) or "ndarray" in str(signature.return_annotation)
        assert not takes or SHAPE.search(text), f"{name}: {own} takes or returns arrays and states no shape"
    if not failure and thing.__name__ not in RESULTS:
        text = inspect.getdoc(thing.__init__) if inspect.isclass(thing) else ""
        assert "InputError" in f"{thing.__doc__} {text}", f"{name}: what it raises is not said"


@pytest.mark.parametrize("name", [name for name in NAMES if not name.endswith("build_map")])
def test_examples_run(name: str, maps: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shutil.copytree(maps, tmp_path, dirs_exist_ok=True)
    run_example(name, tmp_path, monkeypatch)


@pytest.mark.slow
def test_a_map_is_built(small_scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shutil.copytree(small_scene, tmp_path / "table")
    run_example("perception.pipeline.mapping.build_map", tmp_path, monkeypatch)


def run_example(name: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In `folder`, with the names of its module; the encoder of the made maps stands in for that of the package."""
    for module in ("serve.engine", "query.map_store", "query.indexing"):
        monkeypatch.setattr(f"perception.{module}.make_encoder", encoders)
    monkeypatch.chdir(folder)
    thing = named(name)
    names = {**vars(inspect.getmodule(thing)), "perception": perception}
    example = doctest.DocTestParser().get_doctest(thing.__doc__, names, name, None, None)
    assert example.examples, f"{name} has no example"
    said: list[str] = []
    doctest.DocTestRunner(verbose=False).run(example, out=said.append)
    assert not said, "".join(said)
