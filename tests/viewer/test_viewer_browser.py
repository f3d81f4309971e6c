"""The viewer's page in a real browser: asking, naming, two people at once, a map that changes, parts."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from perception.language.description import InstanceDescription, to_arrays
from perception.map.replace import writing
from perception.map.write import read_map, set_labels, write_map
from perception.query import QueryMap
from support.viewer_maps import free_port, small_map

viser = pytest.importorskip("viser")
api = pytest.importorskip("playwright.sync_api")
CHROMIUM = os.environ.get("PERCEPTION_CHROMIUM") or shutil.which("chromium") or shutil.which("chromium-browser")
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="needs a Chromium (PERCEPTION_CHROMIUM or on the PATH)"),
]
FLAGS = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]


class Asked(QueryMap):
    """Stands for the language model: "pear" is instance 1, nothing else is present."""

    def query(self, text: str, top_k: int) -> list[Any]:  # type: ignore[override]
        from perception.query import Hit
        from perception.types import OrientedBox

        if text != "pear":
            return []
        points = self.means[self.instance_ids == 1]
        return [Hit(1, 0.97, points, points.mean(0), OrientedBox(points.mean(0), np.eye(3), np.ones(3)))]


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with api.sync_playwright() as play:
        chromium = play.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        yield chromium
        chromium.close()


@pytest.fixture
def path(tmp_path: Path) -> Path:
    gmap = small_map()
    names = [
        InstanceDescription(e, e[None], np.zeros((24, 4), np.float32), ["x.jpg"], [(0, 0, 1, 1)])
        for e in np.eye(3, dtype=np.float32)
    ]
    gmap.language = to_arrays(names, "words")
    write_map(tmp_path / "fruit.gsmap", gmap)
    return tmp_path / "fruit.gsmap"


@pytest.fixture
def viewer(path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    from perception.viewer import Viewer, session

    monkeypatch.setattr(session, "QueryMap", Asked)
    running = Viewer(path, port=free_port())
    yield running
    running.stop()


@pytest.fixture
def visit(viewer: Any, browser: Any) -> Iterator[Callable[[], Any]]:
    """Opens the page in a browser window of its own."""
    pages = []

    def opened() -> Any:
        page = browser.new_page(viewport={"width": 700, "height": 480})
        pages.append(page)
        page.set_default_timeout(120_000)  # software rendering on a busy machine
        page.goto(viewer.url)
        page.wait_for_selector("text=Gaussians · instances")
        return page

    yield opened
    for page in pages:
        page.close()


def field(page: Any, label: str) -> Any:
    """The text input beside a label; the first of all is viser's own server address."""
    return page.locator("input.mantine-TextInput-input").nth({"prompt": 1, "name": 2}[label])


def enter(page: Any, viewer: Any, label: str, text: str) -> None:
    """Types and presses Enter as slowly as a person.

    The page sends one message in 50 ms and of those in between only the last (viser 1.1): Enter at once would replace
    the letters before it.
    """
    held = {"prompt": viewer.panel._text, "name": viewer.panel._name}[label]
    for _ in range(20):
        field(page, label).fill(text)
        try:
            until(lambda: held.value == text, 5)
            break
        except AssertionError:  # its message was replaced by the one that marks the form as changed
            field(page, label).fill("")
    assert held.value == text
    field(page, label).press("Enter")


def until(true: Callable[[], bool], seconds: float = 60) -> None:
    end = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < end, "it did not happen"
        time.sleep(0.05)


def labels(path: Path) -> list[str | None]:
    return [entry["label"] for entry in read_map(path).instances]


def test_ask_see_name_save_reload(viewer: Any, visit: Callable[[], Any], path: Path) -> None:
    page = visit()
    enter(page, viewer, "prompt", "elephant")
    page.wait_for_selector("text=not present")
    enter(page, viewer, "prompt", "pear")
    page.wait_for_selector("text=1. instance 1")
    page.wait_for_selector("text=confidence 0.50")
    assert viewer.session.selected == [1]
    assert _yellow(page) > 100
    enter(page, viewer, "name", "the good pear")
    page.wait_for_selector("text=1. the good pear")
    page.get_by_text("Save into the map").click()
    page.wait_for_selector("text=all saved")
    page.reload()
    page.wait_for_selector("text=1. the good pear")
    shots = os.environ.get("PERCEPTION_SHOTS")
    if shots:
        page.screenshot(path=str(Path(shots) / "viewer.png"))
    assert labels(path) == [None, "the good pear", None]


def test_two_browsers_see_each_others_edits_and_lose_none(viewer: Any, visit: Callable[[], Any], path: Path) -> None:
    first, second = visit(), visit()
    enter(first, viewer, "prompt", "pear")
    second.wait_for_selector("text=1. instance 1")
    enter(first, viewer, "name", "mine")
    second.wait_for_selector("text=1. mine")
    viewer.guarded(lambda: viewer.session.select(2))
    second.wait_for_selector("text=id 2")
    enter(second, viewer, "name", "yours")
    first.wait_for_selector("text=named 2 'yours'")
    first.get_by_text("Save into the map").click()
    second.wait_for_selector("text=all saved")
    assert labels(path) == [None, "mine", "yours"]


