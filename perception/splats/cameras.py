"""Virtual cameras for a finished Gaussian scene, from its own free space and surfaces.

Places     a grid in the scene's free space. Where a scene encloses its cameras, as a room does, or a table in one,
           those are places that see surface in most directions; else they lie around and above it, as for a thing or a
           flight.
Panoramas  from each place, depth in all directions: what can be seen of the surface, as voxels.
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
from perception.gaussians.views import expected_depth, render
from perception.geometry import sums_by
from perception.masks.surface import position_in, voxel_keys
from perception.progress import QUIET, Progress

FIVE = 5.0
"""Views that each voxel is to be seen by."""
MOST_VIEWS = 200
ENOUGH = 2e-4
"""Gain of the next view, as share of all there is to gain, at which no more are chosen."""
PLACES, SIDE = 240, 48
"""Places of the grid, and pixels of a face of a panorama."""
PROXY = 150_000
"""Gaussians that panoramas are rendered of; of more, every k-th is taken, enlarged."""
ASPECT, FOCAL = 0.75, 0.8
"""Of the views: height and focal length, relative to the width."""
PIXELS = 5.0
"""Pixels between neighbouring Gaussians in a view that shows all of their detail."""
VOXEL = 0.04
"""Side of a voxel relative to the median distance of what the places see: what a ray of a panorama covers there."""
INSIDE, ENCLOSED = 0.6, 0.75
"""Share of the directions in which a place of an enclosing scene sees surface; and of the best places' own share."""
HEIGHTS = (0.25, 0.9)
"""Heights of places in an enclosing scene, as shares of its own: from above the seats to below the ceiling."""
NEAREST = 0.15
"""Least distance between a camera and what it shows, relative to the median distance."""
FILLED = 0.5
"""Least share of a view that shows surface."""
PITCHES, YAWS = (-75, -50, -28, -8, 15), 12


@dataclass(frozen=True)
class Chosen:
    """poses [C, 4, 4] camera_from_world, in the order of choice; facts: JSON-able, for map.json."""

    poses: np.ndarray
    facts: dict[str, float | int | str]


@dataclass(frozen=True)
class _Panorama:
    """From a place [3], of all rays: the voxel that each hits [R] int64, −1 = none, and its distance [R]."""

    place: np.ndarray
    points: np.ndarray
    distance: np.ndarray
    hit: np.ndarray


def intrinsics(width: int) -> tuple[np.ndarray, int]:
    """K [3, 3] of a virtual camera and its height in pixels."""
    height = round(ASPECT * width)
    return np.array([[FOCAL * width, 0, width / 2], [0, FOCAL * width, height / 2], [0, 0, 1.0]]), height


def proxy_of(gaussians: Gaussians, hidden: np.ndarray) -> Gaussians:
    """The Gaussians that are not hidden, without harmonics; of more than PROXY every k-th, its σ times √k."""
    rows = np.flatnonzero(~hidden)
    k = max(1, -(-len(rows) // PROXY))
    index = torch.from_numpy(rows[::k])
    return Gaussians(
        gaussians.means[index],
        gaussians.quats[index],
        gaussians.log_scales[index] + 0.5 * float(np.log(k)),
        gaussians.opacity_logits[index],
        gaussians.sh[index, :1],
        torch.zeros(len(index), 1),
    )


def choose_views(
    proxy: Gaussians,
    means: np.ndarray,
    up: np.ndarray,
    width: int,
    given: np.ndarray,
    given_focal: float,
    progress: Progress = QUIET,
) -> Chosen:
    """Views of the scene: means [N, 3] of the Gaussians that count, `proxy` what is rendered. given [G, 4, 4]: poses
    that are used anyway, as cameras of `given_focal` (focal length over width). InputError where nothing is seen."""
    axes = upright_axes(up)
    places, inside = _places(proxy, means, axes, progress)
    distances = np.concatenate([p.distance[p.hit] for p in places])
    typical = float(np.median(distances))
    size = VOXEL * typical
    keys, numbers = _numbered(places, size)
    counts = np.bincount(p[p >= 0], minlength=len(keys)) if len(p := position_in(keys, voxel_keys(means, size))) else 0
    per_ray = (FOCAL * width * 2 / SIDE) ** 2  # pixels of a view that a ray of a panorama covers, at its axis
    wanted = np.maximum(PIXELS**2 * np.maximum(counts, 1) / per_ray, 1.0)  # rays
    weight = np.sqrt(1.0 + counts)
    have = np.zeros(len(keys))
    for pose in given:
        voxel = position_in(keys, voxel_keys(_seen_from(proxy, pose, given_focal)[0], size))
        seen, rays = np.unique(voxel[voxel >= 0], return_counts=True)
        have[seen] += np.minimum(1, rays * (given_focal / FOCAL) ** 2 / wanted[seen])
    views, credits = _candidates(places, numbers, axes, wanted, NEAREST * typical)
    if not views:
        raise InputError("no place was found from which the scene is seen; give --cameras")
    order, have = _greedy(credits, weight, have)
    full = weight[have >= FIVE - 0.5].sum() / weight.sum()
    poses = np.stack([views[i] for i in order]) if order else np.zeros((0, 4, 4))
    facts: dict[str, float | int | str] = {
        "places": len(places),
        "kind": "inside" if inside else "around",
        "views": len(order),
        "seen_by_five": round(float(full), 4),
        "voxel": size,
        "median_distance": typical,
    }
    return Chosen(poses, facts)


def upright_axes(up: np.ndarray) -> np.ndarray:
    """[3, 3] rows x, y, z = up of a level frame in world axes."""
    x = np.eye(3)[int(np.abs(up).argmin())]
    x = x - (x @ up) * up
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(up, x), up])


