"""All photos segmented at once: depth by stereo, one surface out of it, patches of it merged into objects.

Ids agree between photos, since every photo shows the same pieces of one surface.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from perception.masks.cues import DepthCues, PhotoCues, depth_cues, filled_depth, photo_cues
from perception.masks.region_graph import agglomerate
from perception.masks.stereo import SIDE, Eye, choose_neighbours, confirmed, sweep
from perception.masks.surface import Surface, SurfaceBuilder, to_world, voxel_side
from perception.masks.surface_graph import SurfaceGraph, patches, voxel_edges
from perception.types import View

# Log odds that two patches are one object, in the order of SurfaceGraph.features: a logistic regression on pairs of
# patches of two rendered scenes with exact truth. Nothing else was learned. Weights fitted on the other scene alone
# gave the tabletop an AP of .526, those fitted on both .493: within the spread of the method, .1.
WEIGHTS = np.array(
    [7.25, -0.91, -0.97, 0.17, -5.47, 0.08, 0.0, -0.39, -0.48, 1.1, 0.23, -2.09,
     0.69, -0.64, 0.27, -1.92, 1.53, 2.66, 4.16, 4.36, -5.11, -5.43, -1.69, 4.29,
     0.7, -0.12, 2.58, 1.12, 0.28, 0.0, 0.35, -0.13, -0.01, 0.39, -2.6]
)  # fmt: skip
THRESHOLD = 1.2  # above even odds: a merged pair is lost, a split one costs less
_SMOOTH = 0.03  # of the depth: a pixel over which the surface jumps farther shows no surface
_CONFIRMED = 2  # photos that must agree with a depth for it to shape the surface
SMALLEST = 2e-4  # area, in squared distances it is photographed from, under which a patch joins its neighbour
_LARGE = 0.1  # area, in the same measure, from which a flat segment may be a part of a floor, a wall, a table
_FLAT = 0.03  # of the depth: standard deviation of such a segment across its plane, low things upon it included
_LEAST_VOXELS = 100
_LEAST_DEPTH = 0.05  # share of a photo's pixels that must have depth for it to take part


class SceneSegmentation:
    """What was found, and how each photo shows it."""

    def __init__(self, sights: list[Sight], surface: Surface, segment: np.ndarray) -> None:
        self._sights = {sight.name: sight for sight in sights}
        self.surface, self.segment = surface, segment

    @staticmethod
    def of(
        views: list[View],
        load_photo: Callable[[View], np.ndarray],
        load_depth: Callable[[View], np.ndarray],
        progress: Callable[[int, int], None] | None = None,
    ) -> SceneSegmentation | None:
        """None where no surface can be told: fewer than two photos with depth, or none that agree."""
        made = [make_sight(view, load_photo(view), load_depth(view)) for view in views]
        sights = [sight for sight in made if sight is not None]
        if len(sights) < 2:
            return None
        measure(sights, progress)
        surface = fuse(sights)
        if len(surface) < _LEAST_VOXELS:
            return None
        graph = surface_graph(sights, surface)
        return SceneSegmentation(sights, surface, segments(graph, WEIGHTS, THRESHOLD))

    def label_image(self, view: View, photo: np.ndarray) -> np.ndarray | None:
        """[H, W] int32 labels of `photo` [H, W, 3]; None for a photo that shows nothing of the surface."""
        import cv2

        sight = self._sights.get(view.name)
        if sight is None:
            return None
        labels = label_sight(sight, self.surface, self.segment)
        return cv2.resize(labels, photo.shape[1::-1], interpolation=cv2.INTER_NEAREST) if labels.any() else None


@dataclass
class Sight:
    """One photo at matching size: what stereo needs, the small photo [h, w, 3] uint8, and its depth once known.

    sure: [h, w] bool, pixels whose depth other photos confirm.
    """

    name: str
    photo: np.ndarray
    eye: Eye
    depth: np.ndarray
    sure: np.ndarray

    def cues(self) -> tuple[PhotoCues, DepthCues]:
        """What photo and depth tell, made anew at every call: keeping it would cost 20 times the photo's memory."""
        return photo_cues(self.photo), depth_cues(self.depth, self.eye.K)

    def points(self, depth: DepthCues) -> np.ndarray:
        """[h, w, 3] world points."""
        return to_world(depth.points, self.world_from_camera)

    @property
    def world_from_camera(self) -> np.ndarray:
        """[4, 4]."""
        return np.asarray(np.linalg.inv(self.eye.camera_from_world))


