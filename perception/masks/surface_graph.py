"""A graph of surface patches. Its edges hold the evidence of all photos whether two patches are one object.

All evidence is a sum over pixels, border pixels or voxels, so the evidence of a merged patch is the sum over its parts.
`merge_features` makes the inputs of the networks of these sums.
"""

from __future__ import annotations

import copy

import numpy as np
from scipy.spatial import cKDTree

from perception import _core
from perception.geometry import sums_by
from perception.masks.cues import COLOUR_BINS, DepthCues, PhotoCues
from perception.masks.surface import Surface, position_in

NEIGHBOURS = 8  # nearest voxels that a voxel can touch
PATCH_SCALE, PATCH_VOXELS = 4.0, 12  # k of Felzenszwalb & Huttenlocher; voxels of the smallest patch
LAB_SCALE, NORMAL_SCALE = (14.0, 7.0, 7.0), 0.25  # differences of colour and normal between voxels that count as 1
BORDER_WEIGHT = 2.0  # of a learned border between voxels, in the same unit
STEP = 0.012  # relative to depth: size from which a step lies between two surfaces
LARGEST_STEP = 0.06  # relative to depth: a larger one is no stronger evidence
SHARP = 12.0  # border gradient in Lab units from which it counts as an edge
COPLANAR_TURN, COPLANAR_OFFSET = 0.02, 0.025  # 1 − cosine of two normals; offset of two planes relative to depth
ALIKE = 0.5  # histogram intersection of colours above which coplanar parts that do not touch are joined

# Columns of the sums over a patch's pixels in all photos
PIXELS = 0
LAB = slice(1, 4)
TEXTURE = 4  # logarithm of the photo's gradient
DEPTH = 5
# and over its voxels; coordinates relative to the mean of the surface, their products as in the upper triangle,
VOXELS = 6
NORMAL = slice(7, 10)
POINT = slice(10, 13)
PRODUCTS = slice(13, 19)
# and again over its pixels: number in each colour bin, and log odds that they belong to a thing.
COLOURS = slice(19, 19 + COLOUR_BINS)
THING = COLOURS.stop
# Columns of the sums over the pixels at the border of two patches: their number, gradient of the photo, number with one
# over SHARP, steps up to LARGEST_STEP over it, number with one over STEP, bend towards and away from the camera, and
# log odds of a learned border; last the number of pairs of touching voxels.
LENGTH, EDGE, SHARPS, STEPS, BROKEN, CONCAVE, CONVEX, LEARNED, CONTACT = range(9)
_UPPER = np.triu_indices(3)


