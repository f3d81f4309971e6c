"""docs/recipes.md: every snippet runs, in order, and finds what the map is known to hold."""

from __future__ import annotations

import json
import re
import shlex
import shutil
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.request import urlopen

import numpy as np
import pytest

from support.paths import REPOSITORY
from support.query_maps import encoders, write_map_of

pytest.importorskip("starlette", reason="the extra 'serve' is not installed")
from perception.cli import build_parser
from perception.io.cloud import read_cloud
from perception.map.write import read_map
from perception.query import load_map
from support.processes import served
from support.synthetic_map import SIGMA

PAGE = (REPOSITORY / "docs" / "recipes.md").read_text(encoding="utf-8")
NAMES = ["red mug", "banana", "laptop", "teapot", "kettle", "lamp", "violin", "anchor", "drum"]
SNIPPETS = re.findall(r"```(\w+)\n(.*?)```", PAGE, re.DOTALL)


@pytest.fixture(scope="module")
def kitchen(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_map_of(tmp_path_factory.mktemp("recipes") / "kitchen.gsmap", NAMES, gaussians=3000)


@pytest.fixture(scope="module")
def world(kitchen: Path) -> Iterator[dict[str, Any]]:
    """The names after all Python snippets have run, a server at the port they speak of."""
    before = read_map(kitchen)
    patch = pytest.MonkeyPatch()
    for module in ("serve.engine", "query.map_store", "query.indexing"):
        patch.setattr(f"perception.{module}.make_encoder", encoders)
    patch.chdir(kitchen.parent)
    names: dict[str, Any] = {"before": before}
    free, far = np.ones((2, 2, 5), np.uint8), np.arange(20, dtype=np.float32).reshape(2, 2, 5) / 10
    np.savez("space.npz", occupancy=free, esdf=far, origin=np.array([0, 0, -0.25]), voxel_size=0.1, unit="m")
    try:
        with served(kitchen) as (_, port):
            for kind, code in SNIPPETS:
                if "urlopen" in code:
                    _wait_for_labels(port)
                if kind == "python":
                    exec(compile(code.replace(":8765", f":{port}"), "recipes.md", "exec"), names)
            yield names
    finally:
        patch.undo()


def _wait_for_labels(port: int) -> None:
    """Until the server has taken over the labels that an earlier snippet gave; else an answer's map may be replaced."""
    written, deadline = load_map("kitchen.gsmap").map_id, time.monotonic() + 20
    while time.monotonic() < deadline:
        with urlopen(f"http://127.0.0.1:{port}/health", timeout=30) as answer:
            health = json.load(answer)
            if health["map_id"] == written:
                return
        time.sleep(0.05)
    raise AssertionError(f"the server never took over map {written}: {health}")


def members(world: dict[str, Any], number: int) -> np.ndarray:
    return world["before"].means[world["before"].instance_ids == number]


def test_the_page_has_snippets_of_both_kinds() -> None:
    assert {kind for kind, _ in SNIPPETS} == {"python", "sh"} and len(SNIPPETS) >= 11


def test_the_mug_is_found_and_moved(world: dict[str, Any]) -> None:
    points, move = members(world, 0), world["base_from_map"]
    assert world["mug"].instance_id == 0 and np.array_equal(world["mug"].points, points)
    expected = points @ move[:3, :3].T + move[:3, 3]
    for hit in (world["mug_in_base"], world["same"]):
        assert hit.frame == "base_link" and np.allclose(hit.points, expected, atol=1e-5)
    assert np.isclose(world["length"], max(world["mug"].obb.extent) * 2.03 / 4.1)


def test_the_slice_is_that_through_zero(world: dict[str, Any]) -> None:
    assert world["level"] == 2  # -0.25 + 2 · 0.1 ≤ 0 < -0.25 + 3 · 0.1
    assert world["safe"].tolist() == [[False, True], [True, True]]  # 0.2, 0.7, 1.2, 1.7 away


def test_filters_leave_what_lies_there(world: dict[str, Any]) -> None:
    assert next(hit.instance_id for hit in world["on_counter"]) == 0
    assert {hit.instance_id for hit in world["on_counter"]} <= {0, 1, 2}
    reach = [k for k in range(9) if np.linalg.norm(members(world, k), axis=1).min() <= 1.5]
    assert [hit.instance_id for hit in world["graspable"]] == reach
    assert [hit.instance_id for hit in world["in_kitchen"]] == [0, 1, 3, 4]


def test_places_are_judged_right(world: dict[str, Any]) -> None:
    robot = np.linalg.inv(world["base_from_map"])[:3, 3]
    gaps = {k: np.linalg.norm(members(world, k) - robot, axis=1).min() for k in range(9)}
    assert [hit.instance_id for hit in world["nearest"]] == sorted(gaps, key=lambda k: gaps[k])[:3]
    assert np.isclose(world["clearance"], min(gaps.values()))
    assert [hit.instance_id for hit in world["blocking"]] == [1]
    assert world["pointed"].instance_id == 4 and world["thing"].hit.instance_id == 4
    assert np.allclose(world["spread"], SIGMA, rtol=0.2) and np.isclose(np.linalg.norm(world["axis"]), 1)
    assert world["goal"] is None  # the map has no gravity; places are tested in test_standing.py


def test_labels_engine_and_http_answer_alike(world: dict[str, Any]) -> None:
    assert world["cup"].instance_id == 0 and [hit.instance_id for hit in world["named"]] == [0]
    assert world["reply"].hits[0].instance_id == 0 and world["reply"].frame == "base_link"
    assert world["closest"][0].instance_id == world["nearest"][0].instance_id
    assert world["health"]["status"] == "ok" and world["health"]["answered"] == 2
    assert [result["hits"][0]["instance_id"] for result in world["answer"]["results"]] == [0, 3]
    assert np.array_equal(world["points"], members(world, 0))


@pytest.mark.slow
def test_shell_lines_do_what_they_say(kitchen: Path, tmp_path: Path) -> None:
    lines = [line for kind, code in SNIPPETS if kind == "sh" for line in code.strip().splitlines()]
    commands = [shlex.split(line)[1:] for line in lines if line.startswith("perception ")]
    named = [build_parser().parse_args(words).command for words in commands]
    assert named == ["localise", "localise", "serve", "mcp", "mcp"]
    if shutil.which("curl") is None or shutil.which("bash") is None:
        pytest.skip("no curl here")
    out = []
    with served(kitchen) as (_, port):
        for line in (line.replace(":8765", f":{port}") for line in lines if line.startswith("curl ")):
            done = subprocess.run(["bash", "-c", line], capture_output=True, text=True, cwd=tmp_path)
            assert done.returncode == 0, done.stderr
            out.append(done.stdout)
    assert json.loads(out[0])["results"][0]["hits"][0]["instance_id"] == 0
    assert json.loads(out[1])["hits"][0]["instance_id"] == 0 and len(json.loads(out[1])["hits"]) == 2
    assert json.loads(out[4])["status"] == "ok"
    assert len(read_cloud(tmp_path / "mug.ply").points) == json.loads(out[0])["results"][0]["hits"][0]["num_points"]
