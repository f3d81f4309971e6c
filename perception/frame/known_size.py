"""The unit of a scene from things of known size in its photos: tags, a calibration board, a length between two pixels.

The corners are triangulated from the posed views. The scale is that of the similarity which moves the thing's true
corners onto them: true corners are exact, so noise of the triangulated ones does not bias it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from perception.calibration.board import Board, refine
from perception.errors import InputError
from perception.frame.scale import LARGEST_ERROR, KnownLength, Measurement, jackknife_error
from perception.geometry import align_similarity
from perception.photos.decode import read_grey
from perception.photos.lens import camera_from_lens
from perception.photos.views import view_lens
from perception.types import View

TAG_FAMILIES = ("APRILTAG_36h11", "4X4_50", "5X5_100", "6X6_250")
"""OpenCV's names of the dictionaries that are tried in turn."""
SIDE, MARGIN, PATCH = 240, 40, 0.4
"""A tag as an image: its side and white margin in pixels; size in sides from which `refine` takes its patches."""
CORNER_ERROR, CLICK_ERROR = 0.15, 1.0
"""Least standard deviation in pixels of a detected corner, and of a pixel that a person chose."""
MISSHAPEN = 0.1
"""Largest deviation of triangulated corners from the true shape, in its size; and of the rays from the corners, in its
size in the pictures: the rays to a thing that was moved do not meet."""
DRAWS = 32  # of the noise of pixels


@dataclass(frozen=True)
class Sighting:
    """A thing of known size: corners [K, 3] in metres, rays [V, K, 2]: x/z and y/z in each view's camera, or NaN."""

    corners: np.ndarray
    rays: np.ndarray


def scale_of_tags(views: Sequence[View], size: float) -> Measurement:
    """Metres per unit from AprilTags or ArUco markers of one size; size: side of the black square in metres.
    InputError when no tag is seen in two photos, or when the tags seen are no squares."""
    square = size * np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    refused = None
    for family in TAG_FAMILIES:
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{family}"))
        detector = cv2.aruco.ArucoDetector(dictionary, parameters)
        seen: dict[int, Sighting] = {}
        for number, view in enumerate(views):
            picture = read_grey(view.photo, view.as_stored)
            corners, ids, _ = detector.detectMarkers(picture)
            for tag, pixels in zip(map(int, () if ids is None else np.ravel(ids)), corners, strict=True):
                sighting = seen.setdefault(tag, Sighting(square, np.full((len(views), 4, 2), np.nan)))
                # OpenCV's corners lie 0.2 to 0.6 pixels inside: they are aligned with the printed pattern.
                pattern = np.pad(cv2.aruco.generateImageMarker(dictionary, tag, SIDE), MARGIN, constant_values=255)
                pixels = refine(
                    picture, square, np.reshape(pixels, (-1, 2)), PATCH * size, pattern, PATCH * SIDE, MARGIN
                )
                sighting.rays[number] = rays_of_pixels(view, pixels + 0.5)
        shown = [s for s in seen.values() if np.isfinite(s.rays[:, 0, 0]).sum() >= 2]
        try:
            if shown:
                return scale_of_sightings(views, shown, CORNER_ERROR, f"{len(shown)} {family} tags of {size:g} m")
        except InputError as error:  # what looks like tags of this family are none, or moved
            refused = refused or error
    families = ", ".join(TAG_FAMILIES)
    none = f"tag size: no tag of {families} is seen in two of the {len(views)} photos; take photos with it"
    raise refused or InputError(none)


def scale_of_board(views: Sequence[View], board: Board) -> Measurement:
    """Metres per unit from a calibration board; InputError when it is not seen in two photos."""
    detected = (board.detect(view.name, read_grey(view.photo, view.as_stored)) for view in views)
    found = {number: detection for number, detection in enumerate(detected) if detection is not None}
    if len(found) < 2:
        raise InputError(f"board: the {board} is seen in {len(found)} of {len(views)} photos, at least 2 are needed")
    points = np.unique(np.concatenate([detection.board_points for detection in found.values()]), axis=0)
    rays = np.full((len(views), len(points), 2), np.nan)
    for number, detection in found.items():
        rows = [int(np.abs(points - corner).sum(axis=1).argmin()) for corner in detection.board_points]
        rays[number, rows] = rays_of_pixels(views[number], detection.pixels + 0.5)
    sighting = Sighting(points.astype(np.float64), rays)
    return scale_of_sightings(views, [sighting], CORNER_ERROR, f"board in {len(found)} photos")


