"""The record of visits: what changed, what is gone, and the map as of an earlier visit, against a made map of three."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from perception.cli import main
from perception.edit.editor import Editor
from perception.edit.scale import scaled
from perception.errors import InputError
from perception.map.history import Visit, change_in, changes_of, date_of, joined_record, visits_of
from perception.map.map import Map
from perception.map.write import read_map, set_labels, write_map
from perception.query import QueryMap, load_map
from support.query_maps import encoders
from support.visited_map import NAMES, SEEN, STATES, STOOD, TIMES, ball, cell, number, write_visited_map


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_visited_map(tmp_path_factory.mktemp("visits") / "a.gsmap")


@pytest.fixture(scope="module")
def gmap(path: Path) -> QueryMap:
    return load_map(path, encoders)


def truth(since: int) -> dict[int, str]:
    """The state of each thing against visit `since`, from the table of cells."""
    states = {}
    for name in NAMES[:-1]:
        then, now = STOOD[since].get(name), STOOD[2].get(name)
        if now is None and then is not None:
            states[number(name)] = "removed"
        elif now is not None:
            same = then == now and all(STOOD[v].get(name) == now for v in range(since, 3))
            seen = "unchanged" if SEEN.get(name, 2) >= min(since + 1, 2) else "unseen"
            states[number(name)] = "added" if then is None else seen if same else "moved"
    return states | {number("shelf"): "unchanged"}


@pytest.mark.parametrize("since", [0, 1, 2])
def test_changes_are_those_of_the_table(gmap: QueryMap, since: int) -> None:
    changes = {change["instance_id"]: change for change in gmap.changes(since)}
    assert {i: change["state"] for i, change in changes.items()} == truth(since)
    for name in NAMES[:-1]:
        change, then, now = changes.get(number(name)), STOOD[since].get(name), STOOD[2].get(name)
        if change is None:
            continue
        for key, where in (("old_centroid", then), ("new_centroid", now)):
            expected = None if where is None else ball(name, where).astype(np.float64).mean(axis=0)
            assert change[key] is expected is None or np.allclose(change[key], expected, atol=1e-5)
        assert change["last_seen"] == SEEN.get(name, 2)
        if change["transform"] is not None and then is not None and now is not None:
            assert np.allclose(np.array(change["transform"])[:3, 3], cell(now) - cell(then))


def test_motions_of_several_visits_are_one(gmap: QueryMap) -> None:
    turn = np.array([[0.0, -1, 0, 1], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    shift = np.eye(4)
    shift[:3, 3] = [0, 2, 1]
    lamp = next(entry for entry in gmap.instances if entry["id"] == number("lamp"))
    first = {**lamp["past"][0], "until": 0, "transform": turn.tolist()}
    second = {**lamp["past"][0], "until": 1, "transform": shift.tolist()}
    change = changes_of(gmap.visits, [{**lamp, "past": [first, second]}], 0)[0]
    assert np.allclose(change["transform"], shift @ turn)


@pytest.mark.parametrize(("turn", "off", "state"), [(0, 0.04, "unchanged"), (0, 0.3, "moved"), (20, 0, "moved")])
def test_what_moved_and_went_back_is_unchanged(gmap: QueryMap, turn: float, off: float, state: str) -> None:
    lamp = next(entry for entry in gmap.instances if entry["id"] == number("lamp"))
    box = {"center": [3.0, 0, 0], "rotation": np.eye(3).tolist(), "extent": [1.0, 1, 1]}
    away, back = np.eye(4), np.eye(4)
    away[:3, 3], back[:3, 3] = [0, 2, 1], [off, -2, -1]
    c, s = np.cos(np.radians(turn)), np.sin(np.radians(turn))
    about = np.array([[c, -s, 0, 3 - 3 * c], [s, c, 0, -3 * s], [0, 0, 1, 0], [0, 0, 0, 1]])  # the box's centre
    spots = [{**lamp["past"][0], "until": n, "transform": m.tolist()} for n, m in enumerate((away, about @ back))]
    entry = {**lamp, "obb": box, "centroid": box["center"], "past": spots}
    assert [changes_of(gmap.visits, [entry], start)[0]["state"] for start in (0, 1)] == [state, "moved"]
    sure = [{**spots[0], "ambiguous": True}, spots[1]]
    assert changes_of(gmap.visits, [{**entry, "past": sure}], 0)[0]["state"] == "moved"


def test_a_gone_thing_is_no_hit_and_is_named(gmap: QueryMap) -> None:
    assert gmap.query("mug") == []
    assert number("mug") not in {hit.instance_id for hit in gmap.find()}
    (gone,) = gmap.gone("mug")
    assert (gone.instance_id, gone.state, gone.since, gone.last_seen) == (number("mug"), "removed", 1, 0)
    assert gone.stood == ("on", number("shelf"))
    assert np.array_equal(gone.points, ball("mug", 0)) and gmap.gone("lamp") == []
    with pytest.raises(InputError, match="was not there at visit 2"):
        gmap.get(number("mug"))


def test_a_name_of_a_gone_thing_is_known_without_any_encoder(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    gmap = read_map(write_visited_map(tmp_path / "a.gsmap"))
    gmap.language = {}
    write_map(tmp_path / "a.gsmap", gmap)
    set_labels(tmp_path / "a.gsmap", {number("mug"): "my cup", number("lamp"): "my lamp"})
    opened = load_map(tmp_path / "a.gsmap")
    assert opened.query("My cup") == [] and [hit.instance_id for hit in opened.gone("My cup")] == [number("mug")]
    assert [hit.instance_id for hit in opened.at(0).query("my cup")] == [number("mug")]
    assert [hit.instance_id for hit in opened.query("my lamp")] == [number("lamp")] and opened.gone("my lamp") == []
    set_labels(tmp_path / "a.gsmap", {number("shelf"): "grandma's shelf"})
    assert main(["query", str(tmp_path / "a.gsmap"), "my cup"]) == 0
    assert "stood on grandma's shelf (instance 17)" in capsys.readouterr().out
    with pytest.raises(InputError, match="no language"):
        opened.query("cup")


def test_the_free_space_is_todays_as_of_every_visit(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("perception.query.free_space.FreeSpace", lambda gmap: (gmap, len(gmap.instances)))
    today = load_map(path, encoders)
    for then in (today.at(0), today.at(1), today.at(0).at(1), today.last_known):
        assert then.free_space == (today, len(STOOD[2]) + 1)  # and the shelf


@pytest.mark.parametrize("name", [name for name in STATES if name != "mug"])
def test_a_hit_has_its_state_and_where_it_was(gmap: QueryMap, name: str) -> None:
    hit = gmap.query(name)[0]
    assert (hit.instance_id, hit.state, hit.last_seen) == (number(name), STATES[name], SEEN.get(name, 2))
    before = [STOOD[v].get(name) for v in (0, 1)]
    moved = name in ("banana", "lamp")
    assert (hit.was is not None) == moved
    if hit.was is not None:
        assert np.allclose(hit.was, ball(name, before[0] or 0).astype(np.float64).mean(axis=0), atol=1e-5)
        shifted = hit.transformed(np.diag([2.0, 2, 2, 1])).was
        assert shifted is not None and np.allclose(shifted, 2 * hit.was)


@pytest.mark.parametrize("visit", [0, 1, 2])
def test_the_map_as_of_a_visit(gmap: QueryMap, visit: int) -> None:
    then = gmap.at(visit)
    known = {number(name): ball(name, k) for name, k in STOOD[visit].items()}
    hits = {hit.instance_id: hit for hit in then.find()}
    assert hits.keys() == known.keys() | {number("shelf")}
    for i, points in known.items():
        assert np.array_equal(hits[i].points, points)
        assert np.allclose(hits[i].centroid, points.astype(np.float64).mean(axis=0), atol=1e-5)
        assert hits[i].colors is not None and len(hits[i].colors()) == len(points)
        assert then.nearest(points.mean(axis=0))[0].instance_id == i
    missing = [number(n) for n in ("mug", "teapot") if n not in STOOD[visit] and n in STOOD[0]]
    assert [hit.instance_id for n in ("mug", "teapot") for hit in then.gone(n)] == missing


@pytest.mark.parametrize(
    ("key", "value", "word"),
    [
        ("state", "lost", "state"), ("confidence", 2, "confidence"), ("last_seen", 3, "last_seen"),
        ("past", [], "past"), ("past", {}, "past"), ("num_gaussians", 1, "past"), ("past", [{"until": 2}], "past[0]"),
        ("first_seen", -1, "first_seen"),
    ],
)  # fmt: skip
def test_a_wrong_record_is_refused(path: Path, tmp_path: Path, key: str, value: Any, word: str) -> None:
    gmap = read_map(path)
    write_map(tmp_path / "b.gsmap", gmap)
    file = tmp_path / "b.gsmap" / "instances.json"
    whole = json.loads(file.read_text())
    whole["instances"][0][key] = value
    file.write_text(json.dumps(whole))
    with pytest.raises(InputError, match=r"instances\.json: ") as error:
        Map.open(tmp_path / "b.gsmap")
    assert word in str(error.value) and "\n" not in str(error.value)


def test_wrong_visits_and_wrong_past_points_are_refused(path: Path, tmp_path: Path) -> None:
    gmap = read_map(path)
    gmap.info["visits"][1]["time"] = "yesterday"
    write_map(tmp_path / "b.gsmap", gmap)
    with pytest.raises(InputError, match=r"map\.json: visits\[1\].time: expected a time in UTC"):
        Map.open(tmp_path / "b.gsmap")
    gmap.info["visits"][1]["time"] = None
    gmap.past["ids"][0] = 17
    write_map(tmp_path / "c.gsmap", gmap)
    with pytest.raises(InputError, match=r"past\.npz: ids: instance 17 has no past until visit 0"):
        Map.open(tmp_path / "c.gsmap").past  # noqa: B018


def test_a_map_of_one_visit_has_no_changes(tmp_path: Path) -> None:
    from support.query_maps import write_map_of

    gmap = load_map(write_map_of(tmp_path / "one.gsmap"), encoders)
    assert {change["state"] for change in gmap.changes()} == {"unchanged"}
    assert gmap.gone("mug") == [] and gmap.query("mug")[0].state is None and gmap.visits_json() == {}
    assert "state" not in gmap.query("mug")[0].to_json()


def test_dates_of_one_day_have_a_time() -> None:
    visits = [Visit(n, time, "", 1) for n, time in enumerate((*TIMES, "2026-11-25T21:00:00Z", None))]
    assert [date_of(visits, n) for n in (0, 2, 3, 4)] == [
        "2026-11-23",
        "2026-11-25 19:41",
        "2026-11-25 21:00",
        "visit 4",
    ]
    twice = [Visit(n, TIMES[2], "", 1) for n in range(2)]  # the same photos again
    assert [date_of(twice, n) for n in (0, 1)] == ["2026-11-25 19:41 (visit 0)", "2026-11-25 19:41 (visit 1)"]


def test_edits_keep_the_record_consistent(path: Path, tmp_path: Path) -> None:
    copy = tmp_path / "b.gsmap"
    write_map(copy, read_map(path))
    editor = Editor(copy)
    editor.rename(number("mug"), "grandma's cup")
    new = editor.merge([number("banana"), number("violin")])
    editor.remove(number("lamp"))
    with pytest.raises(InputError, match="is gone"):
        editor.merge([number("mug"), number("drum")])
    with pytest.raises(InputError, match="is gone"):
        editor.split(number("mug"))
    editor.save()
    edited = load_map(copy, encoders)
    assert [hit.label for hit in edited.gone("grandma's cup")] == ["grandma's cup"]
    merged = edited.get(new)
    assert (merged.state, merged.last_seen, merged.was) == ("unchanged", 2, None)
    assert set(edited.past["ids"].tolist()) == {number("mug"), number("teapot")}
    assert number("lamp") not in {change["instance_id"] for change in edited.changes(0)}


def test_scaling_scales_the_past(path: Path, tmp_path: Path) -> None:
    write_map(tmp_path / "b.gsmap", scaled(read_map(path), 3.0))
    grown = load_map(tmp_path / "b.gsmap", encoders)
    assert np.allclose(grown.at(0).get(number("banana")).points, 3 * ball("banana", 1), atol=1e-5)
    change = next(c for c in grown.changes(0) if c["instance_id"] == number("banana"))
    assert np.allclose(np.array(change["transform"])[:3, 3], 3 * (cell(6) - cell(1)))


def test_the_commands_say_what_changed(path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["changes", str(path), "--since", "0", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert {change["instance_id"]: change["state"] for change in told["changes"]} == truth(0)
    assert [visit["time"] for visit in told["visits"]] == list(TIMES)
    assert main(["changes", str(path)]) == 0
    out = capsys.readouterr().out
    assert "2026-11-25 against 2026-11-24: 1 moved, 0 removed, 2 added, 3 unchanged, 1 not looked at" in out
    assert "not looked at: no name [13], last seen 2026-11-23" in out
    assert main(["changes", str(path), "--since", "9"]) == 2
    assert "visits 0 to 2" in capsys.readouterr().err
    assert main(["info", str(path)]) == 0
    assert "7 instances" in (out := capsys.readouterr().out) and "visits: 3, the newest on 2026-11-25" in out


def test_a_round_thing_keeps_the_axis_of_its_unknown_turn_in_every_frame() -> None:
    box = {"center": [0.0, 0, 0], "rotation": np.eye(3).tolist(), "extent": [1.0, 1, 1]}
    spot = {"until": 0, "centroid": [1.0, 0, 0], "obb": box, "transform": np.eye(4).tolist(), "axis": [0.0, 0, 1]}
    entry = {"id": 3, "state": "moved", "confidence": 0.9, "centroid": [0.0, 1, 0], "obb": box, "last_seen": 1}
    visits = [Visit(0, None, "a", 3), Visit(1, None, "b", 3)]
    (change,) = changes_of(visits, [{**entry, "num_gaussians": 5, "past": [spot]}], 0)
    assert change["state"] == "moved" and change["axis"] == [0.0, 0, 1]
    a_from_b = np.array([[2.0, 0, 0, 1], [0, 0, -2, 0], [0, 2, 0, 0], [0, 0, 0, 1]])  # x stays, z becomes −y
    moved = change_in(a_from_b, change)
    assert moved["axis"] == pytest.approx([0, -1, 0]) and moved["old_centroid"] == [3.0, 0, 0]


def test_a_map_of_one_visit_has_the_path_of_its_input() -> None:
    """`scene.input` is the kind of it."""
    info = {"source": "/home/me/photos", "scene": {"input": "transforms"}}
    assert visits_of(info, 7) == [Visit(0, None, "/home/me/photos", 7)]


def test_exports_hold_what_stands_there_today(path: Path, tmp_path: Path) -> None:
    """The mug is gone: no file of its own, and no group, alone or with the banana."""
    gmap, out = read_map(path), tmp_path / "out.ply"
    assert main(["export", str(path), "--splat", str(out), "--each"]) == 0
    stands = {number(name) for name, state in STATES.items() if state != "removed"}
    assert {int(file.stem.removeprefix("out-")) for file in tmp_path.glob("out-*.ply")} == stands
    assert main(["export", str(path), "--splat", str(out), "--only", str(number("mug"))]) == 2
    of = {"mug": 0, "banana": 0, "lamp": 1, "kettle": 1}
    gmap.groups = {"of": np.int32([of.get(name, -1) for name in NAMES]), "scores": np.float32([0.5, 0.6])}
    write_map(tmp_path / "a.gsmap", gmap)
    assert main(["export", str(tmp_path / "a.gsmap"), "-o", str(out), "--granularity", "groups"]) == 0
    groups = [
        e["instances"]
        for e in json.loads(out.with_suffix(".json").read_text())["instances"].values()
        if "instances" in e
    ]
    assert groups == [[number("lamp"), number("kettle")]]
    gmap.groups = {"of": np.int32([0 if name == "mug" else -1 for name in NAMES]), "scores": np.float32([0.5])}
    write_map(tmp_path / "a.gsmap", gmap)
    assert main(["export", str(tmp_path / "a.gsmap"), "-o", str(out), "--granularity", "groups"]) == 2


def test_what_no_earlier_photo_could_see_is_not_known_to_have_come(path: Path) -> None:
    """A lamp that visit 1 found where none looked before: unchanged until it moves, and added without that record."""
    gmap = read_map(path)
    visits = visits_of(gmap.info)
    lamp = next(dict(entry) for entry in gmap.instances if entry["id"] == number("lamp"))
    lamp = {key: value for key, value in lamp.items() if key != "past"} | {"first_seen": 1, "state": "unchanged"}
    hidden = {**lamp, "hidden_before": True}
    states = [[c["state"] for c in changes_of(visits, [lamp, hidden], start)] for start in (0, 1)]
    assert states == [["added", "unchanged"], ["unchanged", "unchanged"]]
    spot = {key: lamp[key] for key in ("centroid", "obb")} | {"until": 1, "transform": np.eye(4).tolist()}
    (change,) = changes_of(visits, [{**hidden, "state": "moved", "past": [spot]}], 0)
    assert change["state"] == "moved" and change["old_centroid"] == lamp["centroid"]
    assert joined_record([hidden, hidden])["hidden_before"] is True
    assert "hidden_before" not in joined_record([hidden, lamp])
