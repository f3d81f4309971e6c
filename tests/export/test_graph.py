"""Neighbours against brute force, segmentation against a plain reference, normals against closed forms."""

from __future__ import annotations

import json
from functools import partial

import numpy as np
import pytest
from scipy.spatial import Delaunay

from perception.errors import InputError
from perception.export import neighbors
from perception.export.export_map import export_labels
from perception.export.neighbors import Neighbors, list_normals, nearest_gaussian, neighbor_lists
from perception.export.smooth import (
    felzenszwalb,
    list_edges,
    mesh_edges,
    read_segments,
    scannet_normals,
    scannet_weights,
    segment_cloud,
    step_weights,
    vote,
)
from perception.types import PointCloud

CLOUDS = {
    "uniform": lambda rng: rng.random((1500, 3)),
    "five": lambda rng: rng.random((5, 3)),
    "one": lambda rng: rng.random((1, 3)),
    "integer ties": lambda rng: rng.integers(0, 4, (700, 3)).astype(float),
    "all the same": lambda rng: np.ones((100, 3)),
    "a line": lambda rng: np.outer(np.arange(200.0), [1, 0, 0]),
    "far from the origin": lambda rng: rng.random((800, 3)) + np.array([4e5, -5e6, 100]),
    "two scales": lambda rng: np.concatenate([rng.random((400, 3)), 1e-4 * rng.random((400, 3))]),
}


@pytest.mark.parametrize("name", CLOUDS)
@pytest.mark.parametrize("k", [1, 7])
def test_neighbors_equal_brute_force(name, k):
    rng = np.random.default_rng(7)
    points = CLOUDS[name](rng)
    queries = np.concatenate([points[::3], points[:50] + rng.normal(0, 0.1, points[:50].shape)])
    tree = Neighbors(points, threads=2)
    found, distance = tree.query(queries, k)
    # Brute force with the same float32 coordinates and operations, so that ties are the same ties.
    p, q = tree.local(points), tree.local(queries)
    d = p[None] - q[:, None]
    squared = d[..., 0] * d[..., 0] + d[..., 1] * d[..., 1] + d[..., 2] * d[..., 2]
    order = np.lexsort((np.broadcast_to(np.arange(len(p)), squared.shape), squared), axis=1)[:, :k]
    want = np.full((len(q), k), -1)
    want[:, : order.shape[1]] = order
    np.testing.assert_array_equal(found, want)
    exact = np.sort(np.linalg.norm(points[None] - queries[:, None], axis=2), axis=1)[:, :k]
    np.testing.assert_allclose(distance[:, : exact.shape[1]], exact, rtol=2e-5, atol=2e-7 * np.ptp(points))
    assert np.isinf(distance[:, exact.shape[1] :]).all()


def test_max_distance_is_inclusive_and_odd_queries_find_nothing():
    tree = Neighbors(np.array([[0.0, 0, 0], [2, 0, 0]]))
    found, distance = tree.query(np.array([[3.0, 0, 0], [3.5, 0, 0], [np.nan, 0, 0], [np.inf, 0, 0]]), 2, 1.0)
    assert found.tolist() == [[1, -1], [-1, -1], [-1, -1], [-1, -1]]
    assert distance[0].tolist() == [1.0, np.inf]


def test_threads_and_order_do_not_change_answers():
    rng = np.random.default_rng(1)
    points, queries = (
        rng.integers(0, 9, (3000, 3)).astype(float),
        rng.integers(0, 9, (20000, 3)).astype(float),
    )
    one = Neighbors(points, threads=1).query(queries, 3)[0]
    shuffle = rng.permutation(len(queries))
    np.testing.assert_array_equal(Neighbors(points, threads=3).query(queries[shuffle], 3)[0], one[shuffle])


