"""The affinity of segments and their evidence against the formulas, pair by pair in float64."""

from __future__ import annotations

import ctypes
import signal
from functools import partial

import numpy as np
import pytest
from scipy import sparse

from perception import _core
from perception.interrupts import handled
from perception.masks import consensus
from perception.masks.consensus import (
    LARGEST_PART,
    LEAST_SHARE,
    LOWEST,
    ONE_SIDED,
    PART_VIEWS,
    PRIOR,
    SUPPORT,
    dendrogram,
    evidence,
    node_evidence,
    parts_of,
)
from perception.masks.votes import MaskVotes


def a_table(seed: int, segments: int, views: int, filled: float = 0.5) -> MaskVotes:
    rng = np.random.default_rng(seed)
    view = np.sort(np.concatenate([np.arange(views), rng.integers(0, views, 2 * views)]))
    pixels = rng.uniform(0, 100, (segments, len(view))) * (rng.random((segments, len(view))) < filled)
    void = rng.uniform(0, 60, (segments, views)) * (rng.random((segments, views)) < 0.4)
    area = pixels.sum(axis=0) + rng.uniform(0, 50, len(view))
    return MaskVotes(*(sparse.csr_matrix(a.astype(np.float32)) for a in (pixels, void)), view, area)


def affinity(table: MaskVotes, z: np.ndarray, near: np.ndarray, i: int, j: int) -> float:
    """a_ij as the module's docstring has it."""
    P, B = (a.toarray().astype(np.float64) for a in (table.pixels, table.void))
    views = range(B.shape[1])
    T = np.array([[P[k, table.view == v].sum() + B[k, v] for v in views] for k in (i, j)])
    p = float(near[i, j]) * max(0.0, 1 - float(((z[i] - z[j]) ** 2).sum()))
    agreed, weight = PRIOR * p, PRIOR
    for v in views:
        w = min(T[0, v] / max(T[0].max(), 1e-12), T[1, v] / max(T[1].max(), 1e-12))
        if w <= LEAST_SHARE:
            continue
        l_i, l_j = (1 - B[k, v] / T[row, v] for row, k in enumerate((i, j)))
        a, b = P[i, table.view == v], P[j, table.view == v]
        c = a @ b / max(np.linalg.norm(a) * np.linalg.norm(b), 1e-12)
        agreed += w * l_i * l_j * c
        weight += w * (l_i * l_j + ONE_SIDED * (l_i + l_j - 2 * l_i * l_j))
    return float(agreed / weight)


def merged_by_hand(
    table: MaskVotes, z: np.ndarray, sizes: np.ndarray, near: np.ndarray, sure: float
) -> tuple[list[tuple[int, int]], list[float]]:
    """Nodes and affinities of all merges: every pair anew after each, on pooled dense tables. Before all others those
    of neighbours whose affinity reaches `sure`."""
    P, B = (a.toarray().astype(np.float64) for a in (table.pixels, table.void))
    z, sizes, near, node = z.copy(), sizes.astype(float), near.copy(), list(range(len(z)))
    children, values = [], []
    while len(node) > 1:
        pooled = MaskVotes(sparse.csr_matrix(P), sparse.csr_matrix(B), table.view, table.area)
        pairs = [(i, j) for i in range(len(node)) for j in range(i + 1, len(node))]
        found = [affinity(pooled, z, near, i, j) for i, j in pairs]
        close = [value if near[pair] else -1.0 for value, pair in zip(found, pairs, strict=True)]
        sure = sure if max(close) >= sure else np.inf  # not again
        best = int(np.argmax(found if sure == np.inf else close))
        if found[best] < LOWEST:
            break
        i, j = pairs[best]
        children.append((node[i], node[j]))
        values.append(found[best])
        node[i] = len(table.pixels.toarray()) + len(children) - 1
        z[i] = (sizes[i] * z[i] + sizes[j] * z[j]) / (sizes[i] + sizes[j])
        sizes[i] += sizes[j]
        P[i] += P[j]
        B[i] += B[j]
        near[i] |= near[j]
        near[:, i] |= near[:, j]
        left = np.arange(len(node)) != j
        P, B, z, sizes, near = P[left], B[left], z[left], sizes[left], near[left][:, left]
        del node[j]
    return children, values


