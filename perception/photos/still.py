"""What stays in the picture while the camera moves (a gripper, a bumper, a finger, dirt, a date): found, and masked.

With the gradients ∇ᵢ of N photos, dᵢ = ∇ᵢ / √(|∇ᵢ|² + SOFT²) hardly depends on exposure. In a small window Σ, the mean
of Σ dᵢ·dⱼ over pairs of photos i ≠ j, divided by the mean of Σ|dᵢ|², is 1 where the same edges stand in all photos, and
near 0 where the scene moves. Plain things have no edges: the standard deviation over the photos is low in them, and
rises at once at their outline. Plain parts of a scene have no such outline, as the camera moves them over the picture.
"""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from perception.io.atomic import write_file
from perception.photos.decode import nearest, open_photo, pixels_of, reduced_size
from perception.photos.ignore_masks import read_mask
from perception.progress import Progress

SIDE, SAMPLE = 320, 64
"""Long side in pixels at which photos are compared, and most photos of a camera that are."""
FEWEST, FEWEST_PLAIN = 5, 15
"""Fewest photos between which the camera moved; and for plain things, as parts of a scene stay plain in some photos."""
SOFT = 2.0
"""Gradient in grey levels a pixel that counts half: above noise, below most edges."""
WINDOW, FAINT = 5, 0.05
"""Side of the window in pixels; mean |d|² in it below which it has no edges: noise alone."""
STILL, FEW = 0.6, 1.25
"""Windows above STILL + FEW / N are still. Scenes read below 0.25 with 50 photos, but now and then 0.8 with 5."""
SAME = 0.7, 0.4
"""Correlation of two photos' d above which the camera has not moved between them: of the whole picture, and of what is
not still in it."""
MOST = 0.5
"""With more than this share of the picture or of its edges still, it is the scene: the camera has not moved."""
CORNER = 0.05
"""Least ratio of the eigenvalues of Σ d dᵀ. An edge along which the camera moves stays, too, but has one direction."""
SMALLEST, LARGEST_INSIDE, BORDER = 4e-4, 0.02, 0.1
"""Share of the picture of the smallest region, and of the largest that keeps BORDER × SIDE pixels from the border: in
the middle stands what the camera turns around."""
LOW, HIGH, RISE, ENCLOSED, LEAST_USUAL = 0.2, 0.6, 4, 0.8, 3.0
"""Standard deviation in a plain thing and at its outline, over the median of the picture; pixels in which it rises;
share of the outline at which it does; least median, in grey levels, of a picture that is not plain itself."""
GAP, CLOSED, MARGIN = 0.01, 0.03, 0.02
"""Shares of SIDE: gaps between windows of one region, gaps that are closed in masks, and their margin, in which
features would still be drawn from edges of the mask."""


@dataclass(frozen=True)
class Still:
    """masks: of each photo, None uses all pixels. facts: number of "photos", "share" of their pixels, and "mask", a PNG
    in base64 with the mask of each camera, one below the other; {} where nothing stays."""

    masks: list[Path | None]
    facts: dict[str, Any]

    def added_to(self, report: dict[str, Any]) -> dict[str, Any]:
        """The entries "still" and "notes" of a scene's report with what was found; {} where nothing stays."""
        if not self.facts:
            return {}
        found = f"{self.facts['share']:.1%} of the pixels of {self.facts['photos']} photos"
        note = f"what stays in the picture while the camera moves is ignored: {found}"
        return {"still": self.facts, "notes": [*report.get("notes", []), note]}