def scale_of_pixels(views: Sequence[View], length: KnownLength) -> Measurement:
    """Metres per unit from a length between two pixels, which must be given in at least two photos."""
    number, rays = {view.name: n for n, view in enumerate(views)}, np.full((len(views), 2, 2), np.nan)
    pixels_of = length.pixels or {}
    for name, pixels in pixels_of.items():
        if name not in number:
            raise InputError(f"known length: '{name}' is none of the {len(views)} photos, such as {views[0].name}")
        size = views[number[name]].photo_size
        if (pixels < 0).any() or (pixels > size).any():
            found = " and ".join(f"{x:g},{y:g}" for x, y in pixels)
            raise InputError(f"known length: '{name}' has {size[0]}×{size[1]} pixels, found {found}; give pixels in it")
        rays[number[name]] = rays_of_pixels(views[number[name]], pixels)
    if len(pixels_of) < 2:
        raise InputError("known length: both ends are needed in two photos or more, found one; add '; PHOTO X,Y X,Y'")
    ends = np.array([[0.0, 0, 0], [length.metres, 0, 0]])
    text = f"known length {length.metres:g} m in {len(pixels_of)} photos"
    return scale_of_sightings(views, [Sighting(ends, rays)], CLICK_ERROR, text)


def scale_of_sightings(
    views: Sequence[View], sightings: Sequence[Sighting], pixel_error: float, source: str
) -> Measurement:
    """Metres per unit from things of known size; pixel_error: least standard deviation of their pixels.
    The standard error is the larger of two estimates: by random noise of the pixels, and by the jackknife over views,
    which covers wrong poses, as these move all corners of a view together. InputError for corners of another shape."""
    poses = np.stack([view.camera_from_world for view in views])
    focal = float(np.median([np.sqrt(view.K[0, 0] * view.K[1, 1]) for view in views]))
    rng, usable = np.random.default_rng(0), []
    for thing in sightings:
        rays, residuals = _without_outliers(poses, thing.rays, pixel_error / focal)
        seen = np.isfinite(residuals)
        freedom = max(int(seen.sum()) - 3 * len(thing.corners) - 2, 1)  # 2 less: few residuals underestimate the noise
        noise = max(pixel_error / focal, float(np.sqrt((residuals[seen] ** 2).sum() / freedom)))
        sizes = [np.linalg.norm(np.ptp(r[np.isfinite(r[:, 0])], axis=0)) for r in rays if np.isfinite(r).any()]
        meets = np.sqrt((residuals[seen] ** 2).mean()) < MISSHAPEN * np.median(sizes)
        drawn = [_fitted(poses, thing.corners, rays + noise * rng.standard_normal(rays.shape)) for _ in range(DRAWS)]
        metres, off = _fitted(poses, thing.corners, rays)
        error = float(np.std([unit for unit, _ in drawn]))
        if meets and error < LARGEST_ERROR * metres and off < MISSHAPEN:  # false for NaN
            usable.append((thing.corners, rays, error))
    if not usable:
        raise InputError(f"{source}: its corners cannot be triangulated to its shape; see it from farther apart")
    weights = np.array([error**-2 for _, _, error in usable])

    def mean(kept: np.ndarray) -> float:
        shown = np.where(kept, 1.0, np.nan)[:, None, None]
        values = np.array([_fitted(poses, corners, shown * rays)[0] for corners, rays, _ in usable])
        known = np.isfinite(values)
        return float(weights[known] @ values[known] / weights[known].sum()) if known.any() else np.nan

    number = np.arange(len(views))
    showing = np.flatnonzero(np.any([np.isfinite(r).any(axis=(1, 2)) for _, r, _ in usable], axis=0))
    error, each = float(weights.sum() ** -0.5), np.array([mean(number != left_out) for left_out in showing])
    each = each[np.isfinite(each)]
    if len(each) >= 3:
        error = max(error, jackknife_error(each))
    return Measurement(mean(number >= 0), error, source)


