"""Blocks of a large place: how it is cut, that they tile it, and that the joined map has each thing once."""

from __future__ import annotations

import importlib.util
import json
import tracemalloc
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from perception.config import MapConfig, load_config
from perception.errors import InputError
from perception.gaussians.model import Nearby, from_points
from perception.gaussians.state import TrainingState, TrainRecord
from perception.gaussians.stereo import visible_points
from perception.geometry import camera_centres
from perception.map.write import Map
from perception.masks import make_source
from perception.pipeline import blocks as module
from perception.pipeline import photo_tasks
from perception.pipeline.blocks import APART, Block, cut, joined, nearby_rows, optimise_block, optimise_blocks
from perception.pipeline.checkpoint import CHECKPOINT, work_folder
from perception.pipeline.mapping import build_map
from perception.pipeline.optimise import Optimised, Photos, Run
from perception.progress import QUIET
from perception.tasks.engine import Engine
from perception.tasks.folder import TASK, read_task, renew_task, versions, write_task
from perception.types import Scene, View
from support.aimed import look_at
from support.elsewhere import Elsewhere
from support.interrupts import interrupt_at
from support.row_scene import centres, write_row

BALLS = 8
SETTINGS = [
    "train.iterations=400",
    "train.budget=1200",
    "densify.every=20",
    "language.encoder=none",
    "photos.poses=keep",
]
SETTINGS += ["train.block_photos=14", "frame.keep_world=true"]


@pytest.fixture(scope="module")
def row(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_row(tmp_path_factory.mktemp("row"), BALLS)


def settings(row: Path, *more: str) -> MapConfig:
    return load_config(None, [*SETTINGS, f"masks=labels:{row.parent / 'labels'}", *more])


@pytest.fixture(scope="module")
def whole(row: Path, tmp_path_factory: pytest.TempPathFactory) -> Map:
    return build_map(row, tmp_path_factory.mktemp("map") / "whole.gsmap", settings(row))


def same(a: Map, b: Map) -> None:
    for name in ("means", "sh", "features", "instance_ids"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))


def corridor(count: int = 40) -> Scene:
    """Cameras that walk along x and look at a wall in front of them, of 2000 points."""
    rng = np.random.default_rng(1)
    points = np.stack([rng.uniform(-1, 21, 2000), rng.uniform(1.9, 2.1, 2000), rng.uniform(-1, 1, 2000)], axis=1)
    K = np.array([[50.0, 0, 32], [0, 50, 24], [0, 0, 1]])
    views = []
    for number, x in enumerate(np.linspace(0, 20, count)):
        pose = look_at(np.array([x, 0, 0.0]), np.array([x, 1.0, 0]), np.array([0, 0, 1.0]))
        views.append(View(f"{number:03d}.png", Path("x.png"), K, 64, 48, pose))
    return Scene(views, points, np.zeros((2000, 3), np.uint8))


def test_a_point_is_visible_if_no_nearer_one_hides_it() -> None:
    """Against a loop over the points, two walls one behind the other."""
    rng = np.random.default_rng(2)
    view = corridor().views[20]
    points = rng.uniform([5, 1, -2], [15, 8, 2], (400, 3)) * [1, -1, 1] ** rng.integers(0, 2, (400, 1))
    found = visible_points(view, points)
    nearest: dict[tuple[int, int], float] = {}
    cells: list[tuple[int, int] | None] = []
    for point in points:
        x, y, z = view.camera_from_world[:3, :3] @ point + view.camera_from_world[:3, 3]
        u, v = (50 * x / z + 32) / 64, (50 * y / z + 24) / 48
        cells.append((int(16 * v), int(16 * u)) if z > 0 and 0 <= u < 1 and 0 <= v < 1 else None)
        if cells[-1] is not None:
            nearest[cells[-1]] = min(nearest.get(cells[-1], np.inf), z)
    depths = (points @ view.camera_from_world[:3, :3].T + view.camera_from_world[:3, 3])[:, 2]
    wanted = [cell is not None and z <= 1.3 * nearest[cell] for cell, z in zip(cells, depths, strict=True)]
    assert found.tolist() == wanted and 10 < sum(wanted) < sum(cell is not None for cell in cells)


