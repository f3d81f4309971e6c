"""Virtual cameras for a finished Gaussian scene, from its own free space and surfaces.

Places     where cameras may stand, and what can be seen from there, see `panoramas`
Views      chosen greedily, of all places and directions, until every voxel that can be seen is seen by FIVE with as
           many pixels as its Gaussians need. Nothing is random.
"""

from __future__ import annotations

import heapq
from dataclasses import dataclass

import numpy as np
import torch

from perception.errors import InputError
from perception.gaussians.model import Gaussians
from perception.gaussians.views import expected_depth, render, unprojected
from perception.geometry import sums_by
from perception.masks.surface import position_in, voxel_keys
from perception.splats.panoramas import EPS, NEAREST, SIDE, Survey, pose_at, upright_axes

FIVE = 5.0
"""Views that each voxel is to be seen by."""
MOST_VIEWS = 160
"""Of 640 views of a million Gaussians, grouping holds more than 11 GiB."""
ENOUGH = 2e-4
"""Gain of the next view, as share of all there is to gain, at which no more are chosen."""
ASPECT, FOCAL = 0.75, 0.8
"""Of the views: height and focal length, relative to the width."""
PIXELS, DENSE = 3.0, 4.0
"""Pixels between neighbouring Gaussians in a view that shows their detail; multiple of the median number of Gaussians
in a voxel beyond which more of them ask for no more pixels."""
SEEN = 0.25
"""Credit of a view for a voxel, 1 with all the pixels wanted, from which the voxel counts as seen by it."""
FILLED = 0.5
"""Least share of a view that shows surface."""
PITCHES, YAWS = (-75, -50, -28, -8, 15), 12


@dataclass(frozen=True)
class Chosen:
    """poses [C, 4, 4] camera_from_world, in the order of choice; facts: JSON-able, for map.json."""

    poses: np.ndarray
    facts: dict[str, float | int | str]


def intrinsics(width: int) -> tuple[np.ndarray, int]:
    """K [3, 3] of a virtual camera and its height in pixels."""
    height = round(ASPECT * width)
    return np.array([[FOCAL * width, 0, width / 2], [0, FOCAL * width, height / 2], [0, 0, 1.0]]), height


def choose_views(found: Survey, proxy: Gaussians, width: int, given: np.ndarray, focal: float) -> Chosen:
    """Virtual views, `width` pixels wide, of the places in `found`. given [G, 4, 4]: poses that are used anyway, of
    cameras of a focal length of `focal` widths. InputError where no view shows enough."""
    axes, counts = upright_axes(-found.gravity.direction), found.counts
    per_ray = (FOCAL * width * 2 / SIDE) ** 2  # pixels of a view that a ray of a panorama covers, at its axis
    wanted = np.maximum(PIXELS**2 * np.minimum(counts, DENSE * np.median(counts)) / per_ray, 1.0)  # rays
    credits = []
    for pose in given:
        voxel = position_in(found.keys, voxel_keys(_seen_from(proxy, pose, focal), found.size))
        seen, rays = np.unique(voxel[voxel >= 0], return_counts=True)
        credits.append((seen, np.minimum(1, rays / wanted[seen])))
    poses, more = _candidates(found, axes, wanted, NEAREST * found.typical)
    if not poses and not len(given):
        raise InputError("no view was found that shows enough of the scene; give --cameras")
    order = _greedy(more, counts.astype(np.float64), credits)
    times = np.zeros(len(counts))
    for seen, credit in [*credits, *(more[i] for i in order)]:
        times[seen] += credit >= SEEN
    facts: dict[str, float | int | str] = {
        "kind": "inside" if found.inside else "around",
        "places": len(found.places),
        "views": len(order),
        "seen_by_five": round(float(counts[times >= FIVE].sum() / counts.sum()), 4),
        "seen": round(float(counts[times >= 1].sum() / counts.sum()), 4),
        "median_distance": found.typical,
    }
    return Chosen(np.array([poses[i] for i in order]).reshape(-1, 4, 4), facts)


def _seen_from(proxy: Gaussians, pose: np.ndarray, focal: float) -> np.ndarray:
    """World points [P, 3] that a given camera sees, along rays as dense as those of a panorama at its axis."""
    width = max(2, round(SIDE / 2 / focal))
    height = round(ASPECT * width)
    K = np.array([[SIDE / 2, 0, width / 2], [0, SIDE / 2, height / 2], [0, 0, 1.0]])
    tensors = torch.from_numpy(pose).float(), torch.from_numpy(K).float()
    out = render(proxy, *tensors, width, height, eps2d=EPS)
    depth = expected_depth(out).numpy().astype(np.float64)
    y, x = np.nonzero(depth > 0)
    return unprojected(K, pose, x + 0.5, y + 0.5, depth[y, x])


def _candidates(
    found: Survey, axes: np.ndarray, wanted: np.ndarray, nearest: float
) -> tuple[list[np.ndarray], list[tuple[np.ndarray, np.ndarray]]]:
    """Poses of all views that show enough, and of each the voxels that it sees with its credit for each, up to 1."""
    rays = found.rays @ axes.T
    # A ray near a face's corner covers less of the sphere than one at its middle, as a view's pixel does near its own.
    share = 1 / np.linalg.norm(rays, axis=1) ** 3
    turns, inside = [], []
    for pitch in np.radians(PITCHES):
        for yaw in np.radians(np.arange(YAWS) * 360 / YAWS):
            x, y, z = (rays @ pose_at(np.zeros(3), yaw, pitch, np.eye(3))[:3, :3].T).T
            rows = np.flatnonzero((z > 0) & (np.abs(x) * FOCAL < z / 2) & (np.abs(y) * FOCAL < z * ASPECT / 2))
            turns.append((yaw, pitch))
            inside.append((rows, share[rows] * (np.linalg.norm(rays[rows], axis=1) / z[rows]) ** 3))
    poses, credits = [], []
    for place, number in zip(found.places, found.numbers, strict=True):
        for (yaw, pitch), (rows, pixels) in zip(turns, inside, strict=True):
            hit = place.hit[rows]
            if hit.mean() < FILLED or np.quantile(place.distance[rows][hit], 0.02) < nearest:
                continue
            own = number[rows] >= 0
            seen, index = np.unique(number[rows][own], return_inverse=True)
            covered = sums_by(index, pixels[own][:, None], len(seen))[:, 0]
            poses.append(pose_at(place.place, yaw, pitch, axes))
            credits.append((seen, np.minimum(1, covered / wanted[seen])))
    return poses, credits


def _greedy(
    views: list[tuple[np.ndarray, np.ndarray]], weight: np.ndarray, given: list[tuple[np.ndarray, np.ndarray]]
) -> list[int]:
    """Views in the order of choice, beside those `given`; each as voxels and its credit for them. weight [V]: of
    voxels. Gains only fall, so those of most views need not be computed again."""
    have = np.zeros(len(weight))
    for seen, credit in given:
        have[seen] += credit

    def gain(view: int) -> float:
        seen, credit = views[view]
        return float((weight[seen] * np.minimum(credit, np.maximum(FIVE - have[seen], 0))).sum())

    queue = [(-gain(view), view) for view in range(len(views))]
    heapq.heapify(queue)
    order: list[int] = []
    least = ENOUGH * FIVE * float(weight.sum())
    while queue and len(order) < MOST_VIEWS and -queue[0][0] >= least:
        view = heapq.heappop(queue)[1]
        now = gain(view)
        if queue and now < -queue[0][0]:
            heapq.heappush(queue, (-now, view))
        elif now >= least:
            order.append(view)
            have[views[view][0]] += views[view][1]
    return order
