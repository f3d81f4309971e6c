"""`Localiser`: poses of new photos in the frame of a map, from features and, where there is some, measured depth.

A photo alone: the map's photos that look most like it, matches of their features, pose by RANSAC and checks
(`pose.find_pose`). Then all new photos together with the map's cameras held (`joint.adjusted`); a photo that only
overlaps other new photos is reached through them.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from perception.errors import InputError
from perception.geometry import transform
from perception.localise.evidence import doubt
from perception.localise.joint import Adjustment, adjusted, contradicted
from perception.localise.keypoints import described, tolerance
from perception.localise.lenses import OTHER, OWN, lens_of, median, moved
from perception.localise.pose import KNOWN, MIN_INLIERS, Matched, cropped, find_pose
from perception.localise.reference import Locate, Reference, open_reference
from perception.map.map import Map
from perception.photos.decode import photo_size, why_left_out
from perception.photos.still import with_still
from perception.photos.view_json import locate_photo
from perception.photos.views import make_view, view_lens
from perception.progress import QUIET, Progress
from perception.sfm.database import build_features
from perception.sfm.options import ReadOptions
from perception.sfm.tracks import features_of
from perception.types import DepthImage, Lens, View

ALIKE, MORE = 10, 60
"""Photos of the map that a new photo is matched with: the most alike, and if they give no pose, so many more."""
LENS_STEPS, LENS_STEP = 10, 0.1
"""Most steps of the lens of a cropped photo, each with a new pose; pixels of the last one that counts."""
OTHER_UNIT = 1.5
"""Measured depth is scaled if it differs from that of the map's points by this factor: it has another unit."""


@dataclass(frozen=True)
class NewPhoto:
    """A photo to be localised. lens: None if not known. depth: scale in the map's unit. mask: of pixels to ignore (see
    `ignore_masks`). as_stored: its EXIF rotation is not applied."""

    name: str
    photo: Path
    lens: Lens | None = None
    depth: DepthImage | None = None
    mask: Path | None = None
    as_stored: bool = False


@dataclass(frozen=True)
class Localised:
    """A photo's pose: camera_from_map [4, 4] float64, OpenCV axes, in the map's frame and unit. lens: known, or as
    estimated. covariance [6, 6]: of the rotation vector about the map's axes (radians), then of the position. inliers:
    features that agree with the pose; rms_px: their error in pixels. mask: of the pixels that were used. depth: its
    scale in the map's unit."""

    name: str
    photo: Path
    lens: Lens
    camera_from_map: np.ndarray
    covariance: np.ndarray
    inliers: int
    rms_px: float
    mask: Path | None = None
    depth: DepthImage | None = None

    @property
    def position(self) -> np.ndarray:
        """[3] of the camera in the map's frame."""
        return np.asarray(-self.camera_from_map[:3, :3].T @ self.camera_from_map[:3, 3])

    @property
    def standard_error(self) -> tuple[float, float]:
        """Of the position in the map's unit, and of the direction in degrees: roots of the sums of the variances."""
        turn, shift = np.trace(self.covariance[:3, :3]), np.trace(self.covariance[3:, 3:])
        return float(np.sqrt(shift)), float(np.degrees(np.sqrt(turn)))


@dataclass(frozen=True)
class NotHere:
    """A photo without a pose, and why, one line."""

    name: str
    photo: Path
    why: str