def test_blocks_tile_space_and_have_all_photos_of_their_box() -> None:
    scene = corridor()
    found = cut(scene, 15)
    assert len(found) >= 3 and max(len(block.views) for block in found) <= 15
    anywhere = np.random.default_rng(3).uniform(-100, 100, (500, 3))
    assert (np.sum([block.owns(anywhere) for block in found], axis=0) == 1).all()
    seen = np.stack([visible_points(view, scene.points) for view in scene.views])
    for number in range(len(scene.views)):
        shares = np.array([block.owns(scene.points)[seen[number]].mean() for block in found])
        inside = [number in block.views for block in found]
        pose = scene.views[number].camera_from_world
        stands = np.array([block.owns(camera_centres(pose[None]))[0] for block in found])
        assert all(np.array(inside)[(shares > 0.2) | stands])
    overlap = sum(len(block.views) for block in found) - len(scene.views)
    assert 0 < overlap <= 12  # neighbours share the photos that see across their seam


def test_a_place_that_every_photo_sees_stays_whole() -> None:
    scene = corridor()
    assert len(cut(scene, 0)) == len(cut(scene, 40)) == 1
    around = [replace(scene.views[20], name=str(n)) for n in range(40)]
    assert len(cut(replace(scene, views=around), 10)) == 1
    assert len(cut(replace(scene, report={"points_from": "random"}), 10)) == 1


def test_a_cut_holds_less_than_a_byte_for_each_photo_and_point() -> None:
    """What 200 more photos take, each of which sees all points."""
    scene = corridor()
    points = np.random.default_rng(4).uniform([5, 1.9, -1], [15, 2.1, 1], (16_000, 3))
    far = look_at(np.array([10, -40, 0.0]), np.array([10, 2, 0.0]), np.array([0, 0, 1.0]))
    view = replace(scene.views[0], camera_from_world=far)
    assert visible_points(view, points).all()

    def peak(count: int) -> int:
        views = [replace(view, name=str(number)) for number in range(count)]
        tracemalloc.start()
        cut(replace(scene, views=views, points=points), 10)
        most = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return most

    assert peak(300) - peak(100) < 200 * len(points)


def test_blocks_share_the_time_limit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As they are trained one after the other; by their numbers of photos."""
    scene, limits = corridor(), list[tuple[int, float]]()

    def train(folder: str, progress: Any) -> None:
        block, facts = read_task(Path(folder))
        limits.append((len(block.views), facts["config"]["train"]["time_limit"]))

    monkeypatch.setattr(module, "optimise_block", train)
    run = Run.begun(tmp_path, load_config(pairs=["train.time_limit=60"]), tmp_path, QUIET)
    with pytest.raises(InputError, match=r"has no result\.pt"):  # nothing was trained
        optimise_blocks(cut(scene, 15), run, scene, scene.views, [], make_source("builtin"))
    assert len(limits) >= 3 and sum(limit for _, limit in limits) == pytest.approx(60)
    assert len({round(limit / photos, 6) for photos, limit in limits}) == 1


def test_a_resumed_block_has_the_settings_of_today(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its time limit, device and masks; sizes and the part of the scene are those that it began with."""
    scene, asked = corridor(), list[tuple[MapConfig, int]]()

    def train(folder: str, progress: Any) -> None:
        part, facts = read_task(Path(folder))
        asked.append((MapConfig.model_validate(facts["config"]), len(part.points)))

    monkeypatch.setattr(module, "optimise_block", train)
    blocks = cut(scene, 15)
    for more, pairs in enumerate((["train.time_limit=60"], ["train.time_limit=240", "device=cpu", "masks=builtin"])):
        run = Run.begun(tmp_path, load_config(pairs=pairs), tmp_path, QUIET)
        with pytest.raises(InputError, match=r"has no result\.pt"):  # nothing was trained
            optimise_blocks(blocks, run, scene, scene.views, [], make_source("builtin"))
        monkeypatch.setattr(module, "largest_budget", lambda memory, more=more: 100 + more)
        scene = replace(scene, points=scene.points[:1000], point_colors=scene.point_colors[:1000])
    first, again = asked[: len(blocks)], asked[len(blocks) :]
    for (before, points), (now, others) in zip(first, again, strict=True):
        assert now.train.time_limit == pytest.approx(4 * (before.train.time_limit or 0)) and points == others
        assert (now.device, now.masks) == ("cpu", "builtin") and now.train.budget == before.train.budget > 101


