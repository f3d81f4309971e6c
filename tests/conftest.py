"""Shared by all tests: a small scene of photos with exact truth, made once."""

from __future__ import annotations

import json
import os
import shutil
import signal
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest

import perception

# Child processes import the perception under test, installed or in this tree, and the tests' helpers.
_TESTS = Path(__file__).resolve().parent
_HOMES = [Path(perception.__file__).resolve().parents[1], _TESTS, _TESTS.parent / "tools"]
os.environ["PYTHONPATH"] = os.pathsep.join(map(str, _HOMES))
# Compiled files are kept in __pycache__, which git ignores, also where PYTHONDONTWRITEBYTECODE is set, as in many a
# container: else every process compiles all tests and the package anew, which is half of collecting.
sys.dont_write_bytecode = False
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
os.environ.setdefault("OMP_WAIT_POLICY", "passive")
os.environ.setdefault("HF_HUB_OFFLINE", "1")


SLOW = 20
"""Quick tests that one slow test counts for, about, where files are put in order."""


def pytest_configure(config: pytest.Config) -> None:
    if hasattr(config.option, "loadscopereorder"):  # of pytest-xdist, which would put files of one slow test last
        config.option.loadscopereorder = False


@pytest.hookimpl(trylast=True)  # of those that -m leaves
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Under pytest-xdist long files come first, so that at the end no process waits long for another."""
    if hasattr(config, "workerinput"):
        weight = Counter[Path]()
        for item in items:
            weight[item.path] += SLOW if item.get_closest_marker("slow") else 1
        items.sort(key=lambda item: -weight[item.path])


@pytest.fixture
def interruptible() -> Iterator[None]:
    """SIGINT raises KeyboardInterrupt, also where tests are a job in the background, which ignores it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture(scope="session")
def small_scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with transforms.json, images/ and labels/ of the demo's tabletop: 12 photos of 128 × 96, exact poses.

    The label images carry other ids in every photo, as a segmenter's would. truth/ holds the truth.
    """
    from worlds import make_photos

    root = tmp_path_factory.mktemp("small")
    make_photos(root / "images", views=12, width=128, height=96, light_samples=2)
    shutil.copytree(root / "truth" / "labels", root / "labels")
    cameras = json.loads((root / "truth" / "transforms.json").read_text())
    for frame in cameras["frames"]:
        frame["file_path"] = f"images/{Path(frame['file_path']).name}"
    # Points from the surface stand in for structure from motion, which these tests are not about.
    (root / "transforms.json").write_text(json.dumps({**cameras, "ply_file_path": "truth/gt_points.ply"}))
    return root
