"""The rasterizer and training benches: their figures against each other and against what they are made of."""

from __future__ import annotations

import json

import pytest

from perception.bench import rasterizer, training
from perception.bench.iteration import PARTS, make_trainer, measure_iteration
from perception.bench.splats import load_scene, synthetic_scene
from perception.errors import InputError


@pytest.fixture
def small(monkeypatch):
    scene = synthetic_scene(300, 48, 32)
    monkeypatch.setattr(rasterizer, "synthetic_scene", lambda: scene)
    monkeypatch.setattr(training, "default_scene", lambda path: scene)
    return scene


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
        assert row["error_mean"] <= row["error_max"] and row["error_p999"] <= row["error_max"] < 0.1
    assert "M pairs contribute" in capsys.readouterr().out


def test_iteration_parts_add_up(small):
    for losses in (True, False):
        parts = measure_iteration(make_trainer(small, 4, 1, losses), 1)
        assert set(parts) == {*PARTS, "total"}
        assert sum(parts[p] for p in PARTS) == pytest.approx(parts["total"])
        assert all(ms > 0 for name, ms in parts.items() if losses or name not in ("instance", "variance"))
        if not losses:
            assert parts["instance"] == parts["variance"] == 0


def test_training_bench_keeps_its_figures(small, tmp_path, capsys):
    size = ["--height", "24", "--width", "32", "--labels", "4", "--gaussians", "100"]
    training.main(["-o", str(tmp_path), "--turns", "1", "--threads", "1", *size])
    report = json.loads((tmp_path / "training.json").read_text())
    assert {row["group"] for row in report["operations"]} == {"photometric", "instance", "variance", "adam"}
    assert all(0 < row["rasterizer_share"] < 1 for row in report["iterations"])
    assert "Whole iteration" in capsys.readouterr().out


def test_a_file_that_holds_no_splats_is_named(tmp_path):
    path = tmp_path / "no.npz"
    path.write_text("text")
    with pytest.raises(InputError, match=r"no\.npz: not a splats file"):
        load_scene(path)
    with pytest.raises(InputError, match="0 rounds"):
        rasterizer.main(["--rounds", "0"])