def test_a_finished_block_is_trained_again_only_for_other_masks_or_more_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    trained, scene = list[int](), corridor(4)
    labels = Scene(scene.views, scene.points[:9], scene.point_colors[:9])
    gaussians = from_points(np.eye(3), np.zeros((3, 3), np.uint8), feature_dim=2, seed=0)

    def optimised(run: Run, *rest: Any) -> Optimised:
        trained.append(0)
        (run.work / CHECKPOINT).touch()
        return Optimised(Nearby(gaussians), Photos([], [], [], []), TrainRecord(), {})

    def again(limit: float | None, masks: str) -> int:
        config = MapConfig().model_copy(update={"masks": "builtin"})
        facts = {"source": "x", "config": config.to_json(), "held_out": [], "box": [], "masks": "x"}
        write_task(tmp_path / "b", labels, **facts, trained_by={"masks": masks, "time_limit": limit})
        optimise_block(str(tmp_path / "b"))
        return len(trained)

    monkeypatch.setattr(module, "optimise", optimised)
    assert [again(5.0, "a"), again(5.0, "a"), again(9.0, "a"), again(9.0, "b"), again(None, "b")] == [1, 1, 2, 3, 4]
    assert not (tmp_path / "b" / CHECKPOINT).exists()  # all is done
    assert [again(3.0, "b"), again(None, "b"), again(None, "c")] == [4, 4, 5]


def test_joined_gaussians_keep_their_order_harmonics_and_blocks() -> None:
    a, b = (from_points(np.eye(3) * n, np.full((3, 3), 90, np.uint8), feature_dim=2, seed=0) for n in (1, 2))
    b = replace(b, sh=torch.arange(36.0).reshape(3, 4, 3))
    both = joined([a, b])
    assert torch.equal(both.means, torch.cat([a.means, b.means])) and torch.equal(both.sh[3:], b.sh)
    assert torch.equal(both.sh[:3, :1], a.sh) and not both.sh[:3, 1:].any()
    assert torch.equal(both.features[:3], a.features)
    assert torch.equal(both.features[3:] - b.features, torch.tensor([APART, 0.0]).expand(3, 2))


@pytest.mark.slow
def test_each_thing_of_a_row_is_one_instance_also_on_seams(row: Path, whole: Map, tmp_path: Path) -> None:
    assert len(whole.info["blocks"]) >= 2
    seams = {x for block in whole.info["blocks"] for x in (block["box"][0][0], block["box"][1][0]) if x is not None}
    assert any(abs(x - ball) < 0.3 for x in seams for ball in range(BALLS)), seams  # a seam goes through a ball
    solid = whole.opacities > 0.3
    away = np.linalg.norm(whole.means[:, None] - centres(BALLS), axis=2)
    ball = np.argmin(away, axis=1)
    # The points lie at .3. Between the balls is background, how much of it depends on the processor's rounding.
    solid &= away.min(axis=1) < 0.45
    owners = [np.bincount(whole.instance_ids[solid & (ball == n)] + 1) for n in range(BALLS)]
    # Gaussians of the black background, which no mask shows, may be an instance too, with a score of about .3.
    things = sum(entry["score"] > 0.5 for entry in whole.instances)
    assert len({int(own[1:].argmax()) for own in owners}) == BALLS == things
    assert all(own[1:].max() > 0.75 * own.sum() for own in owners)
    piece = build_map(row, tmp_path / "piece.gsmap", settings(row, "train.block_photos=0"))
    assert whole.info["quality"]["psnr"] > piece.info["quality"]["psnr"] - 1.0  # both are about 28 dB


