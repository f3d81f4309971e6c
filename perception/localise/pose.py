"""The pose of one photo from features that match points of a map: RANSAC, verified, and not one of two equals."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

from perception.localise.keypoints import tolerance
from perception.photos.lens import camera_from_lens, lens_from_camera, load_pycolmap
from perception.types import Lens

MIN_INLIERS = 20
"""Least features of a photo that agree with its pose."""
MIN_SPREAD = 0.02
"""Least share of the picture that the agreeing features cover: the ellipse of two standard deviations. Fewer leave the
pose loose, and are as likely a picture within the picture."""
SEARCHES = 3
EQUAL = 0.7
"""Most searches for poses of one photo. A second pose makes the first doubtful if it explains this share as many
features that the first does not, as the other way round: equal textures in two spots, or a thing that was moved."""
SAME_ANGLE, SAME_SHARE = 3.0, 0.05
"""Poses are the same if they differ by less than this angle in degrees and this share of the distance to the points."""
REFINED, FOUND = 1, 2
KNOWN, LIKELY, GUESSED = np.inf, 1.15, 1.0
CLOSELY = 0.25
"""How far a lens is trusted: an estimated one replaces it if that makes this many times as many features agree closely,
within this share of the tolerance: a distortion that is left out moves most features by less than the tolerance."""

CROPPED = 1.5
"""A photo is taken as cropped if with another principal point no fewer features agree, and more of them closely, by
this many roots of their number: of crops by 15 % of a side or more 1.9 to 28, of whole photos and flat things up to
1.3."""
STEPS = 8
"""Most steps towards it: each lets further features agree, which the next one is estimated from."""
_PINHOLE = (
    cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_FIX_ASPECT_RATIO | cv2.CALIB_ZERO_TANGENT_DIST
    | cv2.CALIB_FIX_K1 | cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3
)  # fmt: skip
SQUARE = 0.01
"""Largest relative difference of the focal lengths of square pixels, as photos are resized to whole pixels."""
USUAL = 0.1, 10.0, 1.0
"""Least and largest focal length of an estimated lens in long sides of the picture, and largest coefficient of
distortion, as in COLMAP's mapper: flat things leave all of these open."""


@dataclass(frozen=True)
class Pose:
    """camera_from_map [4, 4]; inliers [M]: mask of the matches that agree; count: features among them; close: those
    that agree closely; lens."""

    camera_from_map: np.ndarray
    inliers: np.ndarray
    count: int
    close: int
    lens: Lens


@dataclass(frozen=True)
class Matched:
    """Matches [M] of a photo with points of the map: feature [M], its pixel [M, 2], point [M, 3] in the map's frame."""

    feature: np.ndarray
    pixel: np.ndarray
    point: np.ndarray


def find_pose(matched: Matched, lens: Lens, trust: float, doubt: Callable[[Pose], str | None]) -> Pose | str:
    """The verified pose of a photo, else why there is none, one line. trust: in the lens (KNOWN, LIKELY, GUESSED).
    doubt: further checks of a pose. The search is repeated without the matches of the poses before: the thing or
    texture that a pose rests on may be elsewhere now, or in two spots; then no pose is right for sure."""
    found, whys, rest = list[Pose](), list[str](), np.ones(len(matched.feature), bool)
    for _ in range(SEARCHES):
        pose = _ransac(matched, rest, lens, trust)
        count = 0 if pose is None else pose.count
        if pose is None or count < MIN_INLIERS:
            whys.append(f"{count} features agree with one pose, {MIN_INLIERS} are needed")
            break
        rest &= ~pose.inliers
        if (covered := _spread(matched.pixel[pose.inliers], lens)) < MIN_SPREAD:
            whys.append(f"the {count} features that agree with one pose cover {covered:.1%} of the picture")
        elif (why := doubt(pose)) is not None:
            whys.append(why)
        elif not any(_same(pose, other, matched.point[pose.inliers]) for other in found):
            found.append(pose)
    if not found:
        return whys[0]
    best, *others = sorted(found, key=lambda pose: -pose.count)
    for other in others:
        own, its = (set(matched.feature[pose.inliers].tolist()) for pose in (best, other))
        if len(own - its) < MIN_INLIERS or len(its - own) >= EQUAL * len(own - its):
            return f"two poses fit ({best.count} and {other.count} features): equal textures in two spots"
    return best


def _ransac(matched: Matched, used: np.ndarray, lens: Lens, trust: float) -> Pose | None:
    """The pose that most of the `used` matches agree with, refined by them; None if none is found."""
    best = _estimated(matched, used, lens)
    for model in [] if trust == KNOWN else dict.fromkeys((_with_square_pixels(lens), _with_distortion(lens))):
        for free in (_estimated(matched, used, model, FOUND), _refined(matched, used, model)):
            if free is not None and (
                best is None or (free.close >= trust * best.close and free.count >= best.count / trust)
            ):
                best = free
    return best if best is None or trust == KNOWN else _recentred(matched, used, best)


