"""`builtin`, segmentation without models of yours: stereo depth, one fused surface, and patches merged to segments.

Label ids are consistent across photos, because every photo shows the same segments of one surface.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from skimage.segmentation import watershed

from perception.errors import InputError
from perception.geometry import move_points
from perception.io.memory import Keep
from perception.machine import in_threads
from perception.masks.averaging import averaged
from perception.masks.base import LoadImage, MaskSource
from perception.masks.boundaries import WEIGHTS, boundaries, read_layers
from perception.masks.cues import filled, photo_cues
from perception.masks.merging import Segmentation, segmentation
from perception.masks.stereo import StereoView, make_stereo_view, measure_depths
from perception.masks.surface import FOOTPRINTS, Surface, SurfaceBuilder, pixels_of
from perception.masks.surface_graph import SurfaceGraph, patches, voxel_edges
from perception.progress import QUIET, Progress
from perception.types import View

VERSION = 17  # increased whenever the label images change, so that cached ones are recomputed
_SMOOTH = 0.03  # relative to the depth: a pixel with a larger depth step is not part of the surface
_LEAST_VOXELS = 100
SHIFTS = (0.0, 1 / 3, 2 / 3)  # of the voxels' grid, in their sides: the segmentations that are averaged
_BAND = 2  # pixels to either side of where segments meet, between which their border may move; half a voxel
_LEARNED = 15.0  # of a certain learned border, in the unit of the photo's gradient (Lab)


class BuiltinSegmentation(MaskSource):
    """Segments objects in all photos jointly. Needs approximate depth of every photo, which the map renders."""

    needs_depth = True

    def __init__(self) -> None:
        if not hasattr(cv2, "ximgproc"):
            raise InputError(
                f"--masks builtin: OpenCV {cv2.__version__} has no ximgproc, so another OpenCV package hides "
                "opencv-contrib-python-headless; uninstall the other and install that one again"
            )
        self.name, self.identity = "builtin", f"builtin {VERSION}"
        self._labels: dict[str, np.ndarray] = {}  # of each photo, [h, w] the segment that each pixel shows, 0 = none

    def prepare(
        self,
        views: list[View],
        load_photo: LoadImage,
        load_depth: LoadImage,
        progress: Progress = QUIET,
        keep: Keep = np.asarray,
    ) -> Segmentation | None:
        """None if fewer than two photos have depth, or no depths agree."""
        made = (make_stereo_view(view, load_photo(view), load_depth(view), keep) for view in views)
        stereo = [view for view in made if view is not None]
        if len(stereo) < 2:
            return None
        measure_depths(stereo, progress)
        cuts = segmented(stereo)
        if cuts is None:
            return None
        images = in_threads(partial(labels_of, segment=cuts.segment), stereo)
        self._labels = {view.name: keep(labels) for view, labels in zip(stereo, images, strict=True)}
        return cuts

    def label_image(self, view: View, photo: np.ndarray) -> np.ndarray:
        """[H, W] int32 labels of `photo` [H, W, 3], after `prepare`. All 0 if the photo does not show the surface."""
        if view.name not in self._labels:
            return np.zeros(photo.shape[:2], np.int32)
        return cv2.resize(self._labels[view.name], photo.shape[1::-1], interpolation=cv2.INTER_NEAREST)


def labels_of(view: StereoView, segment: np.ndarray) -> np.ndarray:
    """[h, w] int32 segment of each pixel; 0 everywhere if the photo shows none. segment: [V] of each voxel.

    Voxels are wider than pixels, and stereo is wrong next to things. So a pixel knows its segment only where others
    confirm its depth and no other segment is within _BAND pixels. Segments grow from there to the borders of the photo,
    and to the learned ones, by a watershed (Meyer 1991).
    """
    labels = np.where(view.voxel >= 0, segment[view.voxel], 0).astype(np.int32)
    if not (labels > 0).any():
        return labels
    labels = filled(labels, labels > 0)  # pixels off the surface take the nearest segment in the image
    window = np.ones((2 * _BAND + 1, 2 * _BAND + 1), np.uint8)
    image = labels.astype(np.float32)
    inside = view.confirmed & (cv2.dilate(image, window) == cv2.erode(image, window))
    seeds = np.where(inside | ~np.isin(labels, labels[inside]), labels, 0)  # a segment too thin for it stays
    learned = 1 / (1 + np.exp(-view.learned[:2].max(axis=0).astype(np.float32)))
    gradient = np.expm1(photo_cues(view.photo).texture) + _LEARNED * learned
    return np.asarray(watershed(gradient, seeds), np.int32)


def segmented(views: list[StereoView], side: float = FOOTPRINTS) -> Segmentation | None:
    """The segments of the surface that all photos show, on which those of the grids of SHIFTS agree most; None if there
    is hardly a surface. side: of a voxel, in pixel footprints. The views are given the voxels of the first grid."""
    surfaces = fuse(views, side, shifts=SHIFTS)
    if min(map(len, surfaces)) < _LEAST_VOXELS:
        return None
    first, *others = map(segmentation, surface_graphs(views, surfaces))
    points = first.points.astype(np.float64)
    voxels = [surface.voxel_of(points) for surface in surfaces[1:]]
    at_points = [np.where(voxel >= 0, of.segment[voxel], 0) for voxel, of in zip(voxels, others, strict=True)]
    return averaged(first, [(segment, of.probability) for segment, of in zip(at_points, others, strict=True)])


def fuse(
    views: list[StereoView], side: float = FOOTPRINTS, weights: Path = WEIGHTS, shifts: Sequence[float] = (0.0,)
) -> list[Surface]:
    """Fuses the confirmed pixels of all photos into one surface, once for each grid of voxels.

    side: of a voxel, in pixel footprints; weights: of learned borders; shifts: of the grids along each axis, in sides.
    """
    layers = read_layers(weights)
    footprints = np.concatenate([(view.depth[::4, ::4] / view.K[0, 0]).ravel() for view in views])
    builders = [SurfaceBuilder(side * float(np.median(footprints)), shift) for shift in shifts]

    def voxels(view: StereoView) -> tuple[np.ndarray, list[tuple[np.ndarray, np.ndarray]]]:
        photo, depth = view.cues()
        learned = boundaries(photo, depth, layers).astype(np.float16)
        border = 1 / (1 + np.exp(-learned[:2].max(axis=0).astype(np.float32)))
        known = view.confirmed & (depth.step.max(axis=0) < _SMOOTH)
        pixels = pixels_of(photo, depth, border, known, view.world_from_camera)
        return learned, [builder.voxels_of(pixels) for builder in builders]

    for view, (learned, found) in zip(views, in_threads(voxels, views), strict=True):
        view.learned = view.keep(learned)
        for builder, shown in zip(builders, found, strict=True):
            builder.add(*shown)
    return [builder.build() for builder in builders]


def surface_graphs(views: list[StereoView], surfaces: Sequence[Surface]) -> list[SurfaceGraph]:
    """Patches of each surface, with the evidence of all photos, which were fused, about the borders between them. The
    views are given the voxels of the first."""
    graphs = []
    for surface in surfaces:
        edges = voxel_edges(surface)
        graphs.append(SurfaceGraph(surface, patches(surface, edges), edges))

    def evidence(view: StereoView) -> tuple[np.ndarray, list[tuple[np.ndarray, ...]]]:
        photo, depth = view.cues()
        points, learned = move_points(view.world_from_camera, depth.points.astype(np.float64)), view.learned
        voxels = [surface.voxel_of(points) for surface in surfaces]
        regions = [np.where(voxel >= 0, graph.patch[voxel], -1) for graph, voxel in zip(graphs, voxels, strict=True)]
        floats = np.asarray(learned, np.float32)
        return voxels[0], [g.evidence(shown, photo, depth, floats) for g, shown in zip(graphs, regions, strict=True)]

    for view, (voxel, found) in zip(views, in_threads(evidence, views), strict=True):
        view.voxel = view.keep(voxel)
        for graph, of_photo in zip(graphs, found, strict=True):
            graph.add(*of_photo)
    for graph in graphs:
        graph.link()
    return graphs
