"""The viewer: picking against the rasterizer, painting against what it promises, and the page in a real browser."""

from __future__ import annotations

import os
import shutil
import socket
from pathlib import Path

import numpy as np
import pytest
import torch

from perception.errors import InputError
from perception.io.store import GaussianMap, read_map, write_map
from perception.language.description import InstanceDescription, to_arrays
from perception.viewer.paint import HIGHLIGHT, MODES, highlight, paint
from perception.viewer.picking import covariances, pick

CHROMIUM = os.environ.get("PERCEPTION_CHROMIUM") or shutil.which("chromium") or shutil.which("chromium-browser")


def small_map(count: int = 600, seed: int = 0) -> GaussianMap:
    """Three balls of colour in front of a wall that is no instance; a camera at the origin looks along z."""
    rng = np.random.default_rng(seed)
    ids = rng.integers(-1, 3, count).astype(np.int32)
    centres = np.array([[-1.2, 0, 4], [0, 0.2, 5], [1.2, -0.2, 4.5], [0, 0, 7]])
    spread = np.where(ids[:, None] < 0, [2.0, 1.5, 0.05], 0.25)
    colors = np.array([[0.9, 0.1, 0.1], [0.1, 0.8, 0.2], [0.15, 0.2, 0.9], [0.6, 0.6, 0.6]])
    quats = rng.normal(size=(count, 4))
    pose = np.eye(4)[None].repeat(2, 0).astype(np.float32)
    entries = [
        {"id": i, "label": None, "score": 0.2 + 0.3 * i, "num_gaussians": int((ids == i).sum()), "views": 2}
        | {"centroid": centres[i].tolist(), "aabb": {"min": [0, 0, 0], "max": [1, 1, 1]}}
        | {"obb": {"center": centres[i].tolist(), "rotation": np.eye(3).tolist(), "extent": [1, 1, 1]}}
        for i in range(3)
    ]
    return GaussianMap(
        (centres[ids] + rng.normal(size=(count, 3)) * spread).astype(np.float32),
        (quats / np.linalg.norm(quats, axis=1, keepdims=True)).astype(np.float32),
        rng.uniform(np.log(0.05), np.log(0.15), (count, 3)).astype(np.float32),
        np.full(count, 3.0, np.float32),
        ((colors[ids] - 0.5) / 0.28209479177387814)[:, None].astype(np.float32),
        rng.normal(size=(count, 4)).astype(np.float32),
        ids,
        np.where(ids >= 0, 1, 0).astype(np.float32),
        entries,
        {"frame": "map", "metric": True, "views": [], "config": {"language": {"encoder": "auto"}}},
        {"camera_from_world": pose},
    )


def test_picking_agrees_with_the_rasterizer() -> None:
    """The instance with the largest rendered weight at a pixel is the one its ray picks."""
    from perception.gaussians.model import Gaussians
    from perception.gaussians.rasterize import rasterize

    gmap = small_map()
    names = ("means", "quats", "log_scales", "opacity_logits", "sh", "features")
    g = Gaussians(**{name: torch.from_numpy(getattr(gmap, name)) for name in names})
    K = torch.tensor([[400.0, 0, 160], [0, 400.0, 120], [0, 0, 1]])
    one_hot = torch.nn.functional.one_hot(torch.from_numpy(gmap.instance_ids.astype(np.int64)) + 1, 4).float()
    out = rasterize(
        g.means, g.quats, g.scales, g.opacities, g.base_colors, torch.eye(4)[None], K[None], 320, 240, features=one_hot
    )
    assert out.features is not None
    shown = np.ones(len(gmap), bool)
    rng = np.random.default_rng(1)
    agreed = asked = 0
    for _ in range(150):
        x, y = rng.uniform(0, 320), rng.uniform(0, 240)
        weights = out.features[0, int(y), int(x), 1:].numpy()
        if 0.1 < weights.max() < 0.25 or np.sort(weights)[-2] > 0.7 * weights.max() > 0:
            continue  # a tie for the eye as well
        direction = np.array([(int(x) + 0.5 - 160) / 400, (int(y) + 0.5 - 120) / 400, 1.0])
        expected = int(weights.argmax()) if weights.max() >= 0.25 else None
        asked += 1
        agreed += pick(gmap, gmap.instance_ids, shown, np.zeros(3), direction) == expected
    # The rasterizer draws the local linearisation of each Gaussian, the ray its exact section: edges may differ.
    assert asked > 80 and agreed >= 0.95 * asked


def test_picking_sees_through_what_is_hidden_and_behind() -> None:
    gmap = small_map()
    front = np.array([-1.2, 0, 4]) / np.linalg.norm([-1.2, 0, 4])
    shown = np.ones(len(gmap), bool)
    assert pick(gmap, gmap.instance_ids, shown, np.zeros(3), front) == 0
    assert pick(gmap, gmap.instance_ids, gmap.instance_ids != 0, np.zeros(3), front) is None
    assert pick(gmap, gmap.instance_ids, shown, np.zeros(3), -front) is None
    assert pick(gmap, gmap.instance_ids, shown, np.zeros(3), np.zeros(3)) is None
    assert pick(gmap, gmap.instance_ids, shown, np.full(3, np.nan), front) is None


