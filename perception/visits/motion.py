"""Which new thing of a visit is which thing that no longer stands where it stood, and how it moved.

Two things are compared by registration: the points of the new one, with their colours, are brought onto those of the
old one (ICP, Besl and McKay 1992) from many starting rotations. The best few motions are then judged by the photos, by
the same signs as a thing that did not move: carried to the new spot, would the photos say that it stands there? All
pairs are assigned jointly.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from perception.gaussians.model import Gaussians
from perception.gaussians.views import TrainingView, expected_depth, render
from perception.geometry import nearest_rotation, rotations
from perception.visits.evidence import Signs, signs_of
from perception.visits.look import Look, moments, projected

YAWS = 12
"""Starting rotations about the vertical; the 24 that map a cube's axes to each other are tried as well."""
ROUGH, FINE, BEST = 150, 600, 4
"""Points of the new thing in the first rounds of all starts, and in the last rounds of the BEST ones."""
ROUNDS = (6, 25)
TRIMMED = 0.8
"""Share of the new points that are compared: the rest are of neighbours, or were hidden in the first visit."""
COLOUR = 1.0
"""Radii of a thing that a difference of colour of 1 counts as."""
VISIBLE, TOUCHING = 0.3, 0.02
"""Least opacity of a pixel that shows a thing; relative depth by which it may lie behind what it stands on."""
SOLID = 0.1
"""Least opacity of a Gaussian that shows a surface."""
REACH = 2.2
"""Radii of a thing (root of the mean squared distance to its centre) within which all of it lies."""
SIZES, LEAST_PART = (0.35, 1.6), 0.3
"""Least and largest size of the new thing relative to the old one, which may be half hidden; least share of its points
that lie within reach of each other, if it is that thing."""
JUDGED, LARGE, SMALL = 4, 128, 48
"""Photos by which a motion is judged: those that show most of the new thing; the long side in pixels from which their
parts are halved, and from which they are to find a motion at first, when it may be far off."""
MARGIN = 0.3
"""Of the cut around a thing in a photo, relative to its sides."""
TURNED = 15.0
"""Degrees from which two motions are different ones."""
HOPELESS = -4.0
"""Log-odds of a first guess below which a motion is not refined."""
ALIKE = 2
"""Old things, most alike in colour, with which a new one is compared."""
CERTAIN = 4.0
"""Log-odds of a motion from which no other thing is tried, unless that is as much alike."""
TWINS = 0.15
"""Difference of what two histograms have in common, within which two things are as much alike."""
MOVED = 1.2
"""Least log-odds for which a new thing is an old one."""
GAINS = 0.02
"""Log-odds that a step of refinement must gain."""
ROUGH_STEP, STEP, LEAST_STEP = 0.4, 0.1, 0.015
"""Steps of a motion in refinement, from a rough one down: radii of the thing, and radians."""
BINS = 6
"""Of each colour in the histograms of things."""
LOOKS = 8.0, 0.45
"""Log-odds of being one thing per unit of what two histograms have in common, and where that says nothing: the same
things share .5 to .75 between visits, others up to .5."""
CLOSE = 1.5
"""Log-odds within which two motions, or two look-alikes, cannot be told apart."""


