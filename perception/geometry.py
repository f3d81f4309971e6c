"""Transforms in float64, named a_from_b; sums of rows by group; order along a curve; nearest neighbours."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from perception.errors import InputError
from perception.interrupts import uninterrupted

if TYPE_CHECKING:
    from scipy.spatial import cKDTree
    from torch import Tensor

OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
"""Camera axes: OpenGL (x right, y up, z backward) to OpenCV (x right, y down, z forward). Its own inverse."""
_TOLERANCE = 1e-4
"""Largest deviation of R Rᵀ / s² from the identity: float32 poses pass, shears do not."""
FAR_GAP = 20.0
"""Ratio of distances that no path of a camera leaves between two photos: those at a table lie within 2 m, the next one
across a hall at 10."""
AT_ONCE = 1 << 18
"""Points whose neighbours are searched at once: a second of one core."""

_CELLS = 1024
"""Cells of `along_curve` along each axis, a power of two."""


def transform(linear: np.ndarray, shift: np.ndarray | Sequence[float]) -> np.ndarray:
    """The matrix [4, 4] float64 of x ↦ linear x + shift; linear [3, 3], shift [3]."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = linear, shift
    return matrix


def inverse_se3(a_from_b: np.ndarray) -> np.ndarray:
    """b_from_a [4, 4] of a rigid a_from_b [4, 4]."""
    return transform(a_from_b[:3, :3].T, -a_from_b[:3, :3].T @ a_from_b[:3, 3])


def camera_centres(camera_from_world: np.ndarray) -> np.ndarray:
    """Camera centres [N, 3] in the world frame, of poses camera_from_world [N, 3 or 4, 4]."""
    return np.asarray(-np.einsum("nji,nj->ni", camera_from_world[:, :3, :3], camera_from_world[:, :3, 3]))


