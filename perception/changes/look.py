"""What the photos of a visit show beside what the map says that they should show."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch

from perception.gaussians.model import Gaussians
from perception.gaussians.views import TrainingView, expected_depth, render
from perception.instances.silhouettes import render_silhouettes
from perception.masks.stereo import StereoView, make_stereo_view, measure_depths
from perception.progress import QUIET, Progress
from perception.types import View

HALVED_FROM = 480
"""Long side in pixels from which photos are compared at half the resolution, near that of stereo."""
WINDOW = 3.0
"""Standard deviation in pixels of the window in which brightness is compared: some times the error of a silhouette."""
DARK, BRIGHT = 0.04, 0.96
"""Colours beyond are clipped or mostly noise, and do not show the exposure."""
DIFFERENT = 0.1
"""Mean difference of colour, of 1, from which a pixel shows something else than the map."""


@dataclass(frozen=True)
class Look:
    """One photo beside the render of the map, all [h, w].

    view: the photo at this size, with its labels; mapped: depth of the map's surface, 0 = none; measured: depth that
    stereo or a sensor measured and other photos confirm, 0 = none; ids: the map's instance, −1 = none. product,
    rendered, shown: local covariance of render and photo, and their variances; colour: mean absolute difference.
    """

    view: TrainingView
    mapped: np.ndarray
    measured: np.ndarray
    ids: np.ndarray
    product: np.ndarray
    rendered: np.ndarray
    shown: np.ndarray
    colour: np.ndarray

    @property
    def counts(self) -> np.ndarray:
        """[h, w] bool: pixels that are not ignored."""
        weight = self.view.weight
        return np.ones(self.mapped.shape, bool) if weight is None else weight.numpy() > 0

    @property
    def labels(self) -> np.ndarray:
        """[h, w] int64 masks of the photo, 0 = none."""
        height, width = self.mapped.shape
        labels = self.view.labels
        return np.zeros((height, width), np.int64) if labels is None else labels.numpy().astype(np.int64)


def compared(view: TrainingView) -> TrainingView:
    """The view at the size at which photos are compared."""
    return view.halved() if max(view.photo.shape[:2]) >= HALVED_FROM else view


def stereo_of(
    views: Sequence[View], photos: Sequence[TrainingView], looks: Sequence[Look], progress: Progress = QUIET
) -> list[StereoView | None]:
    """Depth of every photo, by a sensor or by stereo among the visit's photos; None where the map shows nothing.

    The map's depth bounds the search, so that a thing that is gone is not found again. Where the photo has another
    colour than the map, the search does not prefer that depth: something else may stand there.
    """
    made: list[StereoView | None] = []
    for view, photo, shown in zip(views, photos, looks, strict=True):
        prior = shown.mapped
        if shown.view.depth is not None:
            prior = np.where(shown.view.depth.numpy() > 0, shown.view.depth.numpy(), prior)
        stereo = make_stereo_view(view, photo.photo.numpy(), prior)
        if stereo is not None:
            unlike = cv2.dilate((shown.colour > DIFFERENT).astype(np.uint8), np.ones((3, 3)))
            unlike = cv2.resize(unlike, stereo.prior.shape[::-1], interpolation=cv2.INTER_NEAREST)
            stereo.preferred = np.where(unlike > 0, np.float32(0), stereo.prior)
        made.append(stereo)
    measure_depths([view for view in made if view is not None], progress)
    for stereo, shown in zip(made, looks, strict=True):
        if stereo is not None and shown.view.depth is not None:  # where the sensor measured nothing, it is the map's
            known = shown.view.depth.numpy() > 0
            known = cv2.resize(known.astype(np.uint8), stereo.depth.shape[::-1], interpolation=cv2.INTER_NEAREST) > 0
            stereo.confirmed = stereo.confirmed & known
    return made


def depth_at(stereo: StereoView | None, shape: tuple[int, ...], confirmed: bool = True) -> np.ndarray:
    """[H, W] float32 depth at another size, 0 = none, or not confirmed by other photos."""
    if stereo is None:
        return np.zeros(shape[:2], np.float32)
    depth = np.where(stereo.confirmed, stereo.depth, 0) if confirmed else stereo.depth
    return np.asarray(cv2.resize(depth.astype(np.float32), shape[1::-1], interpolation=cv2.INTER_NEAREST))


def with_exposure(gaussians: Gaussians, views: Sequence[TrainingView]) -> tuple[list[TrainingView], np.ndarray]:
    """The views with gains relative to each other, of geometric mean 1, and [3] the light of the visit over the map's.

    The gain of a photo is the median over its pixels of its colours over the map's, so that what has changed in less
    than half of a photo does not count.
    """
    logs = np.array([_log_gain(gaussians, compared(view)) for view in views]).reshape(-1, 3)
    known = np.isfinite(logs).all(axis=1)
    mean = np.median(logs[known], axis=0) if known.any() else np.zeros(3)
    own = np.where(known[:, None], logs - mean, 0)
    gains = torch.from_numpy(np.exp(own).astype(np.float32))
    return [replace(view, gain=gain) for view, gain in zip(views, gains, strict=True)], np.exp(mean)


def _log_gain(gaussians: Gaussians, view: TrainingView) -> np.ndarray:
    out = render(gaussians, view.camera_from_world, view.K, *view.photo.shape[1::-1], harmonics=True, eps2d=view.eps2d)
    image, photo = out.colors[0].numpy(), view.photo.numpy().astype(np.float32) / 255
    usable = (out.alphas[0].numpy() > 0.9) & ((photo > DARK) & (photo < BRIGHT) & (image > DARK)).all(axis=2)
    if view.weight is not None:
        usable &= view.weight.numpy() > 0
    if usable.sum() < 100:
        return np.full(3, np.nan)
    return np.asarray(np.median(np.log(photo[usable] / image[usable]), axis=0))


def look(gaussians: Gaussians, ids: np.ndarray, view: TrainingView, measured: np.ndarray) -> Look:
    """Compares a photo (at the size of `compared`, with its gain) with the Gaussians, which have instances ids [N]."""
    height, width = view.photo.shape[:2]
    out = render(gaussians, view.camera_from_world, view.K, width, height, harmonics=True, eps2d=view.eps2d)
    mapped = expected_depth(out).numpy()
    image = view.exposed(out.colors[0]).clamp(0, 1).numpy()
    photo = view.photo.numpy().astype(np.float32) / 255
    (seen,) = render_silhouettes(gaussians, [ids], view.camera_from_world, view.K, width, height, eps2d=view.eps2d)
    shown = seen.ids.copy()
    if view.weight is not None:
        shown[view.weight.numpy() == 0] = -1
    return Look(view, mapped, measured, shown, *moments(image, photo), np.abs(image - photo).mean(axis=2))


def moments(image: np.ndarray, photo: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Local covariance of two images [h, w, 3] in brightness, and their variances, each [h, w]."""
    a, b = (cv2.cvtColor(np.ascontiguousarray(x), cv2.COLOR_RGB2GRAY) for x in (image, photo))
    mean_a, mean_b = blurred(a), blurred(b)
    return blurred(a * b) - mean_a * mean_b, blurred(a * a) - mean_a**2, blurred(b * b) - mean_b**2