def test_places_without_a_photo_in_common_are_blocks_of_one_frame() -> None:
    one = corridor()
    away = np.array([60.0, 0, 0])  # 39 m between them
    shift = np.eye(4)
    shift[:3, 3] = -away
    moved = [replace(view, camera_from_world=view.camera_from_world @ shift) for view in one.views]
    points = np.concatenate([one.points, one.points + away])
    found = cut(Scene([*one.views, *moved], points, np.zeros((4000, 3), np.uint8)), 40)
    first = [block for block in found if block.views.min() < 40]
    assert all(block.views.max() < 40 for block in first) and 0 < len(first) < len(found)
    assert {int(i) for block in found for i in block.views} == set(range(80))


def test_near_a_photo_are_the_gaussians_of_the_blocks_that_it_sees() -> None:
    scene = corridor()
    blocks = cut(scene, 15)
    counts = list(range(2, 2 + len(blocks)))
    owner = np.repeat(np.arange(len(blocks)), counts)
    rows = nearby_rows(scene, blocks, counts)
    for number, view in enumerate(scene.views):
        visible = scene.points[visible_points(view, scene.points)]
        sees = [number in block.views or block.owns(visible).any() for block in blocks]
        assert np.concatenate(rows[view.name]).tolist() == [i for i, block in enumerate(owner) if sees[block]]
    assert len(blocks) > 2 and len({id(parts) for parts in rows.values()}) < len(scene.views)  # shared
    assert len({id(part) for parts in rows.values() for part in parts}) == len(blocks)  # a row is held once


