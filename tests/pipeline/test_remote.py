"""Maps from and into object stores: those of the same photos on disk; nothing is made twice, nothing is lost."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import fsspec
import numpy as np
import pytest
from fsspec.implementations.memory import MemoryFileSystem

pytest.importorskip("perception._core")
from perception.cli import main
from perception.config import load_config
from perception.errors import InputError
from perception.io.object_store import fetch
from perception.map.write import Map
from perception.onnx.store import cache_folder
from perception.pipeline import mapping, remote
from perception.pipeline.mapping import build_map
from perception.pipeline.optimise import optimise
from perception.progress import Progress

SETTINGS = ["train.iterations=12", "train.budget=500", "language.encoder=none", "masks=builtin"]
ARRAYS = ("means", "sh", "features", "instance_ids", "membership")
QUIET = Progress(quiet=True)


def mapped(source: str, output: Path | str, *more: str) -> int:
    return main(["map", source, "-o", str(output), "--json", *(f"--set={pair}" for pair in SETTINGS), *more])


@pytest.fixture
def photos(small_scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """The small scene at a URL; no labels beside it."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    store = fsspec.filesystem("memory")
    for path in small_scene.rglob("*"):
        if path.is_file():
            store.pipe_file(f"/b/photos/{path.relative_to(small_scene).as_posix()}", path.read_bytes())
    yield "memory://b/photos/transforms.json"
    MemoryFileSystem.store.clear()
    MemoryFileSystem.pseudo_dirs[:] = [""]


@pytest.mark.slow
def test_a_map_between_urls_is_that_of_files(
    photos: str,
    small_scene: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    config, url = load_config(None, SETTINGS), "memory://b/maps/x.gsmap"
    alone = build_map(small_scene / "transforms.json", tmp_path / "alone.gsmap", config)

    def full(*_: object) -> None:
        raise InputError("the store is full")

    publish = remote.publish
    monkeypatch.setattr(remote, "publish", full)
    assert mapped(photos, url) == 2 and "the store is full" in capsys.readouterr().err
    monkeypatch.setattr(remote, "publish", publish)
    trained = []
    monkeypatch.setattr(mapping, "optimise", lambda *a: trained.append(0) or optimise(*a))
    assert mapped(photos, url) == 0  # what was made before is taken up
    told = json.loads(capsys.readouterr().out)
    info = json.loads(fsspec.filesystem("memory").cat_file("/b/maps/x.gsmap/map.json"))
    assert info["source"] == photos and info["num_gaussians"] == len(alone) and not trained
    assert not list((cache_folder() / "unpublished").iterdir())

    fetch(url, tmp_path / "back.gsmap", QUIET)
    back = Map.open(tmp_path / "back.gsmap")
    for name in ARRAYS:
        np.testing.assert_array_equal(getattr(back, name), getattr(alone, name))
    assert (tmp_path / "back.gsmap" / "report.html").is_file()

    assert mapped(photos, url, "--resume") == 0 and json.loads(capsys.readouterr().out) == told and not trained
    for more in ([], ["--resume", "--seed", "1"]):
        assert mapped(photos, url, *more) == 2
        assert "memory://b/maps/x.gsmap: exists already" in capsys.readouterr().err


def test_photos_at_a_url_are_kept_beside_a_local_map(photos: str, tmp_path: Path) -> None:
    assert mapped(photos, tmp_path / "x.gsmap") == 0
    gmap = Map.open(tmp_path / "x.gsmap")
    assert all(Path(view.photo).is_relative_to(tmp_path / "x.input") for view in gmap.views)
    assert not cache_folder().exists()


@pytest.mark.slow
def test_jobs_have_urls(photos: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    set_ = dict(text.split("=") for text in SETTINGS)
    jobs = [{"input": photos, "output": f"memory://b/{name}.gsmap", "set": set_} for name in "xy"]
    jobs.append({"input": "memory://b/nothing", "output": "z.gsmap"})
    (tmp_path / "jobs.yaml").write_text(json.dumps(jobs))
    assert main(["fleet", str(tmp_path / "jobs.yaml"), "--json"]) == 2
    assert "z.gsmap: memory://b/nothing: nothing lies there" in capsys.readouterr().err
    assert {"/b/x.gsmap/map.json", "/b/y.gsmap/map.json"} <= set(fsspec.filesystem("memory").find("/b"))
