"""Structure from motion by submodels: partition against brute force, a walk with exact truth, and equal results."""

from __future__ import annotations

from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
from scipy import sparse

from perception.errors import InputError
from perception.geometry import align_similarity, camera_centres
from perception.sfm import merge, partition, parts, submodels
from perception.sfm.options import ReadOptions
from perception.tasks import engine as engines
from perception.tasks.engine import Engine
from support.elsewhere import Elsewhere
from support.progress import Told
from support.walk import PHOTOS, walk


def clusters(sizes: list[int], rng: np.random.Generator) -> dict[tuple[int, int], int]:
    """Photos 1, 2, ... in groups that match well, each group and the next by one pair of 60 matches."""
    matches, first = {}, 1
    for size in sizes:
        own = range(first, first + size)
        matches |= {pair: int(rng.integers(100, 300)) for pair in combinations(own, 2)}
        if first > 1:
            matches[first - 1, first] = 60
        first += size
    return matches


def test_photos_are_divided_where_few_match() -> None:
    matches = clusters([12, 9, 14], np.random.default_rng(0))
    assert partition.divide(matches, 15) == [list(range(1, 13)), list(range(13, 22)), list(range(22, 36))]
    assert partition.divide(matches, 35) == [list(range(1, 36))]


def test_unconnected_photos_are_in_different_submodels() -> None:
    first = clusters([8], np.random.default_rng(0))
    second = {(i + 20, j + 20): found for (i, j), found in first.items()}
    assert partition.divide({**first, **second}, 100) == [list(range(1, 9)), list(range(21, 29))]


def test_a_photo_whose_only_match_is_beyond_a_cut_is_divided_as_well() -> None:
    """A scene without narrow places, and photos that match one other each: every photo is in one small submodel."""
    rng = np.random.default_rng(0)
    pairs = [(i, int(j)) for i in range(120) for j in rng.choice(120, 4, replace=False) if i != j]
    matches = {(min(pair), max(pair)): 100 for pair in pairs} | {(i, 120 + i): 15 for i in range(60)}
    with np.errstate(all="raise"):
        parts = partition.divide(matches, 20)
    assert max(map(len, parts)) <= 20 and sorted(image for part in parts for image in part) == list(range(180))


