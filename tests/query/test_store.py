"""A store of many maps: it answers as its maps do one by one; what changes in it; what it refuses; kills."""

from __future__ import annotations

import json
import os
import pickle
import shutil
from collections.abc import Sequence
from copy import deepcopy
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import perception
from kills import children
from perception.cli import main
from perception.errors import InputError
from perception.language.base import Part, Reading
from perception.language.colors import palette
from perception.language.description import to_arrays
from perception.map.write import Map, read_map, set_labels, write_map
from perception.query import Where, load_map
from perception.query.indexing import index_maps
from perception.query.map_store import RECORD
from perception.serve.engine import QueryEngine
from support.query_maps import NAMES, HashEncoder, encoders, write_map_of
from support.views_at import views_at

PROMPTS = (
    *("mug", "red mug", "a colorful teapot", "blue and white lamp", "banana", "grandma's cup", "floor", "table", "box"),
    *("sofa", "oat milk carton", 'the carton that says "OAT MILK"', "mug that says BIRDS", "unheard-of thing"),
    *(
        "mug next to the banana",
        "mug next to the banana next to the laptop",
        "banana on the lamp",
        "lamp above the mug",
    ),
    *("banana left of the laptop", 'mug that says "BIRDS" next to the banana'),
)
SAME = 1e-6  # float32 products of other shapes are summed in another order


def looking_down() -> np.ndarray:
    pose = np.diag([1.0, -1, -1, 1])
    pose[:3, 3] = [-1, 1, 5]
    return pose


def write_varied(path: Path, seed: int) -> Path:
    """A map that knows, by its seed, more or less of itself: colours, metres, gravity, prints, labels."""
    rng = np.random.default_rng(seed)
    write_map_of(
        path, [str(name) for name in rng.permutation(NAMES)[: 4 + seed]], gaussians=600, seed=seed, first_id=seed
    )
    gmap = read_map(path)
    gmap.language["palettes"] = np.stack([palette(rng.integers(0, 256, (3, 3), np.uint8)) for _ in gmap.instances])
    gmap.language["view_counts"][1] = 0  # one that no photo shows
    for name in ("view_names", "view_boxes", "view_embeddings"):
        gmap.language[name] = np.delete(gmap.language[name], 1, axis=0)
    gmap.info["metric"] = seed != 1
    if seed != 1:
        gmap.info["gravity"] = {"direction": [0, 0, -1], "source": "test", "standard_error_deg": 1.0}
        gmap.views = views_at([looking_down(), looking_down()])
    if seed != 2:
        gmap.info["instances"] = {"texts": {}}
        gmap.instances[2]["texts"] = [{"text": "OAT M1LK", "score": 0.9}]
        gmap.instances[3]["texts"] = [{"text": ("BIRDS", "BIRD")[seed % 2], "score": 0.5 + seed / 10}]
    gmap.instances[0]["label"] = {0: None, 3: "mug next to the banana"}.get(seed, "Grandma's cup")
    write_map(path, gmap)
    return path


def write_empty(path: Path) -> Path:
    gmap = read_map(write_map_of(path))
    gmap.instances, gmap.language = [], to_arrays([], HashEncoder.identity)
    gmap.instance_ids[:] = -1
    write_map(path, gmap)
    return path