def test_nearest_gaussian_streams_and_skips_what_is_not_finite(monkeypatch):
    monkeypatch.setattr(neighbors, "CHUNK", 64)
    rng = np.random.default_rng(2)
    points, means = rng.random((1000, 3)), rng.random((90, 3))
    means[5] = np.nan
    points[3] = np.inf
    distance = np.linalg.norm(points[:, None] - means[None], axis=2)
    distance[:, 5] = np.inf
    want = distance.argmin(axis=1)
    want[3] = -1
    np.testing.assert_array_equal(nearest_gaussian(points, means), want)
    near = nearest_gaussian(points, means, max_distance=0.1)
    np.testing.assert_array_equal(near, np.where(distance.min(axis=1) <= 0.1, want, -1))
    assert (nearest_gaussian(points, np.empty((0, 3))) == -1).all()


def reference_segments(edges, weights, nodes, k, min_size):
    """The algorithm in dictionaries of sets (Felzenszwalb and Huttenlocher 2004, section 4)."""
    member = {i: {i} for i in range(nodes)}
    root = list(range(nodes))
    threshold = [np.float32(k)] * nodes
    order = sorted(range(len(edges)), key=lambda e: (weights[e], min(edges[e]), max(edges[e])))

    def join(a, b):
        for x in member[b]:
            root[x] = a
        member[a] |= member.pop(b)

    for e in order:
        a, b = root[edges[e][0]], root[edges[e][1]]
        if a != b and weights[e] <= threshold[a] and weights[e] <= threshold[b]:
            join(a, b)
            threshold[a] = weights[e] + np.float32(k) / np.float32(len(member[a]))
    for e in order:
        a, b = root[edges[e][0]], root[edges[e][1]]
        if a != b and min(len(member[a]), len(member[b])) < min_size:
            join(a, b)
    names: dict[int, int] = {}
    return [names.setdefault(root[i], len(names)) for i in range(nodes)]


@pytest.mark.parametrize("seed", range(12))
def test_segments_equal_a_plain_reference_whatever_the_edge_order(seed):
    rng = np.random.default_rng(seed)
    nodes = 300
    edges = rng.integers(0, nodes, (900, 2)).astype(np.int32)
    weights = rng.random(900).astype(np.float32) ** 3
    if seed % 3 == 0:
        weights = np.round(weights, 1)  # many ties
    k, min_size = [(0.01, 20), (0.3, 5), (1.0, 1)][seed % 3]
    got = felzenszwalb(edges, weights, nodes, k, min_size)
    assert got.tolist() == reference_segments(edges.tolist(), weights, nodes, k, min_size)
    shuffle = rng.permutation(900)
    flipped = edges[shuffle][:, ::-1]
    np.testing.assert_array_equal(felzenszwalb(flipped, weights[shuffle], nodes, k, min_size), got)


def box_mesh(n: int = 12):
    """Two unit squares meeting at a right angle along the y axis: floor (z = 0) and wall (x = 0)."""
    u, v = (g.ravel() for g in np.meshgrid(np.linspace(0.01, 1, n), np.linspace(0, 1, n), indexing="ij"))
    floor = np.stack([u, v, 0 * u], axis=1)
    wall = np.stack([0 * u, v, u], axis=1)
    cell = np.array([i * n + j for i in range(n - 1) for j in range(n - 1)])
    quads = np.stack([cell, cell + n, cell + n + 1, cell + 1], axis=1)
    faces = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    points = np.concatenate([floor, wall])
    return points, np.concatenate([faces, faces[:, ::-1] + n * n]).astype(np.int32)


def test_mesh_normals_and_edges():
    points, faces = box_mesh()
    normals = scannet_normals(points, faces)
    half = len(points) // 2
    np.testing.assert_allclose(normals[:half], np.tile([0, 0, 1.0], (half, 1)), atol=1e-6)
    np.testing.assert_allclose(normals[half:], np.tile([1.0, 0, 0], (half, 1)), atol=1e-6)
    edges = mesh_edges(np.array([[0, 1, 2], [3, 3, 4]], np.int32))
    assert edges.tolist() == [[0, 1], [0, 2], [2, 1], [3, 4], [4, 3]]


