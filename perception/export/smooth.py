"""Superpoint smoothing: segments a cloud by shape (Felzenszwalb-Huttenlocher); each segment gets one label.

Graphs of clouds and meshes, with normals and weights as in ScanNet's segmentator.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from perception import _core
from perception.errors import InputError
from perception.export.neighbors import list_normals, neighbor_lists
from perception.io.documents import read_json, refusing
from perception.machine import require_memory
from perception.types import PointCloud

K_THRESHOLD, MIN_SIZE = 0.01, 20  # ScanNet's kThresh and segMinVerts
NEIGHBORS = 8  # of each point in the graph of a cloud without faces
COLOR_WEIGHT = 0.2  # for clouds without faces: separates flat objects, such as paper on a table, with equal normals
CREASE = 0.8  # length of a vertex normal, the mean of its faces', where two planes meet at 74 degrees
_COLOR_EDGE = 0.3  # RGB distance above which colour separates points; texture and shading are below it
_COLOR_NEIGHBORS = 9  # points, itself included, over which colours are median filtered to remove fine texture
_STEP_WEIGHT = 0.1  # of `step_weights`, which separates close parallel surfaces with equal normals
NORMAL_NEIGHBORS = 12  # of each point, for the plane fit of its normal
_BYTES_PER_POINT = 250  # peak memory of a kNN segmentation, measured, with a margin


def mesh_edges(faces: np.ndarray) -> np.ndarray:
    """Edges [E, 2] int32 of triangles [F, 3], three per face as ScanNet's segmentator lists them: 12, 13, 32.
    Of faces that contain a vertex twice, edges from a vertex to itself are left out."""
    edges = np.stack([faces[:, [0, 1]], faces[:, [0, 2]], faces[:, [2, 1]]], axis=1).reshape(-1, 2)
    return np.ascontiguousarray(edges[edges[:, 0] != edges[:, 1]], dtype=np.int32)


def list_edges(lists: np.ndarray) -> np.ndarray:
    """Edges [E, 2] int32, each once with a < b, of neighbour lists [P, k]."""
    edges = np.empty((lists.size, 2), np.int32)
    return edges[: _core.undirected(np.ascontiguousarray(lists), edges)]


def scannet_normals(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Vertex normals [P, 3] float32 of ScanNet's segmentator, bit for bit: the running mean of the unit normals of a
    vertex's faces, short at a crease. Faces without area, which give NaN there, are left out; zero without faces."""
    corners = points[faces].astype(np.float64)
    with np.errstate(invalid="ignore", divide="ignore"):
        sides = [(corners[:, k] - corners[:, 0]).astype(np.float32) for k in (1, 2)]
        normal = np.cross(*sides)
        normal /= np.sqrt(_dot(normal, normal))[:, None]
    sound = np.isfinite(normal).all(axis=1)
    vertex, normal = faces[sound].reshape(-1), np.repeat(normal[sound], 3, axis=0)
    order = np.argsort(vertex, kind="stable")
    turn = np.empty(len(vertex), np.int64)  # how many faces of the same vertex come before
    turn[order] = np.arange(len(vertex)) - np.searchsorted(vertex[order], vertex[order])
    normals = np.zeros((len(points), 3), np.float32)
    for k in range(int(turn.max(initial=-1)) + 1):
        rows = turn == k
        share = np.float32(1) / np.float32(k + 1)
        normals[vertex[rows]] = share * normal[rows] + (np.float32(1) - share) * normals[vertex[rows]]
    return normals


