"""A graph of surface patches. Its edges hold the evidence of all photos whether two patches are one object.

All evidence is a sum over pixels, border pixels or voxels, so the evidence of a merged patch is the sum over its parts.
Convexity of patches follows Stein et al. 2014. The features of the joint shape are our own: two mugs side by side are
longer than either one, the side and the top of a box are not.
"""

from __future__ import annotations

import copy

import numpy as np

from perception import _core
from perception.geometry import sums_by
from perception.masks.cues import COLOUR_BINS, DepthCues, PhotoCues
from perception.masks.surface import Surface

FEATURES = 36
NEIGHBOURS = 8
_STEP = 0.012  # relative to depth: minimum size of a step between surfaces
_STEP_CAP = 0.06
_TURN, _OFFSET = 0.02, 0.025  # coplanar: 1 − cosine of the normals; offset relative to depth
_ALIKE = 0.5  # histogram intersection of colours above which coplanar parts that do not touch are joined
_BORDER = 2.0  # weight of a learned border between voxels, in the unit of their difference
_SHARP = 12.0  # border gradient above which it counts as an edge

# Columns of the sums over a patch's pixels and voxels, then of the sums over border pixels of two patches.
_AREA, _LAB, _TEXTURE, _DEPTH = 0, slice(1, 4), 4, 5
_VOXELS, _NORMAL, _POINT, _SQUARES = 6, slice(7, 10), slice(10, 13), slice(13, 19)
_COLOURS = slice(19, 19 + COLOUR_BINS)
_THING = _COLOURS.stop
_LENGTH, _EDGE, _SHARPS, _STEPS, _BROKEN, _CONCAVE, _CONVEX, _LEARNED, _CONTACT = range(9)
_UPPER = np.triu_indices(3)


