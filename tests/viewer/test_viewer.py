"""The viewer: picking against the rasterizer, painting against what it promises, what arrives first."""

from __future__ import annotations

import json
import signal
import socket
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from perception.errors import InputError
from perception.io.atomic import atomic_file
from perception.map.write import write_map
from perception.viewer.picking import covariances, pick
from perception.viewer.session import HIGHLIGHT, MODES, Session, highlight, paint
from support.processes import hears_ctrl_c
from support.query_maps import HashEncoder, encoders, write_map_of
from support.viewer_maps import free_port, small_map


def test_picking_agrees_with_the_rasterizer() -> None:
    """The instance with the largest rendered weight at a pixel is the one its ray picks."""
    from perception.gaussians.model import Gaussians
    from perception.rasterizer.rasterize import rasterize

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
    from support.rotations import rotation_from_quaternion

    gmap = small_map(20)
    for i, found in enumerate(covariances(gmap)):
        axes = rotation_from_quaternion(gmap.quats[i]) * np.exp(gmap.log_scales[i].astype(float))
        np.testing.assert_allclose(found, axes @ axes.T, rtol=1e-4, atol=1e-7)


def test_an_encoder_is_loaded_once_whatever_is_edited(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[str] = []

    def make(spec: str) -> HashEncoder:
        made.append(spec)
        return encoders(spec)

    monkeypatch.setattr("perception.viewer.session.make_encoder", make)
    session = Session(write_map_of(tmp_path / "a.gsmap", gaussians=200))
    for name in ("cup", "beaker", "tin"):
        session.editor.rename(0, name)
        session.edited()
        assert [hit.label for hit in session.ask(name)] == [name]
    assert made == ["hash"]


@pytest.mark.parametrize("mode", MODES)
def test_every_mode_paints_every_gaussian(mode: str) -> None:
    gmap = small_map()
    colors = paint(gmap, gmap.instance_ids, mode)
    assert colors.shape == (len(gmap), 3) and colors.dtype == np.uint8
    if mode == "instances":
        assert len({tuple(c) for c in colors}) == 4  # three instances and grey
        assert (colors[gmap.instance_ids < 0] == 128).all()


def test_highlight_dims_the_rest() -> None:
    gmap = small_map()
    colors = paint(gmap, gmap.instance_ids, "photo")
    lit = highlight(colors, gmap.instance_ids, [1])
    near = np.abs(lit.astype(int) - HIGHLIGHT).sum(axis=1)
    assert near[gmap.instance_ids == 1].max() < near[gmap.instance_ids != 1].min()
    np.testing.assert_array_equal(highlight(colors, gmap.instance_ids, []), colors)


@pytest.mark.slow
def test_no_value_in_instances_json_ends_the_watcher(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Whatever stands there, also what only the page cannot draw: the file that comes after it is shown."""
    pytest.importorskip("viser")
    from perception.viewer import Viewer, app

    monkeypatch.setattr(app, "WATCH", 0.05)
    path = tmp_path / "m.gsmap"
    write_map(path, small_map())
    good = json.loads((path / "instances.json").read_text())

    def put(**changed: object) -> None:
        entries = [{**good["instances"][0], **changed}, *good["instances"][1:]]
        with atomic_file(path / "instances.json") as aside:
            aside.write_text(json.dumps({**good, "instances": entries}))

    def until(reached: Callable[[], bool]) -> None:
        end = time.monotonic() + 60
        while not reached():
            assert time.monotonic() < end
            time.sleep(0.02)

    viewer = Viewer(path, port=free_port())
    try:
        viewer.session.select(0)
        odd = (
            {"texts": ["MUG"]},
            {"parts": 3},
            {"parts": [5]},
            {"id": 2**70},
            {"id": 1},
            {"obb": None},
            {"score": "x"},
        )
        for turn, wrong in enumerate(odd):
            caplog.clear()
            put(**wrong)
            until(lambda: bool(viewer._problem) or bool(caplog.records) or not viewer.session.editor.outdated)
            put(label=f"mended {turn}")
            until(lambda turn=turn: viewer.session.editor.instances[0].get("label") == f"mended {turn}")
            until(lambda: not viewer._problem)
    finally:
        viewer.stop()


def test_a_port_in_use_is_told(tmp_path: Path) -> None:
    pytest.importorskip("viser")
    from perception.viewer import Viewer

    with socket.socket() as busy:
        busy.bind(("127.0.0.1", 0))
        busy.listen()
        with pytest.raises(InputError, match="is in use"):
            Viewer(tmp_path / "none.gsmap", port=busy.getsockname()[1])
    with pytest.raises(InputError, match="no map"):
        Viewer(tmp_path / "none.gsmap", port=free_port())


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGHUP])
def test_without_a_display_the_address_is_printed_and_ctrl_c_ends(tmp_path: Path, number: int) -> None:
    """As over SSH: no DISPLAY, no browser; the page answers, and Ctrl-C ends it without noise."""
    pytest.importorskip("viser")
    import os
    import subprocess
    import sys
    from urllib.request import HTTPCookieProcessor, build_opener

    write_map(tmp_path / "m.gsmap", small_map(100))
    env = {name: value for name, value in os.environ.items() if name not in ("DISPLAY", "WAYLAND_DISPLAY")}
    port = free_port()
    command = [sys.executable, "-m", "perception.cli", "view", "m.gsmap", "--port", str(port)]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    viewer = subprocess.Popen(command, cwd=tmp_path, env=env, text=True, preexec_fn=hears_ctrl_c, **pipes)
    try:
        assert viewer.stderr is not None
        told = viewer.stderr.readline()
        assert f"http://localhost:{port}" in told and f"ssh -L {port}:localhost:{port}" in told
        address = next(word for word in told.split() if word.startswith("http://"))
        cookies = build_opener(HTTPCookieProcessor())
        with cookies.open(address, timeout=30) as page:
            assert page.status == 200 and b"<script" in page.read()
        viewer.send_signal(number)
        out, err = viewer.communicate(timeout=60)
    finally:
        viewer.kill()
    assert viewer.returncode == 0 and "Traceback" not in err and out.strip() == ""
