"""The rasterizer bench: its figures against each other."""

from __future__ import annotations

import json

import pytest

from perception.bench import rasterizer
from perception.bench.rasterizer import load_scene, synthetic_scene
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


def test_a_file_that_holds_no_splats_is_named(tmp_path):
    path = tmp_path / "no.npz"
    path.write_text("text")
    with pytest.raises(InputError, match=r"no\.npz: not a splats file"):
        load_scene(path)
    with pytest.raises(InputError, match="0 rounds"):
        rasterizer.main(["--rounds", "0"])
