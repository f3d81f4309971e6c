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


def stop_at(step: int, patch: pytest.MonkeyPatch) -> None:
    """The command is interrupted after so many steps of features."""
    show = Progress.update

    def update(self: Progress, stage: str, done: int, total: int, *words: str) -> None:
        show(self, stage, done, total, *words)
        if (stage, done) == ("features", step):
            raise KeyboardInterrupt

    patch.setattr(Progress, "update", update)


@pytest.mark.parametrize("killed", [False, True])
def test_a_run_stopped_in_features_goes_on_to_the_same_map(
    room: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, killed: bool
) -> None:
    """killed: without the last words of an interrupted program, so that the latest checkpoint is three steps old."""
    whole, cut = tmp_path / "whole.gsmap", tmp_path / "cut.gsmap"
    assert mapped(room, whole) == 0
    with monkeypatch.context() as patch:
        stop_at(13, patch)
        if killed:
            save = FeatureCheckpoints.save
            patch.setattr(checkpoint, "CHECKPOINT_SECONDS", -1.0)
            patch.setattr(
                FeatureCheckpoints,
                "save",
                lambda self, state, at_once=False: state["record"]["iterations"] <= 10 and save(self, state, at_once),
            )
        assert mapped(room, cut) == 130
    assert (tmp_path / "cut.gsmap.work" / CHECKPOINT).is_file()
    steps, train = list[int](), features.instance_loss
    monkeypatch.setattr(features, "instance_loss", lambda *a, **k: steps.append(1) or train(*a, **k))
    assert mapped(room, cut, "--resume") == 0
    assert len(steps) == 28 - (10 if killed else 13)
    for name in ("gaussians.ply", "features.npy", "instance_ids.npy", "membership.npy", "instances.json"):
        assert (cut / name).read_bytes() == (whole / name).read_bytes(), name
    assert not (tmp_path / "cut.gsmap.work").exists()


def test_other_masks_train_features_anew(room: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The map is that of these masks alone."""
    cut, fresh = tmp_path / "cut.gsmap", tmp_path / "fresh.gsmap"
    with monkeypatch.context() as patch:
        stop_at(13, patch)
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
