"""Superpoint smoothing: segments a cloud by shape (Felzenszwalb-Huttenlocher); each segment gets one label."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from perception import _core
from perception.errors import InputError
from perception.export.neighbors import (
    list_edges,
    list_normals,
    mesh_edges,
    neighbor_lists,
    scannet_normals,
    scannet_weights,
    step_weights,
)
from perception.io.documents import read_json
from perception.io.memory import require_memory
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


def felzenszwalb(
    edges: np.ndarray, weights: np.ndarray, num_nodes: int, k_threshold: float = K_THRESHOLD, min_size: int = MIN_SIZE
) -> np.ndarray:
    """Segment [num_nodes] int32 of each node of a graph, numbered in order of appearance (IJCV 2004).
    edges [E, 2] int32, weights [E]; equal weights are ordered by node numbers, not by position in `edges`."""
    labels = np.empty(num_nodes, np.int32)
    edges = np.ascontiguousarray(edges, np.int32)
    _core.felzenszwalb(edges, np.ascontiguousarray(weights, np.float32), k_threshold, min_size, labels)
    return labels


def segment_cloud(cloud: PointCloud, color_weight: float | None = None, scannet: bool = False) -> np.ndarray:
    """Superpoints [P] int32 of a cloud or mesh. Points that are not finite become segments of their own.

    scannet: those of ScanNet's segmentator, for meshes alone; it leaves open how equal weights are ordered, here by
    vertex. By default its short normals are scaled to length 1 except at a CREASE, which keeps curved things whole:
    exported to meshes of tabletop_a with cells of 1 and 2 cm, AP is .509 and .589, with ScanNet's rule .493 and .548.

    The graph is the mesh's edges, or the NEIGHBORS nearest neighbours where there are no faces. color_weight: added to
    an edge's weight per unit of RGB distance in [0, √3] beyond 0.3; None: 0 on meshes, as ScanNet, else COLOR_WEIGHT.
    """
    points, meshed = cloud.points, cloud.faces is not None and len(cloud.faces) > 0
    if scannet and not meshed:
        raise InputError("cloud: has no faces, as ScanNet's segments need; leave out --segments scannet or give a mesh")
    require_memory(_BYTES_PER_POINT * len(points), "smoothing", "export without it (--no-smooth) or split the cloud")
    lists = None if meshed else neighbor_lists(points, NORMAL_NEIGHBORS)
    if cloud.faces is not None and meshed:
        edges, normals = mesh_edges(cloud.faces), scannet_normals(points, cloud.faces)
        if not scannet:
            length = np.linalg.norm(normals, axis=1, keepdims=True)
            normals = np.where(length > CREASE, normals / np.maximum(length, CREASE), normals)
    else:
        assert lists is not None  # there are no faces
        edges, normals = list_edges(lists[:, : NEIGHBORS + 1]), list_normals(points, lists)
    if cloud.normals is not None and not scannet:
        normals = np.nan_to_num(cloud.normals)
    weights = scannet_weights(points, normals, edges, oriented=meshed or cloud.normals is not None)
    if not meshed and cloud.normals is not None:  # meshes have no edges across gaps; estimated normals show steps
        weights += _STEP_WEIGHT * step_weights(points, normals, edges)
    if color_weight is None:
        color_weight = 0.0 if meshed else COLOR_WEIGHT
    if color_weight and cloud.colors is not None:
        near = neighbor_lists(points, _COLOR_NEIGHBORS) if lists is None else lists[:, :_COLOR_NEIGHBORS]
        colors = _median_colors(cloud.colors, near)
        difference = colors[edges[:, 0]] - colors[edges[:, 1]]
        distance = np.sqrt(np.einsum("ei,ei->e", difference, difference)) / np.float32(255)
        weights += color_weight * np.maximum(distance - _COLOR_EDGE, 0)
    weights = np.nan_to_num(weights, nan=2.0).astype(np.float32)
    return felzenszwalb(edges, weights, len(points))


def _median_colors(colors: np.ndarray, lists: np.ndarray) -> np.ndarray:
    """Colours [P, 3] float32, each the median, channel by channel, of colors [P, 3] uint8 over its neighbour list
    [P, k]; a missing neighbour (−1) is the point itself."""
    own = np.arange(len(colors), dtype=lists.dtype)[:, None]
    near = colors[np.where(lists >= 0, lists, own)]
    return np.partition(near, lists.shape[1] // 2, axis=1)[:, lists.shape[1] // 2].astype(np.float32)


def vote(labels: np.ndarray, segments: np.ndarray) -> np.ndarray:
    """Each segment's most frequent label, for all its points [P] int32; ties go to the smallest label.
    labels [P] int32 (−1 = none), segments [P] int32 >= 0. −1 counts like any other label."""
    if len(labels) != len(segments):
        raise InputError(f"{len(segments)} segment ids for {len(labels)} points; they must be the same points in order")
    if len(labels) == 0:
        return labels.astype(np.int32)
    key = np.sort((segments.astype(np.int64) << 32) | (labels.astype(np.int64) + (1 << 31)))
    first = np.flatnonzero(np.concatenate(([True], key[1:] != key[:-1])))
    counts = np.diff(np.append(first, len(key)))
    segment, label = key[first] >> 32, (key[first] & 0xFFFFFFFF) - (1 << 31)
    order = np.lexsort((label, -counts, segment))
    winner = order[np.concatenate(([True], np.diff(segment[order]) != 0))]
    chosen = np.zeros(int(segment.max()) + 1, np.int32)
    chosen[segment[winner]] = label[winner]
    return chosen[segments]


def read_segments(path: str | Path, num_points: int) -> np.ndarray:
    """Segments [P] int32 from a ScanNet `*.segs.json` (its list "segIndices"), one for each vertex."""
    try:
        values = np.asarray(read_json(Path(path))["segIndices"], np.int64)
    except (KeyError, TypeError, OverflowError) as error:
        raise InputError(f"{path}: is no segmentation file: expected a list 'segIndices' ({error})") from error
    if values.shape != (num_points,):
        raise InputError(f"{path}: lists {values.size} segments, the cloud has {num_points} points")
    return np.unique(values, return_inverse=True)[1].astype(np.int32)
