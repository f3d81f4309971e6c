"""`builtin`, segmentation without models of yours: stereo depth, one fused surface, and patches merged to segments.

Label ids are consistent across photos, because every photo shows the same segments of one surface.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from perception.errors import InputError
from perception.geometry import move_points
from perception.io.memory import Keep
from perception.masks.base import LoadImage, MaskSource
from perception.masks.boundaries import WEIGHTS, boundaries, read_layers
from perception.masks.cues import filled
from perception.masks.merging import Segmentation, segmentation
from perception.masks.stereo import StereoView, make_stereo_view, measure_depths
from perception.masks.surface import FOOTPRINTS, Surface, SurfaceBuilder
from perception.masks.surface_graph import SurfaceGraph, patches, voxel_edges
from perception.progress import QUIET, Progress
from perception.types import View

VERSION = 14  # increased whenever the label images change, so that cached ones are recomputed
_SMOOTH = 0.03  # relative to the depth: a pixel with a larger depth step is not part of the surface
_LEAST_VOXELS = 100


class BuiltinSegmentation(MaskSource):
    """Segments objects in all photos jointly. Needs approximate depth of every photo, which the map renders."""

    needs_depth = True

    def __init__(self) -> None:
        import cv2

        if not hasattr(cv2, "ximgproc"):
            raise InputError(
                f"--masks builtin: OpenCV {cv2.__version__} has no ximgproc, so another OpenCV package hides "
                "opencv-contrib-python-headless; uninstall the other and install that one again"
            )
        self.name, self.identity = "builtin", f"builtin {VERSION}"
        self._voxels: dict[str, np.ndarray] = {}  # of each photo, [h, w] the voxel that each pixel shows, −1 = none
        self._segment = np.zeros(0, np.int32)

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
        surface = fuse(stereo)
        if len(surface) < _LEAST_VOXELS:
            return None
        cuts = segmentation(surface_graph(stereo, surface))
        self._segment, self._voxels = cuts.segment, {view.name: view.voxel for view in stereo}
        return cuts

    def label_image(self, view: View, photo: np.ndarray) -> np.ndarray:
        """[H, W] int32 labels of `photo` [H, W, 3], after `prepare`. All 0 if the photo does not show the surface."""
        import cv2

        if view.name not in self._voxels:
            return np.zeros(photo.shape[:2], np.int32)
        voxel = self._voxels[view.name]
        labels = np.where(voxel >= 0, self._segment[voxel], 0)
        known = labels > 0
        if known.any():  # pixels off the surface take the nearest segment in the image
            labels = filled(labels, known)
        return cv2.resize(labels, photo.shape[1::-1], interpolation=cv2.INTER_NEAREST)


def fuse(views: list[StereoView], side: float = FOOTPRINTS, weights: Path = WEIGHTS) -> Surface:
    """Fuses the confirmed pixels of all photos into one surface. side: of a voxel, in pixel footprints; weights: of
    learned borders."""
    layers = read_layers(weights)
    footprints = np.concatenate([(view.depth[::4, ::4] / view.K[0, 0]).ravel() for view in views])
    builder = SurfaceBuilder(side * float(np.median(footprints)))
    for view in views:
        photo, depth = view.cues()
        view.learned = view.keep(boundaries(photo, depth, layers).astype(np.float16))
        border = 1 / (1 + np.exp(-view.learned[:2].max(axis=0).astype(np.float32)))
        known = view.confirmed & (depth.step.max(axis=0) < _SMOOTH)
        builder.add(photo, depth, border, known, view.world_from_camera)
    return builder.build()


def surface_graph(views: list[StereoView], surface: Surface) -> SurfaceGraph:
    """Patches of the surface, with the evidence of all photos, which were fused, about the borders between them."""
    edges = voxel_edges(surface)
    graph = SurfaceGraph(surface, patches(surface, edges), edges)
    for view in views:
        photo, depth = view.cues()
        view.voxel = view.keep(surface.voxel_of(move_points(view.world_from_camera, depth.points.astype(np.float64))))
        regions = np.where(view.voxel >= 0, graph.patch[view.voxel], -1)
        graph.add(regions, photo, depth, np.asarray(view.learned, np.float32))
    graph.link()
    return graph
