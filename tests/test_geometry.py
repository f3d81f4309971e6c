"""Sums by index against plain loops."""

from __future__ import annotations

import numpy as np
import pytest

from perception.geometry import sums_by


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