@pytest.mark.slow
def test_blocks_go_on_for_the_time_that_is_added(row: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """By a clock that counts iterations, 100 a second: a finished block and one that was stopped, at half its time."""
    monkeypatch.setattr(TrainingState, "elapsed", property(lambda self: self.iteration / 100))
    out, trained, original = tmp_path / "m.gsmap", list[object](), module.optimise

    def second(run: Run, *rest: Any) -> Any:
        trained.append(run)
        if len(trained) == 2:
            monkeypatch.setattr("perception.pipeline.checkpoint.TrainingObserver.after_step", interrupt_at(20))
        return original(run, *rest)

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(module, "optimise", second)
        build_map(row, out, settings(row, "train.time_limit=0.8"))
    monkeypatch.undo()
    monkeypatch.setattr(TrainingState, "elapsed", property(lambda self: self.iteration / 100))
    blocks = build_map(row, out, settings(row, "train.time_limit=2"), resume=True).info["blocks"]
    photos = sum(block["photos"] for block in blocks)
    assert len(blocks) >= 2
    for block in blocks:
        assert block["iterations"] == pytest.approx(200 * block["photos"] / photos, abs=1.01)


@pytest.mark.slow
def test_a_run_that_was_stopped_in_a_block_ends_in_the_same_map(
    row: Path, whole: Map, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, trained, original = tmp_path / "m.gsmap", list[object](), module.optimise

    def second(run: Run, *rest: Any) -> Any:
        trained.append(run)
        if len(trained) == 2:
            raise KeyboardInterrupt
        return original(run, *rest)

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr("perception.pipeline.checkpoint.TrainingObserver.after_step", interrupt_at(70))
        build_map(row, out, settings(row))
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(module, "optimise", second)
        build_map(row, out, settings(row), resume=True)
    build_map(row, out, settings(row), resume=True)
    same(Map.open(out), whole)
    assert not work_folder(out).exists()


def test_a_worker_of_another_version_is_refused(tmp_path: Path) -> None:
    for theirs, told in (
        ({**versions(), "perception": "9.9"}, r"this worker has perception .*, the run 9\.9; install the same"),
        ({**versions(), "zlib": "1"}, r"this worker has zlib None, the run 1; install the same"),
    ):
        (tmp_path / TASK).write_text(json.dumps({"versions": theirs}))
        with pytest.raises(InputError, match=told):
            optimise_block(str(tmp_path))


class KilledOnce(Engine):
    """An engine whose first task kills its worker in the middle of the training, once."""

    def run(self, task: Callable[..., Any], folders: Sequence[str], *rest: Any) -> list[Any]:
        mark = Path(folders[0]).parents[1] / "killed"

        def killed(folder: str) -> None:  # runs in the worker, which cannot import this module
            import os
            import signal

            from perception.pipeline import checkpoint

            original = checkpoint.TrainingObserver.after_step

            def after_step(self: Any, trainer: Any, loss: float) -> None:
                original(self, trainer, loss)
                if trainer.iteration == 70 and not mark.exists():
                    mark.touch()
                    os.kill(os.getpid(), signal.SIGKILL)

            checkpoint.CHECKPOINT_SECONDS = 0.0
            checkpoint.TrainingObserver.after_step = after_step  # type: ignore[method-assign]
            task(folder)

        return super().run(killed, folders, *rest)


@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="needs the extra ray")
def test_ray_gives_the_same_map_although_a_worker_is_killed(
    row: Path, whole: Map, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("RAY_ADDRESS", "127.0.0.1:1")  # a cluster that is gone: without --address a new one is started
    made = build_map(row, tmp_path / "m.gsmap", settings(row), engine=KilledOnce("ray"))
    assert (tmp_path / "killed").exists()
    same(made, whole)


@pytest.mark.slow
def test_votes_and_silhouettes_of_other_machines_are_those_made_here(
    row: Path, whole: Map, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Tasks that have nothing but their folders, each run twice, of photos that see one block or two."""
    monkeypatch.setattr(photo_tasks, "PHOTOS_A_TASK", 7)
    engine, shown = Elsewhere(), list[list[list[int]]]()

    def noted(folder: Path, scene: Scene, **facts: Any) -> None:
        shown.append(facts["parts"])
        renew_task(folder, scene, **facts)

    monkeypatch.setattr(photo_tasks, "renew_task", noted)
    made = build_map(row, tmp_path / "m.gsmap", settings(row), engine=engine)
    sets = -(-sum(not view.held_out for view in whole.views) // 7)
    assert engine.asked[-2:] == [sets, sets] and len(shown) == 2 * sets
    assert {len(parts) for task in shown for parts in task} >= {1, 2}
    same(made, whole)
    assert made.instances == whole.instances
    np.testing.assert_array_equal(made.membership, whole.membership)
    assert not work_folder(tmp_path / "m.gsmap").exists()


def test_no_cluster_at_an_address_is_one_line() -> None:
    pytest.importorskip("ray")
    with pytest.raises(InputError, match=r"--address 127\.0\.0\.1:1: no Ray cluster there .*ray start --head"):
        Engine("ray", "127.0.0.1:1").run(optimise_block, ["x"], "block", None)  # type: ignore[arg-type]


def test_a_block_does_not_add_what_leaves_it_longer_than_its_nearest_camera_is_far() -> None:
    """The block owns x < 1, its camera stands 2 from the origin. Only the needle that crosses x = 1 is left out."""
    block = Block(np.full(3, -np.inf), np.array([1, np.inf, np.inf]), np.arange(1))
    about = {  # mean x: longest σ, its axis as a quaternion of the x axis
        "small, across the border": (0.95, 0.1, (1, 0, 0, 0)),
        "long, shorter than the camera is far": (0.0, 1.9, (1, 0, 0, 0)),
        "a needle across the border": (0.0, 2.1, (1, 0, 0, 0)),
        "a needle along the border": (0.0, 9.0, (np.sqrt(0.5), 0, 0, np.sqrt(0.5))),  # 90° about z
        "another block's": (1.5, 0.1, (1, 0, 0, 0)),
    }
    x, length, quats = (np.array(each) for each in zip(*about.values(), strict=True))
    means = np.stack([x, np.zeros(5), np.zeros(5)], axis=1)
    gaussians = from_points(means, np.zeros((5, 3), np.uint8), feature_dim=3, seed=0)
    scales = torch.from_numpy(np.stack([length, np.full(5, 0.05), np.full(5, 0.05)], axis=1)).float()
    gaussians = replace(gaussians, quats=torch.from_numpy(quats).float(), log_scales=scales.log())
    assert block.adds(gaussians, np.array([[0.0, 0, 2]])).tolist() == [True, True, False, True, False]
    everything = Block(np.full(3, -np.inf), np.full(3, np.inf), np.arange(1))
    assert everything.adds(gaussians, np.array([[0.0, 0, 2]])).all()
    gaussians.means[0, 0] = torch.nan
    assert everything.adds(gaussians, np.array([[0.0, 0, 2]])).tolist() == [False, True, True, True, True]