@dataclass(frozen=True)
class Points:
    """Of one thing: points [P, 3] float64, colors [P, 3] in [0, 1]."""

    points: np.ndarray
    colors: np.ndarray

    @classmethod
    def of(cls, gaussians: Gaussians) -> Points:
        """The means and colours of the solid Gaussians."""
        solid = gaussians.opacities.numpy() >= SOLID
        return cls(gaussians.means.double().numpy()[solid], gaussians.base_colors.double().numpy()[solid].clip(0, 1))

    def within(self, radius: float) -> Points:
        """The points in the ball about the densest spot in which a thing of this `radius` fits; strays are left out."""
        from scipy.spatial import cKDTree

        if len(self.points) == 0:
            return self
        counts = cKDTree(self.points).query_ball_point(self.points, radius, return_length=True)
        centre = self.points[int(np.argmax(counts))]
        for _ in range(ROUNDS[0]):
            kept = np.linalg.norm(self.points - centre, axis=1) <= REACH * radius
            centre = np.median(self.points[kept], axis=0)
        return Points(self.points[kept], self.colors[kept])

    @property
    def radius(self) -> float:
        """Root of the mean squared distance to the centre."""
        return float(np.sqrt(((self.points - self.points.mean(axis=0)) ** 2).sum(axis=1).mean()))

    def some(self, count: int) -> Points:
        """An even selection of at most about `count` points."""
        every = max(1, len(self.points) // count)
        return Points(self.points[::every], self.colors[::every])


@dataclass(frozen=True)
class Motion:
    """new_from_old [4, 4] of a thing; odds: log-odds that it is the same thing, by the photos and by its colours;
    ambiguous: another motion explains the photos as well."""

    new_from_old: np.ndarray
    odds: float
    ambiguous: bool = False


def register(old: Points, new: Points, up: np.ndarray) -> list[tuple[float, np.ndarray]]:
    """(mean residual in radii of the old thing, new_from_old [4, 4]) of the best motions, the best first, and of all
    turns about the vertical that differ from them: points of a half hidden thing alone cannot tell."""
    from scipy.spatial import cKDTree

    radius = max(old.radius, 1e-9)
    tree = cKDTree(np.concatenate([old.points / radius, COLOUR * old.colors], axis=1))
    middle_old, middle_new = (np.median(each.points, axis=0) for each in (old, new))
    starts = []
    for rotation in _starts(up):
        start = np.eye(4)
        start[:3, :3], start[:3, 3] = rotation, middle_new - rotation @ middle_old
        starts.append(_icp(tree, old, new.some(ROUGH), start, radius, ROUNDS[0]))
    likely = sorted(starts, key=lambda found: found[0])[: 2 * BEST]
    fine = [_icp(tree, old, new.some(FINE), start, radius, ROUNDS[1]) for _, start in likely]
    distinct: list[tuple[float, np.ndarray]] = []
    for found in [*sorted(fine, key=lambda found: found[0]), *starts[:YAWS]]:
        if all(angle_between(found[1], other[1]) > TURNED for other in distinct):
            distinct.append(found)
    return distinct


def _starts(up: np.ndarray) -> list[np.ndarray]:
    from scipy.spatial.transform import Rotation

    turns = Rotation.from_rotvec(np.arange(YAWS)[:, None] * (2 * np.pi / YAWS) * up).as_matrix()
    return [*turns, *Rotation.create_group("O").as_matrix()]


def _icp(
    tree: Any, old: Points, new: Points, start: np.ndarray, radius: float, rounds: int
) -> tuple[float, np.ndarray]:
    pose, residual = start, np.inf
    for _ in range(rounds):
        back = (new.points - pose[:3, 3]) @ pose[:3, :3]
        distance, nearest = tree.query(np.concatenate([back / radius, COLOUR * new.colors], axis=1))
        kept = distance <= np.quantile(distance, TRIMMED)
        residual = float(distance[kept].mean())
        a, b = old.points[nearest[kept]], new.points[kept]
        rotation = nearest_rotation((b - b.mean(axis=0)).T @ (a - a.mean(axis=0)))
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotation, b.mean(axis=0) - rotation @ a.mean(axis=0)
    return residual, pose


def angle_between(a: np.ndarray, b: np.ndarray) -> float:
    """Degrees between the rotations of two motions."""
    cosine = (np.trace(a[:3, :3] @ b[:3, :3].T) - 1) / 2
    return float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))