def pose_at(place: np.ndarray, yaw: float, pitch: float, axes: np.ndarray) -> np.ndarray:
    """camera_from_world [4, 4] of a level camera at `place`; yaw and pitch in radians, the latter up."""
    ahead = np.array([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), np.sin(pitch)])
    right = np.array([np.sin(yaw), -np.cos(yaw), 0])
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(ahead, right), ahead]) @ axes
    pose[:3, 3] = -pose[:3, :3] @ place
    return pose


# ----------------------------------------------------------------------- places


def _places(proxy: Gaussians, means: np.ndarray, axes: np.ndarray, progress: Progress) -> tuple[list[_Panorama], bool]:
    """Panoramas of the places that are used, and whether the scene encloses them."""
    local = means @ axes.T
    low, high = np.quantile(local, [0.1, 0.9], axis=0)
    margin = 0.5 * (high - low)
    # Of a uniform scene this is more than all; far backgrounds stay out.
    low, high = np.maximum(low - margin, local.min(axis=0)), np.minimum(high + margin, local.max(axis=0))
    grid = _grid(low, high, PLACES) @ axes
    free = [p for p in _panoramas(proxy, grid, axes, progress) if p.hit.any()]
    if not free:
        raise InputError("the scene is one blob: nothing is seen from anywhere in it; give --cameras, or another scene")
    typical = float(np.median(np.concatenate([p.distance[p.hit] for p in free])))
    free = [p for p in free if np.quantile(p.distance[p.hit], 0.02) > NEAREST * typical]
    enclosed = np.array([p.hit.mean() for p in free])
    best = float(np.quantile(enclosed, 0.9)) if len(free) else 0.0
    if best >= INSIDE:
        height = np.array([(axes[2] @ p.place - low[2]) / (high[2] - low[2]) for p in free])
        good = (enclosed >= ENCLOSED * best) & (height >= HEIGHTS[0]) & (height <= HEIGHTS[1])
        chosen = [p for p, is_good in zip(free, good, strict=True) if is_good]
        if chosen:
            return chosen, True
    around = _around(low, high) @ axes
    free = [p for p in _panoramas(proxy, around, axes, progress) if p.hit.any()]
    if not free:
        raise InputError("the scene is one blob: nothing is seen from around it; give --cameras, or another scene")
    return free, False


def _grid(low: np.ndarray, high: np.ndarray, count: int) -> np.ndarray:
    """[P, 3] centres of about `count` cubes that fill a box."""
    side = np.maximum(high - low, 1e-9)
    step = float(np.cbrt(np.prod(side) / count))
    parts = np.maximum(np.round(side / step), 1).astype(int)
    axes = [low[i] + (np.arange(parts[i]) + 0.5) * side[i] / parts[i] for i in range(3)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def _around(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """[P, 3] places on two domes about a box, and on two levels above it."""
    centre, half = (low + high) / 2, np.maximum((high - low) / 2, 1e-9)
    places = []
    for factor in (1.3, 2.0):
        for pitch in np.radians([8, 30, 55]):
            yaw = np.radians(np.arange(0, 360, 30) + (15 if factor > 1.5 else 0))
            dome = [np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), np.full(len(yaw), np.sin(pitch))]
            places.append(centre + factor * np.linalg.norm(half) * np.stack(dome, axis=1))
    step = max(float(np.sqrt(half[0] * half[1])) / 4, 1e-9)
    for above in (1.0, 2.0):
        level = np.array([[low[0], low[1], high[2] + above * step], [high[0], high[1], high[2] + above * step]])
        places.append(_grid(level[0], level[1] + [0, 0, 1e-6 * step], 64) if half.max() > 0 else level[:1])
    return np.concatenate(places)


def _rays() -> np.ndarray:
    """[R, 3] of the pixels of a panorama in level axes, of length 1 along the axis of their face."""
    centre = (np.arange(SIDE) + 0.5) / SIDE * 2 - 1
    x, y = np.meshgrid(centre, centre)
    face = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3)
    return np.concatenate([face @ turn for turn in _faces()])


