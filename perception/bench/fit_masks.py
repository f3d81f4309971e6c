"""Fits the built-in segmentation's weights: `python -m perception.bench.fit_masks SCENE… [--depth]`.

Pairs of regions are met while merging photos; each says whether both lie mostly on the same truth instance.
A logistic regression over them gives the log odds that `perception.masks.regions` merges by. With --depth the
scene's depth is used, disturbed as depth rendered from Gaussians is: blurred, waving, with holes.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from perception.bench.masks import read_image, views_with_truth
from perception.masks import regions
from perception.masks.cues import DepthCues, PhotoCues, depth_cues, photo_cues
from perception.masks.region_graph import DEPTH_FEATURES, PHOTO_FEATURES, RegionGraph

_COLOUR_FEATURES = (1, 2, 3, 4, 7)
_PURE = 0.7  # share of a region that one instance must cover for the region to teach anything


@dataclass
class Pairs:
    """features [F] each, whether the pair is one object, and its weight: the root of the smaller area."""

    features: list[np.ndarray] = field(default_factory=list)
    same: list[bool] = field(default_factory=list)
    weights: list[float] = field(default_factory=list)


@dataclass(frozen=True)
class Example:
    """One photo, ready to be merged. truth: [h, w] instance ids."""

    first: np.ndarray
    look: PhotoCues
    surface: DepthCues | None
    truth: np.ndarray


def disturbed(depth: np.ndarray, seed: int) -> np.ndarray:
    """depth [h, w] in any unit, as a map of Gaussians would render it: float32, 0 = none."""
    import cv2

    rng = np.random.default_rng(seed)
    noise = [cv2.GaussianBlur(rng.normal(size=depth.shape).astype(np.float32), (0, 0), s) for s in (3, 25)]
    rendered = cv2.GaussianBlur(depth.astype(np.float32), (0, 0), 1.2)
    rendered *= 1 + 0.004 * sum(part / part.std() for part in noise)
    rendered[(depth == 0) | (rng.random(depth.shape) < 0.01)] = 0
    return rendered


def example(scene: Path, photo: Path, truth: np.ndarray, with_depth: bool, seed: int) -> Example:
    """Reads a photo of a truth scene; its depth is `depth/STEM.png`, its camera in transforms.json."""
    look, surface = photo_cues(read_image(photo)), None
    if with_depth:
        depth = read_image(scene / "depth" / f"{photo.stem}.png")
        surface = depth_cues(disturbed(depth, seed), _intrinsics(scene))
    return Example(regions.first_regions(look, surface), look, surface, truth)


def collect(item: Example, weights: np.ndarray | None, pairs: Pairs) -> None:
    """Adds the pairs met while merging with `weights`; without, those of the first regions."""
    ids, truth = np.unique(item.truth, return_inverse=True)
    count = int(item.first.max()) + 1
    covered = np.zeros((count, len(ids)))
    np.add.at(covered, (item.first.ravel(), truth.ravel()), 1.0)

    def teach(graph: RegionGraph, a: int, others: list[int]) -> None:
        for b, features in zip(others, graph.features(a, others), strict=True):
            one, two = covered[a], covered[b]
            if min(one.max() / one.sum(), two.max() / two.sum()) >= _PURE:
                pairs.features.append(features)
                pairs.same.append(bool(one.argmax() == two.argmax()))
                pairs.weights.append(float(np.sqrt(min(one.sum(), two.sum()))))

    def watch(graph: RegionGraph, a: int, b: int) -> None:
        teach(graph, a, [b, *(c for c in list(graph.borders[a])[:6] if c != b)])
        covered[a] = covered[b] = covered[a] + covered[b]

    if weights is None:
        graph = RegionGraph(item.first, item.look, item.surface)
        for a, links in enumerate(graph.borders):
            if later := [b for b in links if b > a]:
                teach(graph, a, later)
    else:
        regions.merge_regions(item.first, item.look, item.surface, weights, 0.0, watch)


def fit(pairs: Pairs, without: tuple[int, ...] = ()) -> np.ndarray:
    """[F] log odds per unit of each feature; those `without` get none."""
    from sklearn.linear_model import LogisticRegression

    features = np.array(pairs.features)
    features[:, list(without)] = 0
    weights = np.array(pairs.weights) / np.mean(pairs.weights)
    model = LogisticRegression(C=1.0, fit_intercept=False, max_iter=2000)
    return model.fit(features, pairs.same, sample_weight=weights).coef_[0]


def _intrinsics(scene: Path) -> np.ndarray:
    import json

    camera = json.loads((scene / "transforms.json").read_text())
    return np.array([[camera["fl_x"], 0, camera["cx"]], [0, camera["fl_y"], camera["cy"]], [0, 0, 1]])


def main(arguments: list[str] | None = None) -> int:
    """Prints the weights, to be pasted into perception/masks/regions.py."""
    parser = argparse.ArgumentParser(prog="python -m perception.bench.fit_masks")
    parser.add_argument("scenes", nargs="+", type=Path, metavar="SCENE")
    parser.add_argument("--depth", action="store_true", help="fit the weights used when depth is known")
    parser.add_argument("--every", type=int, default=8, help="take every n-th photo")
    options = parser.parse_args(arguments)
    examples = []
    for scene in options.scenes:
        for seed, (view, truth) in enumerate(list(views_with_truth(scene))[:: options.every]):
            examples.append(example(scene, view.photo, truth, options.depth, seed))
    pairs, weights = Pairs(), None
    for _ in range(2):  # the first regions, then every level that merging them goes through
        for item in examples:
            collect(item, weights, pairs)
        weights = fit(pairs)
    assert weights is not None and len(weights) == (DEPTH_FEATURES if options.depth else PHOTO_FEATURES)
    print(f"{len(pairs.same)} pairs, {np.mean(pairs.same):.3f} of one object")
    print(np.array2string(weights, precision=2, separator=", ", suppress_small=True))
    if options.depth:
        shape_alone = fit(pairs, without=_COLOUR_FEATURES)
        print("shape alone:", np.array2string(shape_alone, precision=2, separator=", ", suppress_small=True))
    return 0


if __name__ == "__main__":
    sys.exit(main())
