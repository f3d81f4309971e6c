"""`perception map SCENE.ply` that is stopped goes on to the map of a run without a stop."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from perception.cli import main
from perception.pipeline import checkpoint
from perception.pipeline.checkpoint import CHECKPOINT, FeatureCheckpoints
from perception.progress import Progress
from perception.splats import cameras, features, panoramas
from support.splat_rooms import room_columns, write_room

pytestmark = pytest.mark.slow

OPTIONS = ["--max-side", "120", "--set", "language.encoder=none", "--set", "language.texts=off"]
OPTIONS += ["--set", "train.iterations=120"]  # 28 steps


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_room(tmp_path_factory.mktemp("room") / "room.ply", room_columns()[0])


@pytest.fixture(autouse=True)
def few_views(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cameras, "MOST_VIEWS", 8)
    monkeypatch.setattr(panoramas, "PLACES", 60)


def mapped(room: Path, output: Path, *more: str) -> int:
    return main(["map", str(room), "-o", str(output), *OPTIONS, *more])


def stop_at(where: tuple[str, int], patch: pytest.MonkeyPatch) -> None:
    """The command is interrupted when so many steps of a stage are done."""
    show = Progress.update

    def update(self: Progress, stage: str, done: int, total: int, *words: str) -> None:
        show(self, stage, done, total, *words)
        if (stage, done) == where:
            raise KeyboardInterrupt

    patch.setattr(Progress, "update", update)


@pytest.fixture(scope="module")
def whole(room: Path) -> Path:
    """The map of a run without a stop."""
    output = room.with_name("whole.gsmap")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cameras, "MOST_VIEWS", 8)
        patch.setattr(panoramas, "PLACES", 60)
        assert mapped(room, output) == 0
    return output


def gone_on(room: Path, cut: Path, whole: Path, patch: pytest.MonkeyPatch) -> int:
    """Goes on with a run that was stopped, to the same map; the steps of features that it took."""
    assert (cut.with_name("cut.gsmap.work") / CHECKPOINT).is_file()
    steps, train = list[int](), features.instance_loss
    patch.setattr(features, "instance_loss", lambda *a, **k: steps.append(1) or train(*a, **k))
    assert mapped(room, cut, "--resume") == 0
    for name in ("gaussians.ply", "features.npy", "instance_ids.npy", "membership.npy", "instances.json"):
        assert (cut / name).read_bytes() == (whole / name).read_bytes(), name
    assert not cut.with_name("cut.gsmap.work").exists()
    return len(steps)


@pytest.mark.parametrize(("where", "left"), [(("features", 13), 15), (("mask votes", 4), 0), (("silhouettes", 3), 0)])
def test_a_run_that_was_interrupted_goes_on_where_it_was(
    room: Path, whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, where: tuple[str, int], left: int
) -> None:
    cut = tmp_path / "cut.gsmap"
    with monkeypatch.context() as patch:
        stop_at(where, patch)
        assert mapped(room, cut) == 130
    assert gone_on(room, cut, whole, monkeypatch) == left


def test_a_run_that_was_killed_goes_on_from_its_last_checkpoint(
    room: Path, whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It had no time for one at its end: its last is three steps old."""
    cut, save = tmp_path / "cut.gsmap", FeatureCheckpoints.save
    with monkeypatch.context() as patch:
        stop_at(("features", 13), patch)
        patch.setattr(checkpoint, "CHECKPOINT_SECONDS", -1.0)
        patch.setattr(
            FeatureCheckpoints,
            "save",
            lambda self, state, at_once=False: state["record"]["iterations"] <= 10 and save(self, state, at_once),
        )
        assert mapped(room, cut) == 130
    assert gone_on(room, cut, whole, monkeypatch) == 18


def test_other_masks_train_features_anew(room: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The map is that of these masks alone."""
    cut, fresh = tmp_path / "cut.gsmap", tmp_path / "fresh.gsmap"
    with monkeypatch.context() as patch:
        stop_at(("features", 13), patch)
        assert mapped(room, cut) == 130
    labels = tmp_path / "labels"
    for photo in sorted((tmp_path / "cut.gsmap.frames").rglob("*.png")):
        shape = cv2.imread(str(photo)).shape[:2]
        file = labels / "virtual" / photo.name
        file.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(file), np.where(np.arange(shape[1]) < shape[1] // 3, 1, 2) * np.ones(shape, np.uint8))
    assert mapped(room, fresh, "--masks", f"labels:{labels}") == 0
    assert mapped(room, cut, "--masks", f"labels:{labels}", "--resume") == 0
    kept = (np.load(folder / "features.npy") for folder in (cut, fresh))
    np.testing.assert_array_equal(*kept)
