"""Fits the built-in segmentation's weights: `python -m perception.bench.fit_masks SCENE… [--surface]`.

Pairs of regions are met while merging photos, or with --surface pairs of patches of the whole scene's surface; each
says whether both lie mostly on the same truth instance. A logistic regression over them gives the log odds that
`perception.masks.regions` and `perception.masks.scene` merge by. Of each scene it prints what the merging finds with
the weights fitted on all, and on the other scenes only: the second is what a new place may expect. Depth for --surface
is found by stereo as in a map; where it starts from is the scene's depth, spoilt as that of a half-trained map is.
"""

from __future__ import annotations

import argparse
import copy
import json
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from perception.bench.masks import read_image, views_with_truth
from perception.masks import regions, scene
from perception.masks.cues import photo_cues
from perception.masks.region_graph import RegionGraph, agglomerate
from perception.types import View

_PURE = 0.7  # share of a region that one instance must cover for the region to teach anything
_PRIOR = 0.1  # C of the regression: few scenes must not decide much
_HEAVIEST = 4.0  # times the mean weight: one wall must not outweigh a table full of things
_METRES = 1e-3  # a truth scene's depth/ is in millimetres, its poses are in metres
_ROUNDS = 2  # the first regions, then every level that merging them goes through


@dataclass
class Pairs:
    """features [F] each, whether the pair is one object, and its weight: the root of the smaller area."""

    features: list[np.ndarray] = field(default_factory=list)
    same: list[bool] = field(default_factory=list)
    weights: list[float] = field(default_factory=list)


@dataclass(frozen=True)
class Example:
    """A graph ready to be merged. covered: [R, I] how much of each region lies on each instance; smallest: see
    `agglomerate`."""

    graph: Any
    covered: np.ndarray
    smallest: float


def photo_example(photo: np.ndarray, truth: np.ndarray) -> Example:
    """photo: [h, w, 3] uint8; truth: [h, w] instance ids."""
    look = photo_cues(photo)
    first = regions.first_regions(look)
    return Example(RegionGraph(first, look), _covered([first], [truth]), regions.SMALLEST * truth.size)


def surface_example(folder: Path) -> Example:
    """The whole of a truth scene: photos, cameras, masks_gt/ and depth/ of equal stems."""
    sights, truths = [], []
    posed = posed_views(folder)
    for seed, (view, truth) in enumerate(views_with_truth(folder)):
        depth = spoilt_depth(folder, view.photo.stem, seed)
        sight = scene.make_sight(posed[view.name], read_image(view.photo), depth)
        if sight is not None:
            sights.append(sight)
            truths.append(_shrunk(truth, sight.depth.shape))
    scene.measure(sights)
    surface = scene.fuse(sights)
    graph = scene.surface_graph(sights, surface)
    voxels = [surface.voxel_of(sight.points(sight.cues()[1])) for sight in sights]
    patches = [np.where(voxel >= 0, graph.patch[voxel], -1) for voxel in voxels]
    return Example(graph, _covered(patches, truths), scene.SMALLEST)


def spoilt_depth(folder: Path, stem: str, seed: int) -> np.ndarray:
    """[h, w] float32 depth of a truth scene's photo in the unit of its poses, as a half-trained map renders it: waving
    by a few per cent, 0 = none."""
    import cv2

    depth = read_image(folder / "depth" / f"{stem}.png") * np.float32(_METRES)
    rng = np.random.default_rng(seed)
    noise = [cv2.GaussianBlur(rng.normal(size=depth.shape).astype(np.float32), (0, 0), s) for s in (5, 40)]
    rendered = cv2.GaussianBlur(depth, (0, 0), 2.0)
    rendered *= 1 + 0.04 * sum(part / part.std() for part in noise)
    rendered[(depth == 0) | (rng.random(depth.shape) < 0.01)] = 0
    return rendered


def posed_views(folder: Path) -> dict[str, View]:
    """The views of a scene's transforms.json by photo name."""
    about = json.loads((folder / "transforms.json").read_text(encoding="utf-8"))
    K = np.array([[about["fl_x"], 0, about["cx"]], [0, about["fl_y"], about["cy"]], [0, 0, 1]])
    views = {}
    for frame in about["frames"]:
        photo = folder / frame["file_path"]
        world_from_camera = np.array(frame["transform_matrix"]) @ np.diag([1.0, -1.0, -1.0, 1.0])
        size = int(about["w"]), int(about["h"])
        views[photo.name] = View(photo.name, photo, K, *size, np.linalg.inv(world_from_camera))
    return views


