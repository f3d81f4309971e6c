"""Checks given poses against matched features and depth, and refines them where they are worse than features."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from perception.errors import InputError
from perception.geometry import camera_centres, nearest_rotation
from perception.photos.views import view_lens
from perception.posed.bundle_adjustment import Poses, adjust, residuals, starting_points
from perception.sfm.tracks import Features, tracks_of
from perception.types import View

TOLERANCE, TOLERANCE_SIDE = 1.0, 800
"""Poses are refined when matched features lie more than TOLERANCE pixels off their epipolar lines in the median; pixels
of photos with a long side of TOLERANCE_SIDE, if they are larger. Exact poses read 0.3, those of a drifting robot 2."""
GATE, ROUNDS = 8.0, 2
"""Matches with more than GATE times the median error of all are wrong. This is judged again with the refined poses."""
LEAST_MATCHES = 100
IMPROVED, HOPELESS = 0.8, 3.0
"""Refined poses are used only if their error is at most this share of that of the given poses, and at most this many
times the tolerance."""
PARTS, LEAST_OF_PART, AGREED = 4, 20, 0.75
"""Refined poses are used only if the error falls to IMPROVED in the share AGREED of the PARTS × PARTS parts of the
picture that have LEAST_OF_PART features. A thing that moves with the camera drags the poses, but fits only its part."""
UNIT = 1.5
"""Depth is left out if the median ratio of triangulated to measured depth is farther from 1 than this factor."""
AS_DISTANCE = 0.5
"""Depth is left out if taking it for distances along the rays lowers its median relative error to this share."""
LIKELY = 0.5
"""Given poses that do not fit are refused if another reading of them lowers their error to this share."""
_BACK, _BODY = np.diag([1.0, -1, -1]), np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
"""Axes of a camera (right, down, forward) from those of OpenGL (right, up, back); those of a ROS body from them."""
_READINGS = (  # (what the poses may be, whether they are inverted, axes that they have from those of a camera)
    ("of cameras whose y and z axes point the other way, as those of OpenGL and of OpenCV do", False, _BACK),
    ("of bodies with x forward and z up, as ROS has them, not of cameras with z forward", False, _BODY),
    ("of bodies with x forward and z up, as ROS has them, not of cameras with z forward", False, _BACK @ _BODY),
    ("camera_from_world in place of world_from_camera", True, np.eye(3)),
    ("camera_from_world in place of world_from_camera", True, _BACK),
)


def poses_of(views: list[View]) -> Poses:
    """The poses of `views`."""
    matrices = np.stack([view.camera_from_world for view in views])
    return Poses(matrices[:, :3, :3], camera_centres(matrices))


def match_errors(features: Features, poses: Poses) -> tuple[np.ndarray, np.ndarray]:
    """Pixel errors of the matches in both directions, [2M] each: distance from the epipolar line; and from the feature
    that is carried over by its measured depth, NaN without depth."""
    lines, carried = [], []
    rays = np.c_[features.rays, np.ones(len(features.rays))]
    for a, b in (features.pairs.T, features.pairs.T[::-1]):
        first, second = features.view[a], features.view[b]
        b_from_world = poses.rotation[second]
        ray = np.einsum("mij,mkj,mk->mi", b_from_world, poses.rotation[first], rays[a])
        origin = np.einsum("mij,mj->mi", b_from_world, poses.center[first] - poses.center[second])
        line = np.cross(origin, ray)
        norm = np.maximum(np.linalg.norm(line[:, :2], axis=1), 1e-300)
        lines.append(features.focal[b] * np.abs((line * rays[b]).sum(1)) / norm)
        x = origin + ray * features.depth[a][:, None]
        z = np.where((features.depth[a] > 0) & (x[:, 2] > 0), x[:, 2], np.nan)
        carried.append(features.focal[b] * np.linalg.norm(x[:, :2] / z[:, None] - features.rays[b], axis=1))
    return np.concatenate(lines), np.concatenate(carried)


def checked_poses(views: list[View], features: Features, mode: str) -> tuple[list[View], dict[str, Any]]:
    """`views` as given or with refined poses, and the report's entries: "poses", "notes", "warnings".
    mode: "auto" refines poses that are worse than TOLERANCE, "refine" any that gain by it. Views that are held out for
    scoring are refined as well, by features and depth alone. InputError for poses that fit in another convention."""
    given = poses_of(views)
    if len(features.pairs) < LEAST_MATCHES:
        note = f"given poses not checked: {len(features.pairs)} matched features, {LEAST_MATCHES} are needed"
        return views, {"poses": {}, "notes": [note], "warnings": []}
    side = max(max(lens.width, lens.height) for lens in map(view_lens, views))
    before, good = _medians(features, given), TOLERANCE * max(1.0, side / TOLERANCE_SIDE)
    facts: dict[str, Any] = {"refined": False, "given_error_px": before}
    notes, warnings = [f"given poses: matched features {_text(before)}"], list[str]()
    report = {"poses": facts, "notes": notes, "warnings": warnings}
    usable, fault = views, _depth_fault(features, given)
    if fault is not None:
        warnings.append(f"{fault}; depth is not used")
        usable, features = [replace(v, depth=None) for v in views], replace(features, depth=0 * features.depth)
    if mode == "auto" and before["epipolar"] <= good:
        return usable, report
    if before["epipolar"] > HOPELESS * good:
        error, meant = min((_medians(features, read)["epipolar"], text) for text, read in _readings(given))
        if error <= min(LIKELY * before["epipolar"], HOPELESS * good):
            found = f"the given poses do not fit the photos: {_text(before)}; {error:.2f} px if they are {meant}"
            raise InputError(f"{found}; correct them, or take them as they are with --set photos.poses=keep")
    refined = refine(features, given)
    after, (changes, text) = _medians(features, refined), _changes(refined.since(given))
    better = after["epipolar"] <= min(IMPROVED * before["epipolar"], HOPELESS * good)
    agreed, parts = _parts_improved(features, given, refined)
    if better and agreed < AGREED * parts:
        where = f"lowers their error only in {agreed} of {parts} parts of the picture"
        warnings.append(f"refining the given poses {where}, and {text}; they are used as they are")
        return usable, report
    if better:
        facts |= {"refined": True, "error_px": after, **changes}
        notes.append(f"refined poses: {_text(after)}; {text}")
        return [replace(v, camera_from_world=m) for v, m in zip(usable, refined.matrices(), strict=True)], report
    if before["epipolar"] <= HOPELESS * good:
        notes.append(f"refining them gains little ({_text(after)}); they are used as they are")
        return usable, report
    warning = "the given poses do not fit the photos, and refining them did not help; they are used as they are"
    return views, {**report, "warnings": [warning]}


def _readings(given: Poses) -> Iterator[tuple[str, Poses]]:
    """What the given poses may be, and the cameras' poses if they are that, up to a rotation of the world."""
    for text, inverted, axes in _READINGS:
        rotation, center = given.rotation, given.center
        if inverted:
            center = -np.einsum("nij,nj->ni", rotation, center)
            rotation = rotation.transpose(0, 2, 1)
        yield text, Poses(axes.T @ rotation, center)


