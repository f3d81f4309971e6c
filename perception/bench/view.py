"""`perception bench view`: from `perception view` to the picture in a real browser, over map sizes.

The clock starts with the process. `page`: the server listens; `panel`: a browser that opened the page at once shows the
controls; `received`: the whole map has come to the browser; `first`: pixels of the coarse picture are seen; `whole`:
pixels of Gaussians that the coarse picture lacks are seen. The browser is Chromium with software rendering where there
is no GPU, so the last two are a worst case.
"""

from __future__ import annotations

import argparse
import base64
import os
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from perception.bench.children import child_options
from perception.errors import InputError
from perception.viewer.splats import FIRST

FLAGS = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
WIDTH, HEIGHT = 900, 400
SCENE = slice(290, 490)
"""Columns that neither the panel nor the browser's notices cover."""
STAGES = ("page", "panel", "received", "first", "whole")
LIMIT = 400.0
"""Seconds after which a page without a picture is a failure."""
ENOUGH = 200
"""Pixels of a colour that make it seen."""


def main(arguments: list[str]) -> None:
    """Prints the seconds to every stage for every size."""
    parser = argparse.ArgumentParser(prog="perception bench view", description=__doc__)
    parser.add_argument("--sizes", type=int, nargs="+", default=[100_000, 500_000])
    parser.add_argument("--browser", default=os.environ.get("PERCEPTION_CHROMIUM") or shutil.which("chromium"))
    options = parser.parse_args(arguments)
    if not options.browser:
        raise InputError("bench view: no Chromium found; name one with --browser PATH")
    print(f"seconds, {WIDTH} x {HEIGHT} window\n{'Gaussians':>10}" + "".join(f"{stage:>10}" for stage in STAGES))
    for size in options.sizes:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "bench.gsmap"
            write_synthetic(path, size)
            seconds = time_to_picture(path, options.browser)
        print(f"{size:>10,}" + "".join(f"{seconds[stage]:>10.2f}" for stage in STAGES), flush=True)


def write_synthetic(path: Path, count: int) -> None:
    """An orange ball before a camera at the origin that looks along z, below it a blue one of smaller Gaussians.

    The coarse picture takes what covers most: the orange ones, as long as there are enough of them.
    """
    from perception.io.store import GaussianMap, write_map

    rng = np.random.default_rng(0)
    blue = np.arange(count) >= max(count // 2, min(count, FIRST))
    means = rng.normal(size=(count, 3)) * 0.25 + np.where(blue[:, None], [-0.2, 0.6, 3], [-0.2, -0.6, 3])
    entry: dict[str, Any] = {"id": 0, "label": "ball", "score": 1.0, "num_gaussians": count, "centroid": [0, 0, 3]}
    entry["obb"] = {"center": [0, 0, 3], "rotation": np.eye(3).tolist(), "extent": [2, 2, 2]}
    gmap = GaussianMap(
        means.astype(np.float32),
        np.tile(np.array([1, 0, 0, 0], np.float32), (count, 1)),
        np.log(np.where(blue, 0.005, 0.006))[:, None].repeat(3, 1).astype(np.float32),
        np.full(count, 2.0, np.float32),
        (np.where(blue, -1.4, 1.4)[:, None] * np.array([1, 0, -1]))[:, None].astype(np.float32),
        np.zeros((count, 8), np.float32),
        np.zeros(count, np.int32),
        np.ones(count, np.float32),
        [entry],
        {"frame": "map", "views": []},
        {"camera_from_world": np.eye(4, dtype=np.float32)[None]},
    )
    write_map(path, gmap)


def time_to_picture(path: Path, browser: str) -> dict[str, float]:
    """Seconds from the start of `perception view` to each of STAGES."""
    try:
        from playwright.sync_api import sync_playwright
    except ImportError as error:
        raise InputError("bench view needs Playwright: pip install playwright") from error
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = int(probe.getsockname()[1])
    seconds: dict[str, float] = {}
    with sync_playwright() as play:
        chromium = play.chromium.launch(executable_path=browser, args=FLAGS)
        page = chromium.new_page(viewport={"width": WIDTH, "height": HEIGHT})
        page.set_default_timeout(1000 * LIMIT)
        command = [sys.executable, "-m", "perception.cli", "view", str(path), "--port", str(port)]
        start, began = time.perf_counter(), time.time()

        def reached(stage: str) -> None:
            seconds[stage] = time.perf_counter() - start

        page.on("websocket", lambda line: line.on("framereceived", lambda frame: reached("received")))
        viewer = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, **child_options())
        try:
            _wait_for(port, viewer)
            reached("page")
            page.goto(f"http://127.0.0.1:{port}")
            page.wait_for_selector("text=Gaussians")
            reached("panel")
            frames = _Screencast(page)
            while "whole" not in seconds:
                page.wait_for_timeout(50)
                for shown, png in frames.taken():
                    orange, blue = _seen(png)
                    for stage, pixels in (("first", orange), ("whole", blue)):
                        if pixels > ENOUGH:
                            seconds.setdefault(stage, shown - began)
                if time.perf_counter() - start > LIMIT:
                    raise InputError(f"bench view: no whole picture after {LIMIT:.0f} s, only {seconds}")
            return seconds
        finally:
            viewer.kill()
            viewer.wait()
            chromium.close()


class _Screencast:
    """The frames that the browser shows by itself; taking a screenshot would make it draw another one."""

    def __init__(self, page: Any):
        self._frames: list[dict[str, Any]] = []
        self._session = page.context.new_cdp_session(page)
        self._session.on("Page.screencastFrame", lambda frame: self._frames.append(frame))
        self._session.send("Page.startScreencast", {"format": "png"})

    def taken(self) -> list[tuple[float, bytes]]:
        """(when it was shown, PNG) of the frames since the last call."""
        frames, self._frames[:] = list(self._frames), []
        for frame in frames:
            self._session.send("Page.screencastFrameAck", {"sessionId": frame["sessionId"]})
        return [(float(frame["metadata"]["timestamp"]), base64.b64decode(frame["data"])) for frame in frames]


def _wait_for(port: int, process: subprocess.Popen[bytes]) -> None:
    while process.poll() is None:
        with socket.socket() as probe:
            if probe.connect_ex(("127.0.0.1", port)) == 0:
                return
        time.sleep(0.02)
    raise InputError("bench view: `perception view` ended before it listened; run it by hand to see why")


def _seen(png: bytes) -> tuple[int, int]:
    """Pixels of the scene that are orange, and blue."""
    import cv2

    picture = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)
    assert picture is not None  # Playwright returns a PNG
    scene = picture[:, SCENE].astype(int)
    warmth = scene[..., 2] - scene[..., 0]
    return int((warmth > 60).sum()), int((warmth < -60).sum())
