"""A missing part is told first, `--resume` repeats only what has changed, SIGTERM is Ctrl-C, numbers are finite."""

from __future__ import annotations

import inspect
import json
import math
import os
import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from perception.cli import main
from perception.config import MapConfig, load_config
from perception.errors import InputError
from perception.gaussians import train
from perception.gaussians.views import psnr
from perception.map.write import read_map
from perception.pipeline import checkpoint, mapping
from perception.pipeline.checkpoint import (
    BEFORE_MASKS,
    CHECKPOINT,
    fingerprint,
    load_checkpoint,
    save_checkpoint,
    training_mark,
    work_folder,
)
from perception.pipeline.mapping import build_map
from perception.pipeline.record import finite
from perception.sfm.options import ReadOptions
from perception.types import Scene
from support.interrupts import interrupt_at
from support.progress import Told

pytestmark = pytest.mark.slow

SETTINGS = ["train.iterations=60", "train.budget=2000", "densify.every=10", "language.encoder=none"]
SETTINGS += ["instances.min_cluster_size=15", "instances.min_samples=5", "photos.holdout=6"]


def settings(scene: Path, *more: str) -> MapConfig:
    return load_config(None, [*SETTINGS, f"masks=labels:{scene / 'labels'}", *more])


def interrupted(source: Path, out: Path, config: MapConfig, at: int) -> None:
    with pytest.MonkeyPatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(checkpoint.TrainingObserver, "after_step", interrupt_at(at))
        build_map(source, out, config)


