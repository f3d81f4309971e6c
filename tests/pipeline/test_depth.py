"""Mapping with depth images: the surface is found, the record tells it, a resumed run writes the same bytes."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from perception.config import MapConfig, load_config
from perception.pipeline import checkpoint
from perception.pipeline.mapping import build_map
from perception.report.text import info_text
from support.interrupts import interrupt_at
from support.progress import Told

pytestmark = pytest.mark.slow

SETTINGS = ["train.iterations=60", "train.budget=3000", "densify.every=10", "language.encoder=none"]
SETTINGS += ["instances.min_cluster_size=15", "instances.min_samples=5", "photos.holdout=6"]
FILES = ["gaussians.ply", "instance_ids.npy", "instances.json", "features.npy"]


def settings(scene: Path, *more: str) -> MapConfig:
    return load_config(None, [*SETTINGS, f"masks=labels:{scene / 'labels'}", *more])


@pytest.fixture
def with_depth(small_scene: Path) -> Path:
    """A transforms.json of the small scene that names its depth images and no cloud."""
    data = json.loads((small_scene / "transforms.json").read_text())
    for frame in data["frames"]:
        frame["depth_file_path"] = f"truth/depth/{Path(frame['file_path']).stem}.png"
    del data["ply_file_path"]
    file = small_scene / "with_depth.json"
    file.write_text(json.dumps(data))
    return file


def test_the_map_of_depth_images_and_its_record(with_depth: Path, tmp_path: Path) -> None:
    scene, told = with_depth.parent, Told()
    made = build_map(with_depth, tmp_path / "whole.gsmap", settings(scene), progress=told)
    assert made.info["depth"] == {"views": 10, "measured": pytest.approx(0.87, abs=0.05)}
    found = made.info["quality"]["depth"]
    assert found["unit"] == "relative"
    assert found["median"] < 0.035  # half a voxel of 3000 Gaussians on this table; a start from balls ends at 0.047
    assert found["close"] > 0.4
    assert any("depth error" in line for line in told.lines)
    assert "depth images: 10" in info_text(
        tmp_path, made.info | {"num_gaussians": 0, "num_instances": 0, "sh_degree": 0}
    )

    out = tmp_path / "resumed.gsmap"
    with pytest.MonkeyPatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(checkpoint.TrainingObserver, "after_step", interrupt_at(33))
        build_map(with_depth, out, settings(scene))
    build_map(with_depth, out, settings(scene), resume=True)
    for name in FILES:
        assert (out / name).read_bytes() == (tmp_path / "whole.gsmap" / name).read_bytes()


def test_depth_weight_of_zero_ignores_depth(with_depth: Path, tmp_path: Path) -> None:
    told = Told()
    config = settings(with_depth.parent, "losses.depth_weight=0", "train.iterations=3")
    made = build_map(with_depth, tmp_path / "m.gsmap", config, progress=told)
    assert made.info["depth"] is None
    assert "depth" not in made.info["quality"]
    assert not any("with depth" in line or "depth error" in line for line in told.lines)