def rays_of_pixels(view: View, pixels: np.ndarray) -> np.ndarray:
    """x/z and y/z [N, 2] in the view's camera of pixels [N, 2] of its photo, whose pixel centres lie at +0.5."""
    camera = camera_from_lens(view_lens(view))
    return np.asarray(camera.cam_from_img(np.asarray(pixels, np.float64)), np.float64)[:, :2]


def triangulated(poses: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Points [K, 3] seen on rays [V, K, 2] (NaN: not seen) from poses [V, 4, 4]; NaN for less than two views.
    (x r₃ − r₁) · X = t₁ − x t₃, and for y likewise, with r, t the rows of [R | t]; weighted by 1 / depth, so that the
    residual is that of the image (Hartley and Zisserman, Multiple View Geometry, 12.2)."""
    seen = np.isfinite(rays).all(axis=2)
    used = seen.any(axis=1)
    poses, rays, seen = poses[used], np.where(seen[..., None], rays, 0.0)[used], seen[used]
    R, t = poses[:, None, :3, :3], poses[:, None, :3, 3]
    A = rays[..., None] * R[:, :, 2:] - R[:, :, :2]
    b = t[..., :2] - rays * t[..., 2:]
    weights = seen.astype(np.float64)
    points = np.full((rays.shape[1], 3), np.nan)
    for _ in range(3):
        rows = (A * weights[..., None, None]).transpose(1, 0, 2, 3).reshape(len(points), -1, 3)
        right = rows.transpose(0, 2, 1) @ (b * weights[..., None]).transpose(1, 0, 2).reshape(len(points), -1, 1)
        normal = rows.transpose(0, 2, 1) @ rows
        good = (seen.sum(axis=0) >= 2) & (np.linalg.det(normal) > 1e-12 * np.trace(normal, axis1=1, axis2=2) ** 3)
        points[good] = np.linalg.solve(normal[good], right[good])[..., 0]
        points[~good] = np.nan
        depth = np.einsum("vj,kj->vk", poses[:, 2, :3], np.nan_to_num(points)) + poses[:, 2, 3:]
        weights = seen / np.maximum(np.abs(depth), 1e-12)
    return points


def _without_outliers(poses: np.ndarray, rays: np.ndarray, noise: float) -> tuple[np.ndarray, np.ndarray]:
    """The rays without views whose residual exceeds five times the median, worst first; and their residuals."""
    rays = rays.copy()
    while True:
        local = np.einsum("vij,kj->vki", poses[:, :3, :3], triangulated(poses, rays)) + poses[:, None, :3, 3]
        with np.errstate(divide="ignore", invalid="ignore"):
            residuals = local[..., :2] / local[..., 2:] - rays
        squares = np.nan_to_num(residuals**2).sum(axis=(1, 2))
        each = np.sqrt(squares / np.maximum(np.isfinite(residuals).sum(axis=(1, 2)), 1))
        shown = np.isfinite(residuals).any(axis=(1, 2))
        if shown.sum() <= 3 or each.max() <= 5 * max(float(np.median(each[shown])), 2 * noise):
            return rays, residuals
        rays[each.argmax()] = np.nan


def _fitted(poses: np.ndarray, corners: np.ndarray, rays: np.ndarray) -> tuple[float, float]:
    """Metres per unit, and the root mean square deviation of the triangulated corners from the true shape, in its size;
    NaN where less than two corners are seen, or mirrored."""
    points = triangulated(poses, rays)
    known = np.isfinite(points).all(axis=1)
    if known.sum() < 2:
        return np.nan, np.nan
    scale, rotation, shift = align_similarity(points[known], corners[known])
    if scale <= 0:
        return np.nan, np.nan
    off = points[known] - (scale * corners[known] @ rotation.T + shift)
    size = scale * np.linalg.norm(np.ptp(corners[known], axis=0))
    return 1 / scale, float(np.sqrt((off**2).sum(axis=1).mean()) / size)