def segmentator(points, faces, k=0.01, least=20):
    """ScanNet's segmentator.cpp, rule by rule in float32 scalars. std::sort leaves the order of equal weights open."""
    f = np.float32
    points = [[f(x) for x in p] for p in points.tolist()]
    normals, counts, edges = [[f(0)] * 3 for _ in points], [0] * len(points), []

    def dot(u, v):
        return u[0] * v[0] + u[1] * v[1] + u[2] * v[2]

    for i1, i2, i3 in faces.tolist():
        u, v = ([b - a for a, b in zip(points[i1], points[i], strict=True)] for i in (i2, i3))
        cross = [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]]
        cross = [x / np.sqrt(dot(cross, cross)) for x in cross]
        for i in (i1, i2, i3):
            share = f(1) / (f(counts[i]) + f(1))
            normals[i] = [share * b + (f(1) - share) * a for a, b in zip(normals[i], cross, strict=True)]
            counts[i] += 1
        edges += [(i1, i2), (i1, i3), (i3, i2)]
    weights = []
    for a, b in edges:
        d = [y - x for x, y in zip(points[a], points[b], strict=True)]
        weight = f(1) - dot(normals[a], normals[b])
        convex = dot(normals[b], [x / np.sqrt(dot(d, d)) for x in d]) > 0
        weights.append(weight * weight if convex else weight)
    return reference_segments(edges, weights, len(points), k, least)


def two_walls(n: int = 40):
    """Two perpendicular walls of n × n vertices that share a row."""
    flat, v = (g.ravel() for g in np.meshgrid(np.arange(2 * n - 1) - n + 1.0, np.arange(n) * 1.0, indexing="ij"))
    points = np.stack([np.maximum(flat, 0), v, np.maximum(-flat, 0)], axis=1) * 0.05
    cell = np.array([i * n + j for i in range(2 * n - 2) for j in range(n - 1)])
    quads = np.stack([cell, cell + n, cell + n + 1, cell + 1], axis=1)
    return points, np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]).astype(np.int32)


def relief(seed: int):
    """Steps and bumps over an irregular triangulation of random places, one vertex without a face."""
    rng = np.random.default_rng(seed)
    places = rng.random((900, 2))
    height = 0.2 * np.round(places[:, 0] * 3) + 0.1 * np.sin(9 * places[:, 1]) + rng.normal(0, 0.002, 900)
    points = np.concatenate([places, height[:, None]], axis=1).astype(np.float32).astype(float)
    return np.concatenate([points, [[5.0, 5, 5]]]), Delaunay(places).simplices.astype(np.int32)


@pytest.mark.parametrize("mesh", [two_walls, *(partial(relief, seed) for seed in range(3))])
def test_segments_of_a_mesh_are_those_of_scannets_segmentator(mesh):
    points, faces = mesh()
    want = segmentator(points, faces)
    assert segment_cloud(PointCloud(points, faces=faces), scannet=True).tolist() == want
    if mesh is two_walls:  # nor is the crease a thing of its own by our rule
        assert segment_cloud(PointCloud(points, faces=faces)).tolist() == want
    assert len(set(want)) == 2 if mesh is two_walls else 5 < len(set(want)) < 100


def test_weights_between_normals_of_unknown_sign_ignore_it():
    normals = np.array([[0, 0, 1], [0.6, 0, 0.8], [-0.6, 0, -0.8]], np.float32)
    edges = np.array([[0, 1], [1, 0], [0, 2]], np.int32)
    weights = scannet_weights(np.eye(3), normals, edges, oriented=False)
    np.testing.assert_allclose(weights, [0.2, 0.2, 0.2], rtol=1e-6)


def estimate_normals(points):
    return list_normals(points, neighbor_lists(points, 12))