def carried(gaussians: Gaussians, new_from_old: np.ndarray) -> Gaussians:
    """The Gaussians of a thing moved by a rigid motion [4, 4], with their view-dependent colours."""
    from scipy.spatial.transform import Rotation

    rotation, shift = new_from_old[:3, :3], new_from_old[:3, 3]
    means = gaussians.means.double().numpy() @ rotation.T + shift
    turned = Rotation.from_matrix(rotation @ rotations(gaussians.quats.double().numpy())).as_quat()[:, [3, 0, 1, 2]]
    return replace(
        gaussians,
        means=torch.from_numpy(means.astype(np.float32)),
        quats=torch.from_numpy(np.ascontiguousarray(turned, np.float32)),
        sh=turned_harmonics(gaussians.sh, rotation),
    )


def turned_harmonics(sh: torch.Tensor, rotation: np.ndarray) -> torch.Tensor:
    """Coefficients [N, K, 3] of the same colours after a rotation [3, 3]: Y(d) sh' = Y(Rᵀ d) sh for
    many directions d."""
    count = sh.shape[1]
    if count == 1:
        return sh
    directions = np.random.default_rng(0).normal(size=(64, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    turn = np.linalg.lstsq(harmonics(directions)[:, :count], harmonics(directions @ rotation)[:, :count], rcond=None)[0]
    return torch.einsum("ij,njc->nic", torch.from_numpy(turn.astype(np.float32)), sh).contiguous()


def harmonics(d: np.ndarray) -> np.ndarray:
    """The real spherical harmonics [P, 16] of directions d [P, 3] as 3DGS orders and signs them."""
    x, y, z = d.T
    xx, yy, zz = x * x, y * y, z * z
    return np.stack([
        np.full_like(x, 0.28209479177387814),
        -0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x,
        1.0925484305920792 * x * y, -1.0925484305920792 * y * z, 0.31539156525252005 * (2 * zz - xx - yy),
        -1.0925484305920792 * x * z, 0.5462742152960396 * (xx - yy),
        -0.5900435899266435 * y * (3 * xx - yy), 2.890611442640554 * x * y * z,
        -0.4570457994644658 * y * (4 * zz - xx - yy), 0.3731763325901154 * z * (2 * zz - 3 * xx - 3 * yy),
        -0.4570457994644658 * x * (4 * zz - xx - yy), 1.445305721320277 * z * (xx - yy),
        -0.5900435899266435 * x * (xx - 3 * yy),
    ], axis=1)  # fmt: skip


# ------------------------------------------------------------------ judged by the photos


@dataclass(frozen=True)
class Cut:
    """A part of a photo, and what the map shows there beside a thing. view; measured [h, w] depth, 0 = none; image
    [h, w, 3] and depth [h, w] (infinite where nothing is) of all else."""

    view: TrainingView
    measured: np.ndarray
    image: np.ndarray
    depth: np.ndarray

    def halved_to(self, most: int) -> Cut:
        """The part with a long side of at most about `most` pixels."""
        cut = self
        while max(cut.view.photo.shape[:2]) > most:
            height, width = (side // 2 for side in cut.view.photo.shape[:2])
            part = np.s_[: 2 * height : 2, : 2 * width : 2]
            image = cut.image[: 2 * height, : 2 * width].reshape(height, 2, width, 2, 3).mean(axis=(1, 3))
            cut = Cut(cut.view.halved(), cut.measured[part], image, cut.depth[part])
        return cut

    def with_thing(self, thing: Gaussians) -> Look:
        """The part beside a render of all else with a thing, which is instance 0: the nearer of the two surfaces."""
        view, (height, width) = self.view, self.depth.shape
        out = render(thing, view.camera_from_world, view.K, width, height, harmonics=True, eps2d=view.eps2d)
        assert out.depths is not None  # for the type checker
        alpha = out.alphas[0].numpy()
        depth = np.where(alpha > VISIBLE, out.depths[0].numpy() / np.maximum(alpha, 1e-6), np.inf)
        front = depth < self.depth * (1 + TOUCHING)
        weight = np.where(front, alpha, 0)[..., None]
        own = np.where(front[..., None], view.exposed(out.colors[0]).numpy(), 0)
        image = (own + (1 - weight) * self.image).clip(0, 1).astype(np.float32)
        photo = view.photo.numpy().astype(np.float32) / 255
        mapped = np.where(front, depth, np.where(np.isfinite(self.depth), self.depth, 0)).astype(np.float32)
        ids = np.where(front, 0, -1)
        if view.weight is not None:
            ids[view.weight.numpy() == 0] = -1
        return Look(view, mapped, self.measured, ids, *moments(image, photo), np.abs(image - photo).mean(axis=2))


Frame = tuple[TrainingView, np.ndarray]
"""A photo, and the depth [h, w] that was measured in it, 0 = none."""


def cuts_of(frames: Sequence[Frame], points: np.ndarray, scene: Gaussians) -> list[Cut]:
    """The parts of the JUDGED photos that show most of a new thing, points [P, 3]. scene: all else."""
    found = [(bounds, frame) for frame in frames if (bounds := _bounds(frame[0], points)) is not None]
    found.sort(key=lambda cut: -int((cut[0][1] - cut[0][0]).prod()))
    return [_cut(*frame, low, high, scene) for (low, high), frame in found[:JUDGED]]


def _bounds(view: TrainingView, points: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """The corners of the part of a photo around points [P, 3]; None where it shows less than half of them."""
    pixel, z = projected(view, points)
    size = np.array(view.photo.shape[1::-1])
    inside = (z > 1e-3) & ((pixel >= 0) & (pixel < size)).all(axis=1)
    if inside.mean() < 0.5:
        return None
    low, high = np.quantile(pixel[inside], [0.01, 0.99], axis=0)
    margin = MARGIN * (high - low) + 4
    low, high = np.maximum(np.floor(low - margin), 0).astype(int), np.minimum(np.ceil(high + margin), size).astype(int)
    return None if (high - low < 8).any() else (low, high)


def _cut(view: TrainingView, measured: np.ndarray, low: np.ndarray, high: np.ndarray, scene: Gaussians) -> Cut:
    part = np.s_[low[1] : high[1], low[0] : high[0]]
    K = view.K.clone()
    K[:2, 2] -= torch.from_numpy(low.astype(np.float32))
    images = {name: getattr(view, name) for name in ("photo", "labels", "weight")}
    own = {name: image[part].contiguous() for name, image in images.items() if image is not None}
    small = replace(view, K=K, depth=None, **own)
    size = small.photo.shape[1::-1]
    out = render(scene, small.camera_from_world, small.K, *size, harmonics=True, eps2d=small.eps2d)
    depth = expected_depth(out).numpy()
    image = small.exposed(out.colors[0]).numpy()
    return Cut(small, measured[part], image, np.where(depth > 0, depth, np.inf)).halved_to(LARGE)


Found = tuple[Signs, np.ndarray]
"""The signs of a motion and new_from_old [4, 4]."""


def motions_of(
    old: Gaussians, new: Gaussians, frames: Sequence[Frame], scene: Gaussians, up: np.ndarray, depth: float
) -> tuple[list[Found], list[Cut]]:
    """The likeliest motions from an old thing to a new one, the best first, and the parts of photos by which they were
    judged; none where their sizes differ. scene: all else; depth: smallest extent of the old thing."""
    a, whole = Points.of(old), Points.of(new)
    if len(a.points) < 8 or len(whole.points) < 8:
        return [], []
    b = whole.within(a.radius)
    fits = SIZES[0] <= b.radius / max(a.radius, 1e-9) <= SIZES[1] and len(b.points) >= LEAST_PART * len(whole.points)
    cuts = cuts_of(frames, b.points, scene) if fits and len(b.points) >= 8 else []
    if not cuts:
        return [], []
    starts = [pose for _, pose in register(a, b, up)] + _upright_starts(a, b, up)
    small = [cut.halved_to(SMALL) for cut in cuts]
    rough = sorted(((judged(old, pose, small, depth), pose) for pose in starts), key=_falling)
    rough = [refined(old, pose, small, depth, ROUGH_STEP, STEP) for _, pose in _distinct(rough)[:BEST]]
    return sorted(((judged(old, pose, cuts, depth), pose) for _, pose in _distinct(rough)), key=_falling), cuts


def _falling(motion: Found) -> float:
    return -motion[0].same


def _distinct(found: Sequence[Found]) -> list[Found]:
    """The motions whose rotations differ from those of all better ones, the best first."""
    kept: list[Found] = []
    for motion in sorted(found, key=_falling):
        if all(angle_between(motion[1], other) > TURNED for _, other in kept):
            kept.append(motion)
    return kept


def _upright_starts(a: Points, b: Points, up: np.ndarray) -> list[np.ndarray]:
    """Turns about the vertical that bring box a onto box b, the lowest points onto each other."""
    poses = []
    for rotation in _starts(up)[:YAWS]:
        turned = a.points @ rotation.T
        (low_a, high_a), (low_b, high_b) = (np.quantile(points, [0.03, 0.97], axis=0) for points in (turned, b.points))
        step = (low_b + high_b - low_a - high_a) / 2
        step += up * ((low_b - low_a - step) @ up)
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotation, step
        poses.append(pose)
    return poses


def settled(old: Gaussians, found: Sequence[Found], cuts: Sequence[Cut], depth: float, alike: float) -> Motion:
    """The best of the two best motions after refinement, and whether the other explains the photos as well. alike: see
    `looks_alike`."""
    refine = _distinct([refined(old, pose, cuts, depth, STEP, LEAST_STEP) for _, pose in found[:2]])
    (signs, pose), others = refine[0], refine[1:]
    odds = signs.same + LOOKS[0] * (alike - LOOKS[1])
    return Motion(pose, odds, any(other.same > signs.same - CLOSE for other, _ in others))


def judged(old: Gaussians, pose: np.ndarray, cuts: Sequence[Cut], depth: float) -> Signs:
    """What the photos say about the old thing, carried by `pose`."""
    thing = carried(old, pose)
    return signs_of([cut.with_thing(thing) for cut in cuts], [0], np.ones(1), np.array([depth]))[0]


def refined(
    old: Gaussians, pose: np.ndarray, cuts: Sequence[Cut], depth: float, step: float, least: float
) -> tuple[Signs, np.ndarray]:
    """The motion near `pose` that the photos support best: steps along and about three axes, halved when none helps."""
    from scipy.spatial.transform import Rotation

    points = Points.of(old)
    middle, radius = points.points.mean(axis=0), points.radius
    best = judged(old, pose, cuts, depth)
    while step >= least:
        better = False
        for axis, sign in ((axis, sign) for axis in range(6) for sign in (1, -1)):
            change = np.zeros(6)
            change[axis] = sign * step
            moved = np.eye(4)
            moved[:3, :3] = Rotation.from_rotvec(change[3:]).as_matrix() @ pose[:3, :3]
            moved[:3, 3] = pose[:3, :3] @ middle + pose[:3, 3] + radius * change[:3] - moved[:3, :3] @ middle
            signs = judged(old, moved, cuts, depth)
            if signs.same > best.same + GAINS:
                best, pose, better = signs, moved, True
        step = step if better else step / 2
    return best, pose


def looks_alike(old: Gaussians, new: Gaussians) -> float:
    """Share in [0, 1] that the histograms of the colours of two things have in common."""
    histograms = []
    for each in (old, new):
        colors = Points.of(each).colors
        counts = np.histogramdd(colors, bins=BINS, range=[(0, 1)] * 3)[0]
        histograms.append(counts / max(counts.sum(), 1))
    return float(np.minimum(*histograms).sum())


def assigned(odds: np.ndarray, least: float = 0.0) -> list[tuple[int, int]]:
    """Pairs (old, new) of the joint assignment with the largest sum of log-odds [O, N] above `least`."""
    from scipy.optimize import linear_sum_assignment

    gain = np.maximum(np.where(np.isfinite(odds), odds - least, 0), 0)
    rows, columns = linear_sum_assignment(-gain)
    return [(int(i), int(j)) for i, j in zip(rows, columns, strict=True) if gain[i, j] > 0]
