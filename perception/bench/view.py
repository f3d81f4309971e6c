"""`perception bench view`: from `perception view` to the first picture in a real browser, over map sizes.

The clock starts with the process and stops when a browser that opened the page at once shows the map's pixels. The
browser is Chromium with software rendering where there is no GPU, so the picture's own drawing time is a worst case.
"""

from __future__ import annotations

import argparse
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

FLAGS = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
LIMIT = 300.0
"""Seconds after which a page without a picture is a failure."""


def main(arguments: list[str]) -> None:
    """Prints seconds to the listening page, to the panel and to the first picture for every size."""
    parser = argparse.ArgumentParser(prog="perception bench view", description=__doc__)
    parser.add_argument("--sizes", type=int, nargs="+", default=[100_000, 500_000])
    parser.add_argument("--browser", default=os.environ.get("PERCEPTION_CHROMIUM") or shutil.which("chromium"))
    options = parser.parse_args(arguments)
    if not options.browser:
        raise InputError("bench view: no Chromium found; name one with --browser PATH")
    print(f"{'Gaussians':>10} {'page s':>8} {'panel s':>8} {'picture s':>10}")
    for size in options.sizes:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "bench.gsmap"
            write_synthetic(path, size)
            page, panel, picture = first_picture(path, options.browser)
        print(f"{size:>10,} {page:>8.2f} {panel:>8.2f} {picture:>10.2f}", flush=True)


def write_synthetic(path: Path, count: int) -> None:
    """A ball of orange Gaussians before a camera at the origin that looks along z."""
    from perception.io.store import GaussianMap, write_map

    rng = np.random.default_rng(0)
    means = rng.normal(size=(count, 3)) * 0.5 + [0, 0, 3]
    entry: dict[str, Any] = {"id": 0, "label": "ball", "score": 1.0, "num_gaussians": count, "centroid": [0, 0, 3]}
    entry["obb"] = {"center": [0, 0, 3], "rotation": np.eye(3).tolist(), "extent": [2, 2, 2]}
    gmap = GaussianMap(
        means.astype(np.float32),
        np.tile(np.array([1, 0, 0, 0], np.float32), (count, 1)),
        np.full((count, 3), np.log(0.006), np.float32),
        np.full(count, 2.0, np.float32),
        np.tile(np.array([1.4, 0.0, -1.4], np.float32), (count, 1))[:, None],
        np.zeros((count, 8), np.float32),
        np.zeros(count, np.int32),
        np.ones(count, np.float32),
        [entry],
        {"frame": "map", "views": []},
        {"camera_from_world": np.eye(4, dtype=np.float32)[None]},
    )
    write_map(path, gmap)


def first_picture(path: Path, browser: str) -> tuple[float, float, float]:
    """Seconds from the start of `perception view` to (listening, panel shown, map's pixels shown)."""
    try:
        from playwright.sync_api import sync_playwright
    except ImportError as error:
        raise InputError("bench view needs Playwright: pip install playwright") from error
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = int(probe.getsockname()[1])
    with sync_playwright() as play:
        chromium = play.chromium.launch(executable_path=browser, args=FLAGS)
        page = chromium.new_page(viewport={"width": 640, "height": 400})
        page.set_default_timeout(1000 * LIMIT)
        command = [sys.executable, "-m", "perception.cli", "view", str(path), "--port", str(port)]
        start = time.perf_counter()
        viewer = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, **child_options())
        try:
            _wait_for(port, viewer)
            listening = time.perf_counter() - start
            page.goto(f"http://127.0.0.1:{port}")
            page.wait_for_selector("text=Gaussians")
            panel = time.perf_counter() - start
            while _orange(page.screenshot()) < 200:
                if time.perf_counter() - start > LIMIT:
                    raise InputError(f"bench view: no picture of {path.name} after {LIMIT:.0f} s")
            return listening, panel, time.perf_counter() - start
        finally:
            viewer.kill()
            viewer.wait()
            chromium.close()


def _wait_for(port: int, process: subprocess.Popen[bytes]) -> None:
    while process.poll() is None:
        with socket.socket() as probe:
            if probe.connect_ex(("127.0.0.1", port)) == 0:
                return
        time.sleep(0.02)
    raise InputError("bench view: `perception view` ended before it listened; run it by hand to see why")


def _orange(png: bytes) -> int:
    import cv2

    picture = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)
    assert picture is not None  # Playwright returns a PNG
    blue, _, red = (picture[..., i].astype(int) for i in range(3))
    return int((red - blue > 60).sum())