def test_a_browser_that_leaves_in_the_middle_of_an_edit(viewer: Any, visit: Callable[[], Any]) -> None:
    """The edit is whole or not at all, and the next browser finds a working page."""
    page = visit()
    viewer.guarded(lambda: viewer.session.select(0))
    page.wait_for_selector("text=id 0")
    field(page, "name").fill("half typ")
    page.get_by_text("Split", exact=True).click()
    page.close()
    again = visit()
    viewer.guarded(lambda: viewer.session.select(1))
    again.wait_for_selector("text=id 1")
    enter(again, viewer, "name", "still here")
    again.wait_for_selector("text=named 1 'still here'")
    now = viewer.session.editor.current()
    listed = {entry["id"]: entry["num_gaussians"] for entry in now.instances}
    ids, counts = np.unique(now.instance_ids[now.instance_ids >= 0], return_counts=True)
    assert dict(zip(ids.tolist(), counts.tolist(), strict=True)) == listed
    assert "half typ" not in [entry["label"] for entry in now.instances]


def test_a_map_that_another_program_changes_is_followed(viewer: Any, visit: Callable[[], Any], path: Path) -> None:
    page = visit()
    set_labels(path, {0: "named elsewhere"})
    page.wait_for_selector("text=changed by another program")
    assert viewer.session.editor.entry(0)["label"] == "named elsewhere"
    write_map(path, small_map(900, seed=1))
    page.wait_for_selector("text=900 Gaussians")
    viewer.guarded(lambda: viewer.session.select(0))
    page.wait_for_selector("text=id 0")
    assert _yellow(page) > 100


def test_unsaved_edits_outlive_a_replaced_map(viewer: Any, visit: Callable[[], Any], path: Path) -> None:
    """They are kept and told about, saving is refused, and the person decides."""
    page = visit()
    viewer.guarded(lambda: viewer.session.editor.rename(1, "precious"), edited=True)
    page.wait_for_selector("text=named 1 'precious'")
    write_map(path, small_map(900, seed=1))
    page.wait_for_selector("text=cannot be saved into it")
    assert viewer.session.editor.entry(1)["label"] == "precious"
    page.get_by_text("Save into the map").click()
    page.wait_for_selector("text=nothing is saved")
    assert labels(path) == [None] * 3
    page.get_by_text("Drop them, open the new map").click()
    page.wait_for_selector("text=900 Gaussians")
    assert not viewer.session.editor.dirty


def test_saving_while_the_map_is_being_written_waits_for_the_person(
    viewer: Any, visit: Callable[[], Any], path: Path
) -> None:
    page = visit()
    viewer.guarded(lambda: viewer.session.editor.rename(1, "patient"), edited=True)
    with writing(path):
        page.get_by_text("Save into the map").click()
        page.wait_for_selector("text=is writing this map")
    assert labels(path) == [None] * 3
    page.get_by_text("Save into the map").click()
    page.wait_for_selector("text=all saved")
    assert labels(path) == [None, "patient", None]


