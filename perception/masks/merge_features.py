"""What the networks of the built-in masks see: features of a pair of neighbouring patches, and of one region.

Both are ratios and logarithms of the sums of a `SurfaceGraph`, without a unit. Lengths are divided by the mean depth,
which is about as far away as the cameras were. Convexity follows Stein et al. 2014. The features of the joint shape are
our own: two mugs side by side are longer than either one, the side and the top of a box are not.
"""

from __future__ import annotations

import numpy as np

from perception.masks.surface_graph import (
    BROKEN,
    COLOURS,
    CONCAVE,
    CONTACT,
    CONVEX,
    DEPTH,
    EDGE,
    LAB,
    LEARNED,
    LENGTH,
    NORMAL,
    PIXELS,
    POINT,
    SHARPS,
    STEPS,
    TEXTURE,
    THING,
    VOXELS,
    SurfaceGraph,
    covariance,
    extents_of,
)  # fmt: skip

PAIR_FEATURES = (
    "edge", "sharp", "colour", "histogram", "texture_difference", "texture", "smaller_area", "larger_area",
    "contact_share", "contact", "step", "broken", "concave_border", "convex_border",
    "turn", "offset", "concave", "convex", "same_plane",
    "crease_of_flat", "concave_of_flat", "edge_in_plane", "flat_out_of_plane",
    "distance", "thickness_growth", "width_growth", "length_growth", "larger_thickness", "larger_width",
    "larger_length", "smaller_thickness", "smaller_width", "smaller_length", "volume_growth",
    "learned", "thing_difference",
)  # fmt: skip
"""Columns of `pair_features`, in the order of the trained weights; the code says what each is."""

REGION_FEATURES = (
    "area", "thickness", "width", "length", "edge", "sharp", "step", "broken", "concave", "convex", "learned",
    "contact", "neighbours", "texture", "thing", "colours", "next_size", "next_contact", "pixels",
)  # fmt: skip
"""Columns of `region_features`, in the order of the trained weights."""

_LIGHTNESS, _HUE = 0.5, 2.0  # weights of squared differences in L, and in a and b: light and shade change L
_FLAT = 0.01  # relative to depth: thickness at which a patch counts as flat by 1 / e
_PLANE_OFFSET, _PLANE_TURN = 0.01, 0.05  # offset relative to depth, 1 − cosine: two planes count as one by 1 / e
_FAR = 0.2  # relative to depth: planes farther apart are equally unlike
_LEAST_EXTENT = 0.25  # voxel sides: lower limit of extents of pairs, so that their logarithms are finite