@pytest.fixture(scope="module")
def maps(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("maps")
    return [write_empty(folder / "0.gsmap"), *(write_varied(folder / f"{n + 1}.gsmap", n) for n in range(5))]


@pytest.fixture(scope="module")
def store(maps: list[Path]) -> Path:
    index_maps(maps[0].parent / "all.store", maps, encoders=encoders)
    return maps[0].parent / "all.store"


def one_by_one(maps: Sequence[Path], text: str, top: int, least: float | None, spec: Any = encoders) -> dict[Any, Any]:
    """{(map, instance): hit} of all maps, each asked alone."""
    return {(str(path), hit.instance_id): hit for path in maps for hit in opened(path, spec).query(text, top, least)}


opened = lru_cache(load_map)  # rankers are made once


def told(hit: Any) -> dict[str, Any]:
    return {
        key: value for key, value in hit.to_json().items() if key not in ("score", "map", "map_id", "frame", "metric")
    }


@pytest.mark.parametrize("text", PROMPTS)
def test_a_store_answers_as_its_maps_do_one_by_one(store: Path, maps: list[Path], text: str) -> None:
    many = opened(store, encoders)
    for least in (None, 0.0):
        hits, alone = many.query(text, 1000, least), one_by_one(maps, text, 1000, least)
        assert {(hit.map, hit.instance_id) for hit in hits} == alone.keys() and len(hits) == len(alone)
        assert [hit.score for hit in hits] == sorted((hit.score for hit in hits), reverse=True)
        for hit in hits:
            own = alone[hit.map, hit.instance_id]
            assert hit.score == pytest.approx(own.score, abs=SAME)
            assert told(hit) == told(own) and np.array_equal(hit.points, own.points)
            assert np.array_equal(hit.colors(), own.colors())
            assert (hit.frame, hit.metric) == ("map", opened(Path(hit.map), encoders).metric)
        assert [hit.instance_id for hit in many.query(text, 2, least)] == [hit.instance_id for hit in hits[:2]]


def test_a_name_that_says_not_is_found_by_it(tmp_path: Path) -> None:
    named = write_map_of(tmp_path / "a.gsmap", gaussians=200)
    set_labels(named, {2: "not for sale"})
    index_maps(tmp_path / "all.store", [named], encoders=encoders)
    for path in (named, tmp_path / "all.store"):
        assert [hit.instance_id for hit in load_map(path, encoders).query("Not for sale")] == [2]
        with pytest.raises(InputError, match="says what a thing is not"):
            load_map(path, encoders).query("not for rent")


def test_a_hit_is_copied_and_pickled_without_its_map(store: Path, maps: list[Path]) -> None:
    """As multiprocessing sends it to a planner's process: "cannot pickle '_thread.lock' object"."""
    for path in (maps[1], store):
        hit = load_map(path, encoders).query("kettle")[0]
        for same in (pickle.loads(pickle.dumps(hit)), deepcopy(hit)):
            assert same.to_json() == hit.to_json() and np.array_equal(same.points, hit.points)
            assert hit.colors is not None and np.array_equal(same.colors(), hit.colors())


def test_an_underscore_is_a_space(tmp_path: Path) -> None:
    """As in the names of classes and of ROS; "milk_carton" was another text, which other things answered."""
    write_map_of(tmp_path / "m.gsmap", ["milk carton", "red mug", "kettle"])
    set_labels(tmp_path / "m.gsmap", {2: "tea_pot"})
    index_maps(tmp_path / "all.store", [tmp_path / "m.gsmap"], encoders=encoders)
    for path in (tmp_path / "m.gsmap", tmp_path / "all.store"):
        asked = load_map(path, encoders)
        for text, number in (("milk_carton", 0), ("_red_mug ", 1), ("Tea pot", 2), ("tea_pot", 2)):
            assert [hit.instance_id for hit in asked.query(text)] == [number]
        with pytest.raises(InputError, match="lacks"):
            asked.query("mug_without_a_handle")


def test_the_prompts_above_are_about_something(maps: list[Path]) -> None:
    """Each kind of evidence changes scores in some of the maps, so that its absence from a store would be seen."""
    scores = {text: {key: hit.score for key, hit in one_by_one(maps, text, 1000, 0.0).items()} for text in PROMPTS}
    changed = lambda a, b: max(abs(scores[a][key] - scores[b][key]) for key in scores[a])  # noqa: E731
    assert changed("mug", "red mug") > 0.1 and changed("mug", "mug next to the banana") > 0.1
    assert changed("mug next to the banana", "mug next to the banana next to the laptop") > 0.1
    assert changed("mug", "mug that says BIRDS") > 0.1 and max(scores["grandma's cup"].values()) == 1
    assert max(scores["oat milk carton"].values()) > 0.8 and changed("floor", "sofa") > 0.1


class TwoParts(HashEncoder):
    """With two parts, canonical phrases and colours left in the prompt, as the other encoders have."""

    reading = Reading(
        (Part(100, 0.4, HashEncoder().encode_texts([str(n) for n in range(50)])[:, :100]), Part(256, 0.6)),
        (1.2, -0.9),
        canonical=("thing", "stuff"),
        colors=True,
    )


def test_other_readings_of_embeddings_answer_so_too(maps: list[Path], tmp_path: Path) -> None:
    spec = lambda _: TwoParts()  # noqa: E731
    index_maps(tmp_path / "s", maps, encoders=spec)
    for text in ("mug", "red mug", "lamp"):
        found = {(hit.map, hit.instance_id): hit.score for hit in load_map(tmp_path / "s", spec).query(text, 1000, 0.0)}
        alone = {key: hit.score for key, hit in one_by_one(maps, text, 1000, 0.0, spec).items()}
        assert found == pytest.approx(alone, abs=SAME)


def test_the_order_of_maps_and_of_questions_changes_no_answer(store: Path, maps: list[Path], tmp_path: Path) -> None:
    for path in maps[::-1]:
        index_maps(tmp_path / "s", [path], encoders=encoders)
    other, opened = load_map(tmp_path / "s", encoders), load_map(store, encoders)
    assert other.map_id == opened.map_id
    there = {text: [hit.to_json() for hit in opened.query(text)] for text in PROMPTS}
    assert {text: [hit.to_json() for hit in other.query(text)] for text in PROMPTS[::-1]} == there


def test_what_changed_is_replaced_and_what_is_removed_is_gone(maps: list[Path], tmp_path: Path) -> None:
    held = [Path(shutil.copytree(path, tmp_path / path.name)) for path in maps[1:4]]
    store = tmp_path / "s"
    assert index_maps(store, held[:2], encoders=encoders)["added"] == 2
    files, before = {f: f.stat().st_mtime_ns for f in (store / "maps").iterdir()}, load_map(store, encoders)
    set_labels(held[0], {0: "the chalice"})
    counts = index_maps(store, held, encoders=encoders)
    assert {key: counts[key] for key in ("added", "replaced", "unchanged", "removed")} == {
        **{"added": 1, "replaced": 1, "unchanged": 1, "removed": 0}
    }
    assert sum(file.stat().st_mtime_ns == files.get(file) for file in (store / "maps").iterdir()) == 1
    opened = load_map(store, encoders)
    assert [(hit.map, hit.instance_id) for hit in opened.query("The Chalice")] == [(str(held[0]), 0)]
    assert opened.map_id != before.map_id and not before.query("the chalice")
    with pytest.raises(InputError, match=r"1\.gsmap: has changed since"):
        _ = next(hit for hit in before.query("mug", 1000, 0.0) if hit.map == str(held[0])).points
    counts = index_maps(store, [], [held[0]], encoders=encoders)
    assert (counts["removed"], counts["maps"], len(list((store / "maps").iterdir()))) == (1, 2, 2)
    assert not load_map(store, encoders).query("the chalice")
    with pytest.raises(InputError, match="is not one of the 2 maps"):
        index_maps(store, [], [held[0]], encoders=encoders)
    before = contents(store)
    with pytest.raises(InputError, match="would hold no map"):
        index_maps(store, [], held[1:], encoders=encoders)
    assert contents(store) == before


def contents(store: Path) -> dict[str, bytes]:
    return {str(file.relative_to(store)): file.read_bytes() for file in store.rglob("*") if file.is_file()}


@pytest.mark.parametrize("kind", ["missing", "no map", "other encoder", "no embeddings", "a store"])
def test_a_map_that_cannot_be_had_leaves_the_store_as_it_was(maps: list[Path], tmp_path: Path, kind: str) -> None:
    store, bad = tmp_path / "s", tmp_path / "bad.gsmap"
    index_maps(store, maps[1:3], encoders=encoders)
    before = contents(store)
    if kind == "a store":
        bad = store
    elif kind == "no map":
        bad.mkdir()
    elif kind != "missing":
        gmap: Map = read_map(maps[1])
        gmap.language = {} if kind == "no embeddings" else {**gmap.language, "encoder": np.array("another")}
        write_map(bad, gmap)
    with pytest.raises(InputError, match=bad.name) as error:
        index_maps(store, [bad], [maps[2]], encoders=encoders)
    assert "\n" not in str(error.value) and contents(store) == before


def test_maps_that_cannot_be_had_are_named_and_the_others_indexed(
    maps: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """One of them was in the store, and stays in it as it was."""
    monkeypatch.setattr("perception.query.indexing.make_encoder", encoders)
    store, wordless = tmp_path / "s", Path(shutil.copytree(maps[1], tmp_path / "wordless.gsmap"))
    index_maps(store, [wordless], encoders=encoders)
    gmap = read_map(wordless)
    gmap.language, gmap.instances[0]["label"] = {}, "the chalice"
    write_map(wordless, gmap)
    bad = [wordless, tmp_path / "none.gsmap"]
    assert main(["index", *map(str, (*maps[2:4], *bad)), "-o", str(store), "--json"]) == 2
    out, err = capsys.readouterr()
    said = err.splitlines()
    assert out == ""
    assert said[-1] == "error: index: 2 of 4 maps were left out; mend them and run it again"
    assert all(line.startswith(f"{path}: ") for line, path in zip(said[-3:-1], bad, strict=True))
    assert [entry["map"] for entry in load_map(store, encoders).maps] == sorted(map(str, (wordless, *maps[2:4])))
    clean = index_maps(tmp_path / "t", maps[2:4], encoders=encoders)
    held = load_map(store, encoders).counts["instances"] - len(read_map(maps[1]).instances)
    assert held == clean["instances"] and clean["left_out"] == []


def test_embeddings_of_another_encoder_are_refused_at_the_prompt(store: Path) -> None:
    class Newer(HashEncoder):
        identity = "hash-test-2"

    opened = load_map(store, lambda _: Newer())
    assert opened.problem is not None and "hash-test-2" in opened.problem
    with pytest.raises(InputError, match="made by 'hash-test'"):
        opened.query("mug")


def test_what_lies_there_is_not_taken_for_a_store(maps: list[Path], tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes.txt").write_text("mine")
    for place in (tmp_path / "mine", maps[1]):
        with pytest.raises(InputError, match="is no store"):
            index_maps(place, maps[1:], encoders=encoders)
    assert [item.name for item in (tmp_path / "mine").iterdir()] == ["notes.txt"]
    inside = tmp_path / "project" / "maps"
    shutil.copytree(maps[1], inside / "a.gsmap")
    with pytest.raises(InputError, match="maps: holds what is not of a store"):
        index_maps(inside.parent, [inside / "a.gsmap"], encoders=encoders)
    assert [item.name for item in inside.iterdir()] == ["a.gsmap"]


def test_only_files_of_the_store_are_removed_from_it(maps: list[Path], tmp_path: Path) -> None:
    store, inside = tmp_path / "s", tmp_path / "s" / "maps"
    index_maps(store, maps[1:3], encoders=encoders)
    kept = [store / "notes.txt", inside / "plan.pdf", inside / f"{'0' * 32}.npz"]
    for file in kept:
        file.write_text("mine")
    unfinished = inside / f".{'0' * 32}.npz.new-999999999-0a1b2c3d"
    unfinished.touch()
    shutil.copy(next(file for file in inside.iterdir() if file.stat().st_size > 100), inside / f"{'a' * 32}.npz")
    (inside / "photos").symlink_to(tmp_path)
    index_maps(store, [maps[3]], maps[1:2], encoders=encoders)
    assert all(file.read_text() == "mine" for file in kept) and (inside / "photos").is_symlink()
    assert len(list(inside.iterdir())) == 2 + 3 and not unfinished.exists()


def test_without_the_maps_folder_all_but_points_is_answered(maps: list[Path], tmp_path: Path) -> None:
    path = Path(shutil.copytree(maps[1], tmp_path / "a.gsmap"))
    index_maps(tmp_path / "s", [path], encoders=encoders)
    alone = one_by_one([path], "mug", 5, 0.0)
    shutil.rmtree(path)
    hits = load_map(tmp_path / "s", encoders).query("mug", 5, 0.0)
    assert [told(hit) for hit in hits] == [told(hit) for hit in alone.values()]
    with pytest.raises(InputError, match=r"a\.gsmap: the map is gone"):
        _ = hits[0].points


def test_what_is_written_into_a_hit_changes_no_other_answer(store: Path) -> None:
    opened = load_map(store, encoders)
    first, before = opened.query("mug", 1, 0.0)[0], opened.query("mug", 1, 0.0)[0].to_json()
    for array in (first.centroid, first.covariance, first.obb.center, first.obb.extent):
        array += 1
    assert opened.query("mug", 1, 0.0)[0].to_json() == before != first.to_json()


def test_the_views_of_a_map_are_read_once_for_all_hits(store: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    opened, read = load_map(store, encoders), list[int]()
    expected = [hit.views for hit in opened.query("mug", 1000, 0.0)]
    fresh, parse = load_map(store, encoders), json.loads
    monkeypatch.setattr("json.loads", lambda text: read.append(len(text)) or parse(text))
    assert [hit.views for hit in fresh.query("mug", 1000, 0.0)] == expected
    assert len(expected) > 20 and len(read) <= len(fresh.maps)


def test_a_hit_in_a_frame_with_another_unit_is_not_metric(store: Path) -> None:
    hits = load_map(store, encoders).query("mug", min_score=0.0)
    assert {hit.metric for hit in hits} == {True, False}
    for hit in hits:
        turned, larger = (hit.transformed(np.diag([s, s, s, 1.0])) for s in (1.0, 1000.0))
        assert (turned.metric, larger.metric) == (hit.metric, False)


def test_damage_is_told_in_one_line(maps: list[Path], tmp_path: Path) -> None:
    index_maps(tmp_path / "s", maps[1:3], encoders=encoders)
    files = [tmp_path / "s" / "store.json", *(tmp_path / "s" / "maps").iterdir()]
    for file in files:
        whole = file.read_bytes()
        flipped = bytearray(whole)
        flipped[len(whole) // 3] ^= 0xFF  # within the embeddings
        for damaged in (b"", whole[: len(whole) // 2], bytes(flipped) if file.suffix == ".npz" else b"[]"):
            file.write_bytes(damaged)
            with pytest.raises(InputError, match=file.name):
                load_map(tmp_path / "s", encoders)
        file.write_bytes(whole)
    facts = json.loads(files[0].read_text())
    for change in ({"format_version": 99}, {"encoder": None}, {"maps": [{**facts["maps"][0], "file": "../x"}]}):
        files[0].write_text(json.dumps({**facts, **change}))
        with pytest.raises(InputError, match=r"store\.json"):
            load_map(tmp_path / "s", encoders)


def test_a_file_of_a_store_that_fits_nothing_is_told_in_one_line(maps: list[Path], tmp_path: Path) -> None:
    """Whole, but with other arrays than `indexing` writes: told at opening, at the first prompt or at the first hit."""
    index_maps(tmp_path / "s", maps[1:2], encoders=encoders)
    file = next((tmp_path / "s" / "maps").iterdir())
    good = dict(np.load(file))

    def told(name: str, array: np.ndarray | None) -> None:
        changed = {**good, name: array}
        np.savez(file, **{key: value for key, value in changed.items() if value is not None})
        with pytest.raises(InputError, match="cannot be read as a store"):
            load_map(tmp_path / "s", encoders).query("book next to the lamp", min_score=0.0)

    for name, array in good.items():
        told(name, array[..., None])
        told(name, np.full(array.shape, "x"))
        if name != "places":
            told(name, None)
    broken = good["told"].copy()
    broken.view(RECORD)["centroid"] = np.nan
    told("told", broken)
    for name, value in (("views", 5), ("views", [[5]]), ("views", [["a"]]), ("names", {})):
        told(name, np.frombuffer(json.dumps(value).encode(), np.uint8))


def test_what_needs_one_map_says_so(store: Path) -> None:
    opened = perception.load_map(store, encoders)
    for question in (
        lambda: opened.nearest([0, 0, 0]),
        lambda: opened.find(),
        lambda: opened.instance_at([0, 0, 0]),
        lambda: opened.describe(0),
        lambda: opened.free_space,
        lambda: opened.query("mug", where=Where(max_size=1)),
        lambda: read_map(store),
    ):
        with pytest.raises(InputError, match=r"all\.store: is a store"):
            question()


def test_the_commands(maps: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any) -> None:
    for module in ("map_store", "indexing"):
        monkeypatch.setattr(f"perception.query.{module}.make_encoder", encoders)
    store = str(tmp_path / "s")

    def said(*words: object) -> Any:
        assert main([*map(str, words), "--json"]) == 0
        return json.loads(capsys.readouterr().out)

    assert said("index", *maps, "-o", store) == {
        **{"store": store, "added": 6, "replaced": 0, "unchanged": 0, "removed": 0, "maps": 6, "instances": 30}
    }
    absent = next(f"thing {n}" for n in range(100) if not one_by_one(maps, f"thing {n}", 1, None))
    answer = said("query", store, "grandma's cup", absent)
    assert (answer["frame"], answer["metric"]) == (None, None)
    assert [result["present"] for result in answer["results"]] == [True, False]
    for hit in answer["results"][0]["hits"]:
        alone = said("query", hit["map"], "grandma's cup")
        (same,) = (other for other in alone["results"][0]["hits"] if other["instance_id"] == hit["instance_id"])
        more = {"map": hit["map"], "map_id": load_map(hit["map"]).map_id}
        assert hit == {**same, **more, "frame": alone["frame"], "metric": alone["metric"]}
    assert main(["query", store, "grandma's cup"]) == 0
    assert f" in {maps[2]}" in capsys.readouterr().out
    assert main(["query", store, absent]) == 0 and capsys.readouterr().out == f'"{absent}": not present\n'
    for words in (
        ["query", store, "mug", "--min-score", "0", "--points", "x.ply"],
        ["query", store, absent, "--points", "x.ply"],
        ["info", store],
        ["index", "-o", store],
    ):
        assert main(words) == 2 and capsys.readouterr().err.count("\n") == 1
    assert said("index", "--remove", maps[0], "-o", store)["maps"] == 5


def test_a_server_answers_from_a_store_and_takes_over_a_new_one(maps: list[Path], tmp_path: Path) -> None:
    pytest.importorskip("fastapi", reason="the extra 'serve' is not installed")
    from starlette.testclient import TestClient

    from perception.serve.app import build_app
    from perception.serve.requests import ServeSettings

    index_maps(tmp_path / "s", maps[1:3], encoders=encoders)
    with QueryEngine(tmp_path / "s", encoders=encoders, watch=None) as engine:
        client = TestClient(build_app(engine, ServeSettings()), base_url="http://127.0.0.1:8765")
        answer = client.post("/query", json={"text": ["grandma's cup", "mug"], "min_score": 0.5}).json()
        assert {hit["map"] for hit in answer["results"][0]["hits"]} == {str(maps[2])} and answer["frame"] is None
        refused = client.post("/nearest", json={"near": [0, 0, 0]})
        assert refused.status_code == 400 and "is a store of many maps" in refused.json()["error"]
        health = client.get("/health").json()
        assert (health["status"], health["maps"], health["instances"]) == ("ok", 2, 9)
        assert not engine.reload()
        index_maps(tmp_path / "s", maps, encoders=encoders)
        assert engine.reload() and len(engine.ask("grandma's cup").hits) > 1


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "pidfd_open"), reason="the harness needs Linux")
def test_a_killed_index_leaves_the_old_store_or_the_new_one(maps: list[Path], tmp_path: Path) -> None:
    """Killed at every change that it makes to the file system; then run again."""
    old, first = tmp_path / "old", Path(shutil.copytree(maps[1], tmp_path / "first.gsmap"))
    index_maps(old, [first, maps[2], maps[3]], encoders=encoders)
    set_labels(first, {0: "the chalice"})

    def work(place: Path) -> int:
        held = [entry["map"] for entry in json.loads((place / "s" / "store.json").read_text())["maps"]]
        gone = [maps[3]] if str(maps[3]) in held else []
        index_maps(place / "s", [first, maps[2], maps[4]], gone, encoders=encoders)
        return 0

    def laid_out(name: str) -> Path:
        shutil.copytree(old, tmp_path / name / "s")
        return tmp_path / name

    def answers(place: Path) -> list[Any]:
        opened = load_map(place / "s", encoders)
        return [opened.map_id, *([hit.to_json() for hit in opened.query(text, 1000, 0.0)] for text in PROMPTS[:3])]

    before, place = answers(laid_out("before")), laid_out("whole")
    _, changes = children.watch(lambda: work(place), place)
    whole, files = answers(place), sorted(contents(place))
    assert len(changes) > 8 and whole != before
    seen = []
    for number in range(1, len(changes) + 1):
        place = laid_out(str(number))
        end = children.run(lambda place=place: work(place), place, children.Moment(0, number))
        assert end.killed, end.said
        seen.append(answers(place))
        assert children.run(lambda place=place: work(place), place).code == 0
        assert answers(place) == whole and sorted(contents(place)) == files
    assert all(state in (before, whole) for state in seen) and seen[0] == before and seen[-1] == whole


def test_a_link_to_a_folder_that_is_not_there_yet_becomes_a_store_there(maps: list[Path], tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to("there")
    assert index_maps(tmp_path / "link", maps[1:2], encoders=encoders)["added"] == 1
    assert (tmp_path / "there" / "store.json").is_file() and (tmp_path / "link").is_symlink()