@pytest.mark.parametrize("sure", [np.inf, 0.5])
@pytest.mark.parametrize(("seed", "filled"), [(0, 0.5), (1, 0.5), (2, 0.15), (3, 0.15), (4, 0.05), (5, 0.0)])
def test_merges_are_those_of_a_dense_search_in_float64(
    seed: int, filled: float, sure: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also where few pairs share a mask, where none does and features alone join neighbours, and of many segments,
    whose sure neighbours are merged first."""
    monkeypatch.setattr(consensus, "MANY", 100 if sure == np.inf else 11)
    monkeypatch.setattr(consensus, "SURE", 0.5)
    table, rng = a_table(seed, 12, 5, filled), np.random.default_rng(seed)
    z, near = rng.normal(0, 0.3, (12, 3)), rng.random((12, 12)) < 0.2
    near |= near.T
    np.fill_diagonal(near, False)
    sizes = rng.integers(1, 50, 12)
    children, values = merged_by_hand(table, z, sizes, near, sure)
    tree = dendrogram(table, z, sizes, sparse.csr_matrix(near))
    assert [tuple(pair) for pair in tree.children.tolist()] == children and len(children) > 3
    np.testing.assert_allclose(tree.affinity, values, rtol=1e-6)


def test_a_signal_ends_merging_between_two_segments(monkeypatch: pytest.MonkeyPatch) -> None:
    """The signal is pending when the compiled function begins: no bytecode, where Python would handle it, lies between
    two calls of `map`. Nothing was merged when the handler was called."""
    given: list[tuple] = []
    monkeypatch.setattr(_core, "merge_segments", lambda *arguments: given.append(arguments) or 0)
    dendrogram(a_table(0, 6, 2), np.zeros((6, 2)), np.ones(6), sparse.csr_matrix(np.ones((6, 6), bool)))
    monkeypatch.undo()
    (arguments,) = given
    signalled = partial(ctypes.pythonapi.PyErr_SetInterruptEx, int(signal.SIGTERM))
    with handled(signal.default_int_handler, signal.SIGTERM), pytest.raises(KeyboardInterrupt):
        list(map(partial.__call__, [signalled, partial(_core.merge_segments, *arguments)]))
    assert not arguments[-2].any()  # children
    assert _core.merge_segments(*arguments) == 5 and arguments[-2].any()


def test_of_equal_affinities_the_first_pair_is_merged() -> None:
    none = sparse.csr_matrix((4, 0), dtype=np.float32)
    table = MaskVotes(none, none, np.zeros(0, np.int64), np.zeros(0))
    near = np.array([[0, 0, 0, 1], [0, 0, 1, 0], [0, 1, 0, 0], [1, 0, 0, 0]], bool)
    tree = dendrogram(table, np.zeros((4, 2)), np.ones(4), sparse.csr_matrix(near))
    assert tree.children.tolist() == [[0, 3], [1, 2]] and tree.affinity.tolist() == [1, 1]


def test_merging_leaves_the_table_as_it_was() -> None:
    table = a_table(3, 6, 1)
    pixels, void = table.pixels.toarray(), table.void.toarray()
    dendrogram(table, np.zeros((6, 2)), np.ones(6), sparse.csr_matrix(np.ones((6, 6), bool)))
    np.testing.assert_array_equal(table.pixels.toarray(), pixels)
    np.testing.assert_array_equal(table.void.toarray(), void)


def test_evidence_is_the_formula() -> None:
    table = a_table(4, 3, 4)
    found = evidence(table)
    P, void = table.pixels.toarray(), table.void.toarray()
    for g in range(3):
        labelled = [P[g, table.view == v].sum() for v in range(4)]
        iou = [
            pixels / (labelled[v] + void[g, v] + area - pixels)
            for pixels, v, area in zip(P[g], table.view, table.area, strict=True)
        ]
        assert found.matched[g] == pytest.approx(float(P[g] @ np.array(iou)), rel=1e-5)
        fit = [max(x for x, of in zip(iou, table.view, strict=True) if of == v) for v in range(4)]
        expected = [best if shown >= 8 else 0 for best, shown in zip(fit, labelled, strict=True)]
        np.testing.assert_allclose(found.fit[g].toarray()[0], expected, rtol=1e-5)


def test_evidence_of_a_node_is_that_of_its_leaves_together() -> None:
    table = a_table(6, 9, 4, 0.3)
    tree = dendrogram(table, np.zeros((9, 2)), np.ones(9), sparse.csr_matrix(np.ones((9, 9), bool)))
    found = node_evidence(tree, table)
    for node in range(9 + len(tree.children)):
        leaves = tree.leaves_of(node)
        sums = [sparse.csr_matrix(a.toarray()[leaves].sum(axis=0)) for a in (table.pixels, table.void)]
        alone = evidence(MaskVotes(*sums, table.view, table.area))
        assert found.matched[node] == pytest.approx(alone.matched[0], rel=1e-5)
        assert found.pixels[node] == pytest.approx(alone.pixels[0], rel=1e-5)
        assert (found.views[node], found.support[node]) == (alone.views[0], alone.support[0])


def test_parts_are_the_highest_nodes_that_photos_support() -> None:
    """By the definition, node by node on dense tables; instances are nodes of several heights."""
    found = []
    for seed in range(6):
        table = a_table(seed, 12, 6, 0.12)
        tree = dendrogram(table, np.zeros((12, 2)), np.ones(12), sparse.csr_matrix(np.ones((12, 12), bool)))
        seen = node_evidence(tree, table)
        fit, members = seen.fit.toarray(), [set(tree.leaves_of(node)) for node in range(12 + len(tree.children))]
        top = range(len(members) - 3, len(members))
        instances = [n for n in top if not any(members[n] < members[m] for m in top)]
        expected = []
        for number, instance in enumerate(instances):
            good = [
                node
                for node in range(len(members))
                if members[node] < members[instance]
                and ((fit[node] >= SUPPORT) & (fit[node] > fit[instance])).sum() >= PART_VIEWS
                and seen.pixels[node] <= LARGEST_PART * seen.pixels[instance]
            ]
            expected += [(number, n) for n in good if not any(members[n] < members[m] for m in good)]
        assert parts_of(tree, instances, seen) == expected
        found += expected
    assert len(found) > 3
