"""The reach of a map measured from its spacing, and the options of `eval instances`."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from perception.cli import main
from perception.errors import InputError
from perception.export.export_map import ExportOptions, export_labels
from perception.io.cloud import write_cloud
from perception.types import PointCloud


def test_points_beyond_the_limit_stay_unlabelled() -> None:
    grid = np.stack(np.meshgrid(*[np.arange(8.0)] * 3), axis=-1).reshape(-1, 3)
    ids = (grid[:, 0] > 3).astype(np.int32)
    points = np.array([[0, 0, 0], [7, 7, 7], [3.5, 3.5, 3.5], [7, 7, 8.9], [7, 7, 9.2], [-40, 0, 0]], np.float32)
    labels = export_labels(grid, ids, PointCloud(points), ExportOptions(max_distance=2.0, smooth=False))
    assert labels.tolist()[:2] == [0, 1] and labels[3] == 1 and labels.tolist()[4:] == [-1, -1]
    unlimited = export_labels(grid, ids, PointCloud(points), ExportOptions(smooth=False))
    assert (unlimited >= 0).all()  # off by default, as in the paper
    for bad in (float("nan"), -1.0):
        with pytest.raises(InputError, match="max_distance"):
            export_labels(grid, ids, PointCloud(points), ExportOptions(max_distance=bad))


def test_eval_takes_the_name_of_a_protocol(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    gt = np.repeat([1, 2, 3, 9], 50)
    cloud = PointCloud(np.zeros((200, 3), np.float32), labels={"instance_id": gt.astype(np.int32)})
    for name in ("gt.ply", "pred.ply"):
        write_cloud(tmp_path / name, cloud)
    (tmp_path / "pred.json").write_text(json.dumps({"instances": {str(i): {"score": i / 10} for i in (1, 2, 3, 9)}}))

    def run(*flags: str) -> dict:
        paths = [str(tmp_path / "pred.ply"), str(tmp_path / "gt.ply")]
        assert main(["eval", "instances", *paths, "--json", *flags]) == 0
        return json.loads(capsys.readouterr().out)

    assert run()["num_truth"] == 0  # 50 points are under ScanNet's 100
    assert run()["protocol"]["confidence"].endswith("pred.json")
    assert run("--protocol", "segment3d")["protocol"]["confidence"] == "constant 1.0"
    assert main(["eval", "instances", "a.ply", "b.ply", "--protocol", "wall"]) == 2
    assert "\n" not in capsys.readouterr().err.strip()
