"""Compiled kernels of perception."""

from collections.abc import Sequence
from typing import Annotated, overload

import numpy
from numpy.typing import NDArray

from perception._core import training as training


def simd_levels() -> list[str]:
    """SIMD levels that this processor has, best first."""

class RasterizerFrames_f32:
    """What a backward call needs of its forward call."""

    @property
    def evaluated(self) -> int: ...

    @property
    def contributing(self) -> int: ...

    @property
    def seconds(self) -> dict: ...

class RasterizerInputs_f32:
    def __init__(self, means: Annotated[NDArray[numpy.float32], dict(order='C', device='cpu', writable=False)], quats: Annotated[NDArray[numpy.float32], dict(order='C', device='cpu', writable=False)], scales: Annotated[NDArray[numpy.float32], dict(order='C', device='cpu', writable=False)], opacities: Annotated[NDArray[numpy.float32], dict(order='C', device='cpu', writable=False)], colors: Annotated[NDArray[numpy.float32], dict(order='C', device='cpu', writable=False)], features: Annotated[NDArray[numpy.float32], dict(order='C', device='cpu', writable=False)] | None, viewmats: Annotated[NDArray[numpy.float32], dict(order='C', device='cpu', writable=False)], Ks: Annotated[NDArray[numpy.float32], dict(order='C', device='cpu', writable=False)], background: Annotated[NDArray[numpy.float32], dict(order='C', device='cpu', writable=False)] | None, width: int, height: int, sh_degree: int, near_plane: float, eps2d: float, threads: int, depth: bool, variance: bool, max_records: int) -> None: ...

class RasterizerImages_f32:
    def __init__(self, colors: Annotated[NDArray[numpy.float32], dict(order='C', device='cpu')], alphas: Annotated[NDArray[numpy.float32], dict(order='C', device='cpu')], depths: Annotated[NDArray[numpy.float32], dict(order='C', device='cpu')] | None, features: Annotated[NDArray[numpy.float32], dict(order='C', device='cpu')] | None, feature_variance: Annotated[NDArray[numpy.float32], dict(order='C', device='cpu')] | None) -> None: ...

class RasterizerCotangents_f32:
    def __init__(self, colors: Annotated[NDArray[numpy.float32], dict(order='C', device='cpu', writable=False)] | None, alphas: Annotated[NDArray[numpy.float32], dict(order='C', device='cpu', writable=False)] | None, depths: Annotated[NDArray[numpy.float32], dict(order='C', device='cpu', writable=False)] | None, features: Annotated[NDArray[numpy.float32], dict(order='C', device='cpu', writable=False)] | None, feature_variance: Annotated[NDArray[numpy.float32], dict(order='C', device='cpu', writable=False)] | None) -> None: ...

class RasterizerGradients_f32:
    def __init__(self, means: Annotated[NDArray[numpy.float32], dict(order='C', device='cpu')] | None, quats: Annotated[NDArray[numpy.float32], dict(order='C', device='cpu')] | None, scales: Annotated[NDArray[numpy.float32], dict(order='C', device='cpu')] | None, opacities: Annotated[NDArray[numpy.float32], dict(order='C', device='cpu')] | None, colors: Annotated[NDArray[numpy.float32], dict(order='C', device='cpu')] | None, features: Annotated[NDArray[numpy.float32], dict(order='C', device='cpu')] | None, viewmats: Annotated[NDArray[numpy.float32], dict(order='C', device='cpu')] | None, mean2d: Annotated[NDArray[numpy.float32], dict(order='C', device='cpu')] | None, absgrad: Annotated[NDArray[numpy.float32], dict(order='C', device='cpu')] | None) -> None: ...

def rasterize_forward_f32(inputs: RasterizerInputs_f32, images: RasterizerImages_f32, visible: Annotated[NDArray[numpy.uint8], dict(order='C', device='cpu')], radii: Annotated[NDArray[numpy.float32], dict(order='C', device='cpu')] | None, simd: str) -> RasterizerFrames_f32: ...

def rasterize_labels_f32(inputs: RasterizerInputs_f32, labels: Annotated[NDArray[numpy.int32], dict(order='C', device='cpu', writable=False)], least: float, images: Annotated[NDArray[numpy.int32], dict(order='C', device='cpu')], visible: Annotated[NDArray[numpy.uint8], dict(order='C', device='cpu')], simd: str) -> None: ...

def rasterize_backward_f32(inputs: RasterizerInputs_f32, frames: RasterizerFrames_f32, images: RasterizerImages_f32, cotangents: RasterizerCotangents_f32, gradients: RasterizerGradients_f32, stored: bool) -> None: ...