def with_still(
    photos: list[Path],
    sizes: list[tuple[int, int]],
    masks: list[Path | None],
    folder: Path | None,
    progress: Progress,
    as_stored: Sequence[bool] | None = None,
) -> Still:
    """The masks of `photos` with what stays in the pictures of each camera, which are those of one folder and size.
    sizes: (width, height) of the photos as they are used. folder: for the new masks, named by their content; None
    uses all as they are. as_stored: of each photo, whether its EXIF rotation is not applied; None: it is."""
    if folder is None:
        return Still(masks, {})
    stored = as_stored or [False] * len(photos)
    cameras: dict[tuple[Path, tuple[int, int]], list[int]] = {}
    for index, (photo, size) in enumerate(zip(photos, sizes, strict=True)):
        cameras.setdefault((photo.parent, size), []).append(index)
    masks, found, count, ignored = list(masks), list[np.ndarray](), 0, 0.0
    for done, ((_, size), members) in enumerate(cameras.items(), start=1):
        progress.update("poses: what stays in the picture", done, len(cameras))
        if len(members) < FEWEST:
            continue
        some = np.unique(np.linspace(0, len(members) - 1, SAMPLE).round().astype(int))
        used = ~still_pixels(np.stack([_small(photos[members[k]], size, stored[members[k]]) for k in some]))
        if used.all():
            continue
        found, count, ignored = [*found, used], count + len(members), ignored + len(members) * float(1 - used.mean())
        for index in members:
            masks[index] = _written(folder, used, masks[index], size)
    if not found:
        return Still(masks, {})
    widest = max(used.shape[1] for used in found)
    shown = np.concatenate([np.pad(used, ((0, 0), (0, widest - used.shape[1]))) for used in found])
    code = base64.b64encode(_png(shown)).decode()
    return Still(masks, {"photos": count, "share": round(ignored / count, 4), "mask": code})


def _small(photo: Path, size: tuple[int, int], as_stored: bool) -> np.ndarray:
    """A photo of `size` as grey [h, w] uint8 with a long side of SIDE pixels; JPEG is decoded at a reduced size."""
    scale = min(1.0, SIDE / max(size))
    width, height = (max(1, round(scale * side)) for side in size)
    with open_photo(photo) as image:
        image.draft("RGB", reduced_size(*image.size, max(1, int(min(image.size) / (2 * SIDE)))))
        picture = pixels_of(image, photo, as_stored)
    return cv2.resize(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY), (width, height), interpolation=cv2.INTER_AREA)


def _png(used: np.ndarray) -> bytes:
    return cv2.imencode(".png", used.astype(np.uint8) * 255)[1].tobytes()


def _written(folder: Path, used: np.ndarray, own: Path | None, size: tuple[int, int]) -> Path:
    """The file of a mask, with the pixels that the mask `own` of the photo ignores."""
    data = _png(used if own is None else nearest(used, *size) & (read_mask(own, *size) > 0))
    path = folder / f"{hashlib.sha256(data).hexdigest()[:16]}.png"
    if not path.is_file():  # its time of change is part of what features are kept by
        folder.mkdir(parents=True, exist_ok=True)
        write_file(path, data)
    return path


def still_pixels(pictures: np.ndarray) -> np.ndarray:
    """Mask [h, w] bool of what stays in all `pictures` [N, h, w] uint8, grey; all False where the camera hardly moved,
    or where it cannot be known (fewer than FEWEST pictures)."""
    directions, kept = np.stack([_directions(picture) for picture in pictures]), np.arange(len(pictures))
    nothing = still = np.zeros(pictures.shape[1:], bool)
    for same in SAME:
        chosen = _moved(directions * ~still[..., None], same)
        directions, kept = directions[chosen], kept[chosen]
        if len(directions) < FEWEST:
            return nothing
        ratio, energy = _agreement(directions)
        textured = energy > FAINT
        still = textured & (ratio > STILL + FEW / len(directions))
        if still.sum() > MOST * textured.sum():
            return nothing
    plain = _plain_things(pictures[kept]) if len(kept) >= FEWEST_PLAIN else nothing
    mask = _whole(still, plain, directions.mean(axis=0))
    return nothing if mask.mean() > MOST else mask