def refine(features: Features, given: Poses) -> Poses:
    """Poses that agree with the matches and the measured depth, in the world frame of the given ones."""
    poses = given
    for _ in range(ROUNDS):
        tracks = tracks_of(features, features.pairs[agreeing(features, poses)])
        if poses is given:
            angle = max(_medians(features, given).values()) / float(np.median(features.focal))
            depth = residuals(tracks, poses, starting_points(tracks, poses))[2][:, 2]
            if not (depth > 0).any():
                return given
            prior = angle, angle * float(np.median(depth[depth > 0]))
        poses = adjust(tracks, given, poses, prior).poses
    return moved_back(poses, given, prior[1] / prior[0])


def moved_back(poses: Poses, given: Poses, distance: float) -> Poses:
    """`poses` moved together to where what the cameras see, at `distance`, lies as by the given ones.
    Least sum of the displacements of five points ahead of each camera, by reweighting: the priors hold them loosely."""
    ahead = distance * np.array([[0, 0, 1], [0.4, 0, 1], [-0.4, 0, 1], [0, 0.4, 1], [0, -0.4, 1]])
    a, b = ((np.einsum("nji,kj->nki", p.rotation, ahead) + p.center[:, None]).reshape(-1, 3) for p in (poses, given))
    weights = np.ones((len(a), 1))
    for _ in range(20):
        mean_a, mean_b = ((weights * points).sum(axis=0) / weights.sum() for points in (a, b))
        turn = nearest_rotation(np.einsum("ni,nj->ij", weights * (b - mean_b), a - mean_a))
        off = np.einsum("nj,ij->ni", a - mean_a, turn) - (b - mean_b)
        weights = 1 / np.maximum(np.linalg.norm(off, axis=1, keepdims=True), 1e-3 * distance)
    center = np.einsum("nj,ij->ni", poses.center - mean_a, turn) + mean_b
    return Poses(np.einsum("nij,kj->nik", poses.rotation, turn), center)