def voxel_edges(surface: Surface) -> np.ndarray:
    """[E, 2] int32, a < b: pairs of nearest-neighbour voxels, at most three voxel sides apart."""
    from scipy.spatial import cKDTree

    k = min(NEIGHBOURS + 1, len(surface))
    distance, near = cKDTree(surface.points).query(surface.points, k=k, distance_upper_bound=3 * surface.size)
    a = np.repeat(np.arange(len(surface)), k)[np.isfinite(distance).ravel()]
    b = near.ravel()[np.isfinite(distance).ravel()]
    low, high = np.minimum(a, b)[a != b].astype(np.int64), np.maximum(a, b)[a != b]
    unique = np.unique(low * len(surface) + high)
    return np.stack([unique // len(surface), unique % len(surface)], axis=1).astype(np.int32)


def patches(surface: Surface, edges: np.ndarray, scale: float = 4.0, smallest: int = 12) -> np.ndarray:
    """[V] int32 patch of each voxel, uniform in colour and normal, without learned borders within (Felzenszwalb &
    Huttenlocher 2004)."""
    a, b = edges[:, 0], edges[:, 1]
    colour = (surface.lab[a] - surface.lab[b]) / np.array([14.0, 7.0, 7.0], np.float32)
    turn = (surface.normals[a] - surface.normals[b]) / 0.25
    weights = np.sqrt((colour**2).sum(axis=1) + (turn**2).sum(axis=1))
    weights = (weights + _BORDER * np.maximum(surface.border[a], surface.border[b])).astype(np.float32)
    labels = np.empty(len(surface), np.int32)
    _core.felzenszwalb(edges, np.ascontiguousarray(weights), scale, smallest, labels)
    return labels


class SurfaceGraph:
    """sums: [R, C] per patch; borders: patch -> neighbour -> [B] sums. Neighbours are patches with touching voxels."""

    def __init__(self, surface: Surface, patch: np.ndarray, edges: np.ndarray) -> None:
        """patch: [V] int, ids 0..R−1, all used; edges: [E, 2] touching voxels."""
        count = int(patch.max()) + 1
        self.surface, self.patch, self.count = surface, patch, count
        self.unit = surface.size**2
        self._scale = surface.size
        local = (surface.points - surface.points.mean(axis=0)).astype(np.float64)
        squares = np.stack([local[:, i] * local[:, j] for i, j in zip(*_UPPER, strict=True)], axis=1)
        maps = [np.ones((len(patch), 1)), surface.normals, local, squares]
        self.sums = np.zeros((count, _THING + 1))
        self.sums[:, _VOXELS : _COLOURS.start] = sums_by(patch, np.concatenate(maps, axis=1), count)
        ends = patch[edges]
        ends = np.sort(ends[ends[:, 0] != ends[:, 1]], axis=1).astype(np.int64)
        self._keys, contact = np.unique(ends[:, 0] * count + ends[:, 1], return_counts=True)
        self._border = np.zeros((len(self._keys), _CONTACT + 1))
        self._border[:, _CONTACT] = contact
        self.borders: list[dict[int, np.ndarray]] = []

    def add(self, regions: np.ndarray, photo: PhotoCues, depth: DepthCues, learned: np.ndarray) -> None:
        """Adds the evidence of one photo. regions: [h, w] patch of each pixel, −1 = none; learned: [3, h, w], see
        `perception.masks.boundaries.boundaries`."""
        inside = regions >= 0
        flat = regions[inside]
        z = depth.points[..., 2]
        maps = [np.ones(len(flat)), *photo.lab[inside].T, photo.texture[inside], z[inside]]
        self.sums[:, :_VOXELS] += sums_by(flat, np.stack(maps, axis=1), self.count)
        words = flat.astype(np.int64) * COLOUR_BINS + photo.colour_bin[inside]
        words = np.bincount(words, minlength=self.count * COLOUR_BINS)
        self.sums[:, _COLOURS] += words.reshape(self.count, COLOUR_BINS)
        self.sums[:, _THING] += np.bincount(flat, learned[2][inside], self.count)
        for axis in (0, 1):
            first, second = neighbours(regions, axis)
            cut = (first != second) & (first >= 0) & (second >= 0)
            low, high = np.minimum(first, second)[cut].astype(np.int64), np.maximum(first, second)[cut]
            keys = low * self.count + high
            place = np.minimum(np.searchsorted(self._keys, keys), len(self._keys) - 1)
            edge = np.maximum(*neighbours(photo.edge, axis))[cut]
            step, bend, odds = (neighbours(maps[axis], axis)[0][cut] for maps in (depth.step, depth.bend, learned))
            columns = [np.ones(len(edge)), edge, edge > _SHARP, np.minimum(step, _STEP_CAP) / _STEP_CAP, step > _STEP]
            columns += [np.clip(-bend, 0, 1), np.clip(bend, 0, 1), odds]
            touching = self._keys[place] == keys
            values = np.stack(columns, axis=1)[touching]
            self._border[:, :_CONTACT] += sums_by(place[touching], values, len(self._keys))

    def link(self) -> None:
        """Builds `borders`. Call it after all photos are added."""
        self.borders = [{} for _ in range(self.count)]
        for key, row in zip(self._keys.tolist(), self._border, strict=True):
            if row[_LENGTH] > 0:
                a, b = divmod(key, self.count)
                self.borders[a][b] = self.borders[b][a] = row
        self.contacts = np.array([sum(row[_CONTACT] for row in links.values()) for links in self.borders])
        self.extents = _extents(self.sums / self.sums[:, _VOXELS, None])

    def size(self, patch: int) -> float:
        """Number of voxels."""
        return float(self.sums[patch, _VOXELS])

    def features(self, pairs: np.ndarray) -> np.ndarray:
        """Features [M, FEATURES] for the decision whether the two patches of each pair [M, 2] are one object."""
        border = np.stack([self.borders[a][b] for a, b in pairs.tolist()])
        length = border[:, _LENGTH]
        one, two = self.sums[pairs[:, 0]], self.sums[pairs[:, 1]]
        look_a, look_b = (sums / np.maximum(sums[:, _AREA, None], 1) for sums in (one, two))
        shape_a, shape_b = (sums / sums[:, _VOXELS, None] for sums in (one, two))
        depth = (one[:, _DEPTH] + two[:, _DEPTH]) / np.maximum(one[:, _AREA] + two[:, _AREA], 1)
        depth = np.maximum(depth, 1e-9)
        colour = (look_b[:, _LAB] - look_a[:, _LAB]) ** 2 @ np.array([0.5, 2.0, 2.0])
        size = one[:, _VOXELS], two[:, _VOXELS]
        smaller, larger = (f(*size) * self.unit / depth**2 for f in (np.minimum, np.maximum))
        turn, offset, concave, convex, same_plane = _surface_features(shape_a, shape_b, depth)
        a_is_larger = size[0] > size[1]
        extents = self.extents[pairs[:, 0]], self.extents[pairs[:, 1]]
        flat = [np.exp(-extent[:, 0] / (0.01 * depth)) for extent in extents]
        flat_of_larger = np.where(a_is_larger, *flat)
        sharp, broken = border[:, _SHARPS] / length, border[:, _BROKEN] / length
        crease = border[:, _CONCAVE] / length
        grand = np.log(larger) + 2
        return np.stack(
            [
                np.log1p(border[:, _EDGE] / length),
                sharp,
                np.log1p(np.sqrt(colour)),
                1 - np.minimum(look_a[:, _COLOURS], look_b[:, _COLOURS]).sum(axis=1),
                np.abs(look_a[:, _TEXTURE] - look_b[:, _TEXTURE]),
                np.minimum(look_a[:, _TEXTURE], look_b[:, _TEXTURE]),
                np.log(smaller) + 6,
                grand,
                border[:, _CONTACT] / self.contacts[pairs].min(axis=1),
                np.log(border[:, _CONTACT] * self._scale / depth) + 2,
                border[:, _STEPS] / length,
                broken,
                crease,
                border[:, _CONVEX] / length,
                turn,
                offset,
                concave,
                convex,
                same_plane,
                crease * flat_of_larger,
                concave * flat_of_larger,
                same_plane * sharp,
                flat_of_larger * (1 - same_plane),
                *_growth_features(one, two, extents, a_is_larger, depth, self._scale / 4),
                border[:, _LEARNED] / length,
                np.abs(look_a[:, _THING] - look_b[:, _THING]),
            ],
            axis=1,
        )

    def region_features(self, a: int, sibling: int | None) -> np.ndarray:
        """[19] features for the decision whether `a` is a whole object: area and extents, all its borders together,
        texture and variety of colour, and size and contact of the neighbour that it would be merged with next."""
        sums, links = self.sums[a], self.borders[a]
        voxels, pixels, depth = sums[_VOXELS], max(sums[_AREA], 1), max(self.depth(a), 1e-9)
        border = sum(links.values(), np.zeros(_CONTACT + 1))
        length = max(border[_LENGTH], 1)
        colours = sums[_COLOURS] / pixels
        extents = np.maximum(self.extents[a] / depth, 1e-3)
        beside = [0.0, 0.0]
        if sibling is not None:
            other = self.size(sibling)
            beside = [np.log(other / voxels), np.log1p(links[sibling][_CONTACT]) - np.log(min(other, voxels)) / 2]
        return np.array(
            [
                np.log(max(self.area(a), 1e-7)),
                *np.log(extents),
                *border[_EDGE:_CONTACT] / length,
                np.log1p(border[_CONTACT]) - np.log(voxels) / 2,
                len(links),
                sums[_TEXTURE] / pixels,
                sums[_THING] / pixels,
                -(colours * np.log(colours + 1e-9)).sum(),
                *beside,
                np.log(pixels / voxels),
            ]
        )

    def depth(self, a: int) -> float:
        """Mean depth over the pixels that show the patch."""
        return float(self.sums[a, _DEPTH] / max(self.sums[a, _AREA], 1))

    def area(self, a: int) -> float:
        """Area divided by the squared mean depth (no unit)."""
        return float(self.sums[a, _VOXELS] * self.unit / max(self.depth(a), 1e-9) ** 2)

    def one_plane(self, a: int, b: int) -> bool:
        """Whether two patches that do not touch are parts of one plane: coplanar, with colours that agree."""
        shapes = (self.sums[[i]] / self.sums[i, _VOXELS] for i in (a, b))
        (point_a, normal_a), (point_b, normal_b) = (
            (s[0, _POINT], np.linalg.eigh(_covariance(s)[0])[1][:, 0]) for s in shapes
        )
        offset = max(abs(float((point_b - point_a) @ normal)) for normal in (normal_a, normal_b))
        turned = 1 - abs(float(normal_a @ normal_b)) > _TURN or offset > _OFFSET * (self.depth(a) + self.depth(b)) / 2
        words = (self.sums[i, _COLOURS] / max(self.sums[i, _AREA], 1) for i in (a, b))
        return b not in self.borders[a] and not turned and bool(np.minimum(*words).sum() > _ALIKE)

    def copy(self) -> SurfaceGraph:
        """A graph that can be merged without changing this one."""
        other = copy.copy(self)
        other.sums, other.contacts, other.extents = self.sums.copy(), self.contacts.copy(), self.extents.copy()
        other.borders = [dict(links) for links in self.borders]  # their rows are never written to
        return other

    def merge(self, a: int, b: int) -> None:
        """Merges patch b into patch a: the sums and borders of b are added to those of a, in place."""
        self.contacts[a] += self.contacts[b] - 2 * self.borders[a].pop(b)[_CONTACT]
        self.sums[a] += self.sums[b]
        self.extents[a] = _extents(self.sums[a : a + 1] / self.sums[a, _VOXELS])
        for other, row in self.borders[b].items():
            if other != a:
                del self.borders[other][b]
                total = self.borders[a][other] + row if other in self.borders[a] else row
                self.borders[a][other] = self.borders[other][a] = total
        self.borders[b] = {}


def neighbours(image: np.ndarray, axis: int) -> tuple[np.ndarray, np.ndarray]:
    """Each pixel and its right (axis 0) or lower (axis 1) neighbour."""
    return (image[:, :-1], image[:, 1:]) if axis == 0 else (image[:-1], image[1:])


def _surface_features(shape_a: np.ndarray, shape_b: np.ndarray, depth: np.ndarray) -> list[np.ndarray]:
    """Geometric relation of two patches. Each is approximated by a plane through its mean point."""
    normals = (shape[:, _NORMAL] for shape in (shape_a, shape_b))
    normal_a, normal_b = (n / (np.linalg.norm(n, axis=1, keepdims=True) + 1e-9) for n in normals)
    chord = shape_b[:, _POINT] - shape_a[:, _POINT]
    turn = np.minimum(1 - (normal_b * normal_a).sum(axis=1), 1.0)
    offset = np.maximum(*(np.abs((chord * normal).sum(axis=1)) for normal in (normal_a, normal_b))) / depth
    bend = ((normal_b - normal_a) * chord).sum(axis=1) / (np.linalg.norm(chord, axis=1) + 1e-9)
    same_plane = np.exp(-offset / 0.01 - turn / 0.05)
    return [turn, 5 * np.minimum(offset, 0.2), np.maximum(-bend, 0), np.maximum(bend, 0), same_plane]


def _growth_features(
    one: np.ndarray,
    two: np.ndarray,
    extents: tuple[np.ndarray, np.ndarray],
    one_is_larger: np.ndarray,
    depth: np.ndarray,
    least: float,
) -> np.ndarray:
    """[11, M] relation of the extents of the union of two patches to their own extents (see `_extents`).

    Distance of the patches in units of both extents along it. For each axis: extent of the union over that of the
    larger patch; extents of the larger and of the smaller patch over the depth. Volume of the union over both. All but
    the first are logarithms. one, two: [M, C] sums of the patches; extents: [M, 3] of each. least: lower limit of an
    extent, so that logarithms are finite.
    """
    shape_a, shape_b, union = (sums / sums[:, _VOXELS, None] for sums in (one, two, one + two))
    chord = shape_b[:, _POINT] - shape_a[:, _POINT]
    distance = np.maximum(np.linalg.norm(chord, axis=1), least)
    chord = chord / distance[:, None]
    along = np.zeros(len(two))
    for shape in (shape_a, shape_b):
        along += np.sqrt(np.maximum(np.einsum("mi,mij,mj->m", chord, _covariance(shape), chord), least**2))
    a, b, whole = (np.maximum(extent, least) for extent in (*extents, _extents(union)))
    larger, smaller = (np.where(choice[:, None], a, b) for choice in (one_is_larger, ~one_is_larger))
    volume = np.log(whole.prod(axis=1) / (a.prod(axis=1) + b.prod(axis=1)))
    logs = [np.log(whole / larger), np.log(larger / depth[:, None]), np.log(smaller / depth[:, None])]
    return np.concatenate([(distance / along)[None], *(log.T for log in logs), volume[None]])


def _covariance(shape: np.ndarray) -> np.ndarray:
    """[M, 3, 3] covariance of the voxels of each patch, from mean points and squares [M, C]."""
    full = np.zeros((len(shape), 3, 3))
    full[:, _UPPER[0], _UPPER[1]] = full[:, _UPPER[1], _UPPER[0]] = shape[:, _SQUARES]
    mean = shape[:, _POINT]
    return full - mean[:, :, None] * mean[:, None, :]


def _extents(shape: np.ndarray) -> np.ndarray:
    """[M, 3] standard deviations of the voxels of each patch along its principal axes, ascending. The first is the
    thickness across the patch's plane."""
    return np.sqrt(np.maximum(np.linalg.eigvalsh(_covariance(shape)), 0))