def scannet_weights(points: np.ndarray, normals: np.ndarray, edges: np.ndarray, *, oriented: bool = True) -> np.ndarray:
    """Weights [E] float32 of edges (a, b): 1 − n_a·n_b, squared when the pair is convex, n_b·(p_b − p_a) > 0.
    Not oriented: normals of unknown sign; 1 − |n_a·n_b| and no convexity. A missing (zero) normal weighs 1."""
    a, b = edges[:, 0], edges[:, 1]
    cosine = _dot(normals[a], normals[b])
    if not oriented:
        return np.maximum(1 - np.abs(cosine), 0).astype(np.float32)
    weights = 1 - cosine
    chord = (points[b] - points[a]).astype(np.float32)
    with np.errstate(invalid="ignore", divide="ignore"):
        convex = _dot(normals[b], chord / np.sqrt(_dot(chord, chord))[:, None]) > 0
    return np.where(convex, weights * weights, weights).astype(np.float32)


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Scalar products [E] of rows [E, 3], added from the first axis to the last."""
    return a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1] + a[:, 2] * b[:, 2]


def step_weights(points: np.ndarray, normals: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """How far each edge (a, b) leaves the planes of its ends, [E] float32: the squared sine of the larger angle, near 1
    between close parallel surfaces, such as a poster and its wall. Missing (zero) normals are ignored."""
    a, b = edges[:, 0], edges[:, 1]
    chord = (points[b] - points[a]).astype(np.float32)
    off = np.maximum(*(np.einsum("ei,ei->e", normals[end], chord) ** 2 for end in (a, b)))
    return (off / np.maximum(np.einsum("ei,ei->e", chord, chord), np.finfo(np.float32).tiny)).astype(np.float32)


def felzenszwalb(
    edges: np.ndarray, weights: np.ndarray, num_nodes: int, k_threshold: float = K_THRESHOLD, min_size: int = MIN_SIZE
) -> np.ndarray:
    """Segment [num_nodes] int32 of each node of a graph, numbered in order of appearance (IJCV 2004).
    edges [E, 2] int32, weights [E]; equal weights are ordered by node numbers, not by position in `edges`."""
    labels, weights = np.empty(num_nodes, np.int32), np.ascontiguousarray(weights, np.float32)
    _core.felzenszwalb(np.ascontiguousarray(edges, np.int32), weights, k_threshold, min_size, labels)
    return labels


def segment_cloud(cloud: PointCloud, scannet: bool = False) -> np.ndarray:
    """Superpoints [P] int32 of a cloud or mesh. Points that are not finite become segments of their own.

    scannet: those of ScanNet's segmentator, for meshes alone; it leaves open how equal weights are ordered, here by
    vertex. By default its short normals are scaled to length 1 except at a CREASE, which keeps curved things whole:
    exported to meshes of tabletop_a with cells of 1 and 2 cm, AP is .509 and .589, with ScanNet's rule .493 and .548.

    The graph is the mesh's edges, or the NEIGHBORS nearest neighbours where there are no faces. There, COLOR_WEIGHT is
    added to an edge's weight per unit of RGB distance in [0, √3] beyond 0.3; not on meshes, as ScanNet.
    """
    points, meshed = cloud.points, cloud.faces is not None and len(cloud.faces) > 0
    if scannet and not meshed:
        raise InputError("cloud: has no faces, as ScanNet's segments need; leave out --segments scannet or give a mesh")
    require_memory(_BYTES_PER_POINT * len(points), "smoothing", "export without it (--no-smooth) or split the cloud")
    if cloud.faces is not None and meshed:
        edges, normals = mesh_edges(cloud.faces), scannet_normals(points, cloud.faces)
        if not scannet:
            length = np.linalg.norm(normals, axis=1, keepdims=True)
            normals = np.where(length > CREASE, normals / np.maximum(length, CREASE), normals)
    else:
        lists = neighbor_lists(points, NORMAL_NEIGHBORS)
        edges, normals = list_edges(lists[:, : NEIGHBORS + 1]), list_normals(points, lists)
    if cloud.normals is not None and not scannet:
        normals = np.nan_to_num(cloud.normals, posinf=0, neginf=0)
        length = np.linalg.norm(normals, axis=1, keepdims=True)  # sums of faces' normals, or bytes
        normals = np.where(np.abs(length - 1) > 1e-3, normals / np.maximum(length, 1e-12), normals)
    weights = scannet_weights(points, normals, edges, oriented=meshed or cloud.normals is not None)
    if not meshed and cloud.normals is not None:  # meshes have no edges across gaps; estimated normals show steps
        weights += _STEP_WEIGHT * step_weights(points, normals, edges)
    if not meshed and cloud.colors is not None:
        near = lists[:, :_COLOR_NEIGHBORS]  # a missing neighbour (−1) is the point itself
        near = cloud.colors[np.where(near >= 0, near, np.arange(len(points), dtype=near.dtype)[:, None])]
        middle = near.shape[1] // 2  # of the values of each channel
        colors = np.partition(near, middle, axis=1)[:, middle].astype(np.float32)
        distance = np.linalg.norm(colors[edges[:, 0]] - colors[edges[:, 1]], axis=1) / np.float32(255)
        weights += COLOR_WEIGHT * np.maximum(distance - _COLOR_EDGE, 0)
    return felzenszwalb(edges, np.nan_to_num(weights, nan=2.0), len(points))


def vote(labels: np.ndarray, segments: np.ndarray) -> np.ndarray:
    """Each segment's most frequent label, for all its points [P] int32; ties go to the smallest label.
    labels [P] int32 (−1 = none), segments [P] int32 >= 0. −1 counts like any other label."""
    if len(labels) != len(segments):
        raise InputError(f"{len(segments)} segment ids for {len(labels)} points; they must be the same points in order")
    pairs = (segments.astype(np.int64) << 32) | (labels.astype(np.int64) + (1 << 31))
    pairs, counts = np.unique(pairs, return_counts=True)
    segment, label = pairs >> 32, (pairs & 0xFFFFFFFF) - (1 << 31)
    order = np.lexsort((label, -counts, segment))
    known, first = np.unique(segment[order], return_index=True)
    return label[order[first]].astype(np.int32)[np.searchsorted(known, segments)]


def read_segments(path: str | Path, num_points: int) -> np.ndarray:
    """Segments [P] int32 from a ScanNet `*.segs.json` (its list "segIndices"), one for each vertex."""
    with refusing(f"{path}: is no segmentation file: expected a list 'segIndices' ({{why}})"):
        values = np.asarray(read_json(Path(path))["segIndices"], np.int64)
    if values.shape != (num_points,):
        raise InputError(f"{path}: lists {values.size} segments, the cloud has {num_points} points")
    return np.unique(values, return_inverse=True)[1].astype(np.int32)
