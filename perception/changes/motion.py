"""Which new thing of a visit is which thing that no longer stands where it stood, and how it moved:

cuts_of      the parts of photos that show the new thing
likeliest    motions from where the points of both lie on each other, the best refined
settled      the best of all: does another one explain the photos as well, and does the thing look round?
assigned     all pairs jointly

Photos judge a motion by the signs of a thing that did not move (`evidence`): would they say that it stands there now?
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch

from perception.changes.colours import LOOKS, LUMA, colour_odds
from perception.changes.evidence import HIDDEN, WEIGHTS, Signs, signs_from, sums_in
from perception.changes.look import Look, blurred, projected
from perception.changes.registration import BEST, TURNED, YAWS, Points, angle_between, looks_round, register, turns
from perception.gaussians.model import Gaussians
from perception.gaussians.views import TrainingView, expected_depth, render
from perception.geometry import inverse_se3, move_points, transform
from perception.rasterizer.rasterize import rasterizer_for
from perception.rasterizer.types import Settings

VISIBLE, TOUCHING = 0.3, 0.02
"""Least opacity of a pixel that shows a thing; relative depth by which it may lie behind what it stands on."""
SIZES, LEAST_PART = (0.35, 1.6), 0.3
"""Of a new thing, which may be half hidden: size relative to the old one; least share of its points within reach."""
HALF_HIDDEN = 0.3
"""Radii of the old thing by which the new one is less high, from which its lower part may be hidden."""
JUDGED, LARGE, SMALL = 4, 128, 48
"""Photos by which a motion is judged; long sides to which their parts are halved, at last and at first."""
MARGIN = 0.3
"""Of the cut around a thing in a photo, relative to its sides."""
HOPELESS, BEHIND = -4.0, 5.0
"""Log-odds of a first guess below which none is refined; by which one may be behind the best to be refined as well."""
ALIKE = 2
"""Old things, most alike in colour, that a new one is compared with: of this visit, and of earlier ones."""
CERTAIN, TWINS = 6.0, 0.15
"""Log-odds of a motion from which only things are tried that are as much alike; difference of looks up to which."""
GAINS, SHORTER = 0.1, 3
"""Log-odds of a gain of refinement below which its steps become shorter, and how much."""
ROUGH_STEP, STEP, LEAST_STEP = 0.4, 0.1, 0.03
"""Steps of a motion in refinement: radii of the thing, and radians."""
CLOSE = 1.5
"""Log-odds within which two motions, or two look-alikes, cannot be told apart."""
WITHIN = 0.25
"""Share of the pixels of a moved thing that may lie just behind the surface of others: where things truly stand up to
.17, of pieces that fit somewhere by chance .28 to .5."""
SURE, UNLIKE, SIDE = 0.8, WEIGHTS["correlation"][1], 45.0
"""Correlation with the photos from which a turn is sure, and below which it is not known; between, other turns must be
excluded: a carton has one print on two sides. Degrees between directions that see the same side."""
PRINT = 7.0
"""Log-odds that a wrong turn of printed things costs at least; shades of a plain round thing cost up to 6."""


@dataclass(frozen=True)
class Motion:
    """new_from_old [4, 4] of a thing; odds: log-odds that it is the same thing; ambiguous: another motion explains the
    photos as well, or may show sides of it that no visit before saw. axis [3]: unit vector about which the thing looks
    round, so that its turn is not known; None for others."""

    new_from_old: np.ndarray
    odds: float
    ambiguous: bool = False
    axis: np.ndarray | None = None


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

    @cached_property
    def _photo(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """[h, w, 3] colours in [0, 1]; [h, w] its brightness, the local mean and variance of that."""
        photo = self.view.photo.numpy().astype(np.float32) / 255
        gray = photo @ LUMA
        mean = blurred(gray)
        return photo, gray, mean, blurred(gray * gray) - mean**2

    @cached_property
    def _masks(self) -> tuple[np.ndarray, np.ndarray]:
        """[h, w] int64 masks, 0 = none, and the pixels of each."""
        labels = self.view.labels
        images = np.zeros(self.depth.shape, np.int64) if labels is None else labels.numpy().astype(np.int64)
        return images, np.bincount(images.ravel())

    def _drawn(self, thing: Gaussians, motions: np.ndarray) -> tuple[torch.Tensor, np.ndarray, np.ndarray]:
        """Of a thing alone after each of the motions [P, 4, 4]: colours [P, h, w, 3], opacities and depths [P, h, w]
        (infinite where it is not). To move the camera the other way is the same as to move the thing."""
        view, (height, width) = self.view, self.depth.shape
        cameras = torch.from_numpy((view.camera_from_world.double().numpy() @ motions).astype(np.float32))
        inputs = thing.inputs(view.camera_from_world, view.K, harmonics=True)
        inputs = replace(inputs, viewmats=cameras, Ks=view.K.expand(len(motions), 3, 3).contiguous())
        settings = Settings(width, height, sh_degree=thing.sh_degree, eps2d=view.eps2d, variance=False, depth=True)
        out = rasterizer_for(thing.means.device).rasterize_forward(inputs, settings)
        assert out.depths is not None  # for the type checker
        alphas = out.alphas.numpy()
        depths = np.where(alphas > VISIBLE, out.depths.numpy() / np.maximum(alphas, 1e-6), np.inf)
        return out.colors, alphas, depths

    def _before_all(self, thing: Gaussians, motions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """With a thing after each of the motions [P, 4, 4] before all else: colours [P, h, w, 3] and depths [P, h, w],
        float32, and where the thing is seen [P, h, w]."""
        view, (colors, alphas, depths) = self.view, self._drawn(thing, motions)
        fronts = depths < self.depth * (1 + TOUCHING)
        own = np.where(fronts[..., None], view.exposed(colors).numpy(), 0)
        images = own + (1 - np.where(fronts, alphas, 0)[..., None]) * self.image
        mapped = np.where(fronts, depths, np.where(np.isfinite(self.depth), self.depth, 0)).astype(np.float32)
        shown = fronts if view.weight is None else fronts & (view.weight.numpy() > 0)
        return images.clip(0, 1).astype(np.float32), mapped, shown

    def colours(self, thing: Gaussians, motion: np.ndarray) -> np.ndarray:
        """[2, 3] sums of the colours of a thing after a motion where it is seen, and of those of the photo there."""
        (image,), _, (shown,) = self._before_all(thing, motion[None])
        return np.stack([image[shown].sum(axis=0), self._photo[0][shown].sum(axis=0)]).astype(np.float64)

    def within(self, thing: Gaussians, motion: np.ndarray, smallest: float) -> np.ndarray:
        """[2] pixels of a thing after a motion: all, and those less than its least extent behind all else."""
        depth = self._drawn(thing, motion[None])[2][0]
        behind = (depth >= self.depth * (1 + TOUCHING)) & (depth < self.depth * (1 + TOUCHING) + smallest)
        return np.array([np.isfinite(depth).sum(), (behind & np.isfinite(depth)).sum()])

    def sums(self, thing: Gaussians, motions: np.ndarray, smallest: float) -> np.ndarray:
        """[P, 11] of `evidence.sums_in`, of a thing after each of the motions [P, 4, 4]. smallest: its least extent."""
        photo, gray, mean, variance = self._photo
        view, (images, mapped, shown) = self.view, self._before_all(thing, motions)
        colour = np.abs(images - photo).mean(axis=3)
        rows = []
        for n, image in enumerate(images @ LUMA):
            local = blurred(image)
            moment = blurred(image * gray) - local * mean, blurred(image * image) - local**2, variance
            look = Look(view, mapped[n], self.measured, shown[n], *moment, colour[n])
            rows.append(sums_in(look, shown[n], *self._masks, smallest))
        return np.stack(rows)


Frame = tuple[TrainingView, np.ndarray]
"""A photo, and the depth [h, w] that was measured in it, 0 = none."""


def cuts_of(frames: Sequence[Frame], points: np.ndarray, scene: Gaussians) -> list[Cut]:
    """The parts of the JUDGED photos that show most of a new thing, points [P, 3], from directions that differ. scene:
    all else."""
    found = [(bounds, frame) for frame in frames if (bounds := _bounds(frame[0], points)) is not None]
    if not found:
        return []
    areas = np.array([(high - low).prod() for (low, high), _ in found], float)
    rays = _rays([view for _, (view, _) in found], points.mean(axis=0))
    chosen, apart = list[int](), np.ones(len(found))
    while len(chosen) < min(JUDGED, len(found)):
        chosen.append(int(np.argmax(areas * apart)))
        apart = np.minimum(apart, np.arccos(np.clip(rays @ rays[chosen[-1]], -1, 1)) / np.pi)
        apart[chosen] = -1
    return [_cut(*found[n][1], *found[n][0], scene) for n in chosen]


def _rays(views: Sequence[TrainingView], point: np.ndarray) -> np.ndarray:
    """[V, 3] unit directions from a point [3] to the cameras of the views."""
    rays = np.stack([inverse_se3(view.camera[1])[:3, 3] for view in views]) - point
    return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))


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


def motion_between(
    old: Gaussians,
    new: Gaussians,
    frames: Sequence[Frame],
    scene: Gaussians,
    up: np.ndarray,
    depth: float,
    alike: float,
    seen: np.ndarray,
) -> Motion | None:
    """How an old thing came to where a new one stands; None where it is another one. scene: all else; depth: smallest
    extent of the old thing; alike: see `colours.looks_alike`; seen: see `look.seen_from`."""
    a, whole = Points.of(old), Points.of(new)
    if len(a.points) < 8 or len(whole.points) < 8:
        return None
    b = whole.within(a.radius)
    fits = SIZES[0] <= b.radius / max(a.radius, 1e-9) <= SIZES[1] and len(b.points) >= LEAST_PART * len(whole.points)
    cuts = cuts_of(frames, b.points, scene) if fits and len(b.points) >= 8 else []
    if not cuts:
        return None
    found = likeliest(old, a, b, cuts, up, depth)
    if found[0][0].same + LOOKS[0] * (alike - LOOKS[1]) < HOPELESS:
        return None
    return settled(old, found, cuts, up, depth, alike, seen)


def stands_after(old: Gaussians, pose: np.ndarray, frames: Sequence[Frame], scene: Gaussians, depth: float) -> float:
    """Log-odds that photos show an old thing after a motion [4, 4], whatever outlines masks give it. scene, depth:
    see `motion_between`."""
    cuts = cuts_of(frames, move_points(pose, Points.of(old).points), scene)
    shown, within = np.sum([cut.within(old, pose, depth) for cut in cuts], axis=0) if cuts else (0, 0)
    if not cuts or within > WITHIN * shown:
        return HIDDEN
    signs = judged(old, [pose], cuts, depth)[0][0]
    return replace(signs, outline=np.nan).alike if signs.photos else HIDDEN


def likeliest(old: Gaussians, a: Points, b: Points, cuts: Sequence[Cut], up: np.ndarray, depth: float) -> list[Found]:
    """The motions of an old thing that photos support best, roughly refined, the best first. They start where points
    `a` of it lie on those of a new one, `b`."""
    starts = [pose for _, pose in register(a, b, up)] + _upright_starts(a, b, up)
    small = [cut.halved_to(SMALL) for cut in cuts]
    first = _distinct(judged(old, starts, small, depth))[:BEST]
    rough = [refined(old, found, small, depth, ROUGH_STEP, STEP) for found in first]
    return sorted(judged(old, [pose for _, pose in _distinct(rough)], cuts, depth), key=_falling)


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
    """Turns about the vertical that bring box a onto box b, their lowest points onto each other; where b is less high,
    also the highest, which show of a thing that is half hidden."""
    poses = []
    for rotation in turns(up, YAWS):
        turned = a.points @ rotation.T
        (low_a, high_a), (low_b, high_b) = (np.quantile(points, [0.03, 0.97], axis=0) for points in (turned, b.points))
        step = (low_b + high_b - low_a - high_a) / 2
        rises = [(low_b - low_a - step) @ up, (high_b - high_a - step) @ up]
        for rise in rises if rises[1] - rises[0] < -HALF_HIDDEN * a.radius else rises[:1]:
            poses.append(transform(rotation, step + up * rise))
    return poses


def settled(
    old: Gaussians,
    found: Sequence[Found],
    cuts: Sequence[Cut],
    up: np.ndarray,
    depth: float,
    alike: float,
    seen: np.ndarray,
) -> Motion | None:
    """The best of the `found` motions after refinement; None where much of the thing would lie within others. alike:
    see `colours.looks_alike`; seen: see `look.seen_from`."""
    likely = [each for each in found if each[0].same > found[0][0].same - BEHIND]
    refine = _distinct([refined(old, each, cuts, depth, STEP, LEAST_STEP) for each in likely])
    (signs, pose), others = refine[0], refine[1:]
    shown, within = np.sum([cut.within(old, pose, depth) for cut in cuts], axis=0)
    if within > WITHIN * shown:
        return None
    axis = round_about(old, refine[0], cuts, up, depth)
    if axis is not None:  # motions that differ by a turn about it are no others
        own = pose[:3, :3].T @ axis
        others = [other for other in others if (other[1][:3, :3] @ own) @ axis < np.cos(np.radians(TURNED))]
    ambiguous = any(other.same > signs.same - CLOSE for other, _ in others)
    if axis is None and not ambiguous and signs.correlation < SURE:
        ambiguous = signs.correlation < UNLIKE or other_sides(old, pose, cuts, up, depth, seen)
    sums = np.sum([cut.colours(old, pose) for cut in cuts], axis=0)
    odds = signs.same + colour_odds(old, alike, sums)
    return Motion(pose, odds, ambiguous, axis)


def round_about(old: Gaussians, motion: Found, cuts: Sequence[Cut], up: np.ndarray, depth: float) -> np.ndarray | None:
    """The axis [3] about which a moved thing looks round, by its points and by the photos: the vertical `up`, or one of
    the main axes of the points; None without."""
    (signs, pose), points = motion, Points.of(old)
    middle = pose[:3, :3] @ np.quantile(points.points, [0.02, 0.98], axis=0).mean(axis=0) + pose[:3, 3]
    main = np.linalg.svd(points.points - points.points.mean(axis=0), full_matrices=False)[2]
    for axis in (pose[:3, :3].T @ up, *main):
        if looks_round(points, axis):
            after = pose[:3, :3] @ axis
            turned = judged(old, [_about(turn, middle) @ pose for turn in turns(after, YAWS)[1:]], cuts, depth)
            if min(each.same for each, _ in turned) > signs.same - PRINT:
                return np.asarray(after)
    return None


def other_sides(
    old: Gaussians, pose: np.ndarray, cuts: Sequence[Cut], up: np.ndarray, depth: float, seen: np.ndarray
) -> bool:
    """Whether after another turn about the vertical photos would show sides of a moved thing that no visit before saw,
    while the other photos do not contradict it. seen: see `look.seen_from`."""
    middle = pose[:3, :3] @ np.median(Points.of(old).points, axis=0) + pose[:3, 3]
    rays = _rays([cut.view for cut in cuts], middle)
    motions = np.stack([_about(turn, middle) @ pose for turn in turns(up, YAWS)])
    sums = np.stack([cut.sums(old, motions, depth) for cut in cuts], axis=1)
    for rows, motion in zip(sums[1:], motions[1:], strict=True):
        known = (rays @ motion[:3, :3] @ seen.T).max(axis=1, initial=-1) > np.cos(np.radians(SIDE))
        own, other = (signs_from(each[known].sum(axis=0), 1.0).same for each in (sums[0], rows))
        if not known.all() and other > own - CLOSE:
            return True
    return False


def _about(rotation: np.ndarray, middle: np.ndarray) -> np.ndarray:
    """[4, 4] of a rotation [3, 3] about a point [3]."""
    return transform(rotation, middle - rotation @ middle)


def judged(old: Gaussians, motions: Sequence[np.ndarray], cuts: Sequence[Cut], depth: float) -> list[Found]:
    """What the photos say about the old thing after each of the motions."""
    sums = np.sum([cut.sums(old, np.stack(motions), depth) for cut in cuts], axis=0)
    return [(signs_from(row, 1.0), motion) for row, motion in zip(sums, motions, strict=True)]


def refined(old: Gaussians, start: Found, cuts: Sequence[Cut], depth: float, step: float, least: float) -> Found:
    """The motion near `start` that the photos support best. In each round parabolas through three values of six steps,
    along and about three axes, give the next motion; steps become shorter where that is near, or no better."""
    from scipy.spatial.transform import Rotation

    points = Points.of(old)
    middle, radius = points.points.mean(axis=0), points.radius
    best = judged(old, [start[1]], cuts, depth)[0]

    def stepped(change: np.ndarray) -> np.ndarray:
        pose = best[1]
        moved = _about(Rotation.from_rotvec(change[3:]).as_matrix(), pose[:3, :3] @ middle + pose[:3, 3]) @ pose
        moved[:3, 3] += radius * change[:3]
        return moved

    while step >= least:
        single = judged(old, [stepped(sign * step * axis) for sign in (1, -1) for axis in np.eye(6)], cuts, depth)
        more, less = np.array([signs.same for signs, _ in single]).reshape(2, 6)
        bend = 2 * best[0].same - more - less
        peak = np.where(bend > 1e-6, (more - less) / np.maximum(2 * bend, 1e-6), np.sign(more - less)).clip(-1, 1)
        found = min([*judged(old, [stepped(step * peak)], cuts, depth), *single], key=_falling)
        gain = found[0].same - best[0].same
        if gain > 0:
            best = found
        if gain < GAINS or np.abs(peak).max() < 0.5:
            step /= SHORTER
    return best


def assigned(odds: np.ndarray) -> list[tuple[int, int]]:
    """Pairs (old, new) of the joint assignment with the largest sum of positive log-odds [O, N]."""
    from scipy.optimize import linear_sum_assignment

    gain = np.maximum(np.where(np.isfinite(odds), odds, 0), 0)
    rows, columns = linear_sum_assignment(-gain)
    return [(int(i), int(j)) for i, j in zip(rows, columns, strict=True) if gain[i, j] > 0]
