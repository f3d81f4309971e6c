"""The engine of servers: nothing lost, nothing crossed, nothing without end; a new map under load."""

from __future__ import annotations

import copy
import json
import random
import shutil
import subprocess
import sys
import threading
import time
import weakref
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from perception.errors import InputError
from perception.io.atomic import atomic_file
from perception.map.write import read_map, set_labels, write_map
from perception.query import QueryMap, Where, load_map
from perception.serve.engine import QueryEngine
from perception.serve.requests import AnswerTimeout, EngineBusy, EngineClosed, Request
from support.query_maps import NAMES, HashEncoder, encoders, write_map_of


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return write_map_of(tmp_path / "a.gsmap", gaussians=900)


def engine_of(path: Path, **options) -> QueryEngine:
    return QueryEngine(path, encoders=encoders, **{"watch": None, **options})


def held(engine: QueryEngine) -> threading.Event:
    """Keeps one worker busy until the event is set; returns once it has begun."""
    begun, end = threading.Event(), threading.Event()

    def work(gmap: QueryMap) -> None:
        begun.set()
        end.wait(30)

    engine.run(work)
    assert begun.wait(30)
    return end


def test_eight_askers_get_their_own_answers(path: Path) -> None:
    with engine_of(path, workers=3) as engine:
        alone = {name: engine.current.query(name, 2, 0.0) for name in NAMES}

        def asker(number: int) -> int:
            right = 0
            for turn in range(40):
                name = NAMES[(number * 7 + turn) % len(NAMES)]
                reply = engine.ask(Request(name, 2, 0.0))
                same = [hit.instance_id for hit in reply.hits] == [hit.instance_id for hit in alone[name]]
                right += same and reply.request.text == name and reply.hits[0].instance_id == NAMES.index(name)
            return right

        with ThreadPoolExecutor(8) as pool:
            assert sum(pool.map(asker, range(8))) == 320
        health = engine.health()
    assert (health["status"], health["answered"], health["failed"], health["refused"]) == ("ok", 320, 0, 0)
    assert health["median_ms"] <= health["p99_ms"]


def test_a_full_queue_refuses_and_what_waits_is_answered(path: Path) -> None:
    with engine_of(path, workers=1, queue_size=3) as engine:
        end = held(engine)
        waiting = [engine.submit(name) for name in NAMES[:3]]
        with pytest.raises(EngineBusy):
            engine.submit("mug")
        assert engine.health()["refused"] == 1 and engine.health()["waiting"] == 3
        end.set()
        assert [engine.wait(future).hits[0].instance_id for future in waiting] == [0, 1, 2]


def test_an_answer_that_does_not_come_is_told_and_not_computed(path: Path) -> None:
    done = []
    with engine_of(path, workers=1, timeout=0.05) as engine:
        end = held(engine)
        with pytest.raises(AnswerTimeout):
            engine.wait(engine.run(lambda gmap: done.append(1)))
        late = engine.run(lambda gmap: done.append(2))  # nobody waits, so it is dropped when its turn comes
        time.sleep(0.1)
        end.set()
        with pytest.raises(AnswerTimeout):
            late.result(10)
        assert engine.ask("mug", timeout=10).hits[0].instance_id == 0
        assert done == [] and engine.health()["timed_out"] == 2


def test_questions_nobody_waits_for_make_room(path: Path) -> None:
    with engine_of(path, workers=1, queue_size=2, timeout=30) as engine:
        end = held(engine)
        given_up, too_late = engine.submit("mug"), engine.submit("lamp", timeout=0.01)
        assert given_up.cancel()
        time.sleep(0.05)
        kept = [engine.submit("teapot"), engine.submit("violin")]
        with pytest.raises(AnswerTimeout):
            too_late.result(10)
        end.set()
        assert [engine.wait(future).hits[0].instance_id for future in kept] == [3, 6]