class Localiser:
    """Holds the features of a map's photos in memory; each call then takes well under a second for a photo.

    photos: a folder where the map's photos are looked for beside where the map records them. locate: another rule for
    that (see `reference.Locate`). Pictures that are not at hand are rendered from the map; `rendered` names them. The
    same photos in one call give the same poses, bit for bit.
    """

    def __init__(
        self, gmap: Map, photos: Path | None = None, progress: Progress = QUIET, locate: Locate | None = None
    ) -> None:
        self._progress = progress
        self._reference = open_reference(gmap, locate or _finder(gmap, photos), progress)

    @property
    def rendered(self) -> list[str]:
        """Names of the map's views whose photos were not at hand."""
        return self._reference.rendered

    def localise(
        self,
        photos: Sequence[Path],
        lens: Lens | Sequence[Lens | None] | None = None,
        depths: Sequence[DepthImage | None] | None = None,
    ) -> list[Localised | None]:
        """The pose of each photo; None for one that is not in the map. lens: of all photos, or of each; depths: of each
        (scale in the map's unit). InputError for a photo that cannot be read."""
        for photo in photos:
            why_left_out(photo, strict=True)
        lenses = [lens] * len(photos) if lens is None or isinstance(lens, Lens) else lens
        each = zip(photos, lenses, depths or [None] * len(photos), strict=True)
        new = [NewPhoto(photo.name, photo, own, depth) for photo, own, depth in each]
        with TemporaryDirectory(prefix="perception-localise-") as still:
            found = self.answers(new, Path(still))
        return [replace(answer, mask=None) if isinstance(answer, Localised) else None for answer in found]

    def answers(self, photos: Sequence[NewPhoto], still: Path | None = None) -> list[Localised | NotHere]:
        """As `localise`, with the reason for each photo that has no pose; one that cannot be read is among these.
        still: a folder for masks of what stays in the picture while the camera moves; None uses it as all else."""
        unread = {n: why for n, p in enumerate(photos) if (why := why_left_out(p.photo)) is not None}
        chosen = [photo for n, photo in enumerate(photos) if n not in unread]
        paths, own = [photo.photo for photo in chosen], [photo.mask for photo in chosen]
        stored = [photo.as_stored for photo in chosen]
        sizes = [photo_size(photo.photo, photo.as_stored) for photo in chosen]
        masked = with_still(paths, sizes, own, still, self._progress, stored)
        for note in masked.added_to({}).get("notes", []):
            self._progress.log(note)
        chosen = [replace(photo, mask=mask) for photo, mask in zip(chosen, masked.masks, strict=True)]
        with TemporaryDirectory(prefix="perception-localise-") as folder:
            found = iter(_Search(self._reference, chosen, Path(folder), self._progress).run() if chosen else [])
        return [NotHere(p.name, p.photo, unread[n]) if n in unread else next(found) for n, p in enumerate(photos)]


