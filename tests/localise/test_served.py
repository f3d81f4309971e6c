"""A robot asks where it is: over HTTP, as a tool of a language model, and on ROS 2."""

from __future__ import annotations

import base64
import gc
import json
import threading
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from perception.errors import InputError
from perception.node import answers
from perception.node.config import NodeConfig
from perception.node.localise import Localising
from perception.query import QueryMap
from perception.serve import localise as served
from perception.serve.bodies import parse
from perception.serve.engine import QueryEngine
from perception.serve.requests import MAX_BYTES, EngineBusy, ServeSettings
from support.painted_room import PaintedRoom, walk, write_room_map

TRUTH = np.linalg.inv(walk(1, 4, 0.15)[1])
CAMERA = {"image_width": 400, "image_height": 300, "camera_matrix": [300.0, 0, 199.5, 0, 300, 149.5, 0, 0, 1]}
CAMERA |= {"distortion_coefficients": [0.0] * 5}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """a.gsmap, its photos, and a new photo among them."""
    folder, room = tmp_path_factory.mktemp("served"), PaintedRoom(0)
    write_room_map(folder / "a.gsmap", room, walk(1, 5), folder / "photos")
    room.view(folder / "photos", "new.png", walk(1, 4, 0.15)[1])
    PaintedRoom(5).view(folder, "elsewhere.png", walk(1, 4, 0.15)[1])
    return folder


@pytest.fixture(scope="module")
def engine(folder: Path) -> Iterator[QueryEngine]:
    """With the map's photos read."""
    with QueryEngine(folder / "a.gsmap", watch=None, timeout=300, encoders=lambda _: None) as engine:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(served, "WAIT", 300.0)
            served.localiser_of(engine.current, folder / "photos")
        yield engine


def text_of(photo: Path) -> str:
    return base64.b64encode(photo.read_bytes()).decode()


@pytest.mark.slow
def test_over_http(engine: QueryEngine, folder: Path) -> None:
    pytest.importorskip("fastapi", reason="the extra 'serve' is not installed")
    from starlette.testclient import TestClient

    from perception.serve.app import build_app

    settings = ServeSettings(photos=folder / "photos")
    client = TestClient(build_app(engine, settings), base_url="http://127.0.0.1:8765", raise_server_exceptions=False)
    body: dict[str, Any] = {"picture": text_of(folder / "photos/new.png")}
    assert len(body["picture"]) > MAX_BYTES  # more than other requests may have
    answer = client.post("/localise", json={**body, "camera": CAMERA}).json()
    assert answer["localised"] and np.allclose(answer["pose"], TRUTH, atol=0.003)
    assert (answer["frame"], answer["metric"], answer["map_id"]) == ("map", True, engine.current.map_id)
    half = np.diag([0.5, 0.5, 0.5, 1.0])
    halved = client.post("/localise", json={**body, "frame": {"name": "half", "from_map": half.tolist()}}).json()
    assert np.allclose(halved["position"], TRUTH[:3, 3] / 2, atol=0.002) and halved["frame"] == "half"
    assert np.allclose(np.array(halved["pose"])[:3, :3], TRUTH[:3, :3], atol=0.003)
    elsewhere = client.post("/localise", json={"picture": text_of(folder / "elsewhere.png")}).json()
    assert elsewhere["localised"] is False and "not in this map" in elsewhere["why"]
    for wrong, word in (
        ({"picture": "%%"}, "no base64"),
        ({"picture": base64.b64encode(b"GIF89a" * 9).decode()}, "not readable"),
        ({"picture": base64.b64encode((folder / "photos/new.png").read_bytes()[:999]).decode()}, "picture"),
        ({"file": "/etc/passwd"}, "file"),
        ({**body, "camera": {"image_width": 4}}, "camera"),
    ):
        refused = client.post("/localise", json=wrong)
        assert refused.status_code == 400 and word in refused.json()["error"] and "\n" not in refused.json()["error"]
        assert "/tmp" not in refused.json()["error"]
    assert client.post("/localise", json={"picture": "A" * (9 << 20)}).status_code == 413
    assert client.post("/query", json={"text": "a" * 2 * MAX_BYTES}).status_code == 413


@pytest.mark.slow
def test_a_picture_of_too_many_pixels_is_refused_by_its_header(engine: QueryEngine, folder: Path) -> None:
    huge = cv2.imencode(".png", np.zeros((8000, 8000), np.uint8))[1].tobytes()
    with pytest.raises(InputError, match="pixels"):
        served.localised(engine.current, huge, None, folder / "photos")


@pytest.mark.slow
def test_the_first_question_is_told_to_come_again(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    go = threading.Event()
    monkeypatch.setattr(served, "WAIT", 0.01)
    monkeypatch.setattr(served, "Localiser", lambda *_, **__: go.wait(60))
    with QueryEngine(folder / "a.gsmap", watch=None, encoders=lambda _: None) as other:
        with pytest.raises(EngineBusy, match="ask again"):
            served.localiser_of(other.current, None)
        go.set()
        monkeypatch.setattr(served, "WAIT", 60.0)
        assert served.localiser_of(other.current, None) is True


def test_a_failure_to_read_the_photos_is_not_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: Any, **__: Any) -> Any:
        raise InputError("/tmp: its disk has 3 MiB free")

    gmap = QueryMap()
    monkeypatch.setattr(served, "WAIT", 60.0)
    monkeypatch.setattr(served, "Localiser", full)
    with pytest.raises(InputError, match="3 MiB"):
        served.localiser_of(gmap, None)
    monkeypatch.setattr(served, "Localiser", lambda *_, **__: True)
    assert served.localiser_of(gmap, None) is True
    assert gmap in served._localisers
    count = len(served._localisers)
    del gmap
    gc.collect()
    assert len(served._localisers) < count  # it goes with its map


