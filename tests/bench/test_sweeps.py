"""Sweeps resume, tell their variants apart, and find the Pareto front."""

from __future__ import annotations

import itertools
import json
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from perception.bench import map as bench_map
from perception.bench import scaling, sweep
from perception.bench.memory import fresh_peak, status_mib
from perception.bench.output import table
from perception.bench.sweep import Limits, Sweep, SweepScene, Variant, limits_of, pareto, sweep_parser
from perception.cli import main
from perception.config import load_config
from perception.errors import InputError
from perception.evaluate import run_instances
from perception.pipeline.mapping import build_map


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


@pytest.mark.parametrize(
    "cells",
    [
        bench_map.variants("labels"),
        scaling.variants(None, 640, (1, 2)),
    ],
)
def test_every_variant_is_a_valid_setting_of_its_own(cells: list[Variant]) -> None:
    assert len({(v.group, v.name) for v in cells}) == len(cells)
    for cell in cells:
        Limits().config(cell)


def test_limits_shorten_every_variant_alike() -> None:
    limits = Limits(shorten=10, max_side=320, budget=2000)
    plain = limits.config(Variant("a", "b"))
    rich = limits.config(Variant("a", "b", preset="quality"))
    full = Limits().config(Variant("a", "b")).train.iterations
    assert plain.train.iterations == round(full / 10) and rich.train.iterations > plain.train.iterations
    assert (rich.photos.max_side, rich.train.budget) == (320, 2000)
    with pytest.raises(InputError, match="--shorten"):
        limits_of(sweep_parser("x", None).parse_args(["scene", "--shorten", "0"]))


def test_an_interrupted_sweep_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    trained: list[str] = []
    stop = {"c"}

    def train(scene: SweepScene, variant: Variant, config: object) -> dict[str, float]:
        if variant.name in stop:
            stop.clear()
            raise KeyboardInterrupt
        trained.append(variant.name)
        return {"seconds": 1.0, "psnr": 20.0}

    monkeypatch.setattr(sweep, "run_variant", train)
    scene = SweepScene(tmp_path, tmp_path / "work")
    cells = [Variant("g", name, (f"losses.margin={margin}",)) for name, margin in (("a", 1), ("b", 2), ("c", 3))]
    with pytest.raises(KeyboardInterrupt):
        Sweep(tmp_path, Limits(), lambda text: None).run(scene, cells)
    rows = Sweep(tmp_path, Limits(), lambda text: None).run(scene, [*cells, Variant("g", "as a", ("losses.margin=1",))])
    assert trained == ["a", "b", "c"] and [row["name"] for row in rows] == ["a", "b", "c", "as a"]
    Sweep(tmp_path, Limits(settings=("losses.start=0.5",)), lambda text: None).run(scene, cells[:1])
    assert trained == ["a", "b", "c", "a"]
    (tmp_path / "rows.json").write_text("{")
    with pytest.raises(InputError, match="not valid JSON"):
        Sweep(tmp_path, Limits(), lambda text: None)


@pytest.mark.skipif(not Path("/proc/self/clear_refs").exists(), reason="only Linux tells the peak and lets it go")
def test_a_peak_of_memory_is_forgotten() -> None:
    fresh_peak()
    before = status_mib("VmHWM")
    del (waste := [np.ones(1_000) for _ in range(16_000)])[:]  # 122 MiB in blocks that the allocator likes to keep
    assert not waste and status_mib("VmHWM") > before + 100
    fresh_peak()
    assert status_mib("VmHWM") < before + 50  # the kernel's word; a page here and there is still in use


def test_a_scene_keeps_the_photos_of_one_size(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        "perception.pipeline.photos.load_all", lambda views, side, progress: [f"{v}-{side}" for v in views]
    )
    monkeypatch.setattr("perception.pipeline.photos.split_views", lambda views, every: (views[1:], views[:1]))
    scene = SweepScene(tmp_path, tmp_path / "work", _scene=SimpleNamespace(views=["a", "b"]))
    assert scene.photos(640) == (["b-640"], ["a-640"]) and scene.training(320, None) == ["b-320"]
    assert list(scene._views) == [320]


def test_a_table_shows_what_is_missing() -> None:
    text = table([{"group": "g", "name": "n", "psnr": 20.0}], (("PSNR", "psnr", ".2f"), ("AP", "ap", ".3f")))
    assert text.splitlines()[1].split() == ["g", "n", "20.00", "-"]


@pytest.mark.slow
def test_a_bench_trains_and_scores_a_scene(small_scene: Path, tmp_path: Path) -> None:
    """The first row's figures are those of `perception map` and `export` with the same settings."""
    scene, out = tmp_path / "scene", tmp_path / "out"
    shutil.copytree(small_scene, scene)
    shutil.copy(small_scene / "truth" / "gt_points.ply", scene / "gt_points.ply")
    small = ["train.iterations=120", "train.budget=3000", "densify.every=20", "instances.min_cluster_size=15"]
    command = ["bench", "map", str(scene / "transforms.json"), "-o", str(out), "--only", "d 4"]
    assert main([*command, *(f"--set={pair}" for pair in [*small, "instances.min_samples=5"])]) == 0
    rows = json.loads((out / "map.json").read_text())["rows"]
    assert [(row["group"], row["name"]) for row in rows] == [("preset", "default"), ("d", "4")]
    assert rows[0]["iterations"] == 120 and rows[0]["cpu_seconds"] > 0 and rows[0]["ap25"] is not None

    config = load_config(None, [*(json_pairs(rows[0]["config"])), f"masks=labels:{scene / 'labels'}"])
    build_map(scene / "transforms.json", tmp_path / "same.gsmap", config)
    info = json.loads((tmp_path / "same.gsmap" / "map.json").read_text())
    assert (info["num_gaussians"], info["quality"]["psnr"]) == (rows[0]["gaussians"], rows[0]["psnr"])
    labelled = tmp_path / "labelled.ply"
    points = str(scene / "gt_points.ply")
    assert main(["export", str(tmp_path / "same.gsmap"), "--points", points, "-o", str(labelled)]) == 0
    assert run_instances(labelled, points)[0]["ap25"] == pytest.approx(rows[0]["ap25"], abs=1e-6)


def json_pairs(config: dict[str, Any]) -> list[str]:
    """A kept config as KEY=VALUE."""
    pairs = []
    for key, value in config.items():
        inner = value.items() if isinstance(value, dict) else [("", value)]
        pairs += [f"{key}.{name}".rstrip(".") + f"={'none' if v is None else v}" for name, v in inner]
    return pairs
