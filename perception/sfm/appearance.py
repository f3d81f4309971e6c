"""Whether photos look alike at the points that a model lets both see but that are not matched between them.

Where parts of a scene repeat, e.g. walls, photos of different parts are matched at what repeats and differ elsewhere.
Heinly et al., "Correcting for duplicate scene structure in sparse 3D reconstruction" (ECCV 2014) compare such points.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from itertools import permutations, product
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from PIL import Image
from scipy.spatial import cKDTree

SIDE, RADIUS, SHIFTS = 800, 6, (-2.0, 0.0, 2.0)
"""Pixels: long side at which photos are compared, half a patch, displacements in x and y for errors of the poses."""
TEXTURE, CORRELATION = 6.0, 0.6
"""Least standard deviation of a patch in grey values; least normalised cross-correlation of patches that look alike."""
DEGREES, BINS = 45.0, 9
"""Largest angle between the two rays to a point; bins of equal width up to it."""
APART = 1 / 16
"""Points so near to one that both photos match are not compared: what repeats is matched. Relative to the width."""
MOST, PAIRS = 100, 500
"""Points compared of two photos; pairs of photos in which it is counted how many usually look alike."""
CLEARLY, SURE = 1.4, 3
"""Ratio of two likenesses that decides; points that look alike and more or fewer of which decide nothing."""
Likeness = tuple[float, float]
"""How many of the compared points look alike, and how many usually do at the same angles between the rays."""


@dataclass(frozen=True)
class Photo:
    """gray: at a reduced size. camera: of pycolmap. pose: camera_from_world [3, 4]. points: pixels in full resolution,
    by the id of the point that is matched there."""

    gray: np.ndarray
    camera: Any
    pose: np.ndarray
    points: dict[int, np.ndarray]

    @property
    def center(self) -> np.ndarray:
        return np.asarray(-self.pose[:, :3].T @ self.pose[:, 3])

    def pixels(self, xyz: np.ndarray) -> np.ndarray:
        """Of points [..., 3] in front of the camera, at the size of `gray`."""
        found = np.asarray(self.camera.img_from_cam(xyz.reshape(-1, 3) @ self.pose[:, :3].T + self.pose[:, 3]))
        return found.reshape(*xyz.shape[:-1], 2) * (self.gray.shape[1] / self.camera.width)

    def patches(self, pixels: np.ndarray) -> np.ndarray:
        """Grey values at `pixels` [N, P, 2]."""
        x, y = np.moveaxis(pixels.astype(np.float32) - np.float32(0.5), -1, 0)  # cv2 has centres at integers
        found = cv2.remap(self.gray, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return found.astype(np.float64)


@dataclass(frozen=True)
class Looks:
    """xyz: points of a model by id. photos: by image id."""

    xyz: dict[int, np.ndarray]
    photos: dict[int, Photo]

    @classmethod
    def of(cls, model: Any, root: Path, images: Iterable[int]) -> Looks:
        """Of some photos of a pycolmap model."""
        seen: dict[int, dict[int, np.ndarray]] = {image: {} for image in sorted(images)}
        for number, point in model.points3D.items():
            for element in point.track.elements:
                if element.image_id in seen:
                    seen[element.image_id][number] = model.images[element.image_id].points2D[element.point2D_idx].xy
        photos = {}
        for image, points in seen.items():
            of = model.images[image]
            photos[image] = Photo(loaded(root / of.name), of.camera, of.cam_from_world().matrix(), points)
        return cls({number: point.xyz for number, point in model.points3D.items()}, photos)

    @cached_property
    def usual(self) -> np.ndarray:
        """`counted` of pairs of all photos, at most PAIRS."""
        pairs = list(permutations(self.photos.values(), 2))
        return self.counted(pairs[:: max(1, -(-len(pairs) // PAIRS))])

    def counted(self, pairs: Iterable[tuple[Photo, Photo]]) -> np.ndarray:
        """[2, BINS]: points compared by the angle between the rays, and those of them that look alike."""
        found = np.zeros((2, BINS))
        for a, b in pairs:
            degrees, alike = _compared(a, b, self._unmatched(a, b))
            each = np.minimum(degrees * BINS / DEGREES, BINS - 1).astype(int)
            found += [np.bincount(each, minlength=BINS), np.bincount(each, alike, minlength=BINS)]
        return found

    def likeness(self, some: Iterable[Photo], others: Iterable[int]) -> Likeness:
        """Of the photos `some` beside `others`."""
        beside = [(a, self.photos[b]) for a, b in product(some, others)]
        found = self.counted([*beside, *((b, a) for a, b in beside)])
        expected = found[0] * self.usual[1] / np.maximum(self.usual[0], 1)
        return float(found[1, self.usual[0] > 0].sum()), float(expected.sum())

    def _unmatched(self, a: Photo, b: Photo) -> np.ndarray:
        """The points [N, 3] of a that are not matched in b, nor near those that are."""
        both, only = ([at for at in a.points if (at in b.points) == matched] for matched in (True, False))
        if both and only:
            matched, pixels = (np.array([a.points[at] for at in each]) for each in (both, only))
            far = cKDTree(matched).query(pixels)[0] > APART * a.camera.width
            only = [at for at, apart in zip(only, far, strict=True) if apart]
        return np.array([self.xyz[at] for at in sorted(only)]).reshape(-1, 3)


def looks_better(now: Likeness, before: Likeness) -> bool:
    """Whether the first is clearly better, whatever SURE points look like."""
    return now[0] / (now[1] + SURE) > CLEARLY * (before[0] + SURE) / (before[1] + SURE)


def likeness(model: Any, root: Path, some: set[int], others: set[int]) -> Likeness:
    """Of the photos `some` of a pycolmap model beside `others`: points that one of two photos shows are compared where
    the other should see them, and neither matches them or what is near."""
    return Looks.of(model, root, others).likeness(Looks.of(model, root, some).photos.values(), others)


def loaded(path: Path) -> np.ndarray:
    """Grey values [h, w] of a photo at a reduced size."""
    with Image.open(path) as file:
        file.thumbnail((SIDE, SIDE))
        return np.asarray(file.convert("L"))


def _compared(a: Photo, b: Photo, xyz: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of the points [N, 3] of a, those that b should see: degrees between the rays, whether they look alike."""
    xyz = xyz[(xyz @ b.pose[:, :3].T + b.pose[:, 3])[:, 2] > 0]
    toward = np.stack([xyz - a.center, xyz - b.center])
    distance = np.linalg.norm(toward, axis=2, keepdims=True)
    toward /= distance
    at, height, width = b.pixels(xyz), *b.gray.shape
    margin = 2 * RADIUS
    inside = (at > margin).all(axis=1) & (at < [width - margin, height - margin]).all(axis=1)
    degrees = np.degrees(np.arccos(np.clip((toward[0] * toward[1]).sum(axis=1), -1, 1)))
    kept = np.flatnonzero(inside & (degrees < DEGREES))
    kept = kept[:: max(1, -(-len(kept) // MOST))]
    if len(kept) == 0:
        return np.zeros(0), np.zeros(0, bool)
    # A patch is a square across the mean of the two rays, of pixels of the photo that shows it smaller.
    normal = toward[:, kept].mean(axis=0)
    right = np.cross(a.pose[1, :3], normal)
    axes = np.stack([right, np.cross(normal, right)], axis=1)
    axes /= np.linalg.norm(axes, axis=2, keepdims=True)
    focal = min(each.camera.mean_focal_length() * each.gray.shape[1] / each.camera.width for each in (a, b))
    steps = np.stack(np.meshgrid(*[np.arange(-RADIUS, RADIUS + 1.0)] * 2), axis=-1).reshape(-1, 2)
    points = xyz[kept, None] + distance[:, kept].max(axis=0)[:, None] / focal * (steps @ axes)
    first, second = a.patches(a.pixels(points)), b.pixels(points)
    textured = first.std(axis=1) > TEXTURE
    displaced = (b.patches(second + np.array(shift)) for shift in product(SHIFTS, SHIFTS))
    best = np.max([_correlation(first, each) for each in displaced], axis=0)
    return degrees[kept][textured], best[textured] > CORRELATION


def _correlation(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Normalised cross-correlation of the rows."""
    a, b = (each - each.mean(axis=1, keepdims=True) for each in (a, b))
    return np.asarray((a * b).sum(axis=1) / np.sqrt((a * a).sum(axis=1) * (b * b).sum(axis=1) + 1e-9))