def far_from_most(centres: np.ndarray, scale: float = 0.0) -> np.ndarray:
    """[N] bool, true for centres [N, 3] beyond a gap around all others: in order of their distance from the median
    centre, from the first of the farthest quarter that lies FAR_GAP times as far as the one before it, and as `scale`
    (the distance of what the cameras see; 0 = unknown). A camera that drives away leaves no gap."""
    distance = np.linalg.norm(centres - np.median(centres, axis=0), axis=1)
    order = np.argsort(distance, kind="stable")
    outer = np.arange(max(len(order) - len(order) // 4, 2), len(order))
    before = np.maximum(distance[order[outer - 1]], scale)
    gaps = outer[(before > 0) & (distance[order[outer]] > FAR_GAP * before)]
    far = np.zeros(len(order), bool)
    far[order[gaps[0] if len(gaps) else len(order) :]] = True
    return far


def nearest_rotation(matrix: np.ndarray) -> np.ndarray:
    """The rotation [3, 3] closest to `matrix` [3, 3] in the Frobenius norm (polar decomposition)."""
    u, _, vt = np.linalg.svd(matrix)
    return u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt


def rotations(quats: np.ndarray) -> np.ndarray:
    """[N, 3, 3] float64 of quaternions [N, 4] wxyz; one of zeros is the identity."""
    from scipy.spatial.transform import Rotation

    xyzw = np.add(quats[:, [1, 2, 3, 0]], [0, 0, 0, 1e-30], dtype=np.float64)
    return np.asarray(Rotation.from_quat(xyzw).as_matrix())


def interpolated_pose(times: np.ndarray, poses: np.ndarray, time: float, gap: float) -> np.ndarray | None:
    """Pose [4, 4] at `time` between the samples poses [N, 4, 4] at ascending times [N]; rotations by slerp.

    None before the first sample, after the last, and between samples more than `gap` apart.
    """
    after = int(np.searchsorted(times, time))
    if after < len(times) and times[after] == time:
        return np.asarray(poses[after])
    if after == 0 or after == len(times) or times[after] - times[after - 1] > gap:
        return None
    from scipy.spatial.transform import Rotation, Slerp

    share = (time - times[after - 1]) / (times[after] - times[after - 1])
    pair = Rotation.from_matrix(poses[after - 1 : after + 1, :3, :3])
    shift = (1 - share) * poses[after - 1, :3, 3] + share * poses[after, :3, 3]
    return transform(Slerp([0.0, 1.0], pair)(share).as_matrix(), shift)


def align_similarity(a: np.ndarray, b: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Scale s, rotation R [3, 3] and translation t [3] that minimise Σ |a_i − (s R b_i + t)|² over points [N, 3].

    Umeyama 1991, equations 34–42; N ≥ 3 points that are not on one line.
    """
    mean_a, mean_b = a.mean(0), b.mean(0)
    u, singular, vt = np.linalg.svd((a - mean_a).T @ (b - mean_b) / len(a))
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    rotation = u @ np.diag(sign) @ vt
    scale = float((singular * sign).sum() / ((b - mean_b) ** 2).sum(1).mean())
    return scale, rotation, mean_a - scale * rotation @ mean_b


def numbers(value: Any, name: str, expected: str = "numbers") -> np.ndarray:
    """`value` as a float64 array; InputError unless it holds finite numbers."""
    try:
        array = np.asarray(value, np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{name}: expected {expected}, found {str(value)[:60]!r}") from error
    if not np.isfinite(array).all():
        raise InputError(f"{name}: expected finite numbers, found {str(value)[:60]!r}")
    return array


def check_similarity(a_from_b: Any, name: str = "a_from_b") -> np.ndarray:
    """`a_from_b` as float64 [4, 4]; InputError unless it is a rotation times a scale, and a translation."""
    matrix = numbers(a_from_b, name, "4 × 4 numbers")
    if matrix.shape != (4, 4):
        raise InputError(f"{name}: expected a finite [4, 4] transform, found shape {list(matrix.shape)}")
    scale = scale_of(matrix)
    linear = matrix[:3, :3] / scale if scale > 0 else matrix[:3, :3]
    straight = np.abs(linear @ linear.T - np.eye(3)).max() <= _TOLERANCE
    if not 1e-9 < scale < 1e9 or not straight or not np.array_equal(matrix[3], [0, 0, 0, 1]):
        raise InputError(
            f"{name}: expected a rotation, a scale from 1e-9 to 1e9 and a translation with last row 0 0 0 1; "
            "found a shear, a mirror, another scale or another last row"
        )
    return matrix


def scale_of(a_from_b: np.ndarray) -> float:
    """The scale of a similarity [4, 4]: the cube root of the determinant, negative for a mirror."""
    return float(np.cbrt(np.linalg.det(a_from_b[:3, :3])))


def move_points(a_from_b: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Transforms points [..., 3] from frame b to a in float64; returns their own float dtype, else float64."""
    moved = np.asarray(points, np.float64) @ a_from_b[:3, :3].T + a_from_b[:3, 3]
    return moved.astype(points.dtype if np.issubdtype(np.asarray(points).dtype, np.floating) else np.float64)


def sums_by(index: np.ndarray, values: np.ndarray, count: int, weights: np.ndarray | None = None) -> np.ndarray:
    """Sums [count, ...] float64 of values [P, ...] with the same index [P], in their order, times weights [P]."""
    columns = values.reshape(len(values), math.prod(values.shape[1:])).T
    sums = [np.bincount(index, column if weights is None else weights * column, count) for column in columns]
    return np.stack(sums, axis=1).astype(np.float64, copy=False).reshape(count, *values.shape[1:])  # int64 of no values


def along_curve(points: Tensor) -> Tensor:
    """The order [P] int64 of points [P, 3] along a Morton curve (Morton 1966): most neighbours in space are near in it.

    The sides of a cell are shares of all points, not of space, so that far points do not crowd the others.
    """
    import torch

    order = torch.arange(len(points), device=points.device)
    code = torch.zeros_like(order)
    for axis in range(3):
        rank = torch.empty_like(order)
        rank[torch.sort(points[:, axis], stable=True).indices] = order
        cell = rank * _CELLS // max(1, len(points))
        for bit in range(_CELLS.bit_length() - 1):
            code |= (cell >> bit & 1) << (3 * bit + axis)
    return torch.sort(code, stable=True).indices


def nearest(tree: cKDTree, points: np.ndarray, ranks: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
    """Distances [P, R] and indices [P, R] int32 of the points of a tree nearest to each of points [P, 3], of these
    ranks, 1 the nearest. On all cores; in pieces, between which a program can be interrupted."""
    distance, index = np.empty((len(points), len(ranks))), np.empty((len(points), len(ranks)), np.int32)
    for at in range(0, len(points), AT_ONCE):
        piece = slice(at, at + AT_ONCE)
        with uninterrupted():  # its threads would go on in memory that is freed
            distance[piece], index[piece] = tree.query(points[piece], k=ranks, workers=-1)
    return distance, index
