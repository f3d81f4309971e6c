"""Photos over HTTP: only from where they may come, and one that does not come holds up nothing else."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from support.query_maps import encoders, write_map_of

pytest.importorskip("fastapi", reason="the extra 'serve' is not installed")
from PIL import Image
from starlette.testclient import TestClient

from perception.cli import main
from perception.io.map_views import StoredView
from perception.io.store import read_map, write_map
from perception.query import QueryEngine
from perception.query.crops import folders_needed
from perception.query.engine import EngineBusy
from perception.serve import app as app_module
from perception.serve import crops
from perception.serve.app import build_app
from perception.serve.settings import ServeSettings


def write_photo_map(path: Path, photo: str, beside: str | None = None) -> Path:
    """A map of one instance that says its photo is the file `photo`, or `beside` relative to the map."""
    write_map_of(path, ["square"], gaussians=50)
    gmap = read_map(path)
    gmap.views = [StoredView("00000.jpg", Path(photo), np.eye(3), 160, 100, np.eye(4), photo_beside=beside)]
    gmap.language["view_boxes"] = np.array([[100, 40, 130, 60]], np.int32)
    write_map(path, gmap)
    stored = read_map(path).views[0]
    assert isinstance(stored, StoredView) and stored.photo_beside == beside
    return path


def picture(file: Path) -> Path:
    file.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.full((100, 160, 3), 128, np.uint8)).save(file)
    return file


def client_of(engine: QueryEngine, *photos: Path) -> TestClient:
    app = build_app(engine, ServeSettings(photos=photos))
    return TestClient(app, base_url="http://127.0.0.1:8765", raise_server_exceptions=False)


def asked(path: Path, *photos: Path) -> int:
    with QueryEngine(path, watch=None, encoders=encoders) as engine:
        return client_of(engine, *photos).get("/instances/0/crop.jpg").status_code


def test_a_received_map_cannot_have_a_private_file_served(tmp_path: Path) -> None:
    private = picture(tmp_path / "private/secret.png")
    path = write_photo_map(tmp_path / "a.gsmap", str(private))
    assert asked(path) == 404
    assert asked(path, picture(tmp_path / "photos/other.png").parent) == 404
    assert asked(path, private.parent) == 200
    assert asked(path, tmp_path) == 200
    assert asked(write_photo_map(tmp_path / "b.gsmap", "gone.png", "../private/secret.png")) == 404


def test_the_folders_that_would_be_needed_are_told(tmp_path: Path) -> None:
    private = picture(tmp_path / "private/secret.png")
    path = write_photo_map(tmp_path / "a.gsmap", str(private))
    with QueryEngine(path, watch=None, encoders=encoders) as engine:
        assert folders_needed(engine.current, (path,)) == [private.parent]
        assert folders_needed(engine.current, (path, tmp_path)) == []


def test_photos_below_the_map_are_served_and_links_out_of_it_are_not(tmp_path: Path) -> None:
    private = picture(tmp_path / "private/secret.png")
    path = write_photo_map(tmp_path / "a.gsmap", str(tmp_path / "a.gsmap/photos/p.png"))
    picture(path / "photos/p.png")
    assert asked(path) == 200
    (path / "photos/p.png").unlink()
    (path / "photos/p.png").symlink_to(private)
    assert asked(path) == 404
    assert asked(write_photo_map(tmp_path / "b.gsmap", f"{tmp_path}/b.gsmap/../private/secret.png")) == 404


@pytest.mark.parametrize("photo", ["/dev/zero", "\0", "a" * 5000, "", "/proc/self/environ", "~/.ssh/id_rsa"])
def test_what_is_no_photo_is_not_found(tmp_path: Path, photo: str) -> None:
    assert asked(write_photo_map(tmp_path / "a.gsmap", photo), Path("/")) == 404


def test_a_fifo_is_no_photo(tmp_path: Path) -> None:
    """Opening one would wait for a writer that never comes."""
    path = write_photo_map(tmp_path / "a.gsmap", str(tmp_path / "a.gsmap/pipe.png"))
    os.mkfifo(path / "pipe.png")
    assert asked(path) == 404


def test_photo_folders_must_be_there(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["serve", str(tmp_path), "--photos", str(tmp_path / "none")]) == 2
    assert "--photos" in capsys.readouterr().err


@pytest.fixture
def hanging(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[TestClient]:
    """A server whose photos never come, as on a mount whose server is gone."""
    path = write_photo_map(tmp_path / "a.gsmap", "p.png")
    end = threading.Event()
    monkeypatch.setattr(app_module, "best_crop", lambda *_: end.wait(60) and None)
    with QueryEngine(path, watch=None, workers=2, timeout=0.2, encoders=encoders) as engine:
        yield client_of(engine)
        end.set()


@pytest.mark.slow
def test_photos_that_hang_hold_up_no_question_and_are_told(hanging: TestClient) -> None:
    for side in range(20, 20 + crops.MAX_HUNG):  # more than the engine has workers
        assert hanging.get(f"/instances/0/crop.jpg?side={side}").status_code == 504
    assert hanging.post("/query", json={"text": "square"}).status_code == 200
    health = hanging.get("/health").json()
    assert health["status"] == "degraded" and "photos" in health["problem"]
    assert {hanging.get(f"/instances/0/crop.jpg?side={side}").status_code for side in range(30, 40)} == {503}
    assert hanging.post("/query", json={"text": "square"}).status_code == 200


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


def test_one_photo_asked_for_by_many_is_read_once() -> None:
    reads, begin = [], threading.Event()

    def work() -> Any:
        reads.append(begin.wait(60))
        return np.zeros((4, 4, 3), np.uint8)

    held = crops.Crops(timeout=60)
    futures = [held.jpeg("a", work) for _ in range(10)]
    begin.set()
    assert len({id(future.result(60)) for future in futures}) == 1 and reads == [True]
    assert held.jpeg("a", work).result(0) == futures[0].result() and len(reads) == 1
    assert held.jpeg("b", lambda: None).result(60) is None


def test_photos_are_read_beside_hung_ones_up_to_a_bound() -> None:
    now, end, begun = [0.0], threading.Event(), threading.Semaphore(0)

    def work() -> Any:
        begun.release()
        end.wait(60)

    held = crops.Crops(timeout=1, clock=lambda: now[0])
    for number in range(crops.MAX_HUNG):
        held.jpeg(number, work)
        assert begun.acquire(timeout=60)  # a thread is there, although the earlier ones hang
        now[0] += 2
    assert held.hung() == crops.MAX_HUNG
    with pytest.raises(EngineBusy, match="hang"):
        held.jpeg("more", work)
    end.set()
    while held.hung():
        end.wait(0.01)
    assert held.jpeg("more", lambda: None).result(60) is None


def test_a_photo_that_fails_is_told_and_asked_again() -> None:
    held = crops.Crops(timeout=60)
    with pytest.raises(ZeroDivisionError):
        held.jpeg("a", lambda: 1 / 0).result(60)
    assert held.jpeg("a", lambda: None).result(60) is None
