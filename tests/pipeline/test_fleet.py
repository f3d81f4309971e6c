"""A list of jobs: each gives the map that `perception map` gives; what is finished is kept, a wrong job is one line."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from perception.cli import main
from perception.config import load_config
from perception.errors import InputError
from perception.map.write import Map
from perception.pipeline.fleet import read_jobs
from perception.pipeline.mapping import build_map

SETTINGS = {"train.iterations": 20, "train.budget": 600, "language.encoder": "none"}


def written(folder: Path, jobs: object) -> Path:
    (folder / "jobs.yaml").write_text(json.dumps(jobs))  # JSON is YAML
    return folder / "jobs.yaml"


@pytest.mark.slow
def test_each_job_gives_the_map_that_map_gives(
    small_scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    set_ = {**SETTINGS, "masks": f"labels:{small_scene / 'labels'}"}
    source = str(small_scene / "transforms.json")
    jobs = [{"input": source, "output": f"{n}.gsmap", "set": {**set_, "seed": n}} for n in (0, 1)]
    broken = tmp_path / "broken"
    broken.mkdir()
    jobs.append({"input": str(broken), "output": "2.gsmap"})
    assert main(["fleet", str(written(tmp_path, jobs)), "--json"]) == 2
    told = capsys.readouterr().err
    assert "2.gsmap: " in told and told.splitlines()[-1].endswith(
        "1 of 3 maps could not be made; mend the jobs and run it again"
    )
    before = {n: (tmp_path / f"{n}.gsmap" / "map.json").stat().st_mtime_ns for n in (0, 1)}
    assert main(["fleet", str(written(tmp_path, jobs[:2])), "--json"]) == 0
    made = json.loads(capsys.readouterr().out)["maps"]
    assert [Path(job["output"]).name for job in made] == ["0.gsmap", "1.gsmap"]
    assert before == {n: (tmp_path / f"{n}.gsmap" / "map.json").stat().st_mtime_ns for n in (0, 1)}
    config = load_config(None, [f"{key}={value}" for key, value in {**set_, "seed": 1}.items()])
    alone = build_map(Path(source), tmp_path / "alone.gsmap", config)
    for name in ("means", "sh", "features", "instance_ids"):
        np.testing.assert_array_equal(getattr(Map.open(tmp_path / "1.gsmap"), name), getattr(alone, name))


@pytest.mark.parametrize(
    ("jobs", "told"),
    [
        ({}, "expected a list of jobs"),
        ([], "expected a list of jobs"),
        (["x"], "job 1: expected 'input: PHOTOS'"),
        ([{"input": "."}], "job 1: has no output"),
        ([{"input": ".", "output": "a"}, {"input": "nowhere", "output": "b"}], "job 2: .*nowhere does not exist"),
        ([{"input": ".", "output": "a"}, {"input": ".", "output": "./a"}], "job 2: has the output of job 1"),
        ([{"input": ".", "output": "a", "sets": {}}], "job 1: unknown setting 'sets'"),
        ([{"input": ".", "output": "a", "set": {"train.budgets": 3}}], "train.budget"),
        ([{"input": ".", "output": "a", "preset": "slow"}], "found 'slow', expected one of: default"),
    ],
)
def test_a_wrong_job_is_found_before_any_work(jobs: object, told: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=told):
        read_jobs(written(tmp_path, jobs))


def test_a_list_that_is_no_yaml(tmp_path: Path) -> None:
    (tmp_path / "jobs.yaml").write_text("a: [")
    with pytest.raises(InputError, match="not readable YAML"):
        read_jobs(tmp_path / "jobs.yaml")