def test_estimated_normals_of_a_sphere_point_outwards_or_inwards():
    rng = np.random.default_rng(0)
    sphere = rng.normal(size=(6000, 3))
    sphere /= np.linalg.norm(sphere, axis=1, keepdims=True)
    cosine = np.abs((estimate_normals(sphere + 1e4) * sphere).sum(axis=1))
    assert np.median(cosine) > 0.999 and cosine.min() > 0.9
    rotation = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    turned = estimate_normals(sphere @ rotation.T)
    assert np.abs((turned * (estimate_normals(sphere) @ rotation.T)).sum(axis=1)).min() > 0.999
    assert (estimate_normals(np.outer(np.arange(50.0), [1, 2, 3])) == 0).all()  # a line has no normal
    assert (estimate_normals(np.zeros((30, 3))) == 0).all()


def test_edges_to_the_nearest_neighbours_equal_brute_force():
    rng = np.random.default_rng(4)
    points = rng.random((250, 3))
    points[7] = np.nan
    distance = np.linalg.norm(points[:, None] - points[None], axis=2)
    distance[np.isnan(distance)] = np.inf
    np.fill_diagonal(distance, np.inf)
    near = np.argsort(distance, axis=1)[:, :5]
    want = {(min(a, b), max(a, b)) for a in range(250) for b in near[a].tolist() if np.isfinite(distance[a, b])}
    got = [tuple(e) for e in list_edges(neighbor_lists(points, 6)).tolist()]
    assert len(got) == len(set(got)) and set(got) == want


