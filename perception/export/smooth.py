"""Superpoint smoothing: segment the cloud by shape (Felzenszwalb-Huttenlocher), then each segment takes one
label.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from perception import _core
from perception.errors import InputError
from perception.export.graph import (
    estimate_normals,
    list_edges,
    list_normals,
    mesh_edges,
    mesh_normals,
    neighbor_lists,
    radius_edges,
    scannet_weights,
    spacing,
    step_weights,
)
from perception.io.cloud_memory import require_memory
from perception.types import PointCloud

COLOR_WEIGHT = 0.2  # of bare clouds: without it a sheet of paper joins its table, whose normals are the same
_COLOR_EDGE = 0.3  # RGB distance from which colours part: less is texture and shade, which would part everything
_COLOR_NEIGHBORS = 9  # points, itself included, whose median colour is a point's: fine prints are no borders
_STEP_WEIGHT = 0.1  # of leaving the tangent plane: parallel surfaces have the same normals
NORMAL_NEIGHBORS = 12  # of each point, for the plane that gives its normal
_BYTES_PER_POINT = 250  # at the height of a kNN segmentation, measured with a margin


@dataclass(frozen=True)
class SmoothOptions:
    """k_threshold, min_size: ScanNet's kThresh .01 and segMinVerts 20.

    graph: "auto" (mesh edges when there are faces, else kNN), "mesh", "knn" or "radius". neighbors: of each
    point in the kNN graph. radius: length in the cloud's unit; None means three times the cloud's spacing.
    color_weight: weight added per unit of RGB distance in [0, √3] beyond 0.3; None means COLOR_WEIGHT, but 0 on
    mesh edges, where ScanNet has none.
    """

    k_threshold: float = 0.01
    min_size: int = 20
    graph: str = "auto"
    neighbors: int = 8
    radius: float | None = None
    color_weight: float | None = None


def felzenszwalb(
    edges: np.ndarray, weights: np.ndarray, num_nodes: int, k_threshold: float = 0.01, min_size: int = 20
) -> np.ndarray:
    """Segment [num_nodes] int32 of each node of a graph, numbered in order of appearance (IJCV 2004).

    edges [E, 2] int32, weights [E]; equal weights are taken in the order of their nodes, not of their
    position.
    """
    labels = np.empty(num_nodes, np.int32)
    edges = np.ascontiguousarray(edges, np.int32)
    _core.felzenszwalb(edges, np.ascontiguousarray(weights, np.float32), k_threshold, min_size, labels)
    return labels


def segment_cloud(cloud: PointCloud, options: SmoothOptions | None = None) -> np.ndarray:
    """Superpoints [P] int32 of a cloud or mesh. Points that are not finite become segments of their own."""
    options = options or SmoothOptions()
    points = cloud.points
    require_memory(_BYTES_PER_POINT * len(points), "smoothing", "export without it (--no-smooth) or split the cloud")
    faces = cloud.faces if cloud.faces is not None and len(cloud.faces) else None
    kind = ("mesh" if faces is not None else "knn") if options.graph == "auto" else options.graph
    edges, lists = _graph(points, faces, kind, options)
    normals, oriented = _normals(cloud, faces, lists)
    weights = scannet_weights(points, normals, edges, oriented=oriented)
    if kind != "mesh" and cloud.normals is not None:  # a mesh has no edge across a gap; normals estimated feel it
        weights += _STEP_WEIGHT * step_weights(points, normals, edges)
    color_weight = options.color_weight
    if color_weight is None:
        color_weight = 0.0 if kind == "mesh" else COLOR_WEIGHT
    if color_weight and cloud.colors is not None:
        if lists is None:
            lists = neighbor_lists(points, _COLOR_NEIGHBORS)
        difference = _color_difference(_median_colors(cloud.colors, lists[:, :_COLOR_NEIGHBORS]), edges)
        weights += color_weight * np.maximum(difference - _COLOR_EDGE, 0)
    weights = np.nan_to_num(weights, nan=2.0).astype(np.float32)
    return felzenszwalb(edges, weights, len(points), options.k_threshold, options.min_size)


def _median_colors(colors: np.ndarray, lists: np.ndarray) -> np.ndarray:
    """Colours [P, 3] float32, each the median, channel by channel, of colors [P, 3] uint8 over its neighbour list
    [P, k]; a missing neighbour (−1) is the point itself."""
    own = np.arange(len(colors), dtype=lists.dtype)[:, None]
    near = colors[np.where(lists >= 0, lists, own)]
    return np.partition(near, lists.shape[1] // 2, axis=1)[:, lists.shape[1] // 2].astype(np.float32)


def _color_difference(colors: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Euclidean RGB distance [E] float32 of the ends of edges, in [0, √3]; colors: [P, 3] float32 in 0..255."""
    difference = colors[edges[:, 0]] - colors[edges[:, 1]]
    return np.sqrt(np.einsum("ei,ei->e", difference, difference)) / np.float32(255)


def _graph(
    points: np.ndarray, faces: np.ndarray | None, kind: str, options: SmoothOptions
) -> tuple[np.ndarray, np.ndarray | None]:
    """(edges [E, 2], the nearest neighbours [P, k] where the graph came from them)."""
    if kind == "mesh":
        if faces is None:
            raise InputError("smoothing over mesh edges was asked for, but the cloud has no faces; use graph knn")
        return mesh_edges(faces, len(points)), None
    if kind == "knn":
        lists = neighbor_lists(points, max(options.neighbors + 1, NORMAL_NEIGHBORS))
        return list_edges(lists[:, : options.neighbors + 1]), lists[:, :NORMAL_NEIGHBORS]
    if kind == "radius":
        return radius_edges(points, options.radius or 3 * spacing(points) or 1.0), None
    raise InputError(f"graph '{kind}' is unknown; expected auto, mesh, knn or radius")


def _normals(cloud: PointCloud, faces: np.ndarray | None, lists: np.ndarray | None) -> tuple[np.ndarray, bool]:
    """(normals [P, 3], whether their sign means anything)."""
    if cloud.normals is not None:
        return np.nan_to_num(cloud.normals), True
    if faces is not None:
        return mesh_normals(cloud.points, faces), True
    if lists is None:
        return estimate_normals(cloud.points, NORMAL_NEIGHBORS), False
    return list_normals(cloud.points, lists), False


def vote(labels: np.ndarray, segments: np.ndarray) -> np.ndarray:
    """Each segment's most frequent label, for all its points [P] int32; ties go to the smallest label.

    labels [P] int32 (−1 = none), segments [P] int32 >= 0. "None" has a vote like any other label.
    """
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
    path = Path(path)
    try:
        values = np.asarray(json.loads(path.read_text(encoding="utf-8"))["segIndices"], np.int64)
    except (OSError, ValueError, KeyError, TypeError, OverflowError) as error:
        raise InputError(
            f"{path}: is no segmentation file: expected JSON with a list 'segIndices' ({error})"
        ) from error
    if values.shape != (num_points,):
        raise InputError(f"{path}: lists {values.size} segments, the cloud has {num_points} points")
    return np.unique(values, return_inverse=True)[1].astype(np.int32)