class _Search:
    """One call: some photos, all readable. folder: for their features."""

    def __init__(self, reference: Reference, photos: list[NewPhoto], folder: Path, progress: Progress) -> None:
        self.reference, self.photos, self.progress = reference, photos, progress
        lenses, self.trust = zip(*(lens_of(photo.photo, photo.lens, reference.views) for photo in photos), strict=True)
        paths, options = [photo.photo for photo in photos], ReadOptions(folder, progress=progress)
        masks, stored = [photo.mask for photo in photos], [photo.as_stored for photo in photos]
        self.store = build_features(paths, list(lenses), options, masks, as_stored=stored)
        self._see(lenses)
        self.most = tolerance(max(max(view.photo_size) for view in self.views))
        self.placed: dict[int, np.ndarray] = {}
        self.links: dict[int, np.ndarray] = {}
        self.lenses: dict[int, Lens] = {}
        self.cropped = set[int]()
        self.changed: dict[int, np.ndarray] = {}
        self.why: dict[int, str] = {}
        self.dropped = Counter[int]()

    def _see(self, lenses: Sequence[Lens]) -> None:
        """Reads the features as seen through a lens for each photo."""
        self.views = [_view(photo, lens) for photo, lens in zip(self.photos, lenses, strict=True)]
        self.new = described(features_of(self.views, self.store), self.store)

    def run(self) -> list[Localised | NotHere]:
        """The answer for each photo."""
        candidates = {}
        for number in range(len(self.photos)):
            candidates[number] = self._alone(number)
            self.progress.update("localise: photos", number + 1, len(self.photos))
        self._share_lenses(candidates)
        self._use_one_unit()
        found = self._together(candidates)
        for _ in range(LENS_STEPS):
            if found is None or not self._refine_lenses(found):
                break
            found = self._together(candidates)
        covariances = {} if found is None else found.covariances(self._lens_errors())
        return [self._answer(number, found, covariances) for number in range(len(self.photos))]

    def _together(self, candidates: dict[int, np.ndarray]) -> Adjustment | None:
        """Refines all poses at once, drops what is contradicted, and reaches what only new photos see."""
        found = None
        while self.placed:
            found = adjusted(self.reference, self.new, self.placed, self._all_links(), self.most)
            self._take(found)
            wrong = contradicted(self.reference, self.new, found, set(self.placed), self.most)
            if wrong is not None:
                self._drop(wrong, "its matches with the other new photos contradict its pose")
            elif not self._reach(found, candidates):
                break
        return found

    def _refine_lenses(self, found: Adjustment) -> bool:
        """A step of the lenses of cropped photos; whether one changed much. On a flat thing features leave so much of a
        lens open that it stays as matches told it first, if they did not tell of another centre."""
        lenses, count = [view_lens(view) for view in self.views], len(self.reference.views)
        poses, changed, most = dict(self.placed), dict(self.changed), 0.0
        errors = {number: error for number, error in self._lens_errors().items() if number in self.cropped}
        for number, (step, turn) in found.lens_steps(errors, self.changed).items():
            changed[number] = self.changed.get(number, np.zeros(3)) + step
            lenses[number] = moved(lenses[number], *step)
            poses[number] = found.poses.at(count + number).turned(turn[None]).matrices()[0]
            most = max(most, *abs(step * (max(self.views[number].photo_size), 1, 1)))
        if most < LENS_STEP:
            return False
        self.placed, self.changed = poses, changed
        self._see(lenses)
        return True

    def _lens_errors(self) -> dict[int, tuple[float, float]]:
        """Of the placed photos whose lens was not given, by number: see `Adjustment.covariances`."""
        sizes = {view.photo_size for view in self.reference.views}
        errors = {}
        for number in sorted(number for number in self.placed if self.photos[number].lens is None):
            size = self.views[number].photo_size
            focal, centre = OWN if size in sizes else OTHER
            errors[number] = focal, centre * max(size)
        return errors

    def _share_lenses(self, candidates: dict[int, np.ndarray]) -> None:
        """Photos with one assumed lens were taken by one camera: all get the median of the estimates. A photo that was
        cropped keeps its own: others are cropped elsewhere."""
        shared, lenses = dict[Lens, list[Lens]](), [view_lens(view) for view in self.views]
        known, own = [trust == KNOWN for trust in self.trust], dict[int, Lens]()
        for number in sorted(number for number in self.placed if not known[number]):
            if cropped(lenses[number], self.lenses[number]):
                own[number] = self.lenses[number]
            else:
                shared.setdefault(lenses[number], []).append(self.lenses[number])
        self.cropped = set(own)
        chosen = {lens: median(found) for lens, found in shared.items()}
        if not own and all(lens == found for lens, found in chosen.items()):
            return
        others = [lens if sure else chosen.get(lens, lens) for lens, sure in zip(lenses, known, strict=True)]
        self._see([own.get(number, lens) for number, lens in enumerate(others)])
        self.trust = (KNOWN,) * len(lenses)
        self.placed.clear()
        self.links.clear()
        for number, matches in candidates.items():
            self._try(number, matches, self.reference.points[self.reference.point[matches[:, 1]]])

    def _use_one_unit(self) -> None:
        """Scales measured depth to the map's unit, if by the map's points it has another."""
        links = self._all_links()
        depth, view = self.new.features.depth[links[:, 0]], self.new.features.view[links[:, 0]]
        rows = np.stack([self.placed.get(n, np.eye(4))[2] for n in range(len(self.photos))])[view]
        points = self.reference.points[self.reference.point[links[:, 1]]]
        z, known = (rows[:, :3] * points).sum(axis=1) + rows[:, 3], depth > 0
        ratio = float(np.median(z[known] / depth[known])) if known.any() else 1.0
        if not 1 / OTHER_UNIT < ratio < OTHER_UNIT:
            scaled = replace(self.new.features, depth=self.new.features.depth * max(ratio, 0.0))
            self.new = replace(self.new, features=scaled)
            self.photos = [replace(photo, depth=_in_unit(photo.depth, ratio)) for photo in self.photos]

    def _alone(self, number: int) -> np.ndarray:
        """Places a photo by the map's photos alone; its matches [M, 2] with features of the map that have a point."""
        reference = self.reference
        order = np.argsort(-self.new.votes(number, reference.described), kind="stable")
        matches = np.empty((0, 2), np.int64)
        for some in (order[:ALIKE], order[ALIKE : ALIKE + MORE]):
            more = [self.new.matches(number, reference.described, view) for view in some.tolist()]
            matches = np.concatenate([matches, *more])
            matches = matches[reference.point[matches[:, 1]] >= 0]
            self._try(number, matches, reference.points[reference.point[matches[:, 1]]])
            if number in self.placed:
                break
        return matches

    def _try(self, number: int, matches: np.ndarray, points: np.ndarray, others: int = 0) -> None:
        """Places a photo by matches [M, 2] with points [M, 3]; the last `others` are of other new photos."""
        matched = Matched(matches[:, 0], self.new.pixels[matches[:, 0]], points)
        checked = partial(doubt, self.reference, matched)
        found = find_pose(matched, view_lens(self.views[number]), self.trust[number], checked)
        if isinstance(found, str):
            self.why[number] = found
            return
        self.placed[number], self.lenses[number] = found.camera_from_map, found.lens
        mine = matches[: len(matches) - others]
        self.links[number] = mine[found.inliers[: len(mine)]]

    def _reach(self, found: Adjustment, candidates: dict[int, np.ndarray]) -> bool:
        """Tries the photos without a pose again, with the points of the new photos as well; whether one was placed.
        A photo that lost its pose twice is not tried again."""
        before, pairs = set(self.placed), self.new.features.pairs
        both = np.concatenate([pairs, pairs[:, ::-1]])
        both = both[found.point[both[:, 1]] >= 0]
        for number in sorted(set(range(len(self.photos))) - before):
            through = both[self.new.features.view[both[:, 0]] == number]
            if not len(through) or self.dropped[number] >= 2:
                continue
            own = candidates[number]
            points = [self.reference.points[self.reference.point[own[:, 1]]], found.points[found.point[through[:, 1]]]]
            self._try(number, np.concatenate([own, through]), np.concatenate(points), others=len(through))
        return len(self.placed) > len(before)

    def _take(self, found: Adjustment) -> None:
        """Takes over refined poses; photos that kept too few features lose theirs."""
        count = len(self.reference.views)
        for number in list(self.placed):
            if found.inliers.get(number, 0) < MIN_INLIERS:
                self._drop(number, f"{found.inliers.get(number, 0)} features agree with its refined pose")
                continue
            rotation, centre = found.poses.rotation[count + number], found.poses.center[count + number]
            self.placed[number] = transform(rotation, -rotation @ centre)

    def _drop(self, number: int, why: str) -> None:
        del self.placed[number], self.links[number]
        self.dropped[number] += 1
        self.why[number] = why

    def _all_links(self) -> np.ndarray:
        return np.concatenate([np.empty((0, 2), np.int64), *(self.links[n] for n in sorted(self.links))])

    def _answer(self, number: int, found: Adjustment | None, covariances: dict[int, np.ndarray]) -> Localised | NotHere:
        photo = self.photos[number]
        if number not in self.placed or found is None:
            return NotHere(photo.name, photo.photo, f"not in this map: {self.why[number]}")
        lens, pose = view_lens(self.views[number]), self.placed[number]
        figures = covariances[number], found.inliers[number], found.rms[number]
        return Localised(photo.name, photo.photo, lens, pose, *figures, photo.mask, photo.depth)


def _in_unit(depth: DepthImage | None, factor: float) -> DepthImage | None:
    """A depth image in another unit, `factor` of which are one of its own; None without a unit that it can have."""
    return None if depth is None or factor <= 0 else replace(depth, scale=factor * depth.scale)


def _view(photo: NewPhoto, lens: Lens) -> View:
    view = make_view(photo.name, photo.photo, lens, np.eye(4), photo.photo)
    return replace(view, depth=photo.depth, mask=photo.mask, as_stored=photo.as_stored)


def _finder(gmap: Map, folder: Path | None) -> Locate:
    """Photos where the map records them, else in `folder` by the view's name or the file's, of the recorded size."""

    def locate(view: View) -> View:
        try:
            return replace(view, photo=locate_photo(view, gmap.path))
        except InputError:
            names = (view.name, getattr(view, "photo_name", view.name), Path(view.name).name)
            for file in [] if folder is None else [folder / name for name in names]:
                with suppress(InputError):
                    return replace(view, photo=locate_photo(replace(view, photo=file), None))
            raise

    return locate