def agreeing(features: Features, poses: Poses) -> np.ndarray:
    """Mask [M] of the matches whose errors are at most GATE times the median."""
    good = np.ones(2 * len(features.pairs), bool)
    for errors in match_errors(features, poses):
        if np.isfinite(errors).any():
            good &= np.isnan(errors) | (errors <= GATE * np.nanmedian(errors))
    return np.asarray(good.reshape(2, -1).all(0))


def _depth_fault(features: Features, poses: Poses) -> str | None:
    """What tells, by triangulated features, that measured depth has another unit or is no depth; None without fault."""
    tracks = tracks_of(features, features.pairs[agreeing(replace(features, depth=0 * features.depth), poses)])
    blind = replace(tracks, depth=0 * tracks.depth)
    along = residuals(blind, poses, starting_points(blind, poses))[2][:, 2]
    known = (tracks.depth > 0) & (along > 0)
    if not known.any():
        return None
    ratio = along[known] / tracks.depth[known]
    unit = float(np.median(ratio))
    if not 1 / UNIT < unit < UNIT:
        return f"features triangulate at {unit:.3g} times their measured depth, as if in another unit than the poses"
    lengths = np.sqrt(1 + (tracks.rays[known] ** 2).sum(axis=1))  # of the rays to depth 1
    wrong, right = (float(np.median(np.abs(each / np.median(each) - 1))) for each in (ratio, ratio * lengths))
    if right < AS_DISTANCE * wrong:
        found = (
            f"depth is off by {wrong:.1%}, and by {right:.1%} if it is taken for the distance along each pixel's ray"
        )
        return f"{found}; convert it to depth along the optical axis"
    return None


def _medians(features: Features, poses: Poses) -> dict[str, float]:
    lines, carried = match_errors(features, poses)
    known = carried[np.isfinite(carried)]
    return {"epipolar": float(np.median(lines)), **({"by_depth": float(np.median(known))} if len(known) else {})}


def _parts_improved(features: Features, given: Poses, refined: Poses) -> tuple[int, int]:
    """Number of the parts of the picture in which the median error falls to IMPROVED, and of all that have features."""
    before, after = (match_errors(features, poses)[0] for poses in (given, refined))
    rays = features.rays[features.pairs.T.ravel()]
    low, high = np.quantile(rays, (0.01, 0.99), axis=0)
    column, row = np.clip((rays - low) / np.maximum(high - low, 1e-9) * PARTS, 0, PARTS - 1).astype(int).T
    in_parts = [np.flatnonzero(row * PARTS + column == part) for part in range(PARTS**2)]
    ratios = [np.median(after[i]) / max(np.median(before[i]), 1e-9) for i in in_parts if len(i) >= LEAST_OF_PART]
    return sum(ratio <= IMPROVED for ratio in ratios), len(ratios)


def _text(errors: dict[str, float]) -> str:
    by_depth = f", {errors['by_depth']:.2f} px from each other by depth" if "by_depth" in errors else ""
    return f"{errors['epipolar']:.2f} px off their epipolar lines{by_depth} (medians)"


def _changes(delta: np.ndarray) -> tuple[dict[str, Any], str]:
    """How far the cameras moved, in scene units, and turned, for changes [N, 6] of the poses; the same as text."""
    lengths = (np.linalg.norm(vectors, axis=1) for vectors in (delta[:, 3:], np.degrees(delta[:, :3])))
    moved, turned = ({"median": float(np.median(each)), "max": float(each.max())} for each in lengths)
    text = f"cameras moved {moved['median']:.3g} units in the median, at most {moved['max']:.3g}, "
    text += f"and turned {turned['median']:.2g}°, at most {turned['max']:.2g}°"
    return {"moved": moved, "turned_deg": turned}, text
