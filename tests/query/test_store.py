"""A store of many maps: it answers as each map does alone, and is the old or the new one however its writer ends."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from perception import load_map
from perception.cli import main
from perception.errors import InputError
from perception.io.store import set_labels
from perception.query import Frame, QueryEngine, Where
from perception.query.store import QueryStore, StoredHit, index_maps
from support.query_maps import NAMES, HashEncoder, encoders, write_map_of

PROMPTS = [
    *NAMES,
    "red mug",
    "green banana",
    "wall",
    "floor",
    "a box that says OATS",
    "unicorn",
    "ball",
    "grandma's cup",
]


@pytest.fixture
def maps(tmp_path: Path) -> list[Path]:
    """Four maps: overlapping names, one with a name by the user, one with printed texts, one without a unit."""
    lists = [NAMES[:5], NAMES[3:], ["mug", "kettle", "mug"], [*NAMES[2:6], "box", "tin"]]
    paths = [write_map_of(tmp_path / f"{n}.gsmap", names, seed=n) for n, names in enumerate(lists)]
    set_labels(paths[1], {0: "grandma's cup"})
    edited(
        paths[3], "instances.json", lambda facts: facts["instances"][4].update(texts=[{"text": "OATS", "score": 0.9}])
    )
    edited(paths[3], "map.json", lambda facts: facts.setdefault("instances", {}).update(texts="test"))
    edited(paths[2], "map.json", lambda facts: facts.update(metric=False))
    return paths


def edited(path: Path, name: str, change: object) -> None:
    facts = json.loads((path / name).read_text())
    change(facts)  # type: ignore[operator]
    if name == "map.json":
        facts.pop("sha256", None)
    (path / name).write_text(json.dumps(facts))


def opened(store: Path) -> QueryStore:
    found = load_map(store, encoders)
    assert isinstance(found, QueryStore)
    return found


def test_every_instance_has_the_score_that_its_own_map_gives_it(maps: list[Path], tmp_path: Path) -> None:
    facts = index_maps(maps, tmp_path / "store")
    assert facts == {"added": 4, "replaced": 0, "unchanged": 0, "removed": 0, "maps": 4, "instances": 5 + 6 + 3 + 6}
    store = opened(tmp_path / "store")
    for prompt in PROMPTS:
        found = {(hit.map.name, hit.instance_id): hit.score for hit in store.query(prompt, 1000, min_score=0.0)}
        wanted = {}
        for path in maps:
            own = load_map(path, encoders)
            read = (
                path == maps[3]
            )  # a quoted text is looked for in all maps of a store, in a map only where texts were read
            if "OATS" in prompt and not read:
                continue
            wanted |= {(path.name, own.instances[n]["id"]): s for n, s in own.ranker.rank(prompt).hits}
        for key, score in wanted.items():
            assert found[key] == pytest.approx(score, abs=1e-6), (prompt, key)
        assert len(found) == 20


def test_a_hit_names_its_map_and_reads_its_points_there(maps: list[Path], tmp_path: Path) -> None:
    index_maps(maps, tmp_path / "store")
    (hit,) = opened(tmp_path / "store").query("anchor")
    assert isinstance(hit, StoredHit)
    (own,) = load_map(maps[1], encoders).query("anchor")
    assert (hit.map, hit.num_points, hit.instance_id) == (maps[1], len(own.points), own.instance_id)
    told, wanted = json.loads(json.dumps(hit.to_json())), own.to_json()
    assert {name: told[name] for name in wanted} == wanted
    assert set(told) - set(wanted) == {"map", "map_id", "frame", "metric"}
    np.testing.assert_array_equal(hit.points, own.points)
    np.testing.assert_array_equal(hit.colors(), own.colors())  # type: ignore[misc]
    store = opened(tmp_path / "store")
    (again,) = store.query("anchor")
    set_labels(maps[1], {2: "other"})
    with pytest.raises(InputError, match="is another map than the store's"):
        _ = again.points
    (again,) = store.query("anchor")
    maps[1].rename(tmp_path / "moved.gsmap")
    with pytest.raises(InputError, match=r"1\.gsmap"):
        _ = again.points


def test_maps_are_replaced_and_removed(maps: list[Path], tmp_path: Path) -> None:
    store = tmp_path / "store"
    index_maps(maps[:2], store)
    assert index_maps(maps, store)["unchanged"] == 2
    set_labels(maps[0], {1: "yellow thing"})
    facts = index_maps(maps, store)
    assert (facts["replaced"], facts["unchanged"]) == (1, 3)
    assert [hit.label for hit in opened(store).query("yellow thing")] == ["yellow thing"]
    facts = index_maps([], store, [maps[0]])
    assert (facts["removed"], facts["maps"]) == (1, 3) and not opened(store).query("yellow thing", min_score=0.99)


def test_bad_input_leaves_the_store_as_it_was(
    maps: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = tmp_path / "store"
    index_maps(maps[:1], store)
    before = {file: file.read_bytes() for file in store.rglob("*") if file.is_file()}
    write_map_of(tmp_path / "none.gsmap", NAMES[:2])
    (tmp_path / "none.gsmap" / "language.npz").unlink()
    with monkeypatch.context() as patch:
        patch.setattr(HashEncoder, "identity", "other")
        other = write_map_of(tmp_path / "other.gsmap", NAMES[:2])
    for path, told in (
        (tmp_path / "nowhere", "nowhere"),
        (tmp_path / "none.gsmap", "none.gsmap"),
        (other, r"other\.gsmap: has embeddings by 'other', those of .* by 'hash-test'; .*perception upgrade"),
        (store, "is a store of many maps"),
    ):
        with pytest.raises(InputError, match=told):
            index_maps([maps[1], path], store)
    with pytest.raises(InputError, match="is not in"):
        index_maps([maps[1]], store, [maps[2]])
    with pytest.raises(InputError, match="neither empty nor a store"):
        index_maps(maps, maps[0])
    with pytest.raises(InputError, match="no maps given"):
        index_maps([], tmp_path / "new")
    assert before == {file: file.read_bytes() for file in store.rglob("*") if file.is_file()}
    (next((store / "maps").iterdir())).write_bytes(b"PK broken")
    with pytest.raises(InputError, match="is damaged; delete it, and index its map again"):
        opened(store)


def test_what_holds_in_one_map_is_refused(maps: list[Path], tmp_path: Path) -> None:
    index_maps(maps, tmp_path / "store")
    store = opened(tmp_path / "store")
    for ask in (
        lambda: store.query("mug", where=Where(max_size=1.0)),
        lambda: store.query("mug", frame=Frame("arm", np.eye(4))),
        lambda: store.find(),
        lambda: store.nearest(np.zeros(3)),
        lambda: store.get(0),
        lambda: store.describe(0),
        lambda: store.means,
    ):
        with pytest.raises(InputError, match="one of"):
            ask()


def test_servers_answer_and_follow_the_store(maps: list[Path], tmp_path: Path) -> None:
    index_maps(maps[:1], tmp_path / "store")
    with QueryEngine(tmp_path / "store", encoders=encoders, watch=None) as engine:
        assert engine.health()["status"] == "ok" and engine.health()["instances"] == 5
        before = engine.ask("anchor")
        assert not before.hits and not engine.reload()
        index_maps(maps, tmp_path / "store")
        assert engine.reload()
        reply = engine.ask("anchor")
        assert reply.map_id != before.map_id
        assert reply.to_json()["hits"][0]["map"] == str(maps[1])


def test_the_commands(maps: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    store = str(tmp_path / "store")
    assert main(["index", *map(str, maps), "-o", store, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["maps"] == 4
    assert main(["query", store, "grandma's cup"]) == 2  # the encoder of these maps is none of the package's
    assert "hash" in capsys.readouterr().err
    assert main(["query", store, "mug", "--points", "x.ply"]) == 2
    capsys.readouterr()
    assert main(["index", "-o", store, "--remove", str(maps[0])]) == 0
    assert capsys.readouterr().out.startswith(f"{store}: 1 removed; ")


@pytest.mark.slow
def test_a_writer_that_is_killed_leaves_each_map_old_or_new(maps: list[Path], tmp_path: Path) -> None:
    """Killed after each of its renames in turn, and before it."""
    store = tmp_path / "store"
    index_maps(maps, store)
    code = (
        "import os, signal, sys; from pathlib import Path; import perception.io.atomic as atomic\n"
        "left, replace = [int(sys.argv[1])], Path.replace\n"
        "def dying(self, target):\n"
        "    left[0] -= 1\n"
        "    if left[0] == 0: os.kill(os.getpid(), signal.SIGKILL)\n"
        "    return replace(self, target)\n"
        "Path.replace = dying\n"
        "from perception.query.store import index_maps\n"
        "index_maps([Path(p) for p in sys.argv[3:]], Path(sys.argv[2]))"
    )
    for number in range(1, 6):
        for path in maps:
            set_labels(path, {0: f"thing {number}"})
        words = [sys.executable, "-c", code, str(number), str(store), *map(str, maps)]
        ended = subprocess.run(words, env=dict(os.environ), check=False)
        assert ended.returncode == -signal.SIGKILL
        labels = {facts["path"]: facts["instances"][0]["label"] for facts in opened(store).maps}
        new = [labels[str(path)] == f"thing {number}" for path in maps]
        assert sum(new) == max(0, number - 2) and new == sorted(new, reverse=True)
        facts = index_maps(maps, store)
        assert facts["replaced"] == 4 - sum(new)
        assert not [file for file in store.rglob("*") if file.name.startswith(".") or "tmp" in file.name]
