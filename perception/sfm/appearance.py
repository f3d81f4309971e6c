"""Whether photos look alike at the points that a model lets both see but that are not matched between them.

Where parts of a scene repeat, e.g. walls, photos of different parts are matched at what repeats and differ elsewhere.
Heinly et al., "Correcting for duplicate scene structure in sparse 3D reconstruction" (ECCV 2014) compare such points.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import permutations, product
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from PIL import Image

SIDE, RADIUS, SHIFTS = 800, 6, (-2.0, 0.0, 2.0)
"""Pixels: long side at which photos are compared, half a patch, displacements in x and y for errors of the poses."""
TEXTURE, CORRELATION = 6.0, 0.6
"""Least standard deviation of a patch in grey values; least normalised cross-correlation of patches that look alike."""
DEGREES, BINS = 45.0, 9
"""Largest angle between the two rays to a point; bins of equal width up to it."""
MOST, PAIRS, LEAST, CLEARLY = 100, 500, 100, 1.4
"""Points compared of two photos; pairs of photos that tell how many are usually alike; points in all that tell
something; ratio that decides. Four photos of right models read 0.8 to 1.3, on the wrong side of a room 0.5."""


@dataclass(frozen=True)
class _Photo:
    gray: np.ndarray
    camera: Any
    pose: np.ndarray

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


def looks_better(now: Any, before: Any, photos: Path, moved: set[int]) -> bool:
    """Whether photos `moved` of a pycolmap model look clearly more like the others than in the model before."""
    others = set(now.reg_image_ids()) & set(before.reg_image_ids()) - moved
    return likeness(now, photos, moved, others) > CLEARLY * likeness(before, photos, moved, others) > 0


def likeness(model: Any, photos: Path, some: set[int], others: set[int]) -> float:
    """How many points look alike in one of `some` and one of `others`, relative to as many of pairs among `others` with
    the same angles between the rays; 0 if too few are compared. Points that one of two photos shows are compared where
    the other should see them and is not matched with them."""
    seen: dict[int, set[int]] = {image: set() for image in sorted(some | others)}
    for number, point in model.points3D.items():
        for element in point.track.elements:
            seen.get(element.image_id, set()).add(number)
    views = {image: _photo(model.images[image], photos) for image in seen}

    def counted(pairs: list[tuple[int, int]]) -> np.ndarray:
        """[2, BINS]: points by angle, and those of them that look alike."""
        found = np.zeros((2, BINS))
        for a, b in pairs:
            xyz = np.array([model.points3D[number].xyz for number in sorted(seen[a] - seen[b])]).reshape(-1, 3)
            degrees, alike = _compared(views[a], views[b], xyz)
            each = np.minimum(degrees * BINS / DEGREES, BINS - 1).astype(int)
            found += [np.bincount(each, minlength=BINS), np.bincount(each, alike, minlength=BINS)]
        return found

    pairs = list(permutations(seen, 2))
    across, within = ([pair for pair in pairs if len(some & set(pair)) == count] for count in (1, 0))
    compared, alike = counted(across)
    usual, usually = counted(within[:: max(1, -(-len(within) // PAIRS))])
    expected = (compared * usually / np.maximum(usual, 1)).sum()
    return float(alike[usual > 0].sum() / expected) if expected and compared.sum() >= LEAST else 0.0


def _photo(image: Any, photos: Path) -> _Photo:
    with Image.open(photos / image.name) as file:
        file.thumbnail((SIDE, SIDE))
        return _Photo(np.asarray(file.convert("L")), image.camera, image.cam_from_world().matrix())


def _compared(a: _Photo, b: _Photo, xyz: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
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