def test_parts_are_shown_found_and_split_along(path: Path, browser: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    gmap = read_map(path)
    left = (gmap.instance_ids == 1) & (gmap.means[:, 0] < 0)
    parts = np.where(left, 10, np.where(gmap.instance_ids == 1, 11, -1)).astype(np.int32)
    whole = gmap.instances[1]
    gmap.instances[1] = {**whole, "parts": [{**whole, "id": i, "parent": 1, "label": None} for i in (10, 11)]}
    gmap.parts = {"ids": parts}
    write_map(path, gmap)
    from perception.query import Hit
    from perception.types import OrientedBox
    from perception.viewer import Viewer, session

    class AskedParts(Asked):
        def query(self, text: str, top_k: int) -> list[Hit]:
            points = self.means[self.parts["ids"] == 10]
            box = OrientedBox(points.mean(0), np.eye(3), np.ones(3))
            return [Hit(1, 0.8, points, points.mean(0), box, part=10)]

    monkeypatch.setattr(session, "QueryMap", AskedParts)
    viewer = Viewer(path, port=free_port())
    try:
        viewer.session.mode = "parts"
        colors = viewer.session.colors()
        assert len(np.unique(colors[np.isin(parts, [10, 11])], axis=0)) == 2
        assert len(np.unique(colors[gmap.instance_ids == 0], axis=0)) == 1
        page = browser.new_page(viewport={"width": 700, "height": 480})
        page.set_default_timeout(120_000)
        page.goto(viewer.url)
        page.wait_for_selector("text=Gaussians · instances")
        enter(page, viewer, "prompt", "stalk of the pear")
        page.wait_for_selector("text=1. part of instance 1")
        page.wait_for_selector("text=2 parts; Split takes it apart")
        assert viewer.session.selected == [1] and viewer.session.part == 10
        lit = (viewer.session.colors().astype(int) - viewer.session.colors()[~left].astype(int).mean(0)).max(axis=1)
        assert lit[left].min() > lit[~left].max()
        page.get_by_text("Split", exact=True).click()
        page.wait_for_selector("text=split 1 into 2")
        page.close()
        sizes = sorted(entry["num_gaussians"] for entry in viewer.session.editor.instances)[:2]
        assert set(sizes) <= {int(left.sum()), int((parts == 11).sum()), *np.bincount(gmap.instance_ids + 1).tolist()}
        assert len(viewer.session.editor.instances) == 4
    finally:
        viewer.stop()


EVIL = "<img src=x onerror=\"document.body.dataset.owned='yes'\">"
"""A label that runs a script where HTML is rendered."""
MARKED = "**bold** [link](http://evil.example) <b>b</b> www.evil.example a@evil.example {1+1} `code` &amp; # | ~~x~~"


@pytest.mark.parametrize(
    "label", [EVIL, MARKED, f"<script>{'x'}</script>", "a\n\n# heading\n<iframe src=//evil.example>"]
)
def test_names_and_prompts_are_shown_as_they_are_and_run_nothing(
    viewer: Any, visit: Callable[[], Any], path: Path, label: str
) -> None:
    """In every place: facts, selection of one and of several, answer, hits, history, notices, names in the scene."""
    from perception.errors import InputError

    label, elements = " ".join(label.split()), "body img[src=x], iframe, a, b, h1, del, code, script"
    page = visit()
    before = page.locator(elements).count()

    def several() -> None:
        viewer.session.select(0)
        viewer.session.select(1, add=True)

    def refuse() -> None:
        raise InputError(f"notice {label}")

    viewer.guarded(lambda: viewer.session.editor.rename(1, label), edited=True)
    viewer.guarded(lambda: viewer.session.ask("pear"))
    page.wait_for_selector("text=1. ")
    shown = page.locator("body")
    until(lambda: shown.inner_text().count(label) >= 3)  # the hit's button, the selection, the history
    viewer.guarded(several)
    until(lambda: f"2 selected: instance 0, {label}" in shown.inner_text())
    viewer.guarded(lambda: viewer.session.ask(label))
    until(lambda: f'"{label}": not present' in shown.inner_text())
    viewer.show_boxes(True)
    viewer.guarded(refuse)
    until(lambda: f"notice {label}" in shown.inner_text())
    assert page.evaluate("document.body.dataset.owned") is None
    assert page.locator(elements).count() == before


def test_a_page_of_another_origin_cannot_drive_the_viewer(viewer: Any, browser: Any, tmp_path: Path) -> None:
    """In the browser that has the viewer open: another site's script connects, embeds and reads, and gets nothing."""
    context, port = browser.new_context(), free_port()
    context.set_default_timeout(120_000)
    page = context.new_page()
    page.goto(viewer.url)
    page.wait_for_selector("text=Gaussians · instances")
    (tmp_path / "evil").mkdir()
    (tmp_path / "evil" / "index.html").write_text("<title>evil</title>")
    served = subprocess.Popen(
        [sys.executable, "-m", "http.server", str(port), "--bind", "127.0.0.1", "-d", str(tmp_path / "evil")],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        evil = context.new_page()
        until(lambda: _opens(evil, f"http://localhost:{port}/"))
        opened = evil.evaluate(
            """async ([address, protocol]) => {
              const socket = new WebSocket(address, [protocol]);
              return await new Promise((done) => {
                socket.onopen = () => done(true);
                socket.onclose = () => done(false);
              });
            }""",
            [viewer.address.replace("http", "ws"), f"viser-v{viser.__version__}"],
        )
        assert opened is False
        read = "(a) => fetch(a, {credentials: 'include'}).then((r) => r.text(), () => 'refused')"
        assert evil.evaluate(read, viewer.address) == "refused"
        evil.goto(f"{viewer.address}/?websocket=ws://localhost:{port}")
        evil.wait_for_selector("text=Gaussians · instances")
        assert evil.url == f"{viewer.address}/"
    finally:
        context.close()
        served.kill()
        served.wait()


def _opens(page: Any, address: str) -> bool:
    try:
        return bool(page.goto(address).ok)
    except api.Error:  # it does not listen yet
        return False


def _yellow(page: Any) -> int:
    """Pixels of the page in the highlight's hue."""
    import cv2

    for _ in range(40):  # the renderer sorts and draws after the message has come
        picture = cv2.imdecode(np.frombuffer(page.screenshot(), np.uint8), cv2.IMREAD_COLOR)
        assert picture is not None
        red, green, blue = (picture[..., i].astype(int) for i in (2, 1, 0))
        count = int(((red > 110) & (green > 90) & (blue < 80) & (red >= green)).sum())
        if count > 100:
            return count
        time.sleep(0.5)
    return count