@pytest.mark.parametrize("graph", ["mesh", "knn"])
def test_floor_and_wall_are_two_segments(graph):
    points, faces = box_mesh()
    normals = scannet_normals(points, faces)
    cloud = PointCloud(points, normals=normals, faces=faces if graph == "mesh" else None)
    segments = segment_cloud(cloud)
    assert segments.tolist() == [0] * (len(points) // 2) + [1] * (len(points) // 2)
    bare = segment_cloud(PointCloud(points))
    assert len(np.unique(bare[: len(points) // 2])) < 6


@pytest.mark.parametrize("length", [0.5, 127.0, "areas"])
def test_normals_of_any_length_give_the_same_segments(length):
    """MeshLab writes sums of the faces' normals, other programs bytes."""
    rng = np.random.default_rng(0)
    plane, normals = rng.uniform(0, 1, (1600, 2)), np.repeat([[0.0, 0, 1], [0, 1, 0]], 800, axis=0)
    points = np.insert(plane[:800], 2, 0, axis=1), np.insert(plane[800:], 1, 0, axis=1)
    scale = rng.uniform(0.01, 3, (1600, 1)) if length == "areas" else length
    segments = segment_cloud(PointCloud(np.concatenate(points), normals=(scale * normals).astype(np.float32)))
    assert segments.tolist() == [0] * 800 + [1] * 800


@pytest.mark.parametrize("outlier", [[0.0, 0, 0], [1e7, -1e7, 3]])
def test_one_point_far_away_changes_nothing_for_georeferenced_ones(outlier):
    """Missing returns are written as zeros; float32 resolves half a metre at UTM's northings."""
    rng, offset = np.random.default_rng(0), np.array([691234.5, 5334567.25, 512])
    means, points = rng.normal(size=(300, 3)), rng.normal(size=(2000, 3))
    points[:, 2] = np.round(points[:, 2])  # planes
    ids = np.arange(300, dtype=np.int32) % 7
    plain = export_labels(means, ids, PointCloud(points))
    far = PointCloud(np.concatenate([[outlier], points + offset]))
    np.testing.assert_array_equal(export_labels(means + offset, ids, far)[1:], plain)


def test_colour_keeps_a_poster_from_its_wall():
    rng = np.random.default_rng(0)
    points = np.concatenate([rng.random((4000, 2)), np.zeros((4000, 1))], axis=1)
    poster = (np.abs(points[:, :2] - 0.5) < 0.2).all(axis=1)
    colors = np.where(poster[:, None], [200, 30, 30], [220, 220, 210]).astype(np.uint8)
    normals = np.tile(np.float32([0, 0, 1]), (4000, 1))
    assert segment_cloud(PointCloud(points, None, normals)).max() == 0
    segments = segment_cloud(PointCloud(points, colors, normals))
    assert segments.max() == 1
    own = np.bincount(segments[poster]).argmax()
    assert ((segments == own) != poster).mean() < 0.01  # its corners are rounded by the median


def test_a_book_upon_a_book_is_a_segment_of_its_own_by_its_step_alone():
    rng = np.random.default_rng(0)
    points = np.concatenate([rng.random((6000, 2)), np.zeros((6000, 1))], axis=1)
    upper = (np.abs(points[:, :2] - 0.5) < 0.3).all(axis=1)
    points[upper, 2] = 0.04  # about three times the points' spacing; their normals are the same
    segments = segment_cloud(PointCloud(points, normals=np.tile(np.float32([0, 0, 1]), (6000, 1))))
    assert len(set(segments[upper])) == len(set(segments[~upper])) == 1
    assert not set(segments[upper]) & set(segments[~upper])


def test_steps_are_squared_sines_against_the_tangent_planes():
    points = np.array([[0, 0, 0], [2, 0, 0], [3, 0, 1], [3, 0, 1]])
    normals = np.float32([[0, 0, 1], [0, 0, 1], [0, 0, 0], [1, 0, 0]])
    edges = np.int32([[0, 1], [1, 2], [2, 3], [1, 3]])
    np.testing.assert_allclose(step_weights(points, normals, edges), [0, 0.5, 0, 0.5], atol=1e-6)


def test_prints_and_shades_do_not_part_one_surface():
    rng = np.random.default_rng(0)
    points = np.concatenate([rng.random((6000, 2)), np.zeros((6000, 1))], axis=1)
    shade = 90 + 120 * points[:, :1] + rng.normal(0, 25, (6000, 3))  # from dark to bright, and grainy
    normals = np.tile(np.float32([0, 0, 1]), (6000, 1))
    assert segment_cloud(PointCloud(points, shade.clip(0, 255).astype(np.uint8), normals)).max() == 0


def test_the_vote_is_the_mode_and_ties_go_to_the_smallest():
    labels = np.array([5, 5, 2, 7, 3, -1, -1, 4], np.int32)
    segments = np.array([0, 0, 0, 1, 1, 2, 2, 2], np.int32)
    assert vote(labels, segments).tolist() == [5, 5, 5, 3, 3, -1, -1, -1]
    rng = np.random.default_rng(0)
    labels, segments = rng.integers(-1, 6, 5000), rng.integers(0, 300, 5000)
    want = [np.bincount(labels[segments == s] + 1).argmax() - 1 for s in segments]
    assert vote(labels.astype(np.int32), segments.astype(np.int32)).tolist() == want


def test_segs_json(tmp_path):
    path = tmp_path / "scene.segs.json"
    path.write_text(json.dumps({"params": {}, "segIndices": [70, 70, 3, 900]}))
    assert read_segments(path, 4).tolist() == [1, 1, 0, 2]
    with pytest.raises(InputError, match="4 segments, the cloud has 5"):
        read_segments(path, 5)
    path.write_text("{}")
    with pytest.raises(InputError, match="segIndices"):
        read_segments(path, 4)


def test_degenerate_meshes_and_clouds_do_not_break_smoothing():
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [np.nan, 0, 0], [np.inf, 1, 1]])
    faces = np.array([[0, 1, 2], [0, 0, 0], [1, 1, 2], [0, 3, 4]], np.int32)
    assert segment_cloud(PointCloud(points, faces=faces)).shape == (5,)
    for cloud in (points[:1], np.zeros((40, 3)), np.full((3, 3), np.nan)):
        assert segment_cloud(PointCloud(cloud)).shape == (len(cloud),)
