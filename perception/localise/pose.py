"""The pose of one photo from features that match points of a map: RANSAC, verified, and not one of two equals."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from perception.localise.keypoints import tolerance
from perception.photos.lens import camera_from_lens, lens_from_camera, load_pycolmap
from perception.types import Lens

MIN_INLIERS = 20
"""Least features of a photo that agree with its pose."""
MIN_SPREAD = 0.02
"""Least share of the picture that the agreeing features cover: the ellipse of two standard deviations. Fewer leave the
pose loose, and are as likely a picture within the picture."""
EQUAL = 0.7
"""A second pose with this share of the features of the first makes both doubtful: equal textures in two spots."""
SAME_ANGLE, SAME_SHARE = 3.0, 0.05
"""Poses are the same if they differ by less than this angle in degrees and this share of the distance to the points."""
GROWN = 1.15
"""An assumed lens is replaced by an estimated one if that makes this many times as many features agree."""


@dataclass(frozen=True)
class Pose:
    """camera_from_map [4, 4]; inliers [M]: mask of the matches that agree; count: features among them; lens."""

    camera_from_map: np.ndarray
    inliers: np.ndarray
    count: int
    lens: Lens


@dataclass(frozen=True)
class Matched:
    """Matches [M] of a photo with points of the map: feature [M], its pixel [M, 2], point [M, 3] in the map's frame."""

    feature: np.ndarray
    pixel: np.ndarray
    point: np.ndarray

    def part(self, mask: np.ndarray) -> Matched:
        return Matched(self.feature[mask], self.pixel[mask], self.point[mask])


def find_pose(matched: Matched, lens: Lens, known: bool) -> Pose | str:
    """The verified pose of a photo, else why there is none, one line. known: the lens is not to be estimated.
    Ambiguity: the search is repeated without the matches of the first pose; an equal texture elsewhere then wins."""
    best = _ransac(matched, lens, known)
    if best is None or best.count < MIN_INLIERS:
        found = 0 if best is None else best.count
        return f"{found} features agree with one pose, {MIN_INLIERS} are needed"
    covered = _spread(matched.pixel[best.inliers], lens)
    if covered < MIN_SPREAD:
        return f"the {best.count} features that agree with one pose cover {covered:.1%} of the picture"
    rest = matched.part(~best.inliers)
    other = _ransac(rest, best.lens, known=True)
    if other is not None and other.count >= EQUAL * best.count and not _same(best, other, matched.point[best.inliers]):
        return f"two poses fit equally well ({best.count} and {other.count} features): equal textures in two spots"
    return best


def _ransac(matched: Matched, lens: Lens, known: bool) -> Pose | None:
    """The pose that most matches agree with, refined by them; None if none is found."""
    fixed = _estimated(matched, lens, free=False)
    if known:
        return fixed
    free = _estimated(matched, lens, free=True)
    if fixed is None or (free is not None and free.count > GROWN * fixed.count):
        return free
    return fixed


def _estimated(matched: Matched, lens: Lens, free: bool) -> Pose | None:
    if len(matched.feature) < 4:
        return None
    pycolmap, camera = load_pycolmap(), camera_from_lens(lens)
    estimation, refinement = pycolmap.AbsolutePoseEstimationOptions(), pycolmap.AbsolutePoseRefinementOptions()
    estimation.ransac.max_error = most = tolerance(max(lens.width, lens.height))
    estimation.ransac.random_seed = 0
    estimation.estimate_focal_length = refinement.refine_focal_length = free
    found = pycolmap.estimate_and_refine_absolute_pose(matched.pixel, matched.point, camera, estimation, refinement)
    if found is None:
        return None
    pose = np.vstack([found["cam_from_world"].matrix(), [0, 0, 0, 1]])
    x = matched.point @ pose[:3, :3].T + pose[:3, 3]
    pixel = np.asarray(camera.img_from_cam(x), np.float64).reshape(-1, 2)
    good = (x[:, 2] > 0) & (np.linalg.norm(pixel - matched.pixel, axis=1) <= most)
    return Pose(pose, good, len(np.unique(matched.feature[good])), lens_from_camera(camera))


def _spread(pixel: np.ndarray, lens: Lens) -> float:
    """Share of the picture within the ellipse of two standard deviations of pixels [M, 2]."""
    variance = np.linalg.eigvalsh(np.cov(pixel.T))
    return float(4 * np.pi * np.sqrt(np.maximum(variance, 0).prod()) / (lens.width * lens.height))


def _same(a: Pose, b: Pose, points: np.ndarray) -> bool:
    """Whether two poses are one: points seen twice have two positions, and moved things poses of their own."""
    turn = a.camera_from_map[:3, :3] @ b.camera_from_map[:3, :3].T
    angle = np.degrees(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1)))
    centers = [-pose.camera_from_map[:3, :3].T @ pose.camera_from_map[:3, 3] for pose in (a, b)]
    distance = np.median(np.linalg.norm(points - centers[0], axis=1))
    return bool(angle < SAME_ANGLE and np.linalg.norm(centers[0] - centers[1]) < SAME_SHARE * distance)
