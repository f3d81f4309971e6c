"""The affinity of segments and their evidence against the formulas, pair by pair in float64."""

from __future__ import annotations

import numpy as np
import pytest

from perception.instances.consensus import LEAST_SHARE, ONE_SIDED, PRIOR, evidence, merge_tree
from perception.instances.votes import Table


def a_table(seed: int, segments: int, views: int) -> Table:
    rng = np.random.default_rng(seed)
    view = np.sort(np.concatenate([np.arange(views), rng.integers(0, views, 2 * views)]))
    pixels = rng.uniform(0, 100, (segments, len(view))) * (rng.random((segments, len(view))) < 0.5)
    void = rng.uniform(0, 60, (segments, views)) * (rng.random((segments, views)) < 0.4)
    area = pixels.sum(axis=0) + rng.uniform(0, 50, len(view))
    return Table(pixels.astype(np.float32), void.astype(np.float32), view, area)


def affinity(table: Table, z: np.ndarray, near: np.ndarray, i: int, j: int) -> float:
    """a_ij as the module's docstring has it."""
    P, B = table.pixels.astype(np.float64), table.void.astype(np.float64)
    views = range(B.shape[1])
    T = np.array([[P[k, table.view == v].sum() + B[k, v] for v in views] for k in (i, j)])
    p = float(near[i, j]) * max(0.0, 1 - float(((z[i] - z[j]) ** 2).sum()))
    agreed, weight = PRIOR * p, PRIOR
    for v in views:
        w = min(T[0, v] / T[0].max(), T[1, v] / T[1].max())
        if w <= LEAST_SHARE:
            continue
        l_i, l_j = (1 - B[k, v] / T[row, v] for row, k in enumerate((i, j)))
        a, b = P[i, table.view == v], P[j, table.view == v]
        c = a @ b / max(np.linalg.norm(a) * np.linalg.norm(b), 1e-12)
        agreed += w * l_i * l_j * c
        weight += w * (l_i * l_j + ONE_SIDED * (l_i + l_j - 2 * l_i * l_j))
    return float(agreed / weight)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_first_merge_joins_the_pair_of_largest_affinity(seed: int) -> None:
    table, rng = a_table(seed, 7, 5), np.random.default_rng(seed)
    z, near = rng.normal(0, 0.3, (7, 3)), rng.random((7, 7)) < 0.5
    near |= near.T
    pairs = {(i, j): affinity(table, z, near, i, j) for i in range(7) for j in range(i + 1, 7)}
    best = max(pairs, key=lambda pair: pairs[pair])
    tree = merge_tree(table, z, np.full(7, 10), near)
    assert tuple(tree.children[0]) == best
    assert tree.affinity[0] == pytest.approx(pairs[best], rel=1e-5)


def test_merging_leaves_the_table_as_it_was() -> None:
    """Also where there is one view, whose columns need no reordering."""
    table = a_table(3, 6, 1)
    pixels, void = table.pixels.copy(), table.void.copy()
    merge_tree(table, np.zeros((6, 2)), np.ones(6), np.ones((6, 6), bool))
    np.testing.assert_array_equal(table.pixels, pixels)
    np.testing.assert_array_equal(table.void, void)


def test_evidence_is_the_formula() -> None:
    table = a_table(4, 3, 4)
    found = evidence(table)
    for g in range(3):
        labelled = [table.pixels[g, table.view == v].sum() for v in range(4)]
        iou = [
            P / (labelled[v] + table.void[g, v] + area - P)
            for P, v, area in zip(table.pixels[g], table.view, table.area, strict=True)
        ]
        assert found.matched[g] == pytest.approx(float(table.pixels[g] @ np.array(iou)), rel=1e-5)
        fit = [max(x for x, of in zip(iou, table.view, strict=True) if of == v) for v in range(4)]
        expected = [best if shown >= 8 else 0 for best, shown in zip(fit, labelled, strict=True)]
        np.testing.assert_allclose(found.fit[g], expected, rtol=1e-5)