def pair_features(graph: SurfaceGraph, pairs: np.ndarray) -> np.ndarray:
    """[M, 36] for the decision whether the two patches of each of pairs [M, 2] are one object."""
    border = np.stack([graph.borders[a][b] for a, b in pairs.tolist()])
    length = border[:, LENGTH]
    one, two = graph.sums[pairs[:, 0]], graph.sums[pairs[:, 1]]
    look_a, look_b = (sums / np.maximum(sums[:, PIXELS, None], 1) for sums in (one, two))
    depth = np.maximum((one[:, DEPTH] + two[:, DEPTH]) / np.maximum(one[:, PIXELS] + two[:, PIXELS], 1), 1e-9)
    colour = (look_b[:, LAB] - look_a[:, LAB]) ** 2 @ np.array([_LIGHTNESS, _HUE, _HUE])
    voxels = one[:, VOXELS], two[:, VOXELS]
    smaller, larger = (f(*voxels) * graph.surface.size**2 / depth**2 for f in (np.minimum, np.maximum))
    one_is_larger = voxels[0] > voxels[1]
    flat = [np.exp(-graph.extents[patch, 0] / (_FLAT * depth)) for patch in pairs.T]
    flat_of_larger = np.where(one_is_larger, *flat)
    columns = {
        # Means over the pixels of the common border
        "edge": np.log1p(border[:, EDGE] / length),  # of the gradient in Lab units, logarithm
        "sharp": border[:, SHARPS] / length,  # share of strong gradients: borders of things or print
        "step": border[:, STEPS] / length,  # of the depth, 1 = LARGEST_STEP
        "broken": border[:, BROKEN] / length,  # share of depth steps: another thing behind
        "concave_border": border[:, CONCAVE] / length,  # cosine-like: where a thing stands on another
        "convex_border": border[:, CONVEX] / length,  # cosine-like: an edge of one thing
        "learned": border[:, LEARNED] / length,  # log odds of the network of borders
        # Pairs of touching voxels
        "contact_share": border[:, CONTACT] / graph.contacts[pairs].min(axis=1),  # of all of the patch with fewer
        "contact": np.log(border[:, CONTACT] * graph.surface.size / depth) + 2,  # logarithm of their length
        # Looks of the two patches
        "colour": np.log1p(np.sqrt(colour)),  # distance of the mean colours in weighted Lab units, logarithm
        "histogram": 1 - np.minimum(look_a[:, COLOURS], look_b[:, COLOURS]).sum(axis=1),  # share of other colours
        "texture_difference": np.abs(look_a[:, TEXTURE] - look_b[:, TEXTURE]),  # of mean log gradients
        "texture": np.minimum(look_a[:, TEXTURE], look_b[:, TEXTURE]),  # mean log gradient of the plainer one
        "thing_difference": np.abs(look_a[:, THING] - look_b[:, THING]),  # of log odds: thing or floor, wall, table
        # Logarithms of the areas over squared depth; the offsets bring usual ones near 0
        "smaller_area": np.log(smaller) + 6,
        "larger_area": np.log(larger) + 2,
        **_plane_features(one, two, depth),
        **_shape_features(graph, pairs, one_is_larger, depth),
    }
    # Products: the larger patch is often a floor, wall or table, from which things rise at creases.
    columns["crease_of_flat"] = columns["concave_border"] * flat_of_larger
    columns["concave_of_flat"] = columns["concave"] * flat_of_larger
    columns["edge_in_plane"] = columns["same_plane"] * columns["sharp"]  # print, or a thin thing
    columns["flat_out_of_plane"] = flat_of_larger * (1 - columns["same_plane"])
    return np.stack([columns[name] for name in PAIR_FEATURES], axis=1)


def _plane_features(one: np.ndarray, two: np.ndarray, depth: np.ndarray) -> dict[str, np.ndarray]:
    """Each patch is approximated by the plane through its mean point with its mean normal.

    turn = 1 − cosine of the normals   offset = larger distance of a mean point from the other plane / depth
    bend = (normal_b − normal_a) · chord / |chord|, chord from a to b: > 0 convex, < 0 concave
    same_plane = exp(−offset / _PLANE_OFFSET − turn / _PLANE_TURN)
    """
    shape_a, shape_b = (sums / sums[:, VOXELS, None] for sums in (one, two))
    normals = (shape[:, NORMAL] for shape in (shape_a, shape_b))
    normal_a, normal_b = (n / (np.linalg.norm(n, axis=1, keepdims=True) + 1e-9) for n in normals)
    chord = shape_b[:, POINT] - shape_a[:, POINT]
    turn = np.minimum(1 - (normal_b * normal_a).sum(axis=1), 1.0)
    offset = np.maximum(*(np.abs((chord * normal).sum(axis=1)) for normal in (normal_a, normal_b))) / depth
    bend = ((normal_b - normal_a) * chord).sum(axis=1) / (np.linalg.norm(chord, axis=1) + 1e-9)
    same_plane = np.exp(-offset / _PLANE_OFFSET - turn / _PLANE_TURN)
    return {
        "turn": turn,
        "offset": np.minimum(offset, _FAR) / _FAR,
        "concave": np.maximum(-bend, 0),
        "convex": np.maximum(bend, 0),
        "same_plane": same_plane,
    }


