"""Features and matches made by tasks, here or on other machines: the database is that of one process, bit for bit."""

from __future__ import annotations

import os
import sqlite3
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

pytest.importorskip("pycolmap")
from perception.errors import InputError
from perception.progress import QUIET
from perception.sfm import feature_tasks, features
from perception.sfm.database import build_features
from perception.sfm.options import ReadOptions
from perception.tasks import engine as engines
from perception.tasks.folder import RESULT, TASK, write_task
from support.elsewhere import Elsewhere

TABLES = ("cameras", "images", "keypoints", "descriptors", "matches", "two_view_geometries")


@pytest.fixture
def photos(tmp_path: Path) -> list[Path]:
    """24 photos that slide over one texture, taken with two cameras; one of them is of another format."""
    rng = np.random.default_rng(0)
    layers = [cv2.resize(rng.random((n, 2 * n)).astype(np.float32), (1600, 800)) for n in (16, 32, 64, 128)]
    texture = np.uint8(255 * sum(layers) / len(layers))
    paths = []
    for number in range(24):
        width, height = (200, 150) if number % 3 else (160, 200)
        x, y = 40 * number, 100 + 20 * (number % 4)
        paths.append(tmp_path / f"photo {number:02d}{'.bmp' if number == 5 else '.png'}")
        cv2.imwrite(str(paths[-1]), texture[y : y + height, x : x + width])
    return paths


def rows(database: Path) -> dict[str, list[tuple[Any, ...]]]:
    with closing(sqlite3.connect(database)) as tables:
        return {name: sorted(tables.execute(f"SELECT * FROM {name}")) for name in TABLES}