def _faces() -> list[np.ndarray]:
    """Rotations camera_from_level [3, 3] of the six faces."""
    level = [pose_at(np.zeros(3), yaw, 0.0, np.eye(3))[:3, :3] for yaw in np.radians([0, 90, 180, 270])]
    return [*level, *(pose_at(np.zeros(3), 0.0, pitch, np.eye(3))[:3, :3] for pitch in np.radians([90, -90]))]


def _panoramas(proxy: Gaussians, places: np.ndarray, axes: np.ndarray, progress: Progress) -> list[_Panorama]:
    K = torch.tensor([[SIDE / 2, 0, SIDE / 2], [0, SIDE / 2, SIDE / 2], [0, 0, 1.0]])
    rays, faces, found = _rays() @ axes, _faces(), []
    lengths = np.linalg.norm(rays, axis=1)
    for done, place in enumerate(places, start=1):
        depths = []
        for face in faces:
            pose = np.eye(4)
            pose[:3, :3] = face @ axes
            pose[:3, 3] = -pose[:3, :3] @ place
            depths.append(expected_depth(render(proxy, torch.from_numpy(pose).float(), K, SIDE, SIDE)).numpy().ravel())
        depth = np.concatenate(depths).astype(np.float64)
        found.append(_Panorama(place, place + depth[:, None] * rays, depth * lengths, depth > 0))
        progress.update("places", done, len(places))
    return found


def _seen_from(proxy: Gaussians, pose: np.ndarray, focal: float) -> tuple[np.ndarray, float]:
    """World points [P, 3] that a given camera sees, one for each ray of a panorama's size, and the share of its rays
    that see surface."""
    width = round(SIDE / 2 / focal * focal * 2 * ASPECT) or SIDE
    K = np.array([[focal * width, 0, width / 2], [0, focal * width, width * ASPECT / 2], [0, 0, 1.0]])
    shape = (width, round(width * ASPECT))
    out = render(proxy, torch.from_numpy(pose).float(), torch.from_numpy(K).float(), *shape)
    depth = expected_depth(out).numpy().astype(np.float64)
    y, x = np.nonzero(depth > 0)
    rays = np.stack([(x + 0.5 - K[0, 2]) / K[0, 0], (y + 0.5 - K[1, 2]) / K[1, 1], np.ones(len(x))], axis=1)
    return (rays * depth[y, x][:, None] - pose[:3, 3]) @ pose[:3, :3], float((depth > 0).mean())


# ----------------------------------------------------------------------- choice


def _numbered(places: list[_Panorama], size: float) -> tuple[np.ndarray, list[np.ndarray]]:
    """The voxels [V] that the places see, ascending, and of each place the voxel [R] of each ray, −1 = none."""
    found = [np.where(p.hit, voxel_keys(p.points, size), -1) for p in places]
    keys = np.unique(np.concatenate([np.unique(each) for each in found]))
    keys = keys[keys >= 0]
    return keys, [np.where(each >= 0, np.searchsorted(keys, np.maximum(each, 0)), -1) for each in found]


def _candidates(
    places: list[_Panorama], numbers: list[np.ndarray], axes: np.ndarray, wanted: np.ndarray, nearest: float
) -> tuple[list[np.ndarray], list[tuple[np.ndarray, np.ndarray]]]:
    """Poses of all views that show enough, and of each the voxels that it sees with its credit for each, up to 1."""
    rays = _rays()
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
    for place, number in zip(places, numbers, strict=True):
        for (yaw, pitch), (rows, pixels) in zip(turns, inside, strict=True):
            hit = place.hit[rows]
            if hit.mean() < FILLED or np.quantile(place.distance[rows][hit], 0.02) < nearest:
                continue
            seen, index = np.unique(number[rows][hit], return_inverse=True)
            covered = sums_by(index, pixels[hit][:, None], len(seen))[:, 0]
            poses.append(pose_at(place.place, yaw, pitch, axes))
            credits.append((seen, np.minimum(1, covered / wanted[seen])))
    return poses, credits


def _greedy(
    credits: list[tuple[np.ndarray, np.ndarray]], weight: np.ndarray, have: np.ndarray
) -> tuple[list[int], np.ndarray]:
    """Views in the order of choice, and what each voxel then has. Gains only fall, so most are not computed again."""

    def gain(view: int) -> float:
        seen, credit = credits[view]
        return float((weight[seen] * np.minimum(credit, np.maximum(FIVE - have[seen], 0))).sum())

    queue = [(-gain(view), view) for view in range(len(credits))]
    heapq.heapify(queue)
    order: list[int] = []
    least = ENOUGH * FIVE * float(weight.sum())
    while queue and len(order) < MOST_VIEWS:
        _, view = heapq.heappop(queue)
        now = gain(view)
        if now < least:
            if not queue or -queue[0][0] < least:
                break
            continue
        if queue and now < -queue[0][0]:
            heapq.heappush(queue, (-now, view))
            continue
        order.append(view)
        seen, credit = credits[view]
        have[seen] += credit
    return order, have