class RasterizerFrames_f64:
    """What a backward call needs of its forward call."""

    @property
    def evaluated(self) -> int: ...

    @property
    def contributing(self) -> int: ...

    @property
    def seconds(self) -> dict: ...

class RasterizerInputs_f64:
    def __init__(self, means: Annotated[NDArray[numpy.float64], dict(order='C', device='cpu', writable=False)], quats: Annotated[NDArray[numpy.float64], dict(order='C', device='cpu', writable=False)], scales: Annotated[NDArray[numpy.float64], dict(order='C', device='cpu', writable=False)], opacities: Annotated[NDArray[numpy.float64], dict(order='C', device='cpu', writable=False)], colors: Annotated[NDArray[numpy.float64], dict(order='C', device='cpu', writable=False)], features: Annotated[NDArray[numpy.float64], dict(order='C', device='cpu', writable=False)] | None, viewmats: Annotated[NDArray[numpy.float64], dict(order='C', device='cpu', writable=False)], Ks: Annotated[NDArray[numpy.float64], dict(order='C', device='cpu', writable=False)], background: Annotated[NDArray[numpy.float64], dict(order='C', device='cpu', writable=False)] | None, width: int, height: int, sh_degree: int, near_plane: float, eps2d: float, threads: int, depth: bool, variance: bool, max_records: int) -> None: ...

class RasterizerImages_f64:
    def __init__(self, colors: Annotated[NDArray[numpy.float64], dict(order='C', device='cpu')], alphas: Annotated[NDArray[numpy.float64], dict(order='C', device='cpu')], depths: Annotated[NDArray[numpy.float64], dict(order='C', device='cpu')] | None, features: Annotated[NDArray[numpy.float64], dict(order='C', device='cpu')] | None, feature_variance: Annotated[NDArray[numpy.float64], dict(order='C', device='cpu')] | None) -> None: ...

class RasterizerCotangents_f64:
    def __init__(self, colors: Annotated[NDArray[numpy.float64], dict(order='C', device='cpu', writable=False)] | None, alphas: Annotated[NDArray[numpy.float64], dict(order='C', device='cpu', writable=False)] | None, depths: Annotated[NDArray[numpy.float64], dict(order='C', device='cpu', writable=False)] | None, features: Annotated[NDArray[numpy.float64], dict(order='C', device='cpu', writable=False)] | None, feature_variance: Annotated[NDArray[numpy.float64], dict(order='C', device='cpu', writable=False)] | None) -> None: ...

class RasterizerGradients_f64:
    def __init__(self, means: Annotated[NDArray[numpy.float64], dict(order='C', device='cpu')] | None, quats: Annotated[NDArray[numpy.float64], dict(order='C', device='cpu')] | None, scales: Annotated[NDArray[numpy.float64], dict(order='C', device='cpu')] | None, opacities: Annotated[NDArray[numpy.float64], dict(order='C', device='cpu')] | None, colors: Annotated[NDArray[numpy.float64], dict(order='C', device='cpu')] | None, features: Annotated[NDArray[numpy.float64], dict(order='C', device='cpu')] | None, viewmats: Annotated[NDArray[numpy.float64], dict(order='C', device='cpu')] | None, mean2d: Annotated[NDArray[numpy.float64], dict(order='C', device='cpu')] | None, absgrad: Annotated[NDArray[numpy.float64], dict(order='C', device='cpu')] | None) -> None: ...

def rasterize_forward_f64(inputs: RasterizerInputs_f64, images: RasterizerImages_f64, visible: Annotated[NDArray[numpy.uint8], dict(order='C', device='cpu')], radii: Annotated[NDArray[numpy.float64], dict(order='C', device='cpu')] | None, simd: str) -> RasterizerFrames_f64: ...

def rasterize_labels_f64(inputs: RasterizerInputs_f64, labels: Annotated[NDArray[numpy.int32], dict(order='C', device='cpu', writable=False)], least: float, images: Annotated[NDArray[numpy.int32], dict(order='C', device='cpu')], visible: Annotated[NDArray[numpy.uint8], dict(order='C', device='cpu')], simd: str) -> None: ...

def rasterize_backward_f64(inputs: RasterizerInputs_f64, frames: RasterizerFrames_f64, images: RasterizerImages_f64, cotangents: RasterizerCotangents_f64, gradients: RasterizerGradients_f64, stored: bool) -> None: ...

def rasterizer_release_memory() -> None:
    """Frees the buffers kept between calls."""