def make_sight(view: View, photo: np.ndarray, depth: np.ndarray) -> Sight | None:
    """photo: [H, W, 3] uint8 RGB; depth: [H, W] as known so far, 0 = none. None for a photo with too little depth."""
    import cv2

    height, width = photo.shape[:2]
    ratio = SIDE / max(height, width)
    size = (max(1, round(width * ratio)), max(1, round(height * ratio)))
    known = np.isfinite(depth) & (depth > 0)
    if known.mean() < _LEAST_DEPTH:
        return None
    small = cv2.resize(photo, size, interpolation=cv2.INTER_AREA if ratio < 1 else cv2.INTER_LINEAR)
    coarse = cv2.resize(np.where(known, depth, 0).astype(np.float32), size, interpolation=cv2.INTER_NEAREST)
    K = np.diag([size[0] / view.width, size[1] / view.height, 1.0]) @ view.K
    grey = cv2.cvtColor(small, cv2.COLOR_RGB2GRAY).astype(np.float32)
    eye = Eye(grey, K, np.asarray(view.camera_from_world, np.float64), coarse)
    return Sight(view.name, small, eye, filled_depth(coarse), coarse > 0)


def measure(sights: list[Sight], progress: Callable[[int, int], None] | None = None) -> None:
    """Gives all sights their depth by stereo, and says where it is sure."""
    eyes = [sight.eye for sight in sights]
    chosen = choose_neighbours(eyes)

    def depth_of(i: int) -> np.ndarray:
        return sweep(eyes[i], [eyes[j] for j in chosen[i]]) if chosen[i] else sights[i].depth

    depths = []
    pool = ThreadPoolExecutor(os.cpu_count())
    try:
        for done, depth in enumerate(pool.map(depth_of, range(len(eyes))), start=1):
            depths.append(depth)
            if progress is not None:
                progress(done, len(eyes))
    finally:
        pool.shutdown(cancel_futures=True)  # Ctrl-C waits for the photos begun, not for all
    for sight, depth, near in zip(sights, depths, chosen, strict=True):
        if near:
            agreeing, mean = confirmed(depth, sight.eye, [eyes[j] for j in near], [depths[j] for j in near])
            sight.depth, sight.sure = mean, agreeing >= min(_CONFIRMED, len(near))


def fuse(sights: Iterable[Sight]) -> Surface:
    """The surface that the sure pixels of all photos show."""
    sights = list(sights)
    footprints = np.concatenate([(s.depth[::4, ::4] / s.eye.K[0, 0]).ravel() for s in sights])
    builder = SurfaceBuilder(voxel_side(footprints))
    for sight in sights:
        photo, depth = sight.cues()
        builder.add(photo, depth, sight.sure & (depth.step.max(axis=0) < _SMOOTH), sight.world_from_camera)
    return builder.build()


def surface_graph(sights: Iterable[Sight], surface: Surface) -> SurfaceGraph:
    """Patches of the surface and what all photos say about their borders."""
    edges = voxel_edges(surface)
    graph = SurfaceGraph(surface, patches(surface, edges), edges)
    for sight in sights:
        photo, depth = sight.cues()
        voxel = surface.voxel_of(sight.points(depth))
        graph.add(np.where(voxel >= 0, graph.patch[voxel], -1), photo, depth)
    graph.link()
    return graph


def segments(graph: SurfaceGraph, weights: np.ndarray, threshold: float) -> np.ndarray:
    """[V] int32 segment 1.. of each voxel, 1 the largest; 0 for crumbs that touch nothing."""
    ends = join_planes(graph, agglomerate(graph, weights, threshold, SMALLEST))
    crumbs = np.array([graph.negligible(end, SMALLEST) for end in ends.tolist()])[graph.patch]
    _, index, counts = np.unique(ends[graph.patch], return_inverse=True, return_counts=True)
    rank = np.empty(len(counts), np.int32)
    rank[np.argsort(-counts, kind="stable")] = np.arange(1, len(counts) + 1)
    return np.where(crumbs, 0, rank[index]).astype(np.int32)


def join_planes(graph: SurfaceGraph, ends: np.ndarray) -> np.ndarray:
    """Floors and tables that things stand on fall into parts; large flat parts of one plane and look are one again.

    ends: [R] the segment that each patch ended in. Returns the same, joined parts under one name."""
    names = np.unique(ends)
    large = [int(i) for i in names if graph.share(int(i)) > _LARGE and graph.flatness(int(i)) < _FLAT]
    joined = np.arange(graph.count)
    for place, a in enumerate(large):
        for b in large[place + 1 :]:
            if graph.one_plane(a, b):
                joined[joined == joined[b]] = joined[a]
    return joined[ends]


def label_sight(sight: Sight, surface: Surface, segment: np.ndarray) -> np.ndarray:
    """[h, w] int32 segment of each pixel at matching size; pixels off the surface take their neighbours' segment."""
    from scipy.ndimage import distance_transform_edt

    _, depth = sight.cues()
    voxel = surface.voxel_of(sight.points(depth))
    labels = np.where(voxel >= 0, segment[voxel], 0)
    if not labels.any():
        return labels
    nearest = distance_transform_edt(labels == 0, return_distances=False, return_indices=True)
    return labels[tuple(nearest)]