def blurred(image: np.ndarray) -> np.ndarray:
    """Local means of an image [h, w]."""
    return np.asarray(cv2.GaussianBlur(image, (0, 0), WINDOW))


def correlation(product: float, a: float, b: float) -> float:
    """Sum of covariances over the root of the sums of variances: the correlation of brightness over all pixels."""
    return product / max(float(np.sqrt(a * b)), 1e-9)


def in_view(means: np.ndarray, scales: np.ndarray, views: Sequence[TrainingView]) -> np.ndarray:
    """[N] bool: Gaussians (means [N, 3], largest scales [N]) that some view may show, nothing being in front."""
    found = np.zeros(len(means), bool)
    for view in views:
        pixel, z = projected(view, means)
        reach = 3 * scales / np.maximum(z, 1e-6) * float(view.K[0, 0]) + 1
        size = np.array(view.photo.shape[1::-1])
        found |= (z > 0) & ((pixel > -reach[:, None]) & (pixel < size + reach[:, None])).all(axis=1)
    return found


def projected(view: TrainingView, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels [P, 2] and depths [P] of points [P, 3]."""
    K, pose = view.camera
    local = points @ pose[:3, :3].T + pose[:3, 3]
    z = local[:, 2]
    return local[:, :2] / np.where(np.abs(z) > 1e-6, z, 1e-6)[:, None] * np.diag(K)[:2] + K[:2, 2], z


def seen_from(views: Sequence[View], points: np.ndarray) -> np.ndarray:
    """[V, 3] unit directions from the middle of a thing, points [P, 3], to the cameras of the views that show it."""
    middle = np.median(points, axis=0)
    found = []
    for view in views:
        local = view.camera_from_world[:3, :3] @ middle + view.camera_from_world[:3, 3]
        pixel = (view.K @ (local / max(local[2], 1e-9)))[:2]
        if local[2] > 1e-3 and ((pixel >= 0) & (pixel < (view.width, view.height))).all():
            found.append(-view.camera_from_world[:3, :3].T @ (local / np.linalg.norm(local)))
    return np.array(found).reshape(-1, 3)
