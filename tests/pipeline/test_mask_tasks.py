"""Masks of a model, made by tasks on other machines: the same files as without, each once."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("perception._core")
from perception.config import load_config
from perception.pipeline import optimise
from perception.pipeline.mapping import build_map
from perception.tasks.engine import LOCAL
from support.elsewhere import Elsewhere
from support.onnx_files import FLOAT, SAM_DECODER, write_onnx


@pytest.fixture
def model(tmp_path: Path) -> Path:
    """A SAM whose mask is the left half of whatever it sees."""
    half = np.full((1, 4, 256, 256), -9, np.float32)
    half[..., :128] = 9
    write_onnx(
        tmp_path / "encoder.onnx",
        {"x": ((1, 3, 1024, 1024), FLOAT)},
        {"image_embeddings": np.zeros((1, 2, 64, 64), np.float32)},
    )
    found = {"masks": half, "iou_predictions": np.full((1, 4), 0.99, np.float32)}
    write_onnx(tmp_path / "decoder.onnx", SAM_DECODER, found)
    return tmp_path


@pytest.mark.slow
def test_masks_are_those_made_here(
    small_scene: Path, model: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ["train.iterations=8", "train.budget=500", "language.encoder=none", f"masks=sam:{model}"]
    config = load_config(None, [*words, "sam.points_per_side=2"])
    monkeypatch.setattr(optimise, "PHOTOS_A_TASK", 4)
    engine = Elsewhere()
    here, there = (
        build_map(small_scene / "transforms.json", tmp_path / f"{name}.gsmap", config, engine=where)
        for name, where in (("here", LOCAL), ("there", engine))
    )
    assert engine.asked == [3]  # 10 training photos of 12
    assert here.info["masks"]["masks"] > 0
    assert (here.info["masks"]["skipped"], there.info["masks"]["skipped"]) == (0, 10)
    for name in ("means", "features", "instance_ids"):
        np.testing.assert_array_equal(getattr(here, name), getattr(there, name))
