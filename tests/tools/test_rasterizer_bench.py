"""The rasterizer bench: its figures against each other."""

from __future__ import annotations

import json
import sys
from types import SimpleNamespace

import pytest
import torch

import perception
from perception.bench import rasterizer
from perception.bench.rasterizer import load_scene, synthetic_scene
from perception.cli import main
from perception.errors import InputError


@pytest.fixture
def small(monkeypatch):
    scene = synthetic_scene(300, 48, 32)
    monkeypatch.setattr(rasterizer, "synthetic_scene", lambda: scene)
    return scene


@pytest.mark.slow
def test_rasterizer_rows_are_consistent(small, tmp_path, capsys):
    rasterizer.main(["-o", str(tmp_path), "--rounds", "1", "--threads", "1", "2"])
    rows = json.loads((tmp_path / "rasterizer.json").read_text())["rows"]
    levels = len({row["simd"] for row in rows})
    assert len(rows) == levels * 2 * 2 * 2
    for row in rows:
        assert 0 < row["contributing_pairs"] <= row["evaluated_pairs"]
        shares = [row[f"share_{stage}"] for stage in rasterizer.STAGES]
        assert sum(shares) == pytest.approx(1)
        exact = row["dtype"] == "float64"
        assert (row["error_max"] == 0) == exact and (row["gradient_error"] == 0) == exact
        assert row["error_max"] < 0.1
        assert row["forward_ms"] < row["median_ms"] and (row["threads"] > 1 or row["times_one_thread"] == 1)
    assert "M pairs contribute" in capsys.readouterr().out


def test_of_a_scene_that_the_camera_does_not_see_all_figures_are_numbers(small, tmp_path, capsys):
    small["means"][:, 2] = -5
    arguments = ["--rounds", "1", "--threads", "1", "--dtypes", "float32", "--json"]
    rasterizer.main(["-o", str(tmp_path), *arguments])
    rows = json.loads(capsys.readouterr().out, parse_constant=lambda name: pytest.fail(name))["rows"]
    assert {row["gradient_error"] for row in rows} == {0} and {row["contributing_pairs"] for row in rows} == {0}


def test_as_a_command_it_keeps_the_rules_of_commands(small, tmp_path, capsys):
    """One object with --json, wherever that stands; one line for bad usage."""
    few = ["-o", str(tmp_path), "--rounds", "1", "--threads", "1", "--dtypes", "float32"]
    for words in (["--json", "rasterizer", *few], ["rasterizer", *few, "--json"]):
        assert main(["bench", *words]) == 0
        assert json.loads(capsys.readouterr().out)["rows"]
    assert main(["bench", "rasterizer", "--rounds", "x"]) == 2
    told = capsys.readouterr().err
    assert told.startswith("error: ") and told.count("\n") == 1 and "--rounds" in told


def test_a_file_that_holds_no_splats_is_named(tmp_path):
    path = tmp_path / "no.npz"
    path.write_text("text")
    with pytest.raises(InputError, match=r"no\.npz: cannot be read"):
        load_scene(path)
    with pytest.raises(InputError, match="0 rounds"):
        rasterizer.main(["--rounds", "0"])


def test_a_gpu_and_gsplat_are_measured_beside_the_cpu(small, tmp_path, monkeypatch):
    """With the CPU in the GPU's place, and gsplat played by a renderer of its signature."""

    def rasterization(means, quats, scales, opacities, colors, viewmats, Ks, width, height):
        background = torch.zeros(3)
        images = [
            perception.rasterize(means, quats, scales, opacities, part, viewmats, Ks, width, height).colors
            for part in torch.nn.functional.pad(colors, (0, -colors.shape[1] % 3)).split(3, dim=1)
        ]
        return torch.cat(images, dim=-1)[..., : colors.shape[1]], background, {}

    monkeypatch.setitem(sys.modules, "gsplat", SimpleNamespace(rasterization=rasterization, __spec__=None))
    monkeypatch.setattr(rasterizer.importlib.util, "find_spec", lambda _: True)
    monkeypatch.setattr("perception.gaussians.device.choose_device", lambda wanted: None)
    monkeypatch.setattr(rasterizer, "GPU", "cpu")
    arguments = ["--rounds", "1", "--threads", "1", "--dtypes", "float32", "--device", "cuda"]
    rasterizer.main(["-o", str(tmp_path), *arguments])
    rows = {
        (row["simd"], row["channels"]): row for row in json.loads((tmp_path / "rasterizer.json").read_text())["rows"]
    }
    assert {simd for simd, _ in rows} >= {"cuda", "gsplat", "baseline"}
    for row in rows.values():
        assert row["error_max"] < 1e-3 and row["gradient_error"] < 1e-2 and row["times_gsplat"] > 0