def test_at_most_eight_frames_from_main_to_the_loss(
    small_scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found: list[list[str]] = []

    def loss(*args: Any) -> Any:
        names = [frame.function for frame in inspect.stack()]
        found.append(["photometric", *names[1 : names.index("main") + 1]])
        raise InputError("seen")

    monkeypatch.setattr(train, "photometric", loss)
    words = ["map", str(small_scene / "transforms.json"), "-o", str(tmp_path / "m.gsmap")]
    words += [f"--set={pair}" for pair in [*SETTINGS, f"masks=labels:{small_scene / 'labels'}"]]
    assert main(words) == 2
    assert found[0] == ["photometric", "_losses", "step", "run", "optimise", "build_map", "_map", "main"]


@pytest.mark.parametrize(
    ("pair", "told"),
    [
        ("language.encoder=clip:nowhere", "nowhere"),
        ("masks=labels:nowhere", "nowhere"),
        ("masks=sam:nowhere", "nowhere"),
    ],
)
def test_a_missing_encoder_or_source_of_masks_is_found_before_the_poses(
    pair: str, told: str, small_scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def load_scene(*args: object, **kwargs: object) -> None:
        raise AssertionError("the poses were begun")

    monkeypatch.setattr(mapping, "load_scene", load_scene)
    with pytest.raises(InputError, match=told):
        build_map(small_scene / "transforms.json", tmp_path / "m.gsmap", settings(small_scene, pair))
    assert not list(tmp_path.iterdir())


def test_another_encoder_or_grouping_repeats_no_training(small_scene: Path, tmp_path: Path) -> None:
    source, out = small_scene / "transforms.json", tmp_path / "m.gsmap"
    interrupted(source, out, settings(small_scene), 60)
    told = Told()
    config = settings(small_scene, "language.encoder=conse", "language.views=2", "instances.min_cluster_size=40")
    made = build_map(source, out, config, resume=True, progress=told)
    assert "resuming at iteration 60" in told.lines and not [u for u in told.updates if u[0] == "train"]
    assert [update[1] for update in told.updates if update[0].startswith("masks")][-1] == 10
    assert made.info["masks"]["skipped"] == 10 and made.language and made.info["config"]["language"]["views"] == 2
    whole = build_map(source, tmp_path / "whole.gsmap", config)
    assert np.array_equal(made.means, whole.means) and np.array_equal(made.instance_ids, whole.instance_ids)


@pytest.mark.parametrize("at", [10, 40])  # before masks enter, at .3 of 60, and after
def test_other_masks_repeat_the_training_from_where_they_enter(at: int, small_scene: Path, tmp_path: Path) -> None:
    source, out, other = small_scene / "transforms.json", tmp_path / "m.gsmap", tmp_path / "other"
    shutil.copytree(small_scene / "labels", other)
    for file in other.iterdir():  # other ids swapped between photos make no other masks: one photo's are taken away
        if file.stem == "003":
            shutil.copyfile(small_scene / "labels" / "004.png", file)
    interrupted(source, out, settings(small_scene), at)
    told, config = Told(), settings(small_scene, f"masks=labels:{other}")
    made = build_map(source, out, config, resume=True, progress=told)
    resumed = [int(found[1]) for line in told.lines if (found := re.match(r"resuming at iteration (\d+)", line))]
    assert resumed == [min(at, 18)]
    whole = build_map(source, tmp_path / "whole.gsmap", config)
    assert np.array_equal(made.means, whole.means) and np.array_equal(made.features, whole.features)


def test_more_time_does_not_make_a_state_independent_of_its_masks(tmp_path: Path) -> None:
    """With ten times the time limit its progress of .4 is .04, which is before masks enter."""
    trainer: Any = SimpleNamespace(load=lambda state: None, iteration=40, progress=0.04, state=lambda copy: {})
    save_checkpoint(tmp_path / CHECKPOINT, {"masks": "a", "masks_enter": 0.3, "trainer": {}}, "mark")
    told = Told()
    for masks in ("a", "b"):  # the run is stopped at once, and goes on with other masks
        observer = checkpoint.TrainingObserver(tmp_path, "mark", masks, 0.3, told)
        observer.take_up(trainer)
        observer.after_leg(trainer)
    assert told.lines == [
        "resuming at iteration 40",
        f"{tmp_path / CHECKPOINT}: was trained on other masks, which enter again",
    ]


def test_other_settings_of_the_training_are_refused(small_scene: Path, tmp_path: Path) -> None:
    source, out = small_scene / "transforms.json", tmp_path / "m.gsmap"
    interrupted(source, out, settings(small_scene), 30)
    kept = {name: (work_folder(out) / name).read_bytes() for name in (CHECKPOINT, BEFORE_MASKS)}
    for pair in ("seed=1", "train.budget=3000", "losses.margin=2", "photos.max_side=64"):
        with pytest.raises(InputError, match="other settings"):
            build_map(source, out, settings(small_scene, pair), resume=True)
    assert kept == {name: (work_folder(out) / name).read_bytes() for name in kept}


def test_a_checkpoint_of_another_version_is_one_line(small_scene: Path, tmp_path: Path) -> None:
    """It may lack a figure of the record, or have one more."""
    source, out, config = small_scene / "transforms.json", tmp_path / "m.gsmap", settings(small_scene)
    interrupted(source, out, config, 30)
    file, mark = work_folder(out) / CHECKPOINT, training_mark(source, config)
    state = load_checkpoint(file, mark)
    assert state is not None
    state["trainer"]["record"]["figure_of_tomorrow"] = 1
    save_checkpoint(file, state, mark)
    with pytest.raises(InputError, match=r"checkpoint\.pt: is of another version .*figure_of_tomorrow.*; delete "):
        build_map(source, out, config, resume=True)
    assert file.is_file()


def test_other_files_under_the_same_names_are_refused(small_scene: Path, tmp_path: Path) -> None:
    """Finished or not: what was made is of the files that were there."""
    scene = tmp_path / "scene"
    shutil.copytree(small_scene, scene)
    source, done, cut = scene / "transforms.json", tmp_path / "done.gsmap", tmp_path / "cut.gsmap"
    config = settings(scene)
    build_map(source, done, config)
    interrupted(source, cut, config, 30)
    build_map(source, done, config, resume=True)
    before = {path: path.read_bytes() for path in tmp_path.glob("*.gsmap*/*") if path.is_file()}
    for name in ("images/003.jpg", "labels/003.png", "transforms.json"):
        stat = (scene / name).stat()
        os.utime(scene / name, ns=(stat.st_atime_ns, stat.st_mtime_ns + 1))
        for out in (done, cut):
            with pytest.raises(InputError, match=f"1 in all: .*{Path(name).name} .changed.;"):
                build_map(source, out, config, resume=True)
        assert before == {path: path.read_bytes() for path in tmp_path.glob("*.gsmap*/*") if path.is_file()}
        os.utime(scene / name, ns=(stat.st_atime_ns, stat.st_mtime_ns))
    assert np.array_equal(build_map(source, cut, config, resume=True).means, read_map(done).means)


def test_a_finished_map_that_tells_no_input_files_is_kept_and_refused(small_scene: Path, tmp_path: Path) -> None:
    out, config = tmp_path / "m.gsmap", settings(small_scene, "train.iterations=10")
    build_map(small_scene / "transforms.json", out, config)
    facts = json.loads((out / "map.json").read_text())
    del facts["inputs"]
    (out / "map.json").write_text(json.dumps(facts))
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    with pytest.raises(InputError, match="an older version made this map"):
        build_map(small_scene / "transforms.json", out, config, resume=True)
    assert before == {path.name: path.read_bytes() for path in out.iterdir()} and len(read_map(out)) > 0


def test_changed_frames_of_a_video_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def load_scene(source: Path, options: ReadOptions) -> Any:
        """Frames are written and poses found, then the run is stopped."""
        assert options.frames is not None
        options.frames.mkdir(exist_ok=True)
        (options.frames / "frames.json").write_text("{}")
        (options.frames / "0.jpg").write_bytes(b"x")
        return Scene([], np.zeros((0, 3)), np.zeros((0, 3), np.uint8), report={})

    def stop(*_: object) -> None:
        raise KeyboardInterrupt

    video, out = tmp_path / "v.mp4", tmp_path / "m.gsmap"
    video.write_bytes(b"x")
    monkeypatch.setattr(mapping, "load_scene", load_scene)
    monkeypatch.setattr(mapping, "in_world_frame", lambda scene, *_: scene)
    monkeypatch.setattr(mapping, "recentred", lambda scene: scene)
    monkeypatch.setattr(mapping, "log_estimate", lambda *_: None)
    monkeypatch.setattr(mapping, "split_scene", stop)
    config = load_config(None, [*SETTINGS, "masks=builtin"])
    for _ in range(2):
        with pytest.raises(KeyboardInterrupt):
            build_map(video, out, config, resume=True)
    (checkpoint.frames_folder(out) / "0.jpg").write_bytes(b"other")
    with pytest.raises(InputError, match=r"1 in all: 0\.jpg \(changed\)"):
        build_map(video, out, config, resume=True)


def test_when_to_stop_is_no_part_of_the_fingerprint(small_scene: Path, tmp_path: Path) -> None:
    mark = fingerprint(small_scene, settings(small_scene))
    save_checkpoint(tmp_path / "c.pt", {"iteration": 3}, mark)
    assert load_checkpoint(tmp_path / "c.pt", mark) == {"iteration": 3}
    assert fingerprint(small_scene, settings(small_scene, "train.time_limit=9")) == mark
    assert fingerprint(small_scene, settings(small_scene, "language.views=2")) != mark


def test_sigterm_is_ctrl_c(small_scene: Path, tmp_path: Path) -> None:
    """COLMAP's logger answers SIGTERM with a native stack trace; that its module is loaded must not matter."""
    code = (
        "import sys; from perception.cli import main; from perception.photos.lens import load_pycolmap\n"
        "import perception.pipeline.mapping as m; load = m.load_scene\n"
        "def load_scene(*a, **k):\n    load_pycolmap()\n    return load(*a, **k)\n"
        "m.load_scene = load_scene\n"
        "from perception.progress import Progress; show = Progress.update\n"  # a line a step, not one in ten seconds
        "def update(self, *words):\n    self._last = -10.0\n    show(self, *words)\n"
        "Progress.update = update\nsys.exit(main(sys.argv[1:]))"
    )
    words = [
        "map",
        str(small_scene / "transforms.json"),
        "-o",
        "m.gsmap",
        "--masks",
        f"labels:{small_scene / 'labels'}",
    ]
    words += ["--iterations", "100000", "--budget", "1500", "--set", "language.encoder=none", "--resume"]
    process = subprocess.Popen([sys.executable, "-c", code, *words], cwd=tmp_path, stderr=subprocess.PIPE, text=True)
    assert process.stderr is not None
    seen = ""
    while "train: " not in seen and process.poll() is None:
        seen += process.stderr.readline()
    process.send_signal(signal.SIGTERM)
    rest = process.communicate(timeout=120)[1]
    assert process.returncode == 130, rest
    assert rest.splitlines()[-1].startswith("interrupted; what was done is kept, go on with: perception map ")
    assert "***" not in rest and "Traceback" not in rest and (tmp_path / "m.gsmap.work" / CHECKPOINT).is_file()


def test_no_number_that_is_not_finite_stops_the_map_from_being_written(
    small_scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    original = train.Trainer.run

    def run(self: train.Trainer, *args: Any, **kwargs: Any) -> Any:
        record = original(self, *args, **kwargs)
        record.curve.append({"psnr": math.nan, "ssim": -math.inf})
        return record

    def broken(self: train.Trainer, progress: float, step: Any = train.Trainer.step) -> float:
        loss = step(self, progress)
        if self.iteration == 60:
            self.gaussians.means[3] = math.nan
            self.gaussians.log_scales[5, 1] = math.inf
        return float(loss)

    monkeypatch.setattr(train.Trainer, "run", run)
    monkeypatch.setattr(train.Trainer, "step", broken)
    build_map(small_scene / "transforms.json", tmp_path / "m.gsmap", settings(small_scene, "densify.every=7"))
    gmap = read_map(tmp_path / "m.gsmap")
    assert gmap.info["training"]["curve"][-1] == {"psnr": None, "ssim": None}
    assert all(np.isfinite(array).all() for array in (gmap.means, gmap.log_scales, gmap.features))
    json.loads((tmp_path / "m.gsmap" / "instances.json").read_text(), parse_constant=pytest.fail)


def test_finite_keeps_what_json_can_hold() -> None:
    assert finite({"a": [1.5, math.inf, (math.nan, 2)], "b": "nan", "c": -math.inf}) == {
        "a": [1.5, None, [None, 2]],
        "b": "nan",
        "c": None,
    }
    assert psnr(torch.ones(2, 2, 3), torch.full((2, 2, 3), 255, dtype=torch.uint8)) == 100.0