def _plain_things(pictures: np.ndarray) -> np.ndarray:
    """Mask [h, w] of the regions with a low standard deviation over `pictures` [N, h, w] and a sharp outline."""
    quarters = np.quantile(pictures, (0.25, 0.75), axis=0)
    spread = (quarters[1] - quarters[0]) / 1.349  # that of most photos: an edge in a few of them makes no outline
    usual, things = float(np.median(spread)), np.zeros(spread.shape, bool)
    low = pictures.std(axis=0) <= LOW * usual
    low = cv2.morphologyEx(low.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3)))
    near = cv2.dilate(spread, np.ones((2 * RISE + 1, 2 * RISE + 1)))
    if usual < LEAST_USUAL:
        return things
    count, labels = cv2.connectedComponents(low, connectivity=4)
    for number in range(1, count):
        region = labels == number
        outline = cv2.dilate(region.astype(np.uint8), np.ones((3, 3))).astype(bool) & ~region
        if outline.any() and (near[outline] >= HIGH * usual).mean() >= ENCLOSED and _is_thing(region):
            things |= region
    return things


def _directions(picture: np.ndarray) -> np.ndarray:
    """d [h, w, 2] float32 of a picture [h, w]."""
    x, y = (cv2.Sobel(picture, cv2.CV_32F, along, 1 - along, scale=1 / 8) for along in (1, 0))
    return np.stack([x, y], axis=-1) / np.sqrt(x * x + y * y + SOFT**2)[..., None]


def _moved(directions: np.ndarray, same: float) -> list[int]:
    """Numbers of pictures of which no two correlate by more than `same`, the first of each set."""
    flat = directions.reshape(len(directions), -1)
    products = flat @ flat.T
    norm = np.sqrt(np.maximum(np.diag(products), 1e-9))
    kept = list[int]()
    for number, row in enumerate(products / norm / norm[:, None]):
        if not kept or row[kept].max() <= same:
            kept.append(number)
    return kept


def _agreement(directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Σ dᵢ·dⱼ / Σ|d|² [h, w] and mean |d|² [h, w]. The first is the smaller of the means over all pairs, and over pairs
    that are half the sequence apart, between which the camera moved most."""
    count, mean = len(directions), directions.mean(axis=0)
    energy, all_pairs = _window((directions**2).mean(axis=0)), _window(mean**2)
    apart = _window((directions * np.roll(directions, count // 2, axis=0)).mean(axis=0))
    return np.minimum(apart, (count * all_pairs - energy) / (count - 1)) / np.maximum(energy, 1e-9), energy


def _window(values: np.ndarray) -> np.ndarray:
    """Means [h, w] of the sums of values [h, w, 2] in windows."""
    return cv2.blur(values.sum(axis=-1), (WINDOW, WINDOW))


def _whole(still: np.ndarray, plain: np.ndarray, mean: np.ndarray) -> np.ndarray:
    """The mask of still things: `plain` ones, regions of `still` edges that are no line, and small regions that they
    enclose. mean: of d [h, w, 2]."""
    things = plain.copy()
    count, labels = cv2.connectedComponents(_morphed(still, cv2.MORPH_CLOSE, GAP))
    for number in range(1, count):
        region = (labels == number) & still
        small, large = np.linalg.eigvalsh(mean[region].T @ mean[region])
        if small > CORNER * large and _is_thing(region):
            things |= labels == number
    count, labels = cv2.connectedComponents((~things).astype(np.uint8), connectivity=4)
    sizes = np.bincount(labels.ravel()) / still.size
    things |= (sizes <= LARGEST_INSIDE)[labels]
    return _morphed(_morphed(things, cv2.MORPH_CLOSE, CLOSED), cv2.MORPH_DILATE, MARGIN).astype(bool)


def _is_thing(region: np.ndarray) -> bool:
    """Whether a region is large enough, and so small or near the border that it is none of the scene."""
    inner = region[(far := round(BORDER * SIDE)) : -far, far:-far]
    return bool(region.mean() >= SMALLEST and (region.mean() <= LARGEST_INSIDE or inner.sum() < region.sum()))


def _morphed(mask: np.ndarray, operation: int, share: float) -> np.ndarray:
    """The mask after a morphological operation with a disc of radius `share` of SIDE, uint8; what touches the picture's
    border goes on beyond."""
    radius = max(1, round(share * SIDE))
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    around = np.pad(mask.astype(np.uint8), 2 * radius, mode="edge")
    return cv2.morphologyEx(around, operation, disc)[2 * radius : -2 * radius, 2 * radius : -2 * radius]
