"""Transfers the user's labels from an old map to the instances of a new map that occupy the same place."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from perception.geometry import align_similarity, camera_centres
from perception.io.store import Map

SHARE = 0.5  # of either's points must have their nearest point in the other; > ½, so partners are unique
REACH = 0.1  # relative to the instance's size: more distant nearest neighbours are not counted
ALIGNED = 0.02  # relative to the spread of the cameras: larger residuals mean different camera paths
SAMPLES = 2000  # points used per instance


@dataclass
class LabelTransfer:
    """labels: new id -> name. dropped: (old id, name) of instances without a partner. aligned: whether the frames were
    aligned by common cameras. Otherwise they are assumed equal."""

    labels: dict[int, str] = field(default_factory=dict)
    dropped: list[tuple[int, str]] = field(default_factory=list)
    aligned: bool = False


def transfer_labels(old: Map, new: Map) -> LabelTransfer:
    """Names of `old`'s instances for the instances of `new` at the same place (more than half of both overlap)."""
    named = {entry["id"]: str(entry["label"]) for entry in old.instances if entry.get("label")}
    moved, aligned = _in_frame_of(new, old)
    partners = match_instances(moved, old.instance_ids, new.means, new.instance_ids, list(named))
    transfer = LabelTransfer(aligned=aligned)
    for i, name in named.items():
        if i in partners:
            transfer.labels[partners[i]] = name
        else:
            transfer.dropped.append((i, name))
    return transfer


def match_instances(
    old_points: np.ndarray, old_ids: np.ndarray, new_points: np.ndarray, new_ids: np.ndarray, wanted: list[int]
) -> dict[int, int]:
    """Old id -> new id, for those of `wanted` that have a partner. Points [N, 3] in one frame, ids [N], −1 = none.

    j is the partner of i if more than SHARE of the points of i have their nearest new point in j, and more than SHARE
    of the points of j have their nearest old point in i. Neighbours farther than REACH of the size of i do not count.
    """
    from scipy.spatial import cKDTree

    partners: dict[int, int] = {}
    if not wanted or not len(new_points):
        return partners
    old_tree, new_tree = cKDTree(old_points), cKDTree(new_points)
    for i in wanted:
        points = _sample(old_points[old_ids == i])
        if not len(points):
            continue
        reach = REACH * float(np.linalg.norm(np.ptp(points, axis=0))) + 1e-9
        nearest = _neighbour_ids(new_tree, new_ids, points, reach)
        found = nearest[nearest >= 0]
        if not len(found):
            continue
        j = int(np.bincount(found).argmax())
        back = _neighbour_ids(old_tree, old_ids, _sample(new_points[new_ids == j]), reach)
        if (nearest == j).mean() > SHARE and (back == i).mean() > SHARE:
            partners[i] = j
    return partners


def _neighbour_ids(tree: object, ids: np.ndarray, points: np.ndarray, reach: float) -> np.ndarray:
    distances, rows = tree.query(points, distance_upper_bound=reach)  # type: ignore[attr-defined]
    return np.where(np.isfinite(distances), ids[np.minimum(rows, len(ids) - 1)], -1)


def _sample(points: np.ndarray) -> np.ndarray:
    """At most SAMPLES of the points, evenly spaced by index."""
    step = max(1, len(points) // SAMPLES)
    return points[::step].astype(np.float64)


def _in_frame_of(new: Map, old: Map) -> tuple[np.ndarray, bool]:
    """`old`'s means [N, 3] in `new`'s frame, by a similarity transform (Umeyama 1991) that aligns the common cameras.

    With fewer than three common photos, or with different camera paths, the frames are assumed equal.
    """
    place = {view.name: k for k, view in enumerate(old.views)}
    common = [(k, place[view.name]) for k, view in enumerate(new.views) if view.name in place]
    if len(common) < 3:
        return old.means, False
    rows = np.array(common)
    there, here = (camera_centres(m.poses)[c] for m, c in ((new, rows[:, 0]), (old, rows[:, 1])))
    if np.linalg.matrix_rank(here - here.mean(axis=0), tol=1e-3 * max(float(np.ptp(here)), 1e-12)) < 2:
        return old.means, False  # collinear cameras do not determine the rotation about their line
    scale, rotation, shift = align_similarity(there, here)
    residual = np.linalg.norm(scale * here @ rotation.T + shift - there, axis=1)
    if np.median(residual) > ALIGNED * float(np.linalg.norm(np.ptp(there, axis=0))):
        return old.means, False
    return (scale * old.means.astype(np.float64) @ rotation.T + shift).astype(np.float32), True


def transfer_text(transfer: LabelTransfer) -> str:
    """One line of text per old label: transferred or dropped."""
    lines = [f"instance {i} is called “{name}”" for i, name in transfer.labels.items()]
    lines += [f"warning: “{name}” (old instance {i}) has no partner; dropped" for i, name in transfer.dropped]
    return "\n".join(lines) or "the old map has no names"
