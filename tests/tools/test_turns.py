"""Two commits in turns: means over seeds, ratios of seconds, kept rows, a checkout that is not built."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from perception.errors import InputError
from speed.turns import compared, main


def test_means_and_ratios() -> None:
    """Three seeds by hand; what only some runs have is a mean of these, and what none has is left out."""
    old = [{"cpu_seconds": c, "seconds": 10.0, "psnr": p} for c, p in ((10.0, 20.0), (20.0, 21.0), (30.0, None))]
    new = [{"cpu_seconds": 12.0, "seconds": 5.0, "psnr": 22.0}] * 3
    other, this = compared("scene", {"other": old, "this": new})
    assert (other["cpu_seconds"], other["psnr"]) == (20.0, 20.5) and "ssim" not in other
    assert (this["cpu_ratio"], this["wall_ratio"]) == pytest.approx((0.6, 0.5))


def test_kept_rows_are_not_run_again(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "perception").mkdir()
    with pytest.raises(InputError, match="no built core there; run csrc/build_inplace"):
        main([str(tmp_path), "demo", "-o", str(tmp_path / "out")])
    (tmp_path / "perception/_core.so").touch()
    (tmp_path / "out").mkdir()
    for name, seconds in (("other", 8.0), ("this", 6.0)):
        row = json.dumps({"cpu_seconds": seconds, "seconds": seconds, "psnr": 30.0})
        (tmp_path / f"out/demo-{name}-4.json").write_text(row, encoding="utf-8")
    main([str(tmp_path), "demo", "--seeds", "4", "-o", str(tmp_path / "out")])
    assert capsys.readouterr().out.splitlines()[2].split() == [
        "demo",
        "this",
        "6",
        "6",
        "30.00",
        *"---",
        "0.75",
        "0.75",
    ]
