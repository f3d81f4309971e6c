"""A Rerun recording read back by Rerun's own reader."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

rerun = pytest.importorskip("rerun")

from perception.io.store import GaussianMap  # noqa: E402
from perception.pipeline.recording import Recording, write_recording  # noqa: E402
from perception.types import View  # noqa: E402


def small_map() -> GaussianMap:
    rng = np.random.default_rng(0)
    box = {"center": [0, 0, 1], "rotation": np.eye(3).tolist(), "extent": [1, 2, 3]}
    return GaussianMap(
        rng.normal(size=(30, 3)).astype(np.float32),
        np.tile(np.float32([1, 0, 0, 0]), (30, 1)),
        np.full((30, 3), -3, np.float32),
        np.zeros(30, np.float32),
        np.zeros((30, 1, 3), np.float32),
        np.zeros((30, 4), np.float32),
        np.repeat([0, 1, -1], 10).astype(np.int32),
        np.ones(30, np.float32),
        [{"id": i, "label": name, "score": 0.5, "obb": box} for i, name in enumerate(["mug", None])],
        {"training": {"iterations": 700}},
    )


def test_a_recording_holds_cameras_gaussians_points_and_boxes(tmp_path: Path) -> None:
    import cv2

    cv2.imwrite(str(tmp_path / "a.png"), np.full((48, 64, 3), 90, np.uint8))
    K = np.array([[50.0, 0, 32], [0, 50, 24], [0, 0, 1]])
    views = [
        View("a.png", tmp_path / "a.png", K, 64, 48, np.eye(4)),
        View("gone.png", tmp_path / "gone.png", K, 64, 48, np.eye(4)),
    ]
    out = tmp_path / "run.rrd"
    write_recording(out, small_map(), views)
    assert [path.name for path in tmp_path.glob("*run.rrd*")] == ["run.rrd"]
    entities = _entities(out)
    for name in ("cameras/a.png", "cameras/gone.png", "gaussians", "instances", "boxes"):
        assert any(entity.endswith(name) for entity in entities), (name, entities)


def test_a_run_that_fails_leaves_no_half_recording(tmp_path: Path) -> None:
    with pytest.raises(RuntimeError), Recording(tmp_path / "run.rrd") as recording:
        recording.cameras([])
        raise RuntimeError
    assert list(tmp_path.iterdir()) == []


def test_rerun_itself_verifies_the_file(tmp_path: Path) -> None:
    """`rerun rrd verify` decodes every chunk; what it prints names our shapes and the boxes' words."""
    gmap = small_map()
    out = tmp_path / "run.rrd"
    write_recording(out, gmap, [])
    assert "1 file verified without error" in _rerun("verify", out)
    printed = _rerun("print", out, "-vvv")
    assert "GaussianSplats3D:" in printed and "Boxes3D:" in printed and "Points3D:" in printed
    assert "mug" in printed and "1 (0.50)" in printed


def _rerun(what: str, path: Path, *more: str) -> str:
    import subprocess
    import sys

    command = [sys.executable, "-m", "rerun", "rrd", what, *more, str(path)]
    told = subprocess.run(command, capture_output=True, text=True, cwd=path.parent)
    assert told.returncode == 0, told.stderr
    return told.stdout + told.stderr


def _entities(path: Path) -> set[str]:
    """Entity paths in a recording, by Rerun's own inspection."""
    import re

    return set(re.findall(r"/[\w./]+", _rerun("print", path)))
