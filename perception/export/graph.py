"""Neighbourhood graphs of clouds and meshes, normals, and edge weights as in ScanNet's segmentator."""

from __future__ import annotations

import numpy as np

from perception import _core
from perception.export.neighbors import Neighbors
from perception.io.cloud_memory import cores


def mesh_edges(faces: np.ndarray) -> np.ndarray:
    """Edges [E, 2] int32 of triangles [F, 3], three per face as ScanNet's segmentator lists them: 12, 13, 32.

    Of faces that contain a vertex twice, edges from a vertex to itself are left out.
    """
    edges = np.stack([faces[:, [0, 1]], faces[:, [0, 2]], faces[:, [2, 1]]], axis=1).reshape(-1, 2)
    return np.ascontiguousarray(edges[edges[:, 0] != edges[:, 1]], dtype=np.int32)


def neighbor_lists(points: np.ndarray, k: int) -> np.ndarray:
    """The k nearest points [P, k] int32 of each point, itself among them, nearest first; −1 where there are fewer.

    Points that are not finite have no neighbours and are not neighbours of others.
    """
    finite = np.flatnonzero(np.isfinite(points).all(axis=1)).astype(np.int32)
    if len(finite) == 0:
        return np.full((len(points), 1), -1, np.int32)
    k = min(k, len(finite), 1024)
    if len(finite) == len(points):
        return Neighbors(points).query(points, k)[0]
    inside = points[finite]
    found = Neighbors(inside).query(inside, k)[0]
    lists = np.full((len(points), k), -1, np.int32)
    lists[finite] = np.where(found >= 0, finite[found], -1)
    return lists


def list_edges(lists: np.ndarray) -> np.ndarray:
    """Edges [E, 2] int32, each once with a < b, of neighbour lists [P, k]."""
    edges = np.empty((lists.size, 2), np.int32)
    return edges[: _core.undirected(np.ascontiguousarray(lists), edges)]


def list_normals(points: np.ndarray, lists: np.ndarray) -> np.ndarray:
    """Normals [P, 3] float32 of the planes through the neighbour lists [P, k] of points [P, 3].

    The normal is the direction of least variance of a point and its neighbours, of arbitrary sign, so weights must
    not depend on the sign. Zero where the neighbours span no plane.
    """
    normals = np.empty((len(points), 3), np.float32)
    first = np.flatnonzero(np.isfinite(points).all(axis=1))[:1]
    local = (points - points[first].sum(axis=0)).astype(np.float32)  # relative to some point, to keep float32 precision
    _core.plane_normals(local, np.ascontiguousarray(lists), normals, cores())
    return normals


def scannet_normals(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Vertex normals [P, 3] float32 of ScanNet's segmentator: the running mean of the unit normals of a vertex's faces.

    Each face counts alike, and the mean is not scaled to length 1: it is short at a crease. Bit for bit the program's
    arithmetic in float32. Faces without area, which give NaN there, are left out; zero where a vertex has no face.
    """
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

    Not oriented: normals of unknown sign; 1 − |n_a·n_b| and no convexity. A missing (zero) normal weighs 1.
    """
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
    """How far each edge (a, b) leaves the planes of its ends, [E] float32: the squared sine of the larger angle.

    0 on a plane, small on a curved surface, near 1 between close parallel surfaces, such as a poster and its wall.
    Missing (zero) normals are ignored.
    """
    a, b = edges[:, 0], edges[:, 1]
    chord = (points[b] - points[a]).astype(np.float32)
    off = np.maximum(*(np.einsum("ei,ei->e", normals[end], chord) ** 2 for end in (a, b)))
    return (off / np.maximum(np.einsum("ei,ei->e", chord, chord), np.finfo(np.float32).tiny)).astype(np.float32)