def voxel_edges(surface: Surface) -> np.ndarray:
    """[E, 2] int32, a < b: pairs of nearest-neighbour voxels, at most three voxel sides apart."""
    k = min(NEIGHBOURS + 1, len(surface))
    distance, near = cKDTree(surface.points).query(surface.points, k=k, distance_upper_bound=3 * surface.size)
    a = np.repeat(np.arange(len(surface)), k)[np.isfinite(distance).ravel()]
    b = near.ravel()[np.isfinite(distance).ravel()]
    low, high = np.minimum(a, b)[a != b].astype(np.int64), np.maximum(a, b)[a != b]
    unique = np.unique(low * len(surface) + high)
    return np.stack([unique // len(surface), unique % len(surface)], axis=1).astype(np.int32)


def patches(surface: Surface, edges: np.ndarray) -> np.ndarray:
    """[V] int32 patch of each voxel, uniform in colour and normal, without learned borders within (Felzenszwalb &
    Huttenlocher 2004)."""
    a, b = edges[:, 0], edges[:, 1]
    colour = (surface.lab[a] - surface.lab[b]) / np.array(LAB_SCALE, np.float32)
    turn = (surface.normals[a] - surface.normals[b]) / NORMAL_SCALE
    weights = np.sqrt((colour**2).sum(axis=1) + (turn**2).sum(axis=1))
    weights = (weights + BORDER_WEIGHT * np.maximum(surface.border[a], surface.border[b])).astype(np.float32)
    labels = np.empty(len(surface), np.int32)
    _core.felzenszwalb(edges, np.ascontiguousarray(weights), PATCH_SCALE, PATCH_VOXELS, labels)
    return labels


class SurfaceGraph:
    """Patches of touching voxels. sums: [R, THING + 1] of each patch; borders: patch -> neighbour -> [CONTACT + 1] sums
    of the border between them; contacts: [R] touching pairs of voxels at all borders of each; extents: [R, 3], see
    `extents_of`. R: number of patches."""

    def __init__(self, surface: Surface, patch: np.ndarray, edges: np.ndarray) -> None:
        """patch: [V] int, ids 0..R−1, all used; edges: [E, 2] touching voxels."""
        count = int(patch.max()) + 1
        self.surface, self.patch, self.count = surface, patch, count
        local = (surface.points - surface.points.mean(axis=0)).astype(np.float64)
        products = local[:, _UPPER[0]] * local[:, _UPPER[1]]
        maps = [np.ones((len(patch), 1)), surface.normals, local, products]
        self.sums = np.zeros((count, THING + 1))
        self.sums[:, VOXELS : COLOURS.start] = sums_by(patch, np.concatenate(maps, axis=1), count)
        ends = patch[edges]
        ends = np.sort(ends[ends[:, 0] != ends[:, 1]], axis=1).astype(np.int64)
        self._keys, contact = np.unique(ends[:, 0] * count + ends[:, 1], return_counts=True)
        self._border = np.zeros((len(self._keys), CONTACT + 1))
        self._border[:, CONTACT] = contact
        self.borders: list[dict[int, np.ndarray]] = []

    def evidence(
        self, regions: np.ndarray, photo: PhotoCues, depth: DepthCues, learned: np.ndarray
    ) -> tuple[np.ndarray, ...]:
        """The evidence of one photo, to be added. regions: [h, w] patch of each pixel, −1 = none; learned: [3, h, w],
        see `perception.masks.boundaries.boundaries`."""
        inside = regions >= 0
        z = depth.points[..., 2]
        shown, flat = _numbered(regions[inside], self.count)
        maps = [np.ones(len(flat)), *photo.lab[inside].T, photo.texture[inside], z[inside]]
        sums = np.zeros((len(shown), THING + 1))
        sums[:, :VOXELS] = sums_by(flat, np.stack(maps, axis=1), len(shown))
        bins = flat * COLOUR_BINS + photo.colour_bin[inside]
        sums[:, COLOURS] = np.bincount(bins, minlength=len(shown) * COLOUR_BINS).reshape(-1, COLOUR_BINS)
        sums[:, THING] = np.bincount(flat, learned[2][inside], len(shown))
        found = [shown, sums]
        for axis in (0, 1):
            first, second = neighbours(regions, axis)
            cut = (first != second) & (first >= 0) & (second >= 0)
            low, high = np.minimum(first, second)[cut].astype(np.int64), np.maximum(first, second)[cut]
            border = position_in(self._keys, low * self.count + high)
            edge = np.maximum(*neighbours(photo.edge, axis))[cut]
            step, bend, odds = (neighbours(maps[axis], axis)[0][cut] for maps in (depth.step, depth.bend, learned))
            columns = [np.ones(len(edge)), edge, edge > SHARP]
            columns += [np.minimum(step, LARGEST_STEP) / LARGEST_STEP, step > STEP]
            columns += [np.clip(-bend, 0, 1), np.clip(bend, 0, 1), odds]
            touching = border >= 0
            values = np.stack(columns, axis=1)[touching]
            found.append(sums_by(border[touching], values, len(self._keys)))
        return tuple(found)

    def add(self, shown: np.ndarray, sums: np.ndarray, *borders: np.ndarray) -> None:
        """Adds the `evidence` of one photo."""
        self.sums[shown] += sums
        for border in borders:
            self._border[:, :CONTACT] += border

    def link(self) -> None:
        """Builds `borders`. Call it after all photos are added."""
        self.borders = [{} for _ in range(self.count)]
        for key, row in zip(self._keys.tolist(), self._border, strict=True):
            if row[LENGTH] > 0:
                a, b = divmod(key, self.count)
                self.borders[a][b] = self.borders[b][a] = row
        self.contacts = np.array([sum(row[CONTACT] for row in links.values()) for links in self.borders])
        self.extents = extents_of(self.sums / self.sums[:, VOXELS, None])

    def size(self, patch: int) -> float:
        """Number of voxels."""
        return float(self.sums[patch, VOXELS])

    def depth(self, a: int) -> float:
        """Mean depth over the pixels that show the patch."""
        return float(self.sums[a, DEPTH] / max(self.sums[a, PIXELS], 1))

    def area(self, a: int) -> float:
        """Area divided by the squared mean depth (no unit)."""
        return float(self.sums[a, VOXELS] * self.surface.size**2 / max(self.depth(a), 1e-9) ** 2)

    def one_plane(self, a: int, b: int) -> bool:
        """Whether two patches that do not touch are parts of one plane: coplanar, with colours that agree."""
        shapes = self.sums[[a, b]] / self.sums[[a, b], VOXELS, None]
        normals = np.linalg.eigh(covariance(shapes))[1][:, :, 0]
        offset = np.abs(normals @ (shapes[1, POINT] - shapes[0, POINT])).max()
        turned = 1 - abs(float(normals[0] @ normals[1])) > COPLANAR_TURN
        apart = offset > COPLANAR_OFFSET * (self.depth(a) + self.depth(b)) / 2
        colours = (self.sums[i, COLOURS] / max(self.sums[i, PIXELS], 1) for i in (a, b))
        return b not in self.borders[a] and not turned and not apart and bool(np.minimum(*colours).sum() > ALIKE)

    def copy(self) -> SurfaceGraph:
        """A graph that can be merged without changing this one."""
        other = copy.copy(self)
        other.sums, other.contacts, other.extents = self.sums.copy(), self.contacts.copy(), self.extents.copy()
        other.borders = [dict(links) for links in self.borders]  # their rows are never written to
        return other

    def merge(self, a: int, b: int) -> None:
        """Merges patch b into patch a: the sums and borders of b are added to those of a, in place."""
        self.contacts[a] += self.contacts[b] - 2 * self.borders[a].pop(b)[CONTACT]
        self.sums[a] += self.sums[b]
        self.extents[a] = extents_of(self.sums[a : a + 1] / self.sums[a, VOXELS])
        for other, row in self.borders[b].items():
            if other != a:
                del self.borders[other][b]
                total = self.borders[a][other] + row if other in self.borders[a] else row
                self.borders[a][other] = self.borders[other][a] = total
        self.borders[b] = {}


def _numbered(values: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """The distinct of `values` [P], 0 … count − 1, and the number of each value among them [P] int64."""
    present = np.zeros(count, bool)
    present[values] = True
    return np.flatnonzero(present), (np.cumsum(present) - 1)[values]


def neighbours(image: np.ndarray, axis: int) -> tuple[np.ndarray, np.ndarray]:
    """Each pixel and its right (axis 0) or lower (axis 1) neighbour."""
    return (image[:, :-1], image[:, 1:]) if axis == 0 else (image[:-1], image[1:])


def covariance(shape: np.ndarray) -> np.ndarray:
    """[M, 3, 3] covariance of the voxels of each patch, from sums over its voxels divided by their number [M, C]."""
    full = np.zeros((len(shape), 3, 3))
    full[:, _UPPER[0], _UPPER[1]] = full[:, _UPPER[1], _UPPER[0]] = shape[:, PRODUCTS]
    mean = shape[:, POINT]
    return full - mean[:, :, None] * mean[:, None, :]


def extents_of(shape: np.ndarray) -> np.ndarray:
    """[M, 3] standard deviations of the voxels of each patch along its principal axes, ascending. The first is the
    thickness across the patch's plane."""
    return np.sqrt(np.maximum(np.linalg.eigvalsh(covariance(shape)), 0))
