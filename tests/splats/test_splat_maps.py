"""`perception map SCENE.ply`: rows stand in the map as they were given, things are found, and the rows come back."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from perception.cli import main
from perception.io.ply import map_ply, read_ply
from perception.map.write import Map, read_map
from perception.splats import cameras, panoramas
from support.splat_rooms import room_columns, write_room

BAD = [7, 1000]
OPTIONS = ["--max-side", "200", "--set", "language.encoder=none", "--set", "language.texts=off", "--unit", "metre"]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, np.ndarray]:
    """The file, its map, and the thing of each row; two rows are no numbers, and a property is of no use here."""
    folder = tmp_path_factory.mktemp("splat")
    columns, thing = room_columns(floaters=5)
    columns["x"][BAD] = np.nan
    columns["quality"] = np.arange(len(thing), dtype=np.int32)
    source, output = write_room(folder / "room.ply", columns), folder / "room.gsmap"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cameras, "MOST_VIEWS", 24)
        patch.setattr(panoramas, "PLACES", 120)
        patch.chdir(folder)  # and the map is exported elsewhere
        assert main(["map", source.name, "-o", str(output), *OPTIONS, "--set", "train.iterations=300"]) == 0
    return source, output, thing


@pytest.mark.slow
def test_rows_stand_as_they_were_given(made: tuple[Path, Path, np.ndarray]) -> None:
    source, output, _ = made
    given, kept = map_ply(source, "vertex"), map_ply(output / "gaussians.ply", "vertex")
    good = np.setdiff1d(np.arange(len(given)), BAD)
    for name in kept.dtype.names or ():
        assert kept[name][good].tobytes() == given[name][good].tobytes(), name
    facts = Map.open(output).info
    assert facts["scene"]["splat"]["not_finite"] == 2
    assert facts["metric"] is True
    assert facts["frame"] == "map"
    assert np.allclose(facts["gravity"]["direction"], [0, 0, -1], atol=0.05)
    assert np.all(kept["opacity"][BAD] < -50)


@pytest.mark.slow
def test_things_are_found(made: tuple[Path, Path, np.ndarray]) -> None:
    """Boxes of one colour at 24 small views: half of each is in an instance of its own, not the table's or a wall's."""
    _, output, thing = made
    ids = read_map(output).instance_ids
    assert np.all(ids[BAD] == -1)
    assert np.all(ids[thing == -1] == -1)
    most = [int(np.bincount(ids[(thing == number) & (ids >= 0)]).argmax()) for number in range(4)]
    assert len(set(most)) == 4
    for box in (2, 3):
        assert np.mean(ids[thing == box] == most[box]) > 0.5


@pytest.mark.slow
def test_rows_come_back(made: tuple[Path, Path, np.ndarray], tmp_path: Path) -> None:
    source, output, _ = made
    given, ids = map_ply(source, "vertex"), read_map(output).instance_ids
    assert main(["export", str(output), "--splat", str(tmp_path / "all.ply")]) == 0
    back = map_ply(tmp_path / "all.ply", "vertex")
    for name in given.dtype.names or ():  # also rows that are no numbers, and properties that a map does not hold
        assert back[name].tobytes() == given[name].tobytes()
    assert np.array_equal(back["instance_id"], ids)
    assert main(["export", str(output), "--splat", str(tmp_path / "less.ply"), "--without", "0"]) == 0
    less = read_ply(tmp_path / "less.ply")["vertex"]
    assert np.array_equal(less["quality"], given["quality"][ids != 0])
    assert main(["export", str(output), "--splat", str(tmp_path / "one.ply"), "--each", "--only", "0", "1"]) == 0
    assert len(map_ply(tmp_path / "one-1.ply", "vertex")) == np.sum(ids == 1)
    assert main(["export", str(output), "--splat", str(tmp_path / "x.ply"), "--only", "999"]) == 2
    source.rename(source.with_suffix(".away"))  # the map alone gives its own rows
    try:
        assert main(["export", str(output), "--splat", str(tmp_path / "own.ply")]) == 0
    finally:
        source.with_suffix(".away").rename(source)
    own = map_ply(tmp_path / "own.ply", "vertex")
    assert "quality" not in (own.dtype.names or ())
    assert len(own) == len(given)


def test_settings_that_do_not_go_together(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source = write_room(tmp_path / "room.ply", room_columns()[0])
    photos = tmp_path / "photos"
    photos.mkdir()
    for arguments, words in (
        ([str(source), "--known-length", "0.3: a.jpg 1,2 3,4; b.jpg 1,2 3,4"], "--known-length: does not go with"),
        ([str(source), "--time-limit", "60"], "--time-limit: does not go with"),
        ([str(source), "--up", "north"], "--up: found 'north'"),
        ([str(source), "--memory", "1G"], "need about 1.5 GiB, --memory is 1G"),
        ([str(source), "--cameras", str(tmp_path / "none")], "no such file"),
        ([str(photos), "--up", "z"], "--up: goes with a finished splat"),
    ):
        assert main(["map", *arguments, "-o", str(tmp_path / "x.gsmap")]) == 2
        told = capsys.readouterr().err
        assert words in told
        assert not (tmp_path / "x.gsmap").exists()