class KdTree:
    """Exact nearest neighbours in 3D; see perception.export.neighbors."""

    def __init__(self, points: Annotated[NDArray[numpy.float32], dict(shape=(None, 3), order='C', device='cpu', writable=False)], threads: int = 1) -> None: ...

    def knn(self, queries: Annotated[NDArray[numpy.float32], dict(shape=(None, 3), order='C', device='cpu', writable=False)], indices: Annotated[NDArray[numpy.int32], dict(shape=(None, None), order='C', device='cpu')], squared: Annotated[NDArray[numpy.float32], dict(shape=(None, None), order='C', device='cpu')], max_distance: float, threads: int = 1) -> None: ...

    def __len__(self) -> int: ...

def felzenszwalb(edges: Annotated[NDArray[numpy.int32], dict(shape=(None, 2), order='C', device='cpu', writable=False)], weights: Annotated[NDArray[numpy.float32], dict(shape=(None,), order='C', device='cpu', writable=False)], k: float, min_size: int, labels: Annotated[NDArray[numpy.int32], dict(shape=(None,), order='C', device='cpu')]) -> int:
    """
    Felzenszwalb-Huttenlocher on a graph; fills labels [nodes] int32 and returns the number of segments.
    """

def undirected(neighbors: Annotated[NDArray[numpy.int32], dict(shape=(None, None), order='C', device='cpu', writable=False)], edges: Annotated[NDArray[numpy.int32], dict(shape=(None, 2), order='C', device='cpu')]) -> int:
    """
    Pairs of neighbour lists [N, k], each once; fills edges and returns how many there are.
    """

def plane_normals(points: Annotated[NDArray[numpy.float32], dict(shape=(None, 3), order='C', device='cpu', writable=False)], neighbors: Annotated[NDArray[numpy.int32], dict(shape=(None, None), order='C', device='cpu', writable=False)], normals: Annotated[NDArray[numpy.float32], dict(shape=(None, 3), order='C', device='cpu')], threads: int = 1) -> None:
    """
    Normals [Q, 3] of the planes through neighbour lists [Q, k] of points [N, 3]; zero where there is none.
    """

def merge_segments(mask_starts: Annotated[NDArray[numpy.int64], dict(shape=(None,), order='C', device='cpu', writable=False)], masks: Annotated[NDArray[numpy.int32], dict(shape=(None,), order='C', device='cpu', writable=False)], pixels: Annotated[NDArray[numpy.float32], dict(shape=(None,), order='C', device='cpu', writable=False)], blank_starts: Annotated[NDArray[numpy.int64], dict(shape=(None,), order='C', device='cpu', writable=False)], blank_views: Annotated[NDArray[numpy.int32], dict(shape=(None,), order='C', device='cpu', writable=False)], blank: Annotated[NDArray[numpy.float32], dict(shape=(None,), order='C', device='cpu', writable=False)], view: Annotated[NDArray[numpy.int32], dict(shape=(None,), order='C', device='cpu', writable=False)], views: int, near_starts: Annotated[NDArray[numpy.int64], dict(shape=(None,), order='C', device='cpu', writable=False)], near: Annotated[NDArray[numpy.int32], dict(shape=(None,), order='C', device='cpu', writable=False)], z: Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C', device='cpu', writable=False)], sizes: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)], least_share: float, one_sided: float, prior: float, lowest: float, many: int, sure: float, children: Annotated[NDArray[numpy.int32], dict(shape=(None, 2), order='C', device='cpu')], affinity: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu')]) -> int:
    """
    Merge tree of segments by their masks; see perception.masks.consensus. Fills children and affinity and returns the number of merges.
    """

def plane_sweep(photo: Annotated[NDArray[numpy.uint8], dict(shape=(None, None), order='C', device='cpu', writable=False)], others: Sequence[Annotated[NDArray[numpy.uint8], dict(shape=(None, None), order='C', device='cpu', writable=False)]], homographies: Annotated[NDArray[numpy.float64], dict(shape=(None, 2, 3, 3), order='C', device='cpu', writable=False)], prior: Annotated[NDArray[numpy.float32], dict(shape=(None, None), order='C', device='cpu', writable=False)], first: float, step: float, planes: int, depth: Annotated[NDArray[numpy.float32], dict(shape=(None, None), order='C', device='cpu')], threads: int = 0, level: str = 'auto') -> None:
    """
    Fills depth [h, w] of photo [h, w] from others and a prior depth (0 = none). Plane i has the inverse depth
    first + step * i. homographies: A, B per other; A + B / z maps pixels, whose centres are integers.
    """

@overload
def normal_cdf(x: Annotated[NDArray[numpy.float32], dict(shape=(None,), order='C', device='cpu', writable=False)], out: Annotated[NDArray[numpy.float32], dict(shape=(None,), order='C', device='cpu')]) -> None: ...

@overload
def normal_cdf(x: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)], out: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu')]) -> None:
    """Fills out [N] with Phi(x) of x [N]."""