@pytest.mark.slow
def test_the_database_is_that_of_one_process(
    photos: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(feature_tasks, "PHOTOS_A_TASK", 7)
    monkeypatch.setattr(feature_tasks, "PAIRS_A_TASK", 11)
    half = np.zeros((150, 200), np.uint8)
    half[:, :120] = 255
    cv2.imwrite(str(tmp_path / "mask.png"), half)
    masks = [tmp_path / "mask.png" if number in (1, 8) else None for number in range(len(photos))]
    engine, lenses = Elsewhere(), [None] * len(photos)
    here = build_features(photos, lenses, ReadOptions(tmp_path / "here", 3), masks)
    there = build_features(photos, lenses, ReadOptions(tmp_path / "there", 3, engine=engine), masks)
    wanted = rows(here.database)
    assert len(wanted["cameras"]) == 2 and len(wanted["keypoints"]) == 24 and len(wanted["matches"]) > 40
    assert rows(there.database) == wanted
    assert engine.asked == [4, -(-there.facts["pairs_matched"] // 11)]
    assert [path.name for path in (tmp_path / "there").iterdir()] == [there.folder.name]  # no task is left


def test_a_disk_that_fills_is_told_between_few_photos_which_change_no_bit(
    photos: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found, looks = [], iter([10, 10, 10, 0])  # before, and at each of six sets of photos
    for few in (features.PHOTOS_AT_ONCE, 2):
        monkeypatch.setattr(features, "PHOTOS_AT_ONCE", few)
        found.append(rows(build_features(photos[:9], [None] * 9, ReadOptions(tmp_path / str(few), 3)).database))
    assert found[0] == found[1] and len(found[0]["keypoints"]) == 9
    monkeypatch.setattr("shutil.disk_usage", lambda _: SimpleNamespace(free=next(looks) << 30))
    with pytest.raises(InputError, match=r"^\S+: its disk has 0 MiB free, at least 256 are needed; free some$"):
        build_features(photos[:9], [None] * 9, ReadOptions(tmp_path / "full", 3))
    assert not any((tmp_path / "full").iterdir())


@pytest.mark.slow
def test_so_is_that_of_a_process_for_each_core(
    photos: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(feature_tasks, "LEAST_PAIRS", 20)
    lenses, wanted, asked = [None] * len(photos), None, []
    run = feature_tasks.run_in_processes

    def ran(task: Any, folders: list[str], *rest: Any) -> None:
        asked.append(len(folders))
        run(task, folders, *rest)
        left = [rows(Path(folder) / RESULT / feature_tasks.DATABASE) for folder in folders]
        assert not any(tables["descriptors"] for tables in left)  # of all photos, in every folder

    monkeypatch.setattr(feature_tasks, "run_in_processes", ran)
    for number in (1, 3):
        monkeypatch.setattr(feature_tasks, "cores", lambda number=number: number)
        store = build_features(photos, lenses, ReadOptions(tmp_path / str(number), 3))
        wanted = wanted or rows(store.database)
        assert rows(store.database) == wanted and len(wanted["matches"]) > 40
        assert [path.name for path in (tmp_path / str(number)).iterdir()] == [store.folder.name]
    assert asked == [3]


@pytest.mark.slow
def test_an_interrupted_run_makes_no_task_twice(
    photos: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(feature_tasks, "PHOTOS_A_TASK", 10)
    extract, begun = feature_tasks.extract, []

    def counted(*args: Any) -> None:
        begun.append(args)
        if len(begun) == 3:
            raise KeyboardInterrupt
        extract(*args)

    monkeypatch.setattr(feature_tasks, "extract", counted)
    lenses = [None] * len(photos)
    options = ReadOptions(tmp_path / "work", engine=Elsewhere())
    with pytest.raises(KeyboardInterrupt):
        build_features(photos, lenses, options)
    store = build_features(photos, lenses, options)
    assert len(begun) == 4  # three sets of photos, one of them begun twice
    assert len(rows(store.database)["keypoints"]) == 24


def test_a_worker_of_another_version_is_refused(photos: list[Path], tmp_path: Path) -> None:
    class Older(Elsewhere):
        def run(self, task: Any, items: Any, *rest: Any) -> list[Any]:
            file = Path(items[0]) / TASK
            file.write_text(file.read_text().replace('"pycolmap": "', '"pycolmap": "0.'))
            return super().run(task, items, *rest)

    with pytest.raises(InputError, match=r"this worker has pycolmap .*, the run 0\..*; install the same"):
        build_features(photos, [None] * len(photos), ReadOptions(tmp_path / "work", engine=Older()))


def test_an_error_of_a_process_is_raised_and_ends_the_others(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(engines, "cores", lambda: 2)
    children: list[Any] = []

    def started(command: list[str], **given: Any) -> Any:
        code = "import time; time.sleep(600)" if "long" in command else command[2]
        children.append(popen([*command[:2], code, *command[3:]], **given))
        return children[-1]

    popen = engines.subprocess.Popen
    monkeypatch.setattr(engines.subprocess, "Popen", started)
    write_task(tmp_path, pairs=[])
    file = tmp_path / TASK
    file.write_text(file.read_text().replace('"pycolmap": "', '"pycolmap": "0.'))
    with pytest.raises(InputError, match=r"this worker has pycolmap .*, the run 0\..*; install the same"):
        engines.run_in_processes(feature_tasks.match_task, ["long", str(tmp_path)], "poses: matching", QUIET)
    assert len(children) == 2 and all(child.wait(60) for child in children)
    with pytest.raises(RuntimeError, match="FileNotFoundError"):
        engines.run_in_processes(feature_tasks.match_task, [str(tmp_path / "none")], "poses: matching", QUIET)


def test_a_part_of_a_database_whose_path_is_no_utf8(tmp_path: Path) -> None:
    folder = Path(os.fsdecode(os.fsencode(tmp_path) + b"/\xe9"))
    folder.mkdir()
    feature_tasks.load_pycolmap().Database.open(folder / "all.db").close()
    with closing(sqlite3.connect(folder / "all.db")) as database, database:
        database.execute("INSERT INTO cameras VALUES (7, 1, 64, 48, x'00', 0)")
    feature_tasks.write_part(folder / "all.db", [], folder / "part.db")
    with closing(sqlite3.connect(folder / "part.db")) as part:
        assert part.execute("SELECT camera_id FROM cameras").fetchall() == [(7,)]