def _shape_features(
    graph: SurfaceGraph, pairs: np.ndarray, one_is_larger: np.ndarray, depth: np.ndarray
) -> dict[str, np.ndarray]:
    """Extents (see `extents_of`) of the union of two patches against their own.

    distance: of the mean points, over the sum of the standard deviations of both patches along the line between them
    *_growth: logarithm of an extent of the union over that of the larger patch
    larger_*, smaller_*: logarithm of an extent of that patch over the depth
    volume_growth: logarithm of the product of the union's extents over the sum of both products
    """
    one, two = graph.sums[pairs[:, 0]], graph.sums[pairs[:, 1]]
    shape_a, shape_b, union = (sums / sums[:, VOXELS, None] for sums in (one, two, one + two))
    least = graph.surface.size * _LEAST_EXTENT
    chord = shape_b[:, POINT] - shape_a[:, POINT]
    distance = np.maximum(np.linalg.norm(chord, axis=1), least)
    chord = chord / distance[:, None]
    along = np.zeros(len(two))
    for shape in (shape_a, shape_b):
        along += np.sqrt(np.maximum(np.einsum("mi,mij,mj->m", chord, covariance(shape), chord), least**2))
    extents = graph.extents[pairs[:, 0]], graph.extents[pairs[:, 1]], extents_of(union)
    a, b, both = (np.maximum(extent, least) for extent in extents)
    larger, smaller = (np.where(choice[:, None], a, b) for choice in (one_is_larger, ~one_is_larger))
    columns = {"distance": distance / along}
    columns["volume_growth"] = np.log(both.prod(axis=1) / (a.prod(axis=1) + b.prod(axis=1)))
    for axis, name in enumerate(("thickness", "width", "length")):
        columns[f"{name}_growth"] = np.log(both / larger)[:, axis]
        columns[f"larger_{name}"] = np.log(larger / depth[:, None])[:, axis]
        columns[f"smaller_{name}"] = np.log(smaller / depth[:, None])[:, axis]
    return columns


def region_features(graph: SurfaceGraph, a: int, sibling: int | None) -> np.ndarray:
    """[19] for the decision whether region `a` is an object. sibling: the one that it would be merged with next."""
    sums, links = graph.sums[a], graph.borders[a]
    voxels, pixels, depth = sums[VOXELS], max(sums[PIXELS], 1), max(graph.depth(a), 1e-9)
    border = sum(links.values(), np.zeros(CONTACT + 1))  # of all its borders together
    border_means = border[EDGE:CONTACT] / max(border[LENGTH], 1)
    colours = sums[COLOURS] / pixels
    extents = np.maximum(graph.extents[a] / depth, 1e-3)
    next_size = next_contact = 0.0
    if sibling is not None:
        other = graph.size(sibling)
        next_size = np.log(other / voxels)
        next_contact = np.log1p(links[sibling][CONTACT]) - np.log(min(other, voxels)) / 2
    return np.array(
        [
            np.log(max(graph.area(a), 1e-7)),  # area, over squared depth
            *np.log(extents),  # thickness, width, length, over depth
            *border_means,  # edge, sharp, step, broken, concave, convex, learned, as those of pairs, but no logarithm
            np.log1p(border[CONTACT]) - np.log(voxels) / 2,  # contact, relative to √voxels, as a round patch has it
            len(links),  # neighbours
            sums[TEXTURE] / pixels,  # texture, mean log gradient
            sums[THING] / pixels,  # thing, mean log odds
            -(colours * np.log(colours + 1e-9)).sum(),  # colours, entropy of their histogram in nats
            next_size,  # logarithm of the sibling's voxels over its own
            next_contact,  # as contact, with the sibling alone, relative to the smaller one
            np.log(pixels / voxels),  # pixels for each voxel, logarithm: large where cameras were near
        ]
    )