def test_bad_questions_and_defects_do_not_end_the_engine(path: Path) -> None:
    with engine_of(path, workers=1) as engine:
        for text in ("", " ", "x" * 1_000_000):
            with pytest.raises(InputError):
                engine.ask(text)
        with pytest.raises(InputError):
            engine.wait(engine.run(lambda gmap: gmap.get(99)))
        with pytest.raises(ZeroDivisionError):
            engine.wait(engine.run(lambda gmap: 1 // 0))
        assert engine.ask("mug").hits[0].instance_id == 0
        health = engine.health()
        assert (health["bad_input"], health["failed"], health["status"]) == (1, 1, "ok")


def test_a_closed_engine_answers_what_ran_and_refuses_the_rest(path: Path) -> None:
    engine = engine_of(path, workers=1)
    end = held(engine)
    waiting = engine.submit("mug")
    closer = threading.Thread(target=engine.close)
    closer.start()
    with pytest.raises(EngineClosed):
        waiting.result(10)
    end.set()
    closer.join(10)
    assert not closer.is_alive()
    with pytest.raises(EngineClosed):
        engine.ask("mug")
    engine.close()
    assert engine.health()["status"] == "closed"


def test_a_map_replaced_under_load_gives_whole_answers_of_one_or_the_other(path: Path) -> None:
    """The old map knows the names in order, the new in reverse, with other ids and points elsewhere in number."""
    kinds: dict[str, tuple[int, int]] = {}
    with engine_of(path, workers=2, queue_size=1000) as engine:
        kinds[engine.current.map_id] = (0, 1)
        stop = threading.Event()
        heard: list[str] = []
        engine.on_reload(lambda gmap: heard.append(gmap.map_id))

        def asker(number: int) -> list[tuple[str, str, int, int]]:
            seen = []
            while not stop.is_set():
                name = NAMES[len(seen) % len(NAMES)]
                reply = engine.ask(name, timeout=60)
                seen.append((name, reply.map_id, reply.hits[0].instance_id, len(reply.hits[0].points)))
            return seen

        with ThreadPoolExecutor(4) as pool:
            askers = [pool.submit(asker, n) for n in range(4)]
            old_points = {hit.instance_id: len(hit.points) for hit in engine.current.find()}
            write_map_of(path, NAMES[::-1], gaussians=700, first_id=100, seed=9)
            assert engine.reload() is True and engine.reload() is False
            new_points = {hit.instance_id: len(hit.points) for hit in engine.current.find()}
            new_id = engine.current.map_id
            time.sleep(0.1)
            stop.set()
            answers = [entry for asker in askers for entry in asker.result()]
    assert heard == [new_id] and len({entry[1] for entry in answers}) == 2
    for name, map_id, instance, count in answers:
        place = NAMES.index(name)
        if map_id == new_id:
            assert instance == 100 + len(NAMES) - 1 - place and count == new_points[instance]
        else:
            assert instance == place and count == old_points[instance]


def test_the_watcher_takes_over_a_new_map_and_new_labels(path: Path) -> None:
    with engine_of(path, watch=0.02) as engine:
        first = engine.current.map_id
        set_labels(path, {2: "workplace"})
        _until(lambda: engine.current.map_id != first)
        assert engine.ask("workplace").hits[0].instance_id == 2
        write_map_of(path, ["one", "two"], gaussians=200, seed=4)
        _until(lambda: len(engine.current.instances) == 2)
        assert engine.ask("two").hits[0].instance_id == 1 and engine.health()["status"] == "ok"


def test_a_map_deleted_or_spoilt_while_served_is_told_and_the_old_one_answers(path: Path, tmp_path: Path) -> None:
    spare = tmp_path / "spare.gsmap"
    shutil.copytree(path, spare)
    with engine_of(path, watch=0.02) as engine:
        shutil.rmtree(path)
        _until(lambda: engine.health()["status"] == "degraded")
        assert "gone" in engine.health()["problem"]
        assert engine.ask("mug").hits[0].instance_id == 0 and engine.current.describe(3).hit.points.shape[1] == 3
        with pytest.raises(InputError, match="gone"):
            engine.reload()

        shutil.copytree(spare, path)
        (path / "features.npy").write_bytes(b"spoilt")
        _until(lambda: "features.npy" in (engine.health()["problem"] or ""))
        with pytest.raises(InputError, match=r"features\.npy"):
            engine.reload()
        assert engine.ask("mug").hits[0].instance_id == 0

        shutil.rmtree(path)
        shutil.copytree(spare, path)
        _until(lambda: engine.health()["status"] == "ok")


ODD: tuple[Any, ...] = (None, 3, -1, 1e308, True, "MUG", [], ["MUG"], [[]], {}, {"id": 1}, [{"text": 5, "score": 1}])


@pytest.mark.slow
def test_no_value_in_instances_json_ends_the_watcher(path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Whatever stands there: it is taken over, or told in health and in the log; the mended file is taken over."""
    gmap = read_map(path)
    gmap.info["instances"] = {"texts": "test"}
    write_map(path, gmap)
    file, rng = path / "instances.json", random.Random(0)
    good = json.loads(file.read_text())

    def put(value: Any) -> None:
        with atomic_file(file) as aside:
            aside.write_text(json.dumps(value))

    refused = 0
    with engine_of(path, watch=0.01) as engine:
        for turn in range(25):
            before, spoilt = engine.current.map_id, copy.deepcopy(good)
            keys = [*spoilt["instances"][0], "texts", "texts", "parts", "hidden"]
            spoilt["instances"][rng.randrange(3)][rng.choice(keys)] = rng.choice(ODD)
            spoilt["turn"] = turn
            caplog.clear()
            put(spoilt)
            _until(lambda before=before: engine.health()["problem"] or engine.current.map_id != before)
            if engine.health()["problem"]:
                refused += 1
                assert engine.health()["status"] == "degraded" and "\n" not in engine.health()["problem"]
                assert engine.current.map_id == before and caplog.records
                with pytest.raises(InputError):
                    engine.reload()
            put({**good, "mended": turn})
            _until(lambda: json.loads(file.read_text()) and engine.current.map_id == load_map(path).map_id)
            _until(lambda: engine.health()["status"] == "ok")
            assert engine.ask("mug").hits[0].instance_id == 0
    assert 5 < refused < 25


def test_a_listener_that_fails_is_told_and_the_next_map_is_taken_over(path: Path) -> None:
    with engine_of(path, watch=None) as engine:
        engine.on_reload(lambda gmap: gmap.position(2))
        write_map_of(path, ["one", "two"], gaussians=200)
        assert engine.reload() and len(engine.current.instances) == 2
        assert "not all of the map can be served (UnknownInstance" in engine.health()["problem"]
        write_map_of(path, gaussians=200)
        assert engine.reload() and engine.health()["status"] == "ok"


def test_files_cut_in_place_while_served_do_not_end_the_process(path: Path) -> None:
    """Whoever reads a mapped page behind the end of a cut file dies by SIGBUS, so answers must need none."""
    code = (
        "import sys; from pathlib import Path; from support.query_maps import NAMES, encoders\n"
        "from perception.query import Where\n"
        "from perception.serve.engine import QueryEngine\n"
        "path = Path(sys.argv[1])\n"
        "with QueryEngine(path, watch=None, encoders=encoders) as engine:\n"
        "    for file in path.iterdir():\n        file.open('r+b').truncate(0)\n"
        "    found = [engine.ask(name).hits[0].instance_id for name in NAMES]\n"
        "    near = engine.wait(engine.run(lambda gmap: gmap.nearest([0, 0, 0], 9, where=Where(min_size=0.1))))\n"
        "    told = engine.wait(engine.run(lambda gmap: gmap.describe(3).to_json()))\n"
        "    assert found == list(range(9)) and len(near) == 9 and told['num_points'] > 0\n"
    )
    done = subprocess.run([sys.executable, "-c", code, str(path)], cwd=path.parent, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_encoders_are_shared_between_the_old_map_and_the_new(path: Path) -> None:
    made = []

    def make(spec: str) -> HashEncoder:
        made.append(spec)
        return HashEncoder()

    with QueryEngine(path, watch=None, encoders=make) as engine:
        write_map_of(path, ["one"], gaussians=100, seed=2)
        assert engine.reload() and engine.ask("one", timeout=60).hits[0].instance_id == 0
    assert made == ["hash"]


def test_one_loaded_map_serves_many_threads_from_the_first_moment(path: Path) -> None:
    """All lazy parts are asked for at once by threads that start together."""
    for _ in range(3):
        gmap = load_map(path, encoders)
        gate = threading.Barrier(8)

        def ask(number: int, gmap: QueryMap = gmap, gate: threading.Barrier = gate) -> list[int]:
            gate.wait()
            name = NAMES[number % len(NAMES)]
            hit = gmap.query(name, where=Where(near=[0, 0, 0]))[0]
            at = gmap.instance_at(hit.centroid)
            assert at is not None and len(gmap) == 900
            return [hit.instance_id, at.instance_id, gmap.describe(hit.instance_id).hit.instance_id]

        with ThreadPoolExecutor(8) as pool:
            assert list(pool.map(ask, range(8))) == [[n % len(NAMES)] * 3 for n in range(8)]


def test_settings_out_of_range_are_refused(path: Path, tmp_path: Path) -> None:
    for options in ({"workers": 0}, {"queue_size": 0}, {"timeout": 0.0}, {"timeout": float("nan")}):
        with pytest.raises(InputError):
            engine_of(path, **options)
    with pytest.raises(InputError, match=r"no map|gone"):
        engine_of(tmp_path / "none.gsmap")


def test_memory_of_answers_is_let_go(path: Path) -> None:
    """Rankings are remembered, but boundedly."""
    with engine_of(path) as engine:
        for number in range(400):
            engine.ask(Request(f"thing {number}", min_score=0.0))
        ranking = engine.current._ranking
        assert ranking._remembered.cache_info().currsize <= 256
        assert sum(array.nbytes for array in ranking._remembered("thing 399")) <= 12 * len(NAMES)  # numbers, no objects
        assert np.array_equal(engine.ask("mug").hits[0].points, engine.current.get(0).points)


def test_a_map_that_was_replaced_leaves_memory_with_its_last_answers(path: Path) -> None:
    with engine_of(path, workers=2) as engine:
        old = weakref.ref(engine.current)
        for _ in range(4):
            assert engine.ask("mug").hits
        set_labels(path, {0: "cup"})
        assert engine.reload() and old() is None


def _until(condition, seconds: float = 30.0) -> None:
    """Waits for another thread; the bound only ends a test that has failed."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it never happened"
        time.sleep(0.01)


def test_answers_that_hang_are_told(tmp_path: Path) -> None:
    path = write_map_of(tmp_path / "a.gsmap", gaussians=50)
    end = threading.Event()
    with QueryEngine(path, watch=None, workers=1, timeout=0.05, encoders=encoders) as engine:
        assert engine.health()["status"] == "ok"
        future = engine.run(lambda gmap: end.wait(60))
        while engine.health()["status"] == "ok":
            end.wait(0.01)
        assert "longer than 0.05 s" in engine.health()["problem"]
        end.set()
        assert future.result(60)
