"""Sums by index and nearest points against plain loops, order along a curve against interleaved bits."""

from __future__ import annotations

import signal

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from perception import geometry
from perception.errors import InputError
from perception.geometry import along_curve, nearest, numbers, sums_by


@pytest.mark.parametrize("shape", [(7,), (7, 3), (0,), (0, 3), (0, 2, 3)])
@pytest.mark.parametrize("weighted", [False, True])
def test_sums_of_many_and_of_no_values(shape: tuple[int, ...], weighted: bool) -> None:
    """Of no values, too, they are numbers to which others can be added: a photo without any depth adds nothing."""
    rng = np.random.default_rng(0)
    values, index, weights = rng.normal(size=shape), rng.integers(0, 4, shape[0]), rng.normal(size=shape[0])
    expected = np.zeros((5, *shape[1:]))
    for n, row in enumerate(index):
        expected[row] += values[n] * (weights[n] if weighted else 1)
    found = sums_by(index, values, 5, weights if weighted else None)
    assert found.dtype == np.float64
    np.testing.assert_allclose(found, expected, rtol=1e-12)
    found += 0.5


def test_points_of_a_grid_are_ordered_by_their_interleaved_bits() -> None:
    cells = np.stack(np.meshgrid(*[np.arange(8)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    cells = np.random.default_rng(0).permutation(cells)
    codes = ["".join(f"{z:03b}"[bit] + f"{y:03b}"[bit] + f"{x:03b}"[bit] for bit in range(3)) for x, y, z in cells]
    found = along_curve(torch.from_numpy(np.exp(cells) * [1, 10, 0.1]))  # only the order along each axis counts
    assert [codes[n] for n in found] == sorted(codes)
    assert len(along_curve(torch.zeros(0, 3))) == 0


def test_values_that_are_not_finite_are_ordered_too() -> None:
    points = torch.tensor([[torch.nan, 0, torch.inf], [1, 2, 3], [-torch.inf, 0, 0], [1, 2, 3]])
    assert sorted(along_curve(points).tolist()) == [0, 1, 2, 3]


@pytest.mark.parametrize("ranks", [[1], [9], range(1, 5)])
def test_nearest_points_are_found_in_pieces(ranks: list[int], monkeypatch: pytest.MonkeyPatch) -> None:
    """Those of all distances; no piece is larger than it may be, so that a signal need not wait for all."""
    monkeypatch.setattr(geometry, "AT_ONCE", 7)
    points, queries = np.random.default_rng(1).random((2, 40, 3))
    sizes = []

    class Tree:
        def query(self, some: np.ndarray, **options: object) -> tuple[np.ndarray, np.ndarray]:
            sizes.append(len(some))
            return cKDTree(points).query(some, **options)

    distance, index = nearest(Tree(), queries, ranks)  # type: ignore[arg-type]
    every = np.linalg.norm(queries[:, None] - points, axis=2)
    chosen = np.array(ranks) - 1
    np.testing.assert_array_equal(index, np.argsort(every, axis=1)[:, chosen])
    np.testing.assert_allclose(distance, np.sort(every, axis=1)[:, chosen], rtol=1e-12)
    assert sizes == [7, 7, 7, 7, 7, 5]


@pytest.mark.usefixtures("interruptible")
def test_a_signal_waits_for_the_search_that_runs() -> None:
    """The threads of a search must not outlive it; the next piece is not begun."""
    done = []

    class Tree:
        def query(self, some: np.ndarray, **_: object) -> tuple[np.ndarray, np.ndarray]:
            signal.raise_signal(signal.SIGINT)
            done.append(len(some))
            return np.zeros((len(some), 2)), np.zeros((len(some), 2), int)

    with pytest.raises(KeyboardInterrupt):
        nearest(Tree(), np.zeros((geometry.AT_ONCE + 1, 3)), [1, 2])  # type: ignore[arg-type]
    assert done == [geometry.AT_ONCE]


@pytest.mark.parametrize("value", [[10**400], ["x"], [None], [float("nan")], [float("inf")]])
def test_what_is_no_finite_number_is_refused(value: list[object]) -> None:
    with pytest.raises(InputError, match=r"^near: expected "):
        numbers(value, "near")
