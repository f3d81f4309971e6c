"""Sweeps resume, tell their variants apart, and find the Pareto front."""

from __future__ import annotations

import argparse
import itertools
import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from perception.bench.output import table
from perception.cli import main
from perception.config import load_config
from perception.errors import InputError
from perception.evaluate.instances import run_instances
from speed import fronts
from speed.fronts import Variant, pareto, run_sweep, settings_of, sweep_parser, variants


def test_the_front_is_what_brute_force_says() -> None:
    rng = np.random.default_rng(0)
    for _ in range(50):
        points = [(float(c), float(v)) for c, v in rng.integers(0, 6, (12, 2))]
        beaten = {
            i
            for i, j in itertools.permutations(range(12), 2)
            if points[j][0] <= points[i][0] and points[j][1] >= points[i][1] and points[i] != points[j]
        }
        assert {points[i] for i in pareto(points)} == {p for i, p in enumerate(points) if i not in beaten}
    assert pareto([(1.0, None), (2.0, 3.0)]) == [1]


def test_every_variant_is_a_valid_setting_of_its_own(tmp_path: Path) -> None:
    cells = variants()
    assert len({(v.group, v.name) for v in cells}) == len(cells)
    for cell in cells:
        load_config(None, settings_of(cell, options_of(tmp_path)), cell.preset)


def options_of(scene: Path, *more: str) -> argparse.Namespace:
    return sweep_parser().parse_args([str(scene), "-o", str(scene / "out"), *more])


def test_an_interrupted_sweep_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    trained: list[str] = []
    stop = {"c"}

    def train(scene: Path, variant: Variant, pairs: object, row: Path) -> dict[str, float]:
        if variant.name in stop:
            stop.clear()
            raise KeyboardInterrupt
        trained.append(variant.name)
        return {"minutes": 1.0, "psnr": 20.0}

    monkeypatch.setattr(fronts, "map_variant", train)
    cells = [Variant("g", name, (f"losses.margin={margin}",)) for name, margin in (("a", 1), ("b", 2), ("c", 3))]
    with pytest.raises(KeyboardInterrupt):
        run_sweep(options_of(tmp_path), cells)
    rows = run_sweep(options_of(tmp_path), [*cells, Variant("g", "as a", ("losses.margin=1",))])
    assert trained == ["a", "b", "c"] and [row["name"] for row in rows] == ["a", "b", "c", "as a"]
    run_sweep(options_of(tmp_path, "--set", "losses.start=0.5", "--only", "nothing"), cells)
    assert trained == ["a", "b", "c", "a"]
    with pytest.raises(InputError, match="does not exist"):
        run_sweep(options_of(tmp_path / "no"), cells)


def test_a_table_shows_what_is_missing() -> None:
    text = table([{"group": "g", "name": "n", "psnr": 20.0}], (("PSNR", "psnr", ".2f"), ("AP", "ap", ".3f")))
    assert text.splitlines()[1].split() == ["g", "n", "20.00", "-"]


@pytest.mark.slow
def test_a_front_maps_and_scores_a_scene(small_scene: Path, tmp_path: Path) -> None:
    """The AP of a row is that of `export` and `eval` on its map."""
    scene, out = tmp_path / "scene", tmp_path / "out"
    shutil.copytree(small_scene, scene)
    shutil.copytree(small_scene / "truth" / "masks_gt", scene / "masks_gt")
    for name in ("gt_points.ply", "scene.json"):
        shutil.copy(small_scene / "truth" / name, scene / name)
    small = ["train.iterations=60", "train.budget=3000", "densify.every=10", "instances.min_cluster_size=15"]
    small.append("language.encoder=none")
    fronts.main([str(scene), "-o", str(out), "--only", "feature_dim 4", *(f"--set={pair}" for pair in small)])
    rows = json.loads((out / "fronts.json").read_text())["rows"]
    assert [(row["group"], row["name"]) for row in rows] == [("preset", "default"), ("feature_dim", "4")]
    info = json.loads((Path(rows[1]["map"]) / "map.json").read_text())
    assert (info["num_gaussians"], info["quality"]["psnr"]) == (rows[1]["gaussians"], rows[1]["psnr"])
    assert info["config"]["losses"]["feature_dim"] == 4 and rows[1]["cpu_minutes"] > 0
    labelled = tmp_path / "labelled.ply"
    points = str(scene / "gt_points.ply")
    assert main(["export", rows[0]["map"], "--points", points, "-o", str(labelled)]) == 0
    assert run_instances(labelled, points)[0]["ap25"] == pytest.approx(rows[0]["ap25"], abs=1e-6)