@pytest.mark.slow
def test_as_a_tool_with_a_picture_or_a_file_of_an_allowed_folder(engine: QueryEngine, folder: Path) -> None:
    pytest.importorskip("mcp", reason="the extra 'mcp' is not installed")
    from perception.serve.mcp import TOOLS

    gmap, photos = engine.current, folder / "photos"
    for given in ({"picture": text_of(photos / "new.png")}, {"file": "new.png"}, {"file": str(photos / "new.png")}):
        answer, _ = parse(TOOLS["localise"], given).answered(gmap, photos)
        assert answer["localised"] and np.allclose(answer["pose"], TRUTH, atol=0.003) and answer["unit"] == "m"
    (photos / "link.png").symlink_to(folder / "elsewhere.png")
    for file in ("../elsewhere.png", str(folder / "elsewhere.png"), "link.png", "\0"):
        with pytest.raises(InputError, match="file"):
            parse(TOOLS["localise"], {"file": file}).answered(gmap, photos)
    with pytest.raises(InputError, match="not in the folder"):
        parse(TOOLS["localise"], {"file": "new.png"}).answered(gmap, None)
    with pytest.raises(InputError, match="one of them"):
        parse(TOOLS["localise"], {}).answered(gmap, photos)


class Heard:
    """A transport that remembers."""

    def __init__(self) -> None:
        self.messages: dict[answers.Channel, dict[str, Any]] = {}
        self.news = threading.Condition()

    def publish(self, topic: answers.Channel, message: dict[str, Any]) -> None:
        with self.news:
            self.messages[topic] = message
            self.news.notify_all()

    def answer(self) -> dict[str, Any]:
        with self.news:
            assert self.news.wait_for(lambda: answers.LOCALISE_ANSWER in self.messages, 300)
            return dict(json.loads(self.messages.pop(answers.LOCALISE_ANSWER)["data"]))


def image_of(photo: Path) -> SimpleNamespace:
    """A sensor_msgs/Image."""
    picture = cv2.imread(str(photo))
    head = SimpleNamespace(stamp=SimpleNamespace(sec=7, nanosec=8), frame_id="camera_optical")
    facts = {"height": picture.shape[0], "width": picture.shape[1], "step": 3 * picture.shape[1]}
    return SimpleNamespace(header=head, encoding="bgr8", data=picture.tobytes(), **facts)


@pytest.mark.slow
def test_on_ros(engine: QueryEngine, folder: Path) -> None:
    heard = Heard()
    node = Localising(engine, heard, NodeConfig(photos=str(folder / "photos")))
    info = {"k": CAMERA["camera_matrix"], "d": [0.0] * 5, "p": [], "distortion_model": "plumb_bob"}
    node.camera(SimpleNamespace(width=400, height=300, **info))
    node.image(image_of(folder / "photos/new.png"))
    answer = heard.answer()
    assert answer["localised"] and answer["stamp"] == {"sec": 7, "nanosec": 8}
    assert answer["camera_frame"] == "camera_optical" and np.allclose(answer["pose"], TRUTH, atol=0.003)
    message = heard.messages[answers.LOCALISE_POSE]
    assert message["header"] == {"stamp": {"sec": 7, "nanosec": 8}, "frame_id": "map"}
    at, covariance = message["pose"]["pose"], message["pose"]["covariance"].reshape(6, 6)
    assert np.allclose([at["position"][axis] for axis in "xyz"], TRUTH[:3, 3], atol=0.003)
    turn = Rotation.from_quat([at["orientation"][axis] for axis in "xyzw"]).as_matrix()
    assert np.allclose(turn, TRUTH[:3, :3], atol=0.003)
    assert np.sqrt(np.trace(covariance[:3, :3])) == pytest.approx(answer["standard_error"]["position"])
    assert np.degrees(np.sqrt(np.trace(covariance[3:, 3:]))) == pytest.approx(answer["standard_error"]["degrees"])
    bad = image_of(folder / "photos/new.png")
    bad.encoding = "32FC1"
    node.image(bad)
    assert heard.answer()["error"]["kind"] == "bad_input"


@pytest.mark.slow
def test_images_that_come_meanwhile_are_dropped(engine: QueryEngine, folder: Path) -> None:
    heard, go = Heard(), threading.Event()
    node = Localising(engine, heard, NodeConfig(photos=str(folder / "photos")))
    node._answer = lambda *_: go.wait(60) and 1 / 0  # type: ignore[method-assign, assignment, func-returns-value]
    image = image_of(folder / "photos/new.png")
    for _ in range(3):
        node.image(image)
    go.set()
    assert heard.answer()["error"]["kind"] == "failed" and node.dropped == 2
    go.clear()
