"""A list of jobs: each gives the map that `perception map` gives; what is finished is kept, a wrong job is one line."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from perception.cli import main
from perception.config import MapConfig, load_config
from perception.errors import InputError
from perception.map.write import Map
from perception.pipeline import fleet
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


@pytest.mark.slow
def test_an_error_of_any_class_and_other_photos_are_told_in_their_rows(
    small_scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    scene = tmp_path / "scene"
    shutil.copytree(small_scene, scene)
    set_ = {**SETTINGS, "masks": f"labels:{scene / 'labels'}"}
    jobs = [{"input": str(scene), "output": f"{name}.gsmap", "set": set_} for name in ("x", "first", "second")]
    build = fleet.build_map

    def failing(source: Path, output: Path, *more: Any, **named: Any) -> Any:
        if output.name == "x.gsmap":
            raise ZeroDivisionError("of no\ncare")
        return build(source, output, *more, **named)

    monkeypatch.setattr(fleet, "build_map", failing)
    assert main(["fleet", str(written(tmp_path, jobs))]) == 2
    told = capsys.readouterr().err
    assert "x.gsmap: ZeroDivisionError: of no care\n" in told and "1 of 3 maps could not be made" in told
    assert all((tmp_path / f"{name}.gsmap/map.json").is_file() for name in ("first", "second"))
    os.utime(scene / "images/000.jpg", ns=(1, 1))
    assert main(["fleet", str(written(tmp_path, jobs[1:2]))]) == 2
    assert "1 in all: images/000.jpg (changed)" in capsys.readouterr().err


def test_two_spellings_of_one_output_are_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "real").mkdir()
    (tmp_path / "link").symlink_to("real")
    (tmp_path / "real" / "old.gsmap").mkdir()
    spelled = ["real/b.gsmap", "real/b.gsmap/", "./real/b.gsmap", "link/b.gsmap", "link/../real/b.gsmap"]
    spelled += ["gone/../real/b.gsmap", f"{tmp_path}/real//b.gsmap"]
    for first, second in [*((spelled[0], other) for other in spelled), ("real/old.gsmap", "link/old.gsmap")]:
        file = written(tmp_path, [{"input": ".", "output": first}, {"input": ".", "output": second}])
        with pytest.raises(InputError, match="job 2: has the output of job 1"):
            read_jobs(file)
    file = written(
        tmp_path, [{"input": ".", "output": "real/new/B.gsmap"}, {"input": ".", "output": "real/New/b.gsmap"}]
    )
    if not (tmp_path / "REAL").exists():
        assert len(read_jobs(file)) == 2 and sorted(path.name for path in (tmp_path / "real").iterdir()) == [
            "old.gsmap"
        ]
    monkeypatch.setattr(fleet, "_ignores_case", lambda folder: folder == tmp_path / "real")
    with pytest.raises(InputError, match="job 2: has the output of job 1"):
        read_jobs(file)


def test_aliases_are_refused(tmp_path: Path) -> None:
    (tmp_path / "jobs.yaml").write_text("- &a {input: ., output: a.gsmap}\n- *a\n")
    with pytest.raises(InputError, match="aliases are not taken"):
        read_jobs(tmp_path / "jobs.yaml")


@pytest.mark.parametrize("url", ["s3://user:secret@b/x", "gs://b", "file:///tmp/x", "memory://x"])
def test_urls_are_refused_in_one_line(url: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    jobs = written(tmp_path, [{"input": url, "output": "a.gsmap"}])
    before = sorted(tmp_path.rglob("*"))
    for words in (
        ["map", url, "-o", "a.gsmap"],
        ["map", ".", "-o", url],
        ["export", "m", "-o", url],
        ["fleet", str(jobs)],
    ):
        assert main(words) == 2
        told = capsys.readouterr().err
        assert "is a URL" in told and "aws s3 sync" in told and "secret" not in told and told.count("\n") == 1
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize(
    ("jobs", "told"),
    [
        ({}, "expected a list of jobs"),
        ([], "expected a list of jobs"),
        (["x"], "job 1: expected 'input: PHOTOS'"),
        ([{"input": "."}], "job 1: has no output"),
        ([{"input": ".", "output": "a"}, {"input": "nowhere", "output": "b"}], "job 2: .*nowhere does not exist"),
        ([{"input": ".", "output": "a"}, {"input": ".", "output": "./a"}], "job 2: has the output of job 1"),
        ([{"input": "x" * 300, "output": "a"}], "job 1: .*xxx does not exist"),
        ([{"input": ".", "output": "a\0"}], "job 1: .*NUL"),
        ([{"input": ".", "output": "a", "config": "\0"}], "job 1: .*NUL"),
        ([{"input": ".", "output": "a", "sets": {}}], "job 1: unknown setting 'sets', did you mean set"),
        ([{"input": ".", "output": "a", "colour": 1}], "expected one of: input, output, preset, config, set$"),
        ([{"input": ".", "output": "a", "set": {"train.budgets": 3}}], "train.budget"),
        ([{"input": ".", "output": "a", "preset": "slow"}], "found 'slow', expected one of: default"),
    ],
)
def test_a_wrong_job_is_found_before_any_work(jobs: object, told: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=told):
        read_jobs(written(tmp_path, jobs))


@pytest.mark.parametrize("length", [252, 300])
def test_an_output_whose_name_is_too_long_is_one_line(
    length: int, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    assert main(["map", str(tmp_path), "-o", str(tmp_path / ("x" * length))]) == 2
    assert "no map can lie there (File name too long)" in capsys.readouterr().err and not list(tmp_path.iterdir())


def test_a_key_that_is_no_text(tmp_path: Path) -> None:
    (tmp_path / "jobs.yaml").write_text("- {1: x, input: ., output: a}")
    with pytest.raises(InputError, match="job 1: unknown setting '1'"):
        read_jobs(tmp_path / "jobs.yaml")


def test_a_list_that_is_no_yaml(tmp_path: Path) -> None:
    (tmp_path / "jobs.yaml").write_text("a: [")
    with pytest.raises(InputError, match="not readable YAML"):
        read_jobs(tmp_path / "jobs.yaml")


def test_values_of_yaml_are_words_of_settings(tmp_path: Path) -> None:
    jobs = "- {input: ., output: a.gsmap, set: {language.texts: off, train.time_limit: null, photos.strict: yes}}\n"
    (tmp_path / "jobs.yaml").write_text(jobs)
    (job,) = read_jobs(tmp_path / "jobs.yaml")
    settings = job["settings"]
    assert settings["language"]["texts"] == "off" and settings["train"]["time_limit"] is None
    assert settings["photos"]["strict"] is True
    with pytest.raises(InputError, match=r"jobs\.yaml, job 2: --set train\.iterations"):
        read_jobs(written(tmp_path, [{"input": ".", "output": f"{n}.gsmap", "set": {"train.iterations": x}} for n, x in
                                     enumerate((3, "many"))]))  # fmt: skip


def test_paths_in_settings_are_relative_to_the_list(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also those of a job's TOML file, and where the folder in which the command runs has such files, too."""
    for folder in (tmp_path / "lists", tmp_path / "here"):
        for name in ("labels", "model", "config"):
            (folder / name).mkdir(parents=True)
        (folder / "camera.yaml").touch()
    (tmp_path / "lists/config/c.toml").write_text('photos.camera = "camera.yaml"\n')
    set_ = {"masks": "labels:labels", "language.encoder": "clip:model"}
    written(tmp_path / "lists", [{"input": ".", "output": "a.gsmap", "config": "config/c.toml", "set": set_}])
    monkeypatch.chdir(tmp_path / "here")
    for file in (Path("../lists/jobs.yaml"), tmp_path / "lists/jobs.yaml"):
        (job,) = read_jobs(file)
        settings = MapConfig.model_validate(job["settings"])  # as a worker reads them
        found = (settings.masks, settings.language.encoder, settings.photos.camera)
        assert [Path(str(text).rpartition(":")[2]).resolve() for text in found] == [
            tmp_path / "lists" / name for name in ("labels", "model", "camera.yaml")
        ]
    shutil.rmtree(tmp_path / "lists/labels")
    settings = MapConfig.model_validate(read_jobs(tmp_path / "lists/jobs.yaml")[0]["settings"])
    assert settings.masks == f"labels:{tmp_path}/lists/labels"  # not those of here


def test_an_address_without_ray_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Else the maps are made here, while a cluster is paid for."""
    (tmp_path / "photos").mkdir()
    jobs = written(tmp_path, [{"input": "photos", "output": "a.gsmap"}])
    for words in (["fleet", str(jobs)], ["map", str(tmp_path / "photos"), "-o", str(tmp_path / "a.gsmap")]):
        assert main([*words, "--address", "host:6379"]) == 2
        assert "--address host:6379: is of a Ray cluster; give --engine ray too" in capsys.readouterr().err
    assert not list(tmp_path.glob("a.gsmap*"))
