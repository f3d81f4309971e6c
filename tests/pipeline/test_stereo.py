"""Mapping few photos without depth images: stereo finds the surface, and the record tells it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from perception.config import load_config
from perception.gaussians.model import as_gaussians
from perception.gaussians.views import depth_image
from perception.pipeline.mapping import build_map
from support.two_walls import HEIGHT, WIDTH, taken, write_scene

pytestmark = pytest.mark.slow

EYES = [(x, z) for x in (-0.5, 0.0, 0.5) for z in (-0.25, 0.25)]
SETTINGS = ["train.iterations=80", "train.budget=5000", "photos.holdout=0", "language.encoder=none"]


def depth_errors(scene: Path, out: Path, *more: str) -> tuple[np.ndarray, list[str]]:
    """Relative errors [HEIGHT, WIDTH] of the depth of a map, from where no photo was taken, and its decisions."""
    config = load_config(None, [*SETTINGS, f"masks=labels:{scene.parent / 'labels'}", *more])
    made = build_map(scene, out, config)
    _, view, depth = taken(0.0, 0.0)
    rendered = depth_image(as_gaussians(made), view.camera_from_world, view.K, WIDTH, HEIGHT).numpy()
    return np.abs(rendered / depth - 1), made.info["training"]["decisions"]


def test_stereo_holds_the_surface_of_few_photos(tmp_path: Path) -> None:
    scene = write_scene(tmp_path / "scene", EYES)
    found, decisions = depth_errors(scene, tmp_path / "stereo.gsmap")
    assert any(text.startswith("stereo: depth in") and text.endswith("of 6 photos") for text in decisions)
    alone, decisions = depth_errors(scene, tmp_path / "alone.gsmap", "losses.depth_weight=0")
    assert not any("stereo" in text for text in decisions)
    assert np.median(found) < 0.01  # 0.003 when this was written, and 0.035 without stereo
    assert np.median(found) < np.median(alone) / 3
    assert (found < 0.05).mean() > max(0.85, (alone < 0.05).mean())