def test_a_long_walk_is_divided_into_runs() -> None:
    """The least eigenvalues of a path differ by little: found as the largest of the matrix itself, 4,000 photos took a
    minute, and the time grew with their number to the third power."""
    count, rng = 3000, np.random.default_rng(0)
    ahead = [(i, i + step) for step in range(1, 12) for i in range(1, count + 1 - step)]
    matches = {(i, j): int(rng.integers(150, 250)) // (j - i) for i, j in ahead}
    parts = partition.divide(matches, 100)
    assert [image for part in parts for image in part] == list(range(1, count + 1))
    assert max(map(len, parts)) <= 100 and min(map(len, parts)) >= 25


@pytest.mark.parametrize("seed", range(5))
def test_the_cut_is_the_least_along_the_eigenvector(seed: int) -> None:
    """The dense eigenvector of the generalised problem and all cuts along it, by their definition."""
    from scipy.linalg import eigh

    rng = np.random.default_rng(seed)
    half = np.triu(rng.integers(0, 50, (20, 20)) * (rng.random((20, 20)) < 0.5), 1).astype(float)
    weights = half + half.T + 0.1 * (1 - np.eye(20))  # connected
    degree = np.diag(weights.sum(axis=1))
    vector = eigh(degree - weights, degree)[1][:, 1]
    order, costs = np.argsort(vector), {}
    for k in range(5, 16):
        a, b = order[:k], order[k:]
        across = weights[np.ix_(a, b)].sum()
        costs[k] = across / weights[a].sum() + across / weights[b].sum()
    best = set(order[: min(costs, key=costs.__getitem__)].tolist())
    upper = set(np.flatnonzero(partition._upper_half(sparse.csr_matrix(weights))).tolist())
    assert upper in (best, set(range(20)) - best)


def test_an_overlap_leads_into_the_next_submodel_and_not_into_one_that_looks_alike() -> None:
    matches = clusters([30, 30, 30], np.random.default_rng(0))
    matches |= {(i, 60 + i): 40 for i in range(5, 15)}  # the first and the last look alike
    divided = partition.divide(matches, 35)
    assert [len(images) for images in divided] == [30, 30, 30]
    first, second, third = partition.with_overlap(divided, matches)
    assert len(first) == len(third) == 30 + partition.OVERLAP and len(second) == 30 + 2 * partition.OVERLAP
    assert max(first) <= 60 and min(third) >= 31 and 31 in first and 60 in third


def poses(model: Any) -> dict[str, bytes]:
    return {model.images[i].name: model.images[i].cam_from_world().matrix().tobytes() for i in model.reg_image_ids()}


@pytest.mark.slow
def test_a_walk_in_submodels_is_the_true_one_and_always_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(partition, "LARGEST", 18)
    monkeypatch.setattr(partition, "OVERLAP", 6)
    found = []
    for number, (cores, engine) in enumerate([(1, Engine()), (3, Engine()), (1, Elsewhere())]):
        store, truth = walk(tmp_path / str(number), np.random.default_rng(0))
        monkeypatch.setattr(engines, "cores", lambda cores=cores: cores)
        told = Told()
        models, left_out = submodels.map_submodels(store, ReadOptions(tmp_path, progress=told, engine=engine)) or (
            [],
            set(),
        )
        assert len(models) == 1 and not left_out
        found.append(poses(models[0]))
        if cores > 1:
            assert ("poses: submodels", 4, 4) in told.updates
    assert engine.asked == [4]  # type: ignore[attr-defined]
    assert found[0] == found[1] == found[2]
    assert len(found[0]) == PHOTOS
    centres = np.array([np.frombuffer(found[0][name]).reshape(3, 4) for name in store.names])
    centres, truth = camera_centres(centres), camera_centres(truth)
    scale, turn, shift = align_similarity(truth, centres)
    away = np.linalg.norm(scale * centres @ turn.T + shift - truth, axis=1)
    # .3 px are 4 mm at 3 m; errors add up along the 14 m of the walk.
    assert np.median(away) < 0.03 and away.max() < 0.1


@pytest.mark.slow
def test_photos_without_a_submodel_are_added_and_small_repeated_models_are_not_used(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    divide = partition.divide
    monkeypatch.setattr(partition, "LARGEST", 30)
    monkeypatch.setattr(partition, "divide", lambda *given: [[i for i in part if i != 7] for part in divide(*given)])
    monkeypatch.setattr(partition, "with_overlap", lambda divided, _: [divided[0] + divided[1][:5], *divided[1:]])
    store, _ = walk(tmp_path / "walk", np.random.default_rng(0))
    ((whole, *_), _) = submodels.map_submodels(store, ReadOptions(tmp_path)) or ([None], set())
    assert whole is not None and whole.num_reg_images() == PHOTOS
    small = pycolmap.Reconstruction(whole)
    submodels.take_out(small, set(sorted(small.reg_image_ids())[10:]))
    assert merge.without_repeats([[small, whole]]) == [whole]


class Photos:
    """A model of which only the photos are known."""

    def __init__(self, *images: int) -> None:
        self.images = images

    def num_reg_images(self) -> int:
        return len(self.images)

    def reg_image_ids(self) -> tuple[int, ...]:
        return self.images


def test_a_submodel_between_two_that_have_all_its_photos_stays_as_it_joins_them() -> None:
    first, second = Photos(*range(60)), Photos(*range(62, 120))
    between, repeated = Photos(*range(45, 75)), Photos(50, 51, 52, 53)
    assert merge.without_repeats([[first], [repeated, between], [second]]) == [first, second, between]
    assert merge.without_repeats([[first], [repeated], [second]]) == [first, second]


@pytest.mark.slow
def test_a_contradicted_model_is_not_returned(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Adjusted in parts, as very many photos are."""
    monkeypatch.setattr(parts, "WHOLE", 0)
    monkeypatch.setattr(merge, "adjusted", None)
    monkeypatch.setattr(submodels, "is_contradicted", lambda pairs: len(pairs) > 100)
    store, _ = walk(tmp_path / "walk", np.random.default_rng(0))
    told = Told()
    assert submodels.map_submodels(store, ReadOptions(tmp_path, progress=told)) is None
    assert told.lines[-1].endswith("all photos are mapped in one piece")


def test_an_interrupted_call_stops_the_tasks_of_other_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(engines, "cores", lambda: 2)
    stopped = []

    def task(item: str, progress: Any) -> None:
        if item == "wrong":
            raise InputError("wrong")
        try:
            while True:
                progress.update("working", 0, 1)
        except KeyboardInterrupt:
            stopped.append(item)
            raise

    with pytest.raises(InputError, match="wrong"):
        Engine().run(task, ["long", "wrong", "never"], "task", Told(), each_core=True)
    assert stopped == ["long"]