def test_covariances_are_those_of_the_rotated_axes() -> None:
    from perception.geometry import rotation_from_quaternion

    gmap = small_map(20)
    for i, found in enumerate(covariances(gmap)):
        axes = rotation_from_quaternion(gmap.quats[i]) * np.exp(gmap.log_scales[i].astype(float))
        np.testing.assert_allclose(found, axes @ axes.T, rtol=1e-4, atol=1e-7)


@pytest.mark.parametrize("mode", MODES)
def test_every_mode_paints_every_gaussian(mode: str) -> None:
    gmap = small_map()
    scores = {i: 0.2 + 0.3 * i for i in range(3)}
    colors = paint(gmap, gmap.instance_ids, mode, scores)
    assert colors.shape == (len(gmap), 3) and colors.dtype == np.uint8
    if mode in ("instances", "confidence"):
        assert len({tuple(c) for c in colors}) == 4  # three instances and grey
        assert (colors[gmap.instance_ids < 0] == 128).all()


def test_highlight_dims_the_rest() -> None:
    gmap = small_map()
    colors = paint(gmap, gmap.instance_ids, "photo", {})
    lit = highlight(colors, gmap.instance_ids, [1])
    near = np.abs(lit.astype(int) - HIGHLIGHT).sum(axis=1)
    assert near[gmap.instance_ids == 1].max() < near[gmap.instance_ids != 1].min()
    np.testing.assert_array_equal(highlight(colors, gmap.instance_ids, []), colors)


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def test_a_port_in_use_is_told(tmp_path: Path) -> None:
    pytest.importorskip("viser")
    from perception.viewer import start_viewer

    with socket.socket() as busy:
        busy.bind(("127.0.0.1", 0))
        busy.listen()
        with pytest.raises(InputError, match="cannot be opened"):
            start_viewer(tmp_path / "none.gsmap", port=busy.getsockname()[1])
    with pytest.raises(InputError, match="no map"):
        start_viewer(tmp_path / "none.gsmap", port=_free_port())


@pytest.mark.skipif(CHROMIUM is None, reason="needs a Chromium (PERCEPTION_CHROMIUM or on the PATH)")
def test_the_page_in_a_browser(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Asks, sees the highlight, renames, saves, reloads, finds the name."""
    pytest.importorskip("viser")
    api = pytest.importorskip("playwright.sync_api")
    from perception.query import Hit
    from perception.types import OrientedBox
    from perception.viewer import session as sessions
    from perception.viewer import start_viewer

    gmap = small_map()
    names = [
        InstanceDescription(e, e[None], np.zeros((24, 4), np.float32), ["x.jpg"], [(0, 0, 1, 1)])
        for e in np.eye(3, dtype=np.float32)
    ]
    gmap.language = to_arrays(names, "words")
    path = tmp_path / "fruit.gsmap"
    write_map(path, gmap)

    class Asked:
        """Stands for the language model: "pear" is instance 1, nothing else is present."""

        def __init__(self, opened: GaussianMap, path: Path):
            self.gmap = opened

        def query(self, text: str, top_k: int) -> list[Hit]:
            if text != "pear":
                return []
            points = self.gmap.means[self.gmap.instance_ids == 1]
            return [Hit(1, 0.97, points, points.mean(0), OrientedBox(points.mean(0), np.eye(3), np.ones(3)))]

    monkeypatch.setattr(sessions, "LoadedMap", Asked)
    viewer = start_viewer(path, port=_free_port())
    try:
        with api.sync_playwright() as play:
            flags = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
            browser = play.chromium.launch(executable_path=CHROMIUM, args=flags)
            page = browser.new_page(viewport={"width": 700, "height": 480})
            page.set_default_timeout(120_000)  # software rendering on a busy machine
            page.goto(viewer.url)
            page.wait_for_selector("text=600 Gaussians")
            inputs = page.locator("input.mantine-TextInput-input")  # the first is viser's own server address
            prompt, name = inputs.nth(1), inputs.nth(2)
            prompt.fill("elephant")
            prompt.press("Enter")
            page.wait_for_selector("text=not present")
            prompt.fill("pear")
            prompt.press("Enter")
            page.wait_for_selector("text=1. instance 1")
            page.wait_for_selector("text=confidence 0.50")
            assert viewer.session.selected == [1]
            assert _yellow(page) > 100
            name.fill("the good pear")
            name.press("Enter")
            page.wait_for_selector("text=1. the good pear")
            page.get_by_text("Save into the map").click()
            page.wait_for_selector("text=all saved")
            page.reload()
            page.wait_for_selector("text=1. the good pear")
            shots = os.environ.get("PERCEPTION_SHOTS")
            if shots:
                page.screenshot(path=str(Path(shots) / "viewer.png"))
            browser.close()
    finally:
        viewer.stop()
    assert [entry["label"] for entry in read_map(path).instances] == [None, "the good pear", None]


def _yellow(page: object) -> int:
    """Pixels of the page in the highlight's hue."""
    import time

    import cv2

    for _ in range(20):  # the renderer sorts and draws after the message has come
        picture = cv2.imdecode(np.frombuffer(page.screenshot(), np.uint8), cv2.IMREAD_COLOR)[..., ::-1].astype(int)  # type: ignore[attr-defined]
        red, green, blue = picture[..., 0], picture[..., 1], picture[..., 2]
        count = int(((red > 110) & (green > 90) & (blue < 80) & (red >= green)).sum())
        if count > 100:
            return count
        time.sleep(0.5)
    return count