def _refined(matched: Matched, used: np.ndarray, lens: Lens) -> Pose | None:
    """The pose with a lens that is refined from `lens`, step by step: on a plane no focal length is found otherwise."""
    pose: Pose | None = None
    for _ in range(STEPS):
        further = _estimated(matched, used, lens, REFINED)
        if further is None or (pose is not None and (further.count, further.close) <= (pose.count, pose.close)):
            break
        pose, lens = further, further.lens
    return pose


def _recentred(matched: Matched, used: np.ndarray, pose: Pose) -> Pose:
    """The pose with the principal point as matches tell it, if they clearly do: that of a cropped photo is not in its
    middle, and a wrong focal length, a wrong place and a wrong direction together explain most of such a photo."""
    moved = pose
    for _ in range(STEPS):
        lens = _with_centre(matched, used & moved.inliers, moved.lens)
        further = None if lens is None else _estimated(matched, used, lens)
        if further is None or (further.count, further.close) <= (moved.count, moved.close):
            break
        moved = further
    return moved if moved.close >= pose.close + CROPPED * np.sqrt(pose.close) else pose


def _with_centre(matched: Matched, used: np.ndarray, lens: Lens) -> Lens | None:
    """The pinhole whose focal length, principal point and pose fit the `used` matches best, starting from `lens`; None
    where there is none."""
    if used.sum() < MIN_INLIERS:
        return None
    K, size = np.array(camera_from_lens(lens).calibration_matrix(), order="C"), (lens.width, lens.height)
    K[0, 0] = K[1, 1] = (K[0, 0] + K[1, 1]) / 2
    K[:2, 2] = np.clip(K[:2, 2], 1, np.subtract(size, 2))  # OpenCV starts within the picture only
    points, pixels = matched.point[used] - matched.point[used].mean(axis=0), matched.pixel[used]
    seen = [points.astype(np.float32)], [pixels.astype(np.float32)]
    try:
        K = cv2.calibrateCamera(*seen, size, K, np.zeros(5), flags=_PINHOLE)[1]
    except cv2.error:  # points on a plane, for one
        return None
    found = Lens("PINHOLE", tuple(float(K[at]) for at in ((0, 0), (1, 1), (0, 2), (1, 2))), *size)
    return found if USUAL[0] <= found.params[0] / max(size) <= USUAL[1] else None


def cropped(lens: Lens, estimated: Lens) -> bool:
    """Whether the estimate of `lens` has another principal point, as `find_pose` gives to a cropped photo alone."""
    middle, other = (camera_from_lens(each).calibration_matrix()[:2, 2] for each in (lens, estimated))
    return bool(np.linalg.norm(other - middle) > 1)


def _with_square_pixels(lens: Lens) -> Lens:
    """A pinhole with nearly one focal length as one with one: flat things leave the ratio of two open."""
    if lens.model != "PINHOLE" or abs(lens.params[0] / lens.params[1] - 1) > SQUARE:
        return lens
    return Lens("SIMPLE_PINHOLE", (float(np.mean(lens.params[:2])), *lens.params[2:]), lens.width, lens.height)


def _with_distortion(lens: Lens) -> Lens:
    """A pinhole as a lens with radial distortion, which is 0."""
    if lens.model not in ("PINHOLE", "SIMPLE_PINHOLE"):
        return lens
    focal, centre = float(np.mean(lens.params[:-2])), lens.params[-2:]
    return Lens("SIMPLE_RADIAL", (focal, *centre, 0.0), lens.width, lens.height)


def _estimated(matched: Matched, used: np.ndarray, lens: Lens, free: int = 0) -> Pose | None:
    """The pose by `lens`, whose focal length and distortion are kept (0), refined (REFINED), or found by RANSAC and
    refined (FOUND)."""
    if used.sum() < MIN_INLIERS:
        return None
    pycolmap, camera = load_pycolmap(), camera_from_lens(lens)
    estimation, refinement = pycolmap.AbsolutePoseEstimationOptions(), pycolmap.AbsolutePoseRefinementOptions()
    estimation.ransac.max_error = most = tolerance(max(lens.width, lens.height))
    estimation.ransac.random_seed = 0
    estimation.estimate_focal_length = free == FOUND
    refinement.refine_focal_length = refinement.refine_extra_params = free > 0
    pixel, point = matched.pixel[used], matched.point[used]
    found = pycolmap.estimate_and_refine_absolute_pose(pixel, point, camera, estimation, refinement)
    if found is None or not np.isfinite(camera.params).all() or (free and camera.has_bogus_params(*USUAL)):
        return None
    pose = np.vstack([found["cam_from_world"].matrix(), [0, 0, 0, 1]])
    x = matched.point @ pose[:3, :3].T + pose[:3, 3]
    projected = np.asarray(camera.img_from_cam(x), np.float64).reshape(-1, 2)
    errors = np.where(x[:, 2] > 0, np.linalg.norm(projected - matched.pixel, axis=1), np.inf)
    good = errors <= most
    count, close = (len(np.unique(matched.feature[errors <= limit])) for limit in (most, CLOSELY * most))
    return Pose(pose, good, count, close, lens_from_camera(camera))


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