def collect(item: Example, weights: np.ndarray | None, pairs: Pairs) -> None:
    """Adds the pairs met while merging with `weights`; without, those of the first regions."""
    graph, covered = copy.deepcopy(item.graph), item.covered.copy()

    def teach(graph: Any, a: int, others: list[int]) -> None:
        for b, features in zip(others, graph.features(a, others), strict=True):
            one, two = covered[a], covered[b]
            total_one, total_two = one.sum(), two.sum()
            if min(total_one, total_two) > 0 and min(one.max() / total_one, two.max() / total_two) >= _PURE:
                pairs.features.append(features)
                pairs.same.append(bool(one.argmax() == two.argmax()))
                pairs.weights.append(float(np.sqrt(min(graph.size(a), graph.size(b)))))

    def watch(graph: Any, a: int, b: int) -> None:
        teach(graph, a, [b, *(c for c in list(graph.borders[a])[:6] if c != b)])
        covered[a] = covered[b] = covered[a] + covered[b]

    if weights is not None:
        agglomerate(graph, weights, 0.0, item.smallest, watch)
        return
    for a, links in enumerate(graph.borders):
        if later := [b for b in links if b > a]:
            teach(graph, a, later)


def fit(pairs: Pairs) -> np.ndarray:
    """[F] log odds per unit of each feature, of which the first is the constant 1."""
    from sklearn.linear_model import LogisticRegression

    features = np.array(pairs.features)
    mean, spread = features.mean(axis=0), features.std(axis=0) + 1e-9
    mean[0], spread[0] = 0, 1
    weights = np.minimum(np.array(pairs.weights) / np.mean(pairs.weights), _HEAVIEST)
    model = LogisticRegression(C=_PRIOR, max_iter=3000)
    model.fit((features - mean) / spread, pairs.same, sample_weight=weights)
    found = np.asarray(model.coef_[0] / spread)
    found[0] += model.intercept_[0] - found[1:] @ mean[1:]
    return found


def learn(examples: list[Example]) -> tuple[np.ndarray, Pairs]:
    """The weights, and the pairs they were fitted to."""
    pairs, weights = Pairs(), None
    for _ in range(_ROUNDS):
        for item in examples:
            collect(item, weights, pairs)
        weights = fit(pairs)
    assert weights is not None
    return weights, pairs


def found(item: Example, weights: np.ndarray, threshold: float) -> tuple[float, float, int]:
    """(recall, mean best IoU, segments) of the true instances: found are those with an IoU above one half."""
    ends = agglomerate(copy.deepcopy(item.graph), weights, threshold, item.smallest)
    names, segment = np.unique(ends, return_inverse=True)
    shared = np.zeros((len(names), item.covered.shape[1]))
    np.add.at(shared, segment, item.covered)
    area = item.covered.sum(axis=0)
    union = shared.sum(axis=1, keepdims=True) + area - shared
    best = (shared / np.maximum(union, 1)).max(axis=0)[area > 0]
    return float((best > 0.5).mean()), float(best.mean()), len(names)


def report(names: list[str], scenes: list[list[Example]], weights: np.ndarray, threshold: float) -> None:
    """Prints what is found in each scene with the weights of all, and with those of the others."""
    print(f"threshold {threshold}: recall at IoU .5, mean best IoU, segments")
    for place, (name, own) in enumerate(zip(names, scenes, strict=True)):
        others = [item for i, items in enumerate(scenes) if i != place for item in items]
        for title, w in [("fitted on all", weights), *([("on the others", learn(others)[0])] if others else [])]:
            recall, best, count = np.mean([found(item, w, threshold) for item in own], axis=0)
            print(f"{name:16} {title}: {recall:.3f} {best:.3f} {count:.0f}")


def _covered(images: list[np.ndarray], truths: list[np.ndarray]) -> np.ndarray:
    """[R, I] pixels of region r (−1 = none) on instance i."""
    counts = np.zeros((1 + max(int(i.max()) for i in images), 1 + max(int(t.max()) for t in truths)))
    for image, truth in zip(images, truths, strict=True):
        inside = image >= 0
        np.add.at(counts, (image[inside], truth[inside]), 1.0)
    return counts


def _shrunk(ids: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    import cv2

    return cv2.resize(ids.astype(np.int32), shape[::-1], interpolation=cv2.INTER_NEAREST)


def main(arguments: list[str] | None = None) -> int:
    """Prints the weights, to be pasted into perception/masks/regions.py or scene.py."""
    parser = argparse.ArgumentParser(prog="python -m perception.bench.fit_masks")
    parser.add_argument("scenes", nargs="+", type=Path, metavar="SCENE")
    parser.add_argument("--surface", action="store_true", help="fit the weights of the surface's patches")
    parser.add_argument("--every", type=int, default=8, help="take every n-th photo (without --surface)")
    options = parser.parse_args(arguments)
    scenes = []
    for folder in options.scenes:
        if options.surface:
            scenes.append([surface_example(folder)])
        else:
            views = list(views_with_truth(folder))[:: options.every]
            scenes.append([photo_example(read_image(view.photo), truth) for view, truth in views])
    weights, pairs = learn([item for items in scenes for item in items])
    print(f"{len(pairs.same)} pairs, {np.mean(pairs.same):.3f} of one object")
    print(np.array2string(weights, precision=2, separator=", ", suppress_small=True))
    threshold = scene.THRESHOLD if options.surface else regions.PHOTO_THRESHOLD
    report([folder.name for folder in options.scenes], scenes, weights, threshold)
    return 0


if __name__ == "__main__":
    sys.exit(main())
